"""The slab: the latest sample of every pad, written straight from the bus and unpacked once a tick.

A PDO's data is a little-endian word of 64 bits and a channel a bit field of one such word, so that samples of
any width and mapping are stored as received and unpacked for the whole hand at once.

Public names: `Slab`, `CountSlab`, `Cycle`, `ChannelField`, `ChannelLayout`, `STANDARD_LAYOUT`, `MAX_PDOS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.config.channels import integer_limits, saturation_limits
from handtouch.core.memory import view_memory
from handtouch.core.stages import receive

MAX_PDOS = receive.WORDS_OF_SLOT
"""Most PDOs that the channels of a pad may be spread over."""
PDO_BYTES = 8
_SAMPLE_BYTES = MAX_PDOS * PDO_BYTES


@dataclass(frozen=True, slots=True)
class ChannelField:
    """Bit field of a channel: number of its PDO among those of its pad, first bit, and type.

    `counts_per_unit` : of a REAL32 field, None for an integer; `max_count`: None: that of its type
    """

    pdo: int
    first_bit: int
    bits: int
    signed: bool
    counts_per_unit: float | None = None
    max_count: int | None = None

    @property
    def limits(self) -> tuple[int, int]:
        """Lowest and highest count of the channel."""
        return integer_limits(self.bits, self.signed, self.max_count)


ChannelLayout = tuple[ChannelField, ...]
"""Fields of a pad's electrodes, in their order."""

STANDARD_LAYOUT: ChannelLayout = (
    ChannelField(0, 0, 16, True),
    ChannelField(0, 16, 16, True),
    ChannelField(0, 32, 16, True),
    ChannelField(0, 48, 16, True),
)
"""Four int16 in one PDO (CiA 401: object 0x6401 sub 1 to 4)."""


class Slab:
    """Latest complete sample of each of `size` pads, as arrays in memory that the receive path writes.

    channels: number of columns; columns: of each slot, those of its channels, by default the first. What a
    slot lacks counts 0, and is at no limit.

    `arrival_ns` (size,) int64 arrival of its last PDO on the host's monotonic clock, 0 before the first;
    `fresh` (size,) uint8, 1 if it arrived since `begin_cycle`; `repeat_counts` (size,) int64, samples that
    replaced a fresh one; `contrary_counts` (size,) int64, cycles that ended with PDOs of two contents.
    """

    def __init__(self, size: int, channels: int = 4, columns: Sequence[Sequence[int]] | None = None) -> None:
        self.size, self.channels = size, channels
        self._columns = columns or [range(channels)] * size
        self.arrival_ns: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self.repeat_counts: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self.contrary_counts: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self.fresh_count = 0
        self._bytes = bytearray(size * _SAMPLE_BYTES)
        self._words: NDArray[np.int64] = np.frombuffer(self._bytes, dtype="<i8")
        # memoryviews: no boxing of numpy scalars, which costs 50 ns
        self._arrival_ns, self._repeat_counts = self.arrival_ns.data, self.repeat_counts.data
        self._fresh = bytearray(size)
        self.fresh: NDArray[np.uint8] = np.frombuffer(self._fresh, dtype=np.uint8)
        self._single = bytearray(size)  # 1 where a sample is one PDO
        self._contrary = bytearray(size)  # 1 where PDOs of two contents arrived in this cycle
        self._partial_samples: dict[
            int, _PartialSample | _ScheduledSample
        ] = {}  # unfinished samples of pads with several PDOs
        self._fields = np.zeros((size, channels, receive.FIELD_WORDS), dtype=np.int64)
        self._counts_per_unit = np.zeros((size, channels))  # scale of REAL32 fields, 0 for integers
        self._is_real: NDArray[np.bool_] | None = None
        self._low_limits = np.zeros((size, channels), dtype=np.int64)
        self._high_limits = np.zeros((size, channels), dtype=np.int64)
        self._counts = np.zeros((size, channels), dtype=np.int64)
        self.memory = receive.SampleMemory(
            {
                "words": self._words.data,
                "arrival_ns": self._arrival_ns,
                "repeat_counts": self._repeat_counts,
                "contrary_counts": self.contrary_counts.data,
                "fresh": memoryview(self._fresh),
                "single": memoryview(self._single),
                "contrary": memoryview(self._contrary),
                "counts": view_memory(self._counts),
                "fields": view_memory(self._fields),
                "low_limits": view_memory(self._low_limits),
                "high_limits": view_memory(self._high_limits),
            }
        )
        """the same memory as the stages take it"""
        for slot in range(size):
            self.set_layout(slot, STANDARD_LAYOUT[:channels])

    def set_layout(self, slot: int, layout: ChannelLayout, scheduled: bool = False) -> None:
        """Set the channel fields of a slot, STANDARD_LAYOUT by default; its present sample is discarded.

        scheduled: each of its PDOs is a state of a schedule, one in each cycle; a sample is the last of each,
        if they are those of consecutive cycles.

        Channels beyond the slot's columns belong to a sample, but aren't unpacked.
        """
        self._fields[slot] = 0
        self._fields[slot, :, 0] = slot * MAX_PDOS
        self._counts_per_unit[slot] = 0.0
        self._low_limits[slot], self._high_limits[slot] = -1, 1
        for channel, field in zip(self._columns[slot], layout, strict=False):
            sign = 1 << field.bits - 1 if field.signed else 0
            word = slot * MAX_PDOS + field.pdo
            self._fields[slot, channel] = word, field.first_bit, (1 << field.bits) - 1, sign
            self._counts_per_unit[slot, channel] = field.counts_per_unit or 0.0
            low, high = saturation_limits(field.limits, field.signed)
            self._low_limits[slot, channel] = low if field.signed else -1
            self._high_limits[slot, channel] = high
        pdos = frozenset(field.pdo for field in layout)
        self._single[slot] = pdos == {0}
        self._partial_samples.pop(slot, None)
        if not self._single[slot]:
            kind = _ScheduledSample if scheduled else _PartialSample
            self._partial_samples[slot] = kind(pdos)
        self._bytes[slot * _SAMPLE_BYTES : (slot + 1) * _SAMPLE_BYTES] = bytes(_SAMPLE_BYTES)
        is_real = self._counts_per_unit > 0
        self._is_real = is_real if is_real.any() else None

    def write_pdo(self, slot: int, data: bytes | bytearray, arrival_ns: int, pdo: int = 0) -> None:
        """Store a PDO of a slot, at most 8 bytes; `pdo` as numbered by the slot's layout.

        A sample counts when all its PDOs have arrived; a second one within a cycle replaces the first. One of
        several PDOs is dropped if the previous SYNC brought fewer than all: the missing ones may arrive now.
        """
        if self._single[slot]:
            place = slice(slot * _SAMPLE_BYTES, slot * _SAMPLE_BYTES + PDO_BYTES)
            data = data.ljust(PDO_BYTES, b"\0")
            if self._fresh[slot] and self._bytes[place] != data:
                self._contrary[slot] = 1
            self._bytes[place] = data
        else:
            parts = self._partial_samples[slot]
            if parts.contradicts(pdo, data):
                self._contrary[slot] = 1
            if not parts.add_pdo(pdo, data, arrival_ns):
                return
            self._bytes[slot * _SAMPLE_BYTES : (slot + 1) * _SAMPLE_BYTES] = parts.data
        self._arrival_ns[slot] = arrival_ns
        if self._fresh[slot]:
            self._repeat_counts[slot] += 1
        else:
            self._fresh[slot] = 1
            self.fresh_count += 1

    def store_samples(
        self, batch: receive.FrameBatch, routes: memoryview[int], first: int, count: int
    ) -> tuple[int, int]:
        """Store the samples of a batch of `count` frames from frame `first` to the next that is no sample.

        Return that frame's number, and the bytes stored; see `handtouch.core.stages.receive`.
        """
        end = receive.store_samples(self.memory, batch, routes, first, count)
        self.fresh_count += self.memory.new_fresh
        return end, self.memory.stored_bytes

    def unpack_counts(self) -> NDArray[np.int64]:
        """Return counts (size, channels) of the electrodes; the array is reused by the next call."""
        receive.unpack_counts(self.memory)
        if self._is_real is not None:
            self._convert_real(self._counts, self._is_real)
        return self._counts

    def _convert_real(self, counts: NDArray[np.int64], is_real: NDArray[np.bool_]) -> None:
        """Convert the bits of REAL32 fields to counts; NaN becomes the lower limit, which is saturated."""
        low, high = self._low_limits[is_real], self._high_limits[is_real]
        with np.errstate(invalid="ignore"):  # signalling NaN
            values = counts[is_real].astype(np.int32).view(np.float32).astype(np.float64)
            rounded = np.rint(values * self._counts_per_unit[is_real])
        counts[is_real] = np.where(np.isnan(rounded), low, np.clip(rounded, low, high))

    def saturated(self, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which of the counts (size, channels) are at a limit of their channel's range."""
        return (counts >= self._high_limits) | (counts <= self._low_limits)

    @property
    def limits(self) -> NDArray[np.int64]:
        """Counts (size, 2 channels) at the bottom, then at the top of the channels' ranges."""
        return np.hstack([self._low_limits, self._high_limits])

    def begin_cycle(self, sync_ns: int) -> None:
        """Begin a cycle at a SYNC: samples that arrived since then are fresh, even if before this call."""
        for slot, parts in self._partial_samples.items():
            if parts.begin_cycle(sync_ns):
                self._bytes[slot * _SAMPLE_BYTES : (slot + 1) * _SAMPLE_BYTES] = parts.data
                self._arrival_ns[slot] = parts.last_arrival_ns
        self.fresh_count = receive.begin_cycle(self.memory, sync_ns)


class CountSlab(Slab):
    """A slab whose samples are counts of all pads at once, not PDOs; `limits` (size, channels, 2): the lowest
    and highest count of each channel."""

    def __init__(self, limits: NDArray[np.int64]) -> None:
        super().__init__(*limits.shape[:2])
        low, high = limits[:, :, 0], limits[:, :, 1]
        self._low_limits[:], self._high_limits[:] = np.where(low < 0, low + 1, -1), high

    def store_counts(self, counts: NDArray[np.int64], arrival_ns: int) -> None:
        """Store a sample (size, channels) of all pads."""
        self._counts[:] = counts
        self.arrival_ns.fill(arrival_ns)
        self.fresh.fill(1)
        self.fresh_count = self.size

    def unpack_counts(self) -> NDArray[np.int64]:
        """Return counts (size, channels); the array is reused by the next sample."""
        return self._counts


class Cycle:
    """The present SYNC period: `sync_ns` is its SYNC, `previous_sync_ns` the one before.

    Exactly one tick falls due between two calls of `begin_cycle`. Without a SYNC (none on this bus, or a dead
    producer) the timer takes over at `sync_overdue_ns`, so that silence is detected too.
    """

    def __init__(self, period_ns: int, window: float) -> None:
        self.period_ns = period_ns
        self.window_ns = round(period_ns * window)
        self.sync_ns = self.previous_sync_ns = 0
        self.ticked = True

    def begin_cycle(self, sync_ns: int) -> None:
        """Begin a cycle at a SYNC, sent or received."""
        self.previous_sync_ns, self.sync_ns = self.sync_ns, sync_ns
        self.ticked = False

    def is_tick_due(self, now_ns: int, complete: bool) -> bool:
        """Return True when the tick is due; `complete`: every expected sample has arrived."""
        return not self.ticked and (complete or now_ns - self.sync_ns >= self.window_ns)

    @property
    def sync_overdue_ns(self) -> int:
        """Time at which the timer replaces a missing SYNC of another producer."""
        return self.sync_ns + self.period_ns + self.period_ns // 2


class _PartialSample:
    """A sample of several PDOs, `required`, while it is incomplete."""

    def __init__(self, required: frozenset[int]) -> None:
        self.data = bytearray(_SAMPLE_BYTES)
        self._required = required
        self._missing = set(required)
        self._first_arrival_ns: dict[int, int] = {}  # PDO -> first arrival in this cycle
        self._last_arrival_ns: dict[int, int] = {}
        self._mixes_cycles = False

    def contradicts(self, pdo: int, data: bytes | bytearray) -> bool:
        """Return True if this PDO has arrived in this cycle with other data."""
        start = pdo * PDO_BYTES
        return pdo in self._last_arrival_ns and self.data[start : start + len(data)] != data

    def add_pdo(self, pdo: int, data: bytes | bytearray, arrival_ns: int) -> bool:
        """Store a PDO; return True when the sample is complete and of one SYNC."""
        start = pdo * PDO_BYTES
        self.data[start : start + len(data)] = data
        self._first_arrival_ns.setdefault(pdo, arrival_ns)
        self._last_arrival_ns[pdo] = arrival_ns
        self._missing.discard(pdo)
        if self._missing:
            return False
        self._missing |= self._required
        return not self._mixes_cycles

    @property
    def last_arrival_ns(self) -> int:
        """Arrival of the latest PDO, 0 before the first."""
        return max(self._last_arrival_ns.values(), default=0)

    def begin_cycle(self, sync_ns: int) -> bool:
        """Drop PDOs from before the SYNC; return False: no sample becomes complete by that. PDOs
        arriving late in the next cycle look as if they were of it.
        """
        first, last = self._first_arrival_ns, self._last_arrival_ns
        self._mixes_cycles = any(first.get(pdo, sync_ns) >= sync_ns for pdo in self._required)
        self._last_arrival_ns = {pdo: at for pdo, at in last.items() if at >= sync_ns}
        self._first_arrival_ns = dict(self._last_arrival_ns)
        self._missing = set(self._required - self._last_arrival_ns.keys()) or set(self._required)
        return False


class _ScheduledSample:
    """The last PDO of each state of a schedule, `required`; one arrives in each cycle.

    The identifier of a PDO names its state. Without a SYNC or a PDO, or with one that arrives in another
    cycle than its own, the last ones aren't of consecutive cycles: no sample is complete until they are.
    """

    def __init__(self, required: frozenset[int]) -> None:
        self.data = bytearray(_SAMPLE_BYTES)
        self._states = len(required)
        self._cycle = 0
        self._cycle_of: dict[int, int] = {}  # PDO -> cycle of its last arrival
        self._arrival_ns: dict[int, int] = {}

    def contradicts(self, pdo: int, data: bytes | bytearray) -> bool:
        """Return True if this PDO has arrived in this cycle with other data."""
        start = pdo * PDO_BYTES
        return self._cycle_of.get(pdo) == self._cycle and self.data[start : start + len(data)] != data

    def add_pdo(self, pdo: int, data: bytes | bytearray, arrival_ns: int) -> bool:
        """Store a PDO; return True when those of all states are of consecutive cycles, the last this one."""
        start = pdo * PDO_BYTES
        self.data[start : start + len(data)] = data
        self._arrival_ns[pdo], self._cycle_of[pdo] = arrival_ns, self._cycle
        return self._is_complete

    @property
    def last_arrival_ns(self) -> int:
        """Arrival of the latest PDO, 0 before the first."""
        return max(self._arrival_ns.values(), default=0)

    def begin_cycle(self, sync_ns: int) -> bool:
        """Begin a cycle, to which a PDO that has arrived since the SYNC belongs; return True if that
        completes a sample.
        """
        self._cycle += 1
        arrived = [pdo for pdo, at_ns in self._arrival_ns.items() if at_ns >= sync_ns]
        for pdo in arrived:
            self._cycle_of[pdo] = self._cycle
        return bool(arrived) and self._is_complete

    @property
    def _is_complete(self) -> bool:
        cycles = sorted(self._cycle_of.values())
        return cycles == list(range(self._cycle - self._states + 1, self._cycle + 1))
