"""The life of contacts: two thresholds and a debounce turn samples into begin, update and end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
FloatArray = NDArray[np.float64]


class Changes(NamedTuple):
    """What one step changed: pads whose contact began, or ended, and those with a sample of a contact."""

    began: IntArray
    ended: IntArray
    telling: IntArray


_NONE: IntArray = np.zeros(0, dtype=np.intp)


class Contacts:
    """Contacts of n pads, at most one each, as columns; they begin above `on` and end below `off` (n,).

    `touching` (n,) bool; `id` (n,) uint32, 0 without contact; `begin_ns` (n,) time of the first sample above
    the upper threshold; `peak_n` (n,) greatest valid force so far [N], kept by the tick.
    """

    def __init__(
        self,
        on: FloatArray,
        off: FloatArray,
        begin_samples: NDArray[np.int64],
        end_samples: NDArray[np.int64],
    ) -> None:
        n = len(on)
        self.touching = np.zeros(n, dtype=np.bool_)
        self.id = np.zeros(n, dtype=np.uint32)
        self.begin_ns = np.zeros(n, dtype=np.int64)
        self.peak_n = np.full(n, np.nan)
        self._on, self._least = on, np.nextafter(off, -np.inf)
        self._threshold = on.copy()  # that a level is above, to begin a contact or to go on with it
        self._need = np.stack([begin_samples, end_samples])
        self._against = np.zeros(n, dtype=np.int64)  # samples in a row that contradict `touching`
        self._unsettled = False  # whether any of them is not 0
        self._first_ns = np.zeros(n, dtype=np.int64)
        self._next_id = 1

    def step(
        self, level: FloatArray, sampled: BoolArray, trusted: BoolArray, sample_ns: NDArray[np.int64]
    ) -> Changes:
        """Take in one tick: the `level` of all pads, which of them were `sampled` and when, which to trust.

        A contact on a pad that is no longer trusted ends at once; a pad without a sample is left as it is.
        """
        touching = self.touching
        above = level > self._threshold
        against = above != touching
        lost = touching > trusted
        began = ended = _NONE
        if self._unsettled or np.count_nonzero(against) or np.count_nonzero(lost):
            against &= sampled
            against &= trusted
            began, ended = self._count(against, sampled | ~trusted, lost, sample_ns)
            above = level > self._threshold
        # a sample below the threshold tells no place: until it is known whether more follow, the last holds
        return Changes(began, ended, (touching & sampled & above).nonzero()[0])

    def adopt(
        self,
        on: FloatArray,
        off: FloatArray,
        begin_samples: NDArray[np.int64],
        end_samples: NDArray[np.int64],
    ) -> None:
        """Other thresholds and debounces from the next step on; what is touched now goes on by them."""
        self._on, self._least = on, np.nextafter(off, -np.inf)
        self._threshold = np.where(self.touching, self._least, on)
        self._need = np.stack([begin_samples, end_samples])

    def imitate(self, other: Contacts) -> None:
        """Be where another one of the same pads is, but for debounces."""
        self.touching[:], self._threshold[:] = other.touching, other._threshold
        self._against[:] = 0

    @property
    def begun(self) -> int:
        """Contacts that ever began."""
        return self._next_id - 1

    def forget(self, ended: IntArray) -> None:
        """Clear the ids of ended contacts, once their last message is made."""
        if len(ended):
            self.id[ended] = 0

    def _count(
        self, against: BoolArray, known: BoolArray, lost: BoolArray, sample_ns: NDArray[np.int64]
    ) -> tuple[IntArray, IntArray]:
        np.copyto(self._first_ns, sample_ns, where=against & (self._against == 0))
        self._against[against] += 1
        self._against[~against & known] = 0
        flips = against & (self._against >= np.where(self.touching, self._need[1], self._need[0]))
        began = np.flatnonzero(flips & ~self.touching)
        ended = np.flatnonzero(flips & self.touching | lost)
        self._against[began] = self._against[ended] = 0
        self._unsettled = bool(self._against.any())
        self.touching[began] = True
        self.touching[ended] = False
        self._threshold[began] = self._least[began]
        self._threshold[ended] = self._on[ended]
        self.id[began] = np.arange(self._next_id, self._next_id + len(began))
        self._next_id += len(began)
        self.begin_ns[began] = self._first_ns[began]
        self.peak_n[began] = np.nan
        return began, ended
