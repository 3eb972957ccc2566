"""The life of contacts: two thresholds and a debounce turn samples into begin, update and end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class Changes(NamedTuple):
    """What one step changed: pads whose contact began, and pads whose contact ended."""

    began: IntArray
    ended: IntArray


_NOTHING = Changes(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))


class Contacts:
    """Contacts of n pads, at most one each, as columns.

    `touching` (n,) bool; `id` (n,) uint32, 0 without contact; `begin_ns` (n,) time of the first sample above
    the upper threshold; `peak_n` (n,) greatest valid force so far [N], kept by the tick.
    """

    def __init__(self, begin_samples: NDArray[np.int64], end_samples: NDArray[np.int64]) -> None:
        n = len(begin_samples)
        self.touching = np.zeros(n, dtype=np.bool_)
        self.id = np.zeros(n, dtype=np.uint32)
        self.begin_ns = np.zeros(n, dtype=np.int64)
        self.peak_n = np.full(n, np.nan)
        self._need = np.stack([begin_samples, end_samples])
        self._against = np.zeros(n, dtype=np.int64)  # samples in a row that contradict `touching`
        self._first_ns = np.zeros(n, dtype=np.int64)
        self._unsettled = False  # whether any of them is not 0
        self._next_id = 1

    def step(
        self,
        sampled: BoolArray,
        above_on: BoolArray,
        below_off: BoolArray,
        trusted: BoolArray,
        sample_ns: NDArray[np.int64],
    ) -> Changes:
        """Take in one tick: which pads were `sampled` and when, how they stand to their
        thresholds, which to trust.

        A contact on a pad that is no longer trusted ends at once; a pad without a sample is left as it is.
        """
        against = sampled & trusted & np.where(self.touching, below_off, above_on)
        lost = self.touching & ~trusted
        if not (self._unsettled or np.count_nonzero(against) or np.count_nonzero(lost)):
            return _NOTHING
        np.copyto(self._first_ns, sample_ns, where=against & (self._against == 0))
        self._against[against] += 1
        self._against[~against & (sampled | ~trusted)] = 0
        flips = against & (self._against >= np.where(self.touching, self._need[1], self._need[0]))
        began = np.flatnonzero(flips & ~self.touching)
        ended = np.flatnonzero(flips & self.touching | lost)
        if len(began):
            self.touching[began] = True
            self.id[began] = np.arange(self._next_id, self._next_id + len(began))
            self._next_id += len(began)
            self.begin_ns[began] = self._first_ns[began]
            self.peak_n[began] = np.nan
            self._against[began] = 0
        if len(ended):
            self.touching[ended] = False
            self._against[ended] = 0
        self._unsettled = bool(self._against.any())
        return Changes(began, ended)

    def forget(self, ended: IntArray) -> None:
        """Clear the ids of ended contacts, once their last message is made."""
        self.id[ended] = 0
