"""The slab: the latest sample of every pad in one contiguous array, written straight from the bus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FULL_SCALE = 32767
"""Greatest count of a channel; at it, or at its negative, a channel is at the end of its range."""
SAMPLE_BYTES = 8
"""A sample is one TPDO of four little-endian int16 (CiA 401: object 0x6401 sub 1-4)."""


class Slab:
    """Latest sample of each of `size` pads, as arrays that share memory with what the receive path writes.

    `counts` (size, 4) int16, channel order x0, xa, y0, yb; `t_ns` (size,) int64 arrival on the host's
    monotonic clock, 0 before the first sample; `fresh` (size,) uint8, 1 where one came since `begin_cycle`.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._bytes = bytearray(size * SAMPLE_BYTES)
        self.counts: NDArray[np.int16] = np.frombuffer(self._bytes, dtype="<i2").reshape(size, 4)
        self.t_ns: NDArray[np.int64] = np.zeros(size, dtype=np.int64)
        self._t_ns = self.t_ns.data  # item assignment without numpy's scalar boxing: 50 ns
        self._fresh = bytearray(size)
        self.fresh: NDArray[np.uint8] = np.frombuffer(self._fresh, dtype=np.uint8)
        self.fresh_count = 0

    def write(self, slot: int, data: bytes | bytearray, t_ns: int) -> None:
        """Store a sample of SAMPLE_BYTES bytes; a second one within a cycle replaces the first."""
        start = slot * SAMPLE_BYTES
        self._bytes[start : start + SAMPLE_BYTES] = data
        self._t_ns[slot] = t_ns
        if not self._fresh[slot]:
            self._fresh[slot] = 1
            self.fresh_count += 1

    def begin_cycle(self, t_ns: int) -> None:
        """A SYNC at `t_ns`: fresh is what arrived since then, some of which may be here already."""
        np.greater_equal(self.t_ns, t_ns, out=self.fresh, casting="unsafe")
        self.fresh_count = int(np.count_nonzero(self.fresh))
