"""LSS slave (CiA 305) of a node."""

from __future__ import annotations

import struct
from collections.abc import Callable

from handtouch.canbus import cia305
from handtouch.canbus.cia305 import LssAddress

StoreId = Callable[[int | None], bool]
"""Stores a node id, None for none, in permanent memory; returns False on failure."""

_UNCOMPARED = {cia305.FAST_SCAN: cia305.IS_SLAVE, cia305.SELECT[-1]: cia305.SELECTED}


class LssSlave:
    """State machine of CiA 305: requests in, responses out.

    `node_id` : the id in use, None before it has one
    `stored_id` : the id after the next `power_on`
    `can_store` : False for a node that can't store its id
    `store` : stores the id beyond this process
    `compares` : False for a node that in the configuration state responds to every fast scan and every
    selection whatever its data, as several stacks do
    `rejected` : number of malformed requests
    """

    def __init__(
        self,
        address: LssAddress,
        node_id: int | None = None,
        *,
        can_store: bool = True,
        compares: bool = True,
        store: StoreId = lambda _: True,
    ) -> None:
        self.address = address
        self.stored_id = node_id
        self.can_store = can_store
        self.compares = compares
        self._store = store
        self.rejected = 0
        self.power_on()

    def power_on(self) -> None:
        """Start with the stored id, in the waiting state."""
        self.node_id = self._pending_id = self.stored_id
        self.configuring = False
        self._scan_part = 0
        self._selecting: list[int] = []
        self._identifying: list[int] = []

    def reset(self) -> None:
        """Use a newly configured id from now on, at an NMT reset communication."""
        self.node_id = self._pending_id

    def handle_request(self, data: bytes) -> bytes | None:
        """Return the response to a request (a frame on 0x7E5), None if there is none."""
        if len(data) != 8:
            self.rejected += 1
            return None
        command = data[0]
        if command == cia305.SWITCH_GLOBAL:
            self._switch(data[1])
        elif self.configuring and not self.compares and command in _UNCOMPARED:
            return struct.pack("<B7x", _UNCOMPARED[command])
        elif command in cia305.SELECT:
            return self._select(command, data)
        elif command in cia305.IDENTIFY:
            return self._identify(command, data)
        elif command == cia305.IDENTIFY_UNCONFIGURED:
            return struct.pack("<B7x", cia305.IS_UNCONFIGURED) if self._is_unconfigured else None
        elif command == cia305.FAST_SCAN:
            return self._fast_scan(data) if self._is_unconfigured and not self.configuring else None
        elif self.configuring:
            return self._configure(command, data)
        return None

    @property
    def _is_unconfigured(self) -> bool:
        return self.node_id is None and self._pending_id is None

    def _switch(self, state: int) -> None:
        if state not in (cia305.WAITING_STATE, cia305.CONFIGURATION_STATE):
            self.rejected += 1
            return
        self.configuring = state == cia305.CONFIGURATION_STATE
        if not self.configuring and self.node_id is None:
            self.node_id = (
                self._pending_id
            )  # CiA 305: a first id is used at once, a changed one after a reset

    def _select(self, command: int, data: bytes) -> bytes | None:
        """Handle one of the four requests that select a node; it responds to the last."""
        if not self._collect_sequence(self._selecting, command - cia305.SELECT[0], data, len(cia305.SELECT)):
            return None
        if self.configuring or tuple(self._selecting) != self.address.parts:
            return None
        self.configuring = True
        return struct.pack("<B7x", cia305.SELECTED)

    def _identify(self, command: int, data: bytes) -> bytes | None:
        """Handle one of six requests: vendor, product, and ranges of revision and serial number."""
        if not self._collect_sequence(
            self._identifying, command - cia305.IDENTIFY[0], data, len(cia305.IDENTIFY)
        ):
            return None
        vendor_id, product_code, *ranges = self._identifying
        own = self.address
        fits = (vendor_id, product_code) == (own.vendor_id, own.product_code)
        fits = fits and ranges[0] <= own.revision <= ranges[1] and ranges[2] <= own.serial <= ranges[3]
        return struct.pack("<B7x", cia305.IS_SLAVE) if fits else None

    @staticmethod
    def _collect_sequence(values: list[int], number: int, data: bytes, count: int) -> bool:
        """Append the value of a request in the right order; return True if the sequence is complete."""
        del values[number:]
        if len(values) == number:
            values.append(int.from_bytes(data[1:5], "little"))
        return len(values) == count

    def _fast_scan(self, data: bytes) -> bytes | None:
        _, value, bit, sub, following = struct.unpack("<BIBBB", data)
        if bit == cia305.CONFIRM_BIT:
            self._scan_part = 0
            return struct.pack("<B7x", cia305.IS_SLAVE)
        if bit > 31 or sub > 3 or following > 3:
            self.rejected += 1
            return None
        if sub != self._scan_part or (value ^ self.address.parts[sub]) >> bit:
            return None
        if bit == 0:
            self._scan_part = following
            self.configuring = following < sub
        return struct.pack("<B7x", cia305.IS_SLAVE)

    def _configure(self, command: int, data: bytes) -> bytes | None:
        """Return the response to a request of the configuration state."""
        if command in cia305.INQUIRE:
            return struct.pack("<BI3x", command, self.address.parts[command - cia305.INQUIRE[0]])
        if command == cia305.INQUIRE_ID:
            return struct.pack("<BB6x", command, self.node_id or cia305.UNCONFIGURED)
        if command == cia305.CONFIGURE_ID:
            good = 1 <= data[1] <= 127 or data[1] == cia305.UNCONFIGURED
            if good:
                self._pending_id = None if data[1] == cia305.UNCONFIGURED else data[1]
            return struct.pack("<BB6x", command, not good)
        if command == cia305.BIT_TIMING:
            return struct.pack("<BB6x", command, 1)
        if command == cia305.STORE:
            stored = self.can_store and self._store(self._pending_id)
            if stored:
                self.stored_id = self._pending_id
            return struct.pack("<BB6x", command, not stored)
        return None
