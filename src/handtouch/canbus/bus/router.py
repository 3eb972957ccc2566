"""Routing of received frames: samples are written to the slab, other frames are returned to the caller.

A live bus and a replayed log feed the same `Router`. Public names: `Router`, `BusCounters`, `CanFrame`,
`IDENTIFIER_COUNT`, `NO_SLOT`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import can
import numpy as np

from handtouch.canbus import cia301
from handtouch.canbus.bus.bus_state import BusState
from handtouch.canbus.bus.load import frame_bits
from handtouch.core.slab import MAX_PDOS, PDO_BYTES, Slab
from handtouch.core.stages.receive import ROUTE_WORDS, FrameBatch

IDENTIFIER_COUNT = 2048
"""Number of 11-bit identifiers."""
NO_SLOT = -1
_GUARDING_IDS = range(cia301.NMT_ERROR_CONTROL + 1, cia301.NMT_ERROR_CONTROL + 128)

CanFrame = tuple[int, bytes, int]
"""Identifier, data, arrival in ns of the host's monotonic clock."""

_FRAME_BITS = tuple(frame_bits(size) for size in range(9))
_BITS_PER_BYTE = _FRAME_BITS[1] - _FRAME_BITS[0]


@dataclass(slots=True)
class BusCounters:
    """Counters of one bus since it was opened; they only grow."""

    frames: int = 0  # received data frames with an 11-bit identifier
    sent: int = 0
    bits: int = 0  # bits received and sent, with worst-case bit stuffing; their rate is the bus load
    samples: int = 0  # PDOs that carry channels
    wrong_length: int = 0  # known identifier, wrong length: dropped
    unknown_frames: int = 0  # unknown identifier, or a kind of frame that CANopen doesn't use: dropped
    error_frames: int = 0
    send_failures: int = 0  # other than those of a full queue
    queue_full: int = 0  # frames not sent because the transmit queue had no room
    receive_failures: int = 0
    overflow: int = 0  # received frames lost in the kernel's queue or in the receiver's


class _ShortFrames(NamedTuple):
    """Frames too short for a slot: size of the last, that of the mapping, arrival of the last sample."""

    frames: int = 0
    size: int = 0
    expected: int = 0
    sample_ns: int = 0


_NO_SHORT_FRAMES = _ShortFrames()


class Router:
    """Accepts frames one by one and writes those with a route to the slab."""

    def __init__(self, slab: Slab, bus_state: BusState | None = None) -> None:
        self.slab = slab
        self.counters = BusCounters()
        self.bus_state = BusState() if bus_state is None else bus_state
        self._routes: list[tuple[int, int, int] | None] = [None] * IDENTIFIER_COUNT  # slot, PDO, size
        self._short: dict[int, _ShortFrames] = {}
        self._write = slab.write_pdo
        routes = np.full((IDENTIFIER_COUNT, ROUTE_WORDS), NO_SLOT, dtype=np.int64)
        self._route_words = routes.reshape(-1).data  # the same routes for batches

    def route(self, can_id: int, slot: int, pdo: int = 0, size: int = PDO_BYTES) -> None:
        """Write frames with this identifier and `size` bytes to the slab as PDO number `pdo` of a slot.

        NO_SLOT removes the route. Raises ValueError for an identifier beyond 11 bits or a slot or PDO beyond
        the slab.
        """
        if not 0 <= can_id < IDENTIFIER_COUNT:
            raise ValueError(f"identifier 0x{can_id:X} has more than 11 bits")
        if not NO_SLOT <= slot < self.slab.size:
            raise ValueError(f"slot {slot} is outside the slab of {self.slab.size}")
        if not 0 <= pdo < MAX_PDOS or not 0 < size <= PDO_BYTES:
            raise ValueError(
                f"PDO {pdo} of {size} bytes is outside 0 to {MAX_PDOS - 1} of 1 to {PDO_BYTES} bytes"
            )
        self._routes[can_id] = None if slot == NO_SLOT else (slot, pdo, size)
        self._route_words[ROUTE_WORDS * can_id] = slot
        self._route_words[ROUTE_WORDS * can_id + 1] = size

    def get_slot(self, can_id: int) -> int:
        """Return the slot that frames with this identifier are written to, NO_SLOT without a route."""
        route = self._routes[can_id]
        return NO_SLOT if route is None else route[0]

    def accept_frame(self, can_id: int, data: bytes | bytearray, arrival_ns: int) -> bool:
        """Accept a data frame with an 11-bit identifier and at most 8 bytes; return False if it isn't a
        sample.

        A sample longer than the node's mapping counts by its first bytes (CiA 301, 7.5.2.36); a shorter one
        is counted and dropped.
        """
        counters = self.counters
        size = len(data)
        counters.frames += 1
        counters.bits += _FRAME_BITS[size]
        route = self._routes[can_id]
        if route is None:
            return False
        slot, pdo, expected = route
        if size >= expected:
            self._write(slot, data, arrival_ns, pdo)
            counters.samples += 1
        else:
            counters.wrong_length += 1
            sample_ns = int(self.slab.arrival_ns[slot])
            count = self.get_short_frames(slot).frames + 1
            self._short[slot] = _ShortFrames(count, size, expected, sample_ns)
        return True

    def get_short_frames(self, slot: int) -> _ShortFrames:
        """Return the frames too short for a slot since its last sample."""
        short = self._short.get(slot, _NO_SHORT_FRAMES)
        return short if short.sample_ns == self.slab.arrival_ns[slot] else _NO_SHORT_FRAMES

    def accept_samples(self, batch: FrameBatch, first: int, count: int) -> int:
        """Accept the samples of a batch of `count` frames from frame `first` to the next that is no sample.

        Return that frame's number, `count` without one. `accept_frame` takes it, and samples of several PDOs.
        """
        end, stored_bytes = self.slab.store_samples(batch, self._route_words, first, count)
        counters = self.counters
        counters.frames += end - first
        counters.samples += end - first
        counters.bits += (end - first) * _FRAME_BITS[0] + _BITS_PER_BYTE * stored_bytes
        return end

    def handle_error_frame(self, can_id: int, data: bytes | bytearray, arrival_ns: int) -> None:
        """Count an error frame, whose error classes are in the identifier, and update the bus state."""
        counters = self.counters
        counters.error_frames += 1
        self.bus_state.handle_error_frame(can_id, data, arrival_ns, counters.frames, counters.sent)

    def handle_remote_frame(self, can_id: int) -> None:
        """Count a remote frame: a node-guarding request (our own echo on some buses), or an unknown frame."""
        counters = self.counters
        if can_id in _GUARDING_IDS:
            counters.frames += 1
            counters.bits += _FRAME_BITS[0]
        else:
            counters.unknown_frames += 1

    def accept_message(self, message: can.Message, arrival_ns: int) -> CanFrame | None:
        """Accept any frame of python-can; return it if it is neither stored nor dropped here."""
        can_id = message.arbitration_id
        if message.is_error_frame:
            self.handle_error_frame(can_id, message.data, arrival_ns)
        elif message.is_remote_frame and not message.is_extended_id:
            self.handle_remote_frame(can_id)
        elif (
            message.is_extended_id
            or message.is_fd
            or len(message.data) > 8
            or not 0 <= can_id < IDENTIFIER_COUNT
        ):
            self.counters.unknown_frames += 1
        elif not self.accept_frame(can_id, message.data, arrival_ns):
            return can_id, bytes(message.data), arrival_ns
        return None
