"""Contact detection: two thresholds and a debounce turn samples into begin, update and end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.core.state import TickState

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
FloatArray = NDArray[np.float64]


class ContactChanges(NamedTuple):
    """Pads whose contact began or ended in one tick, and those with a new sample of a contact."""

    began: IntArray
    ended: IntArray
    measured: IntArray


_NO_PADS: IntArray = np.zeros(0, dtype=np.intp)


class ContactDetector:
    """Contacts of n pads, at most one each, as columns; they begin above `begin` and end below `end` (n,).

    `touching` (n,) bool; `id` (n,) uint32, 0 without contact; `begin_ns` (n,) time of the first sample above
    the begin threshold; `peak_force_n` (n,) greatest valid force of the contact [N], updated by the tick.
    """

    def __init__(
        self,
        begin: FloatArray,
        end: FloatArray,
        begin_samples: NDArray[np.int64],
        end_samples: NDArray[np.int64],
        state: TickState | None = None,
    ) -> None:
        held = TickState.empty(len(begin)) if state is None else state
        self.touching, self.id, self.begin_ns = held.touching, held.contact_id, held.begin_ns
        self.peak_force_n, self._next_id = held.peak_force_n, held.next_contact_id
        self._first_sample_ns = held.first_sample_ns
        self._contradicting_samples = held.contradicting_samples  # successive, against `touching`
        self.set_settings(begin, end, begin_samples, end_samples)

    def detect_contacts(
        self, level: FloatArray, sampled: BoolArray, trusted: BoolArray, sample_ns: NDArray[np.int64]
    ) -> ContactChanges:
        """Process one tick: the `level` of all pads, which of them were `sampled` and when, which to trust.

        A contact on an untrusted pad ends at once; a pad without a sample keeps its state.
        """
        touching = self.touching
        above = level > self._threshold
        against = above != touching
        lost = touching > trusted
        began = ended = _NO_PADS
        if self._debouncing or np.count_nonzero(against) or np.count_nonzero(lost):
            against &= sampled
            against &= trusted
            began, ended = self._debounce(against, sampled | ~trusted, lost, sample_ns)
            above = level > self._threshold
        # a sample below the threshold has no position: the last one holds until the debounce decides
        return ContactChanges(began, ended, (touching & sampled & above).nonzero()[0])

    def set_settings(
        self,
        begin: FloatArray,
        end: FloatArray,
        begin_samples: NDArray[np.int64],
        end_samples: NDArray[np.int64],
    ) -> None:
        """Set thresholds and debounce counts; they apply to present contacts too. Call it also after the
        state was loaded."""
        self._begin_threshold, self._end_threshold = begin, np.nextafter(end, -np.inf)
        # the one that applies now
        self._threshold = np.where(self.touching, self._end_threshold, begin)
        self._required_samples = np.stack([begin_samples, end_samples])
        self._debouncing = bool(self._contradicting_samples.any())

    @property
    def begun_count(self) -> int:
        """Number of contacts begun so far."""
        return int(self._next_id[0]) - 1

    def clear_ended(self, ended: IntArray) -> None:
        """Clear the ids of ended contacts, after their last message was built."""
        if len(ended):
            self.id[ended] = 0

    def _debounce(
        self, against: BoolArray, known: BoolArray, lost: BoolArray, sample_ns: NDArray[np.int64]
    ) -> tuple[IntArray, IntArray]:
        np.copyto(self._first_sample_ns, sample_ns, where=against & (self._contradicting_samples == 0))
        self._contradicting_samples[against] += 1
        self._contradicting_samples[~against & known] = 0
        flips = against & (
            self._contradicting_samples
            >= np.where(self.touching, self._required_samples[1], self._required_samples[0])
        )
        began = np.flatnonzero(flips & ~self.touching)
        ended = np.flatnonzero(flips & self.touching | lost)
        self._contradicting_samples[began] = self._contradicting_samples[ended] = 0
        self._debouncing = bool(self._contradicting_samples.any())
        self.touching[began] = True
        self.touching[ended] = False
        self._threshold[began] = self._end_threshold[began]
        self._threshold[ended] = self._begin_threshold[ended]
        self.id[began] = np.arange(self._next_id[0], self._next_id[0] + len(began))
        self._next_id[0] += len(began)
        self.begin_ns[began] = self._first_sample_ns[began]
        self.peak_force_n[began] = np.nan
        return began, ended
