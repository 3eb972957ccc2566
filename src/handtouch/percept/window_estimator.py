"""Base of estimators that fit the window of one contact at a time and keep its best estimate.

Public name: `WindowEstimator`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from handtouch.percept.samples import (
    ContactBuffer,
    ContactSamples,
    FitSchedule,
    IntArray,
    PerceptEstimate,
)

Best = TypeVar("Best")


class WindowEstimator(ABC, Generic[Best]):
    """Fits the windows of n pads in turn, each every `fit_period_ns` at most, from `min_samples` on."""

    def __init__(self, pads: int, fit_period_ns: int, min_samples: int) -> None:
        self.requested = np.zeros(pads, dtype=np.bool_)
        self._min_samples = min_samples
        self._schedule = FitSchedule(pads, fit_period_ns)
        self._best: dict[int, Best] = {}
        """pad -> best estimate of its contact so far"""

    @abstractmethod
    def _fit_window(self, buffer: ContactBuffer, pad: int, now_ns: int) -> PerceptEstimate:
        """Fit the window of the pad's contact; return the best estimate so far."""

    def process_samples(
        self,
        buffer: ContactBuffer,  # noqa: ARG002
        sample: ContactSamples,  # noqa: ARG002
        began: IntArray,
    ) -> Sequence[PerceptEstimate]:
        """Discard the estimates of contacts that ended."""
        for pad in began.tolist():
            self._discard(pad)
        return ()

    def next_pad_to_fit(self, buffer: ContactBuffer, now_ns: int) -> int | None:
        """Return the pad that has waited longest."""
        ready = (buffer.contact_id > 0) & (buffer.sample_count >= self._min_samples)
        return self._schedule.next_pad(self.requested & ready, now_ns)

    def fit_contact(self, buffer: ContactBuffer, pad: int, now_ns: int) -> Sequence[PerceptEstimate]:
        """Fit the pad's window."""
        self._schedule.mark_fitted(pad, now_ns)
        return [self._fit_window(buffer, pad, now_ns)]

    def end_contacts(self, buffer: ContactBuffer, pads: IntArray, now_ns: int) -> Sequence[PerceptEstimate]:
        """Fit the windows of ended contacts once more, so that the last samples count."""
        last: list[PerceptEstimate] = []
        for pad in pads.tolist():
            if buffer.sample_count[pad] >= self._min_samples:
                last += self.fit_contact(buffer, pad, now_ns)
            self._discard(pad)
        return last

    def _discard(self, pad: int) -> None:
        """Discard what is known of the pad's contact."""
        self._best.pop(pad, None)
