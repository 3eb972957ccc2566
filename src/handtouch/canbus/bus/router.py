"""Where a frame goes: samples straight into the slab, everything else to whoever asked; counts of both.

A live bus and a replayed log feed the same `Router`.
"""

from __future__ import annotations

from dataclasses import dataclass

import can

from .bus_state import BusState
from .load import frame_bits
from .slab import PDO_BYTES, PDOS, Slab

IDENTIFIERS = 2048
"""CANopen uses 11-bit identifiers."""
SYNC_ID = 0x80
NOBODY = -1
_GUARDING = range(0x701, 0x780)

Frame = tuple[int, bytes, int]
"""Identifier, data, arrival in ns of the host's monotonic clock."""

_FRAME_BITS = tuple(frame_bits(size) for size in range(9))


@dataclass(slots=True)
class Counters:
    """What one bus has carried since it was opened; all only grow."""

    frames: int = 0  # data frames with an 11-bit identifier that were received
    sent: int = 0
    bits: int = 0  # of received and sent frames, worst case of bit stuffing: their rate is the bus load
    samples: int = 0  # PDOs that carry channels
    short: int = 0  # of a known identifier but the wrong length: dropped
    foreign: int = 0  # of nobody that we know, or of a kind that CANopen doesn't use: dropped
    errors: int = 0  # error frames
    send_failures: int = 0  # other than those of a full queue
    queue_full: int = 0  # frames not sent because the transmit queue had no room
    receive_failures: int = 0
    overflow: int = 0  # frames lost between the controller and us, in the kernel's queue or our own


class Router:
    """Takes frames one by one; writes the routed ones into the slab."""

    def __init__(self, slab: Slab) -> None:
        self.slab = slab
        self.counters = Counters()
        self.state = BusState()
        self._routes: list[tuple[int, int, int] | None] = [None] * IDENTIFIERS  # slot, PDO, size
        self._write = slab.write

    def route(self, can_id: int, slot: int, pdo: int = 0, size: int = PDO_BYTES) -> None:
        """Frames with this identifier, of `size` bytes, are that PDO of a slot of the slab.

        NOBODY for the slot takes the route away. Raises ValueError for an identifier beyond 11 bits or a slot
        or PDO beyond the slab.
        """
        if not 0 <= can_id < IDENTIFIERS:
            raise ValueError(f"identifier 0x{can_id:X} has more than 11 bits")
        if not NOBODY <= slot < self.slab.size:
            raise ValueError(f"slot {slot} is outside the slab of {self.slab.size}")
        if not 0 <= pdo < PDOS or not 0 < size <= PDO_BYTES:
            raise ValueError(
                f"PDO {pdo} of {size} bytes is outside 0 to {PDOS - 1} of 1 to {PDO_BYTES} bytes"
            )
        self._routes[can_id] = None if slot == NOBODY else (slot, pdo, size)

    def slot(self, can_id: int) -> int:
        """Slot that frames with this identifier are written to, NOBODY without a route."""
        route = self._routes[can_id]
        return NOBODY if route is None else route[0]

    def accept(self, can_id: int, data: bytes | bytearray, t_ns: int) -> bool:
        """Take a data frame with an 11-bit identifier and at most 8 bytes; False if it isn't a sample.

        A sample of the wrong length is counted and dropped.
        """
        counters = self.counters
        size = len(data)
        counters.frames += 1
        counters.bits += _FRAME_BITS[size]
        route = self._routes[can_id]
        if route is None:
            return False
        slot, pdo, expected = route
        if size == expected:
            self._write(slot, data, t_ns, pdo)
            counters.samples += 1
        else:
            counters.short += 1
        return True

    def error(self, can_id: int, data: bytes | bytearray, t_ns: int) -> None:
        """Take an error frame, its classes in the identifier."""
        counters = self.counters
        counters.errors += 1
        self.state.error_frame(can_id, data, t_ns, counters.frames, counters.sent)

    def remote(self, can_id: int) -> None:
        """Take a remote frame: somebody guards a node (ours come back on some buses), or it is foreign."""
        counters = self.counters
        if can_id in _GUARDING:
            counters.frames += 1
            counters.bits += _FRAME_BITS[0]
        else:
            counters.foreign += 1

    def accept_message(self, message: can.Message, t_ns: int) -> Frame | None:
        """Take any frame as python-can gives it; what isn't ours to store or to drop is returned."""
        can_id = message.arbitration_id
        if message.is_error_frame:
            self.error(can_id, message.data, t_ns)
        elif message.is_remote_frame and not message.is_extended_id:
            self.remote(can_id)
        elif (
            message.is_extended_id or message.is_fd or len(message.data) > 8 or not 0 <= can_id < IDENTIFIERS
        ):
            self.counters.foreign += 1
        elif not self.accept(can_id, message.data, t_ns):
            return can_id, bytes(message.data), t_ns
        return None
