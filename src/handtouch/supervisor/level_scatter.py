"""Noise and drift of untouched pads over hours, from which follows how low contacts may begin.

Public name: `LevelScatter`. What follows: `handtouch.core.least_threshold`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import BoolArray, FloatArray
from handtouch.core.least_threshold import begin_samples, running_means

_MIN_S, _MEMORY_S = 60.0, 3600.0
"""Untouched time from which a scatter is known, and that over which it is a mean."""
_SETTLING_NS = 10_000_000_000
"""Time after a contact in which a sheet's remaining current isn't noise: the baseline's time constant."""


class LevelScatter:
    """Standard deviations of the levels of n untouched pads, by block after block of samples.

    begin_ms: (n,) debounce of their contacts.
    """

    def __init__(self, begin_ms: Sequence[float]) -> None:
        self._begin_ms, n = list(begin_ms), len(begin_ms)
        self._squares, self._seconds = np.zeros(n), np.zeros(n)
        self._usable_from_ns = np.zeros(n, np.int64)
        self._last_ns, self._period_ns = 0, 0.0
        self._samples: NDArray[np.int64] = np.ones(n, np.int64)
        self._tail = np.zeros((0, n))

    @property
    def counts(self) -> FloatArray:
        """Standard deviation (n,) of the mean of as many samples as begin a contact [counts]; NaN while a pad
        hasn't been untouched for a minute."""
        known = self._seconds >= _MIN_S
        mean_square = self._squares / np.where(known, self._seconds, 1.0)
        return np.asarray(np.where(known, np.sqrt(mean_square), np.nan))

    @property
    def samples_per_s(self) -> float:
        """Rate of ticks; 0 before the second block."""
        return 1e9 / self._period_ns if self._period_ns else 0.0

    def forget(self, pad: int) -> None:
        """Discard what is known of a pad."""
        self._squares[pad] = self._seconds[pad] = 0.0

    def add_block(
        self, sync_ns: NDArray[np.int64], levels: FloatArray, usable: BoolArray, touched: BoolArray
    ) -> None:
        """Add m ticks: times (m,), sums (m, n) of the channels less the baseline [counts], which samples are
        new and of pads whose baseline is known, and which pads are touched, both (m, n)."""
        last_ns, self._last_ns = self._last_ns, int(sync_ns[-1])
        elapsed_ns = self._last_ns - last_ns
        if not last_ns or not 0 < elapsed_ns < _SETTLING_NS:  # the first, or after a pause
            self._tail = self._tail[:0]
            return
        self._set_period(elapsed_ns / len(sync_ns))
        settled_ns = (touched * (sync_ns[:, None] + _SETTLING_NS)).max(axis=0)
        np.maximum(self._usable_from_ns, settled_ns, out=self._usable_from_ns)
        usable = usable & (sync_ns[:, None] >= self._usable_from_ns)
        levels = np.concatenate([self._tail, np.where(usable, levels, np.nan)])
        self._tail = levels[len(levels) - (int(self._samples.max()) - 1) :]
        for count in np.unique(self._samples).tolist():
            self._add(
                np.flatnonzero(self._samples == count),
                running_means(levels[-len(sync_ns) - count + 1 :], count),
            )

    def _add(self, pads: NDArray[np.intp], means: FloatArray) -> None:
        """Add means (m, n) of samples; those of unusable ones are NaN."""
        known = ~np.isnan(means[:, pads])
        squares = np.where(known, np.square(means[:, pads]), 0.0).sum(axis=0)
        period_s = self._period_ns * 1e-9
        kept = np.minimum(1.0, _MEMORY_S / np.maximum(self._seconds[pads], 1.0))
        self._squares[pads] = self._squares[pads] * kept + squares * period_s
        self._seconds[pads] = self._seconds[pads] * kept + known.sum(axis=0) * period_s

    def _set_period(self, period_ns: float) -> None:
        """Set how many samples begin a contact at this period of ticks."""
        self._period_ns = period_ns
        self._samples[:] = [begin_samples(begin_ms, round(period_ns)) for begin_ms in self._begin_ms]
