"""A node whose id is given to it over the bus by layer setting services (CiA 305)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from canopen import ObjectDictionary

from handtouch.canbus.find.lss import LssAddress, LssSlave
from handtouch.canbus.objects.eds_file import raw_value

from .node import Device
from .unit import IDENTITY, Unit

if TYPE_CHECKING:
    from .bus import DeviceBus


class Unnamed:
    """Made by `DeviceBus.add_unconfigured`; without an id it answers LSS requests only.

    `lss` is its LSS slave; `device` the node that it is under its id, None while it has none.
    """

    def __init__(self, bus: DeviceBus, row: int, unit: Unit) -> None:
        self.lss = LssSlave(_address(unit, unit.dictionary(1)))
        self.device: Device | None = None
        self.plugged = False
        self._bus, self._row, self._unit = bus, row, unit

    def plug(self) -> None:
        """Power on: with the id that it has stored, if any."""
        with self._bus.lock:
            if not self.plugged:
                self.plugged = True
                self.lss.power_on()
                self._settle()

    def unplug(self) -> None:
        """Power off: an id that it hasn't stored is forgotten."""
        with self._bus.lock:
            self.plugged = False
            self._leave()

    # What `DeviceBus` calls, under its lock.

    def on_request(self, data: bytes) -> bytes | None:
        """An LSS request; returns the answer, if there is one."""
        if not self.plugged:
            return None
        answer = self.lss.handle(data)
        self._settle()
        return answer

    def on_reset(self, node_id: int) -> None:
        """NMT reset of a node id, 0 for all: another id takes effect."""
        if self.device is not None and node_id in (0, self.device.node_id):
            self.lss.reset()
            self._settle()

    def _settle(self) -> None:
        """Be the node of the id that it has now."""
        if self.device is not None and self.device.node_id == self.lss.node_id:
            return
        self._leave()
        if self.lss.node_id is not None:
            self.device = Device(self._bus, self._row, self.lss.node_id, self._unit)
            self._bus.join(self.device)
            self.device.plug()

    def _leave(self) -> None:
        if self.device is not None:
            self.device.unplug()
            self._bus.leave(self.device)
            self.device = None


def _address(unit: Unit, dictionary: ObjectDictionary) -> LssAddress:
    """Its identity, 0x1018, as LSS asks for it."""
    listed = [raw_value(dictionary, IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)]
    told = (unit.vendor_id, unit.product_code, None, unit.serial)
    return LssAddress(*(eds if own is None else own for own, eds in zip(told, listed, strict=True)))
