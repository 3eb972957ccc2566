"""Interface of the estimators of percepts, which run in a process of their own.

Public names: `PerceptEstimator`, `FitSchedule`, `HandSnapshot`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.percept.action_request import Question
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate


class HandSnapshot(NamedTuple):
    """All p pads of a hand at one time, those of rows from `first` on; NaN where unknown."""

    hand: int
    first: int
    t_ns: int
    contact_id: NDArray[np.uint32]
    """(p,), 0 for none"""
    clear: NDArray[np.bool_]
    """(p,), sampled and untouched"""
    slip_probability: FloatArray
    """(p,), 0 where it isn't known"""
    rotation: FloatArray
    """(p, 3, 3), of the links in the palm"""
    origin_m: FloatArray
    """(p, 3)"""
    base_rotation: FloatArray
    """(3, 3), of the palm in the base"""
    base_m: FloatArray
    """(3,)"""
    known_object: str
    """name and table of the object, as in `wire.PerceptInput`"""


class FitSchedule:
    """Schedules fits of n pads: the longest waiting first, none more often than every `period_ns`."""

    def __init__(self, pads: int, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last_fit_ns = np.full(pads, -(10**18), dtype=np.int64)

    def next_pad(self, ready: NDArray[np.bool_], now_ns: int) -> int | None:
        """Return the next of the pads that are `ready` (n,), or None if none is due."""
        pads = np.flatnonzero(ready & (now_ns - self._last_fit_ns >= self._period_ns))
        return int(pads[np.argmin(self._last_fit_ns[pads])]) if len(pads) else None

    def mark_fitted(self, pad: int, now_ns: int) -> None:
        """Record a fit of the pad at `now_ns`."""
        self._last_fit_ns[pad] = now_ns


class PerceptEstimator:
    """Base of estimators, each of one kind of percept over n pads; `requested` (n,) are those it runs for.

    `process_samples` is called in every tick and must be quick. Slow work belongs in `fit_contact`, which is
    called for one pad now and then and must stay below a few milliseconds.
    """

    kind: str

    def __init__(self, pads: int) -> None:
        self.requested: NDArray[np.bool_] = np.zeros(pads, dtype=np.bool_)

    def process_samples(self, buffer: ContactBuffer, sample: ContactSamples) -> Sequence[PerceptEstimate]:
        """Process a tick's samples of requested pads, already in the buffer; return new estimates."""
        raise NotImplementedError

    def process_hand(self, buffer: ContactBuffer, snapshot: HandSnapshot) -> Sequence[PerceptEstimate]:  # noqa: ARG002
        """Process a snapshot of a whole hand, after the samples of its tick; 20 times a second, for those
        that need untouched pads. May take up to 25 ms."""
        return ()

    def next_pad_to_fit(self, buffer: ContactBuffer, now_ns: int) -> int | None:  # noqa: ARG002
        """Return the pad most in need of a fit; None where samples suffice."""
        return None

    def fit_contact(self, buffer: ContactBuffer, pad: int, now_ns: int) -> Sequence[PerceptEstimate]:
        """Fit the contact on one pad, or the object in its hand."""
        raise NotImplementedError

    def end_contacts(self, buffer: ContactBuffer, pads: IntArray) -> None:
        """Handle the end of contacts on these pads, whose samples are still in the buffer."""

    def open_questions(self, now_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Return the undecided questions with the probabilities so far."""
        return ()
