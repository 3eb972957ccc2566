"""The slab: the latest sample of every pad, written straight from the bus and unpacked once a tick.

A PDO's data is a little-endian word of 64 bits, and a channel a run of bits of one such word, so that samples
of any width and mapping are stored as they come and unpacked for the whole hand at once.

Public names: `Slab`, `Field`, `Layout`, `STANDARD`, `PDOS`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PDOS = 4
"""The four channels of a pad come in at most this many PDOs."""
PDO_BYTES = 8
_WORD_BITS = 8 * PDO_BYTES
_SAMPLE_BYTES = PDOS * PDO_BYTES


@dataclass(frozen=True, slots=True)
class Field:
    """Where a channel is: which of its pad's PDOs (0 to 3), its first bit there, and its integer type."""

    pdo: int
    bit: int
    bits: int
    signed: bool

    @property
    def limits(self) -> tuple[int, int]:
        """Least and greatest count that the channel can show."""
        return limits(self.bits, self.signed)


Layout = tuple[Field, Field, Field, Field]
"""Fields of the electrodes x0, xa, y0, yb."""

STANDARD: Layout = (
    Field(0, 0, 16, True),
    Field(0, 16, 16, True),
    Field(0, 32, 16, True),
    Field(0, 48, 16, True),
)
"""Four int16 in one PDO (CiA 401: object 0x6401 sub 1 to 4)."""


def limits(bits: int, signed: bool) -> tuple[int, int]:
    """Least and greatest value of an integer type."""
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)


class Slab:
    """Latest whole sample of each of `size` pads, as arrays in the memory that the receive path writes.

    `t_ns` (size,) int64 arrival of its last PDO on the host's monotonic clock, 0 before the first; `fresh`
    (size,) uint8, 1 where one came since `begin_cycle`; `repeats` (size,) int64, samples that came when there
    was a fresh one already.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.t_ns: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self.repeats: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self.fresh_count = 0
        self._bytes = bytearray(size * _SAMPLE_BYTES)
        self._words: NDArray[np.int64] = np.frombuffer(self._bytes, dtype="<i8")
        self._t_ns, self._repeats = self.t_ns.data, self.repeats.data  # no boxing of numpy's scalars: 50 ns
        self._fresh = bytearray(size)
        self.fresh: NDArray[np.uint8] = np.frombuffer(self._fresh, dtype=np.uint8)
        self._is_fresh = self.fresh.view(np.bool_)
        self._as_standard = np.frombuffer(self._bytes, dtype="<i2").reshape(size, _SAMPLE_BYTES // 2)[:, :4]
        self._standard = np.ones(size, dtype=np.bool_)  # which slots are arranged so
        self._all_standard = True
        self._whole = [1] * size  # bit set of the PDOs that make a sample
        self._parts: dict[int, _Parts] = {}  # of pads with several PDOs
        self._cells = np.zeros((size, 4), dtype=np.intp)
        self._left = np.zeros((size, 4), dtype=np.int64)
        self._right = np.zeros((size, 4), dtype=np.int64)
        self._unsigned: NDArray[np.int64] | None = None  # what is left of a channel after the shifts
        self._bottom = np.zeros((size, 4), dtype=np.int64)
        self._top = np.zeros((size, 4), dtype=np.int64)
        self._counts = np.zeros((size, 4), dtype=np.int64)
        for slot in range(size):
            self.arrange(slot, STANDARD)

    def arrange(self, slot: int, layout: Layout) -> None:
        """Say where the four channels of a slot are; until then it is STANDARD. What it held is forgotten."""
        for channel, field in enumerate(layout):
            self._cells[slot, channel] = slot * PDOS + field.pdo
            self._left[slot, channel] = _WORD_BITS - field.bit - field.bits
            self._right[slot, channel] = _WORD_BITS - field.bits
            low, high = field.limits
            # an amplifier at its end gives either of the two lowest counts; zero is no end of a current
            self._bottom[slot, channel] = low + 1 if field.signed else -1
            self._top[slot, channel] = high
        whole = 0
        for field in layout:
            whole |= 1 << field.pdo
        self._whole[slot] = whole
        self._standard[slot] = layout == STANDARD
        self._all_standard = bool(self._standard.all())
        self._parts.pop(slot, None)
        if whole != 1:
            self._parts[slot] = _Parts(frozenset(field.pdo for field in layout))
        self._bytes[slot * _SAMPLE_BYTES : (slot + 1) * _SAMPLE_BYTES] = bytes(_SAMPLE_BYTES)
        unsigned = self._bottom == -1
        self._unsigned = np.where(unsigned, self._top, -1) if unsigned.any() else None

    def write(self, slot: int, data: bytes | bytearray, t_ns: int, pdo: int = 0) -> None:
        """Store a PDO of a slot, at most 8 bytes; `pdo` as the slot's layout counts them.

        A sample counts when all its PDOs have come; a second one within a cycle replaces the first. One of
        several PDOs doesn't count if the SYNC before brought less than all: what was missing may come now.
        """
        if self._whole[slot] == 1:
            start = slot * _SAMPLE_BYTES
            self._bytes[start : start + len(data)] = data
        elif self._parts[slot].add(pdo, data, t_ns):
            self._bytes[slot * _SAMPLE_BYTES : (slot + 1) * _SAMPLE_BYTES] = self._parts[slot].data
        else:
            return
        self._t_ns[slot] = t_ns
        if self._fresh[slot]:
            self._repeats[slot] += 1
        else:
            self._fresh[slot] = 1
            self.fresh_count += 1

    def read(self) -> NDArray[np.int64]:
        """Counts (size, 4) of the electrodes x0, xa, y0, yb; one array, good until the next `read`."""
        counts = self._counts
        if self._all_standard:
            np.copyto(counts, self._as_standard)
            return counts
        np.take(self._words, self._cells, out=counts, mode="clip")
        np.left_shift(counts, self._left, out=counts)
        np.right_shift(counts, self._right, out=counts)
        if self._unsigned is not None:
            np.bitwise_and(counts, self._unsigned, out=counts)
        return counts

    def railed(self, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the counts (size, 4) are at an end of their channel's range."""
        return (counts >= self._top) | (counts <= self._bottom)

    @property
    def limits(self) -> NDArray[np.int64]:
        """Counts (size, 8) from which on the four channels are at the bottom and top of their range."""
        return np.hstack([self._bottom, self._top])

    def begin_cycle(self, t_ns: int) -> None:
        """A SYNC at `t_ns`: fresh is what arrived since then, some of which may be here already."""
        np.greater_equal(self.t_ns, t_ns, out=self._is_fresh)
        self.fresh_count = int(np.count_nonzero(self.fresh))
        for parts in self._parts.values():
            parts.begin_cycle(t_ns)


class _Parts:
    """A sample of several PDOs, `wanted`, while it is incomplete."""

    def __init__(self, wanted: frozenset[int]) -> None:
        self.data = bytearray(_SAMPLE_BYTES)
        self._wanted = wanted
        self._missing = set(wanted)
        self._first_ns: dict[int, int] = {}  # PDO -> its first arrival in this cycle
        self._last_ns: dict[int, int] = {}
        self._doubtful = False

    def add(self, pdo: int, data: bytes | bytearray, t_ns: int) -> bool:
        """Keep a part; True when the sample is whole and of one SYNC."""
        start = pdo * PDO_BYTES
        self.data[start : start + len(data)] = data
        self._first_ns.setdefault(pdo, t_ns)
        self._last_ns[pdo] = t_ns
        self._missing.discard(pdo)
        if self._missing:
            return False
        self._missing |= self._wanted
        return not self._doubtful

    def begin_cycle(self, t_ns: int) -> None:
        """Parts that came before a SYNC don't belong with those after it; late ones look as if they did."""
        self._doubtful = any(self._first_ns.get(pdo, t_ns) >= t_ns for pdo in self._wanted)
        self._last_ns = {pdo: at for pdo, at in self._last_ns.items() if at >= t_ns}
        self._first_ns = dict(self._last_ns)
        self._missing = set(self._wanted - self._last_ns.keys()) or set(self._wanted)
