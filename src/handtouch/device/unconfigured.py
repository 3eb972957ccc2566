"""A node that gets its id over the bus by layer setting services (CiA 305)."""

from __future__ import annotations

from typing import Protocol

from canopen import ObjectDictionary

from handtouch.canbus import cia301
from handtouch.canbus.cia305 import LssAddress
from handtouch.config.eds_file import raw_value
from handtouch.device.lss import LssSlave, StoreId
from handtouch.device.node import Device
from handtouch.device.scheduler import DeviceHost
from handtouch.device.spec import DeviceSpec


class DeviceRegistry(DeviceHost, Protocol):
    """Bus that devices can join and leave."""

    def join(self, device: Device) -> None: ...

    def leave(self, device: Device) -> None: ...


class UnconfiguredDevice:
    """A node with an LSS slave; without an id it responds to LSS requests only. `DeviceBus` makes it.

    `node_id` : id stored in it, None for none; `store` : stores another one beyond this process
    `lss` is its LSS slave, `device` the node with its present id, None while it has none.
    """

    def __init__(
        self,
        bus: DeviceRegistry,
        row: int,
        spec: DeviceSpec,
        *,
        lss_compares: bool = True,
        node_id: int | None = None,
        store: StoreId = lambda _: True,
    ) -> None:
        address = _lss_address(spec, spec.load_dictionary(1))
        self.lss = LssSlave(address, node_id, compares=lss_compares, store=store)
        self.device: Device | None = None
        self.plugged = False
        self._bus, self._row, self._spec = bus, row, spec

    def plug(self) -> None:
        """Power on with the stored id, if any."""
        with self._bus.lock:
            if not self.plugged:
                self.plugged = True
                self.lss.power_on()
                self._update_device()

    def unplug(self) -> None:
        """Power off; an id that isn't stored is lost."""
        with self._bus.lock:
            self.plugged = False
            self._remove_device()

    # Called by `DeviceBus` under its lock.

    def handle_lss(self, data: bytes) -> bytes | None:
        """Handle an LSS request; return the response, None if there is none."""
        if not self.plugged:
            return None
        answer = self.lss.handle_request(data)
        self._update_device()
        return answer

    def handle_reset(self, node_id: int) -> None:
        """Handle an NMT reset of a node id, 0 for all: a changed id takes effect."""
        if self.device is not None and node_id in (0, self.device.node_id):
            self.lss.reset()
            self._update_device()

    def _update_device(self) -> None:
        """Replace the device after a change of the id."""
        if self.device is not None and self.device.node_id == self.lss.node_id:
            return
        self._remove_device()
        if self.lss.node_id is not None:
            self.device = Device(self._bus, self._row, self.lss.node_id, self._spec)
            self._bus.join(self.device)
            self.device.plug()

    def _remove_device(self) -> None:
        if self.device is not None:
            self.device.unplug()
            self._bus.leave(self.device)
            self.device = None


def _lss_address(spec: DeviceSpec, dictionary: ObjectDictionary) -> LssAddress:
    """Return the LSS address: the identity of the spec, completed by that of the EDS."""
    defaults = [raw_value(dictionary, cia301.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)]
    own = (spec.vendor_id, spec.product_code, None, spec.serial)
    return LssAddress(*(eds if value is None else value for value, eds in zip(own, defaults, strict=True)))
