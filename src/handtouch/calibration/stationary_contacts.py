"""Segment contacts into stationary ones: from the samples of a pad to mean currents of contacts at rest.

Public: `StationaryContactDetector` of one pad; `StationaryContact`. A held contact is one stationary contact
however long it lasts, a slow slide many, which share the touch's error: see `gains`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handtouch.arrays import FloatArray

WINDOW_SAMPLES = 4
"""Samples that are checked for motion together."""
_MAX_FRACTION_CHANGE = 0.012
"""Limit of motion, in fractions, at rest. The error of the mean is of second order, below 1e-4."""
_MIN_FRACTION_DISTANCE = 0.03
"""Least distance, in fractions, from the previous stationary contact."""
_NOISE_SIGMAS = 4.0  # a contact is stationary while its shares stay within
_SKIPPED_SAMPLES = 2  # at the begin, while the contact grows
_MAX_SAMPLES = 256


@dataclass(frozen=True)
class StationaryContact:
    """Contact at rest: mean currents (c,), their noise (c,) [A], number of samples, time of the last, and
    number of the touch that it is a part of."""

    currents: FloatArray
    noise: FloatArray
    samples: int
    last_sync_ns: int
    touch: int


class StationaryContactDetector:
    """Detector for the contacts of one pad; `add_sample` for every tick in which the pad is touched.

    noise_a: of a reading of each of its c channels, (c,) [A].
    """

    def __init__(self, noise_a: FloatArray) -> None:
        self._noise = noise_a
        self._contact_id = 0
        self._window: list[FloatArray] = []
        self._samples_to_skip = 0
        self._last_fractions: FloatArray | None = None
        self._current_sum: FloatArray = np.zeros(len(noise_a))
        self._mean_fractions: FloatArray = np.zeros(len(noise_a))
        self._sample_count, self._last_sync_ns = 0, 0

    def add_sample(self, contact_id: int, currents: FloatArray, sync_ns: int) -> StationaryContact | None:
        """Add a sample (c,); return a stationary contact that is complete. `contact_id` 0: not touched."""
        finished = None
        if contact_id != self._contact_id:
            finished = self._finish_contact()
            self._contact_id, self._samples_to_skip, self._last_fractions = contact_id, _SKIPPED_SAMPLES, None
        if not contact_id:
            return finished
        if self._samples_to_skip:
            self._samples_to_skip -= 1
            return finished
        self._window.append(currents)
        if len(self._window) < WINDOW_SAMPLES:
            return finished
        window, self._window = np.array(self._window), []
        return self._process_window(window, sync_ns) or finished

    def _process_window(self, window: FloatArray, sync_ns: int) -> StationaryContact | None:
        """Add a window (k, c) to the stationary contact, or begin another with it."""
        half = len(window) // 2
        mean = window.mean(axis=0)
        total = float(mean.sum())
        if not total > 0:
            return None
        slack = _MAX_FRACTION_CHANGE + _NOISE_SIGMAS * float(self._noise.max()) / total
        moved = np.abs(_fractions(window[half:].mean(axis=0)) - _fractions(window[:half].mean(axis=0))).max()
        if moved > slack:  # too fast
            return self._finish_contact()
        finished = None
        if self._sample_count and np.abs(_fractions(mean) - self._mean_fractions).max() > slack:
            finished = self._finish_contact()
        if not self._sample_count:
            self._mean_fractions = _fractions(mean)
        if self._sample_count < _MAX_SAMPLES:
            self._current_sum += window.sum(axis=0)
            self._sample_count += len(window)
            self._last_sync_ns = sync_ns
        return finished

    def _finish_contact(self) -> StationaryContact | None:
        """Return the stationary contact so far, unless it repeats the previous one."""
        self._window = []
        total, count, sync_ns = self._current_sum, self._sample_count, self._last_sync_ns
        self._clear_sums()
        if not count:
            return None
        fractions = _fractions(total)
        if (
            self._last_fractions is not None
            and np.abs(fractions - self._last_fractions).max() < _MIN_FRACTION_DISTANCE
        ):
            return None
        self._last_fractions = fractions
        noise = self._noise / np.sqrt(count)
        return StationaryContact(total / count, noise, count, sync_ns, self._contact_id)

    def _clear_sums(self) -> None:
        self._current_sum = np.zeros(len(self._noise))
        self._sample_count = 0


def _fractions(currents: FloatArray) -> FloatArray:
    return np.asarray(currents / currents.sum())
