"""Least threshold of a pad: how low contacts may begin, by the noise and drift that it shows while untouched.

Public names: `LevelScatter`, `level_scatter`, `least_begin_counts`, `begin_samples`, and the period
`FALSE_CONTACT_PERIOD_S`.

A contact begins once k samples in a row exceed `begin_threshold_n`; then their mean exceeds it, too. The
standard deviation of that mean from the tracked baseline holds all that begins false contacts: noise, white
or not, hum, and the drift by which the baseline lags. Taken as normal, with a trial in each sample, it
exceeds `least_begin_counts` once in `FALSE_CONTACT_PERIOD_S`. Single pulses of interference aren't normal:
they aren't covered.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FALSE_CONTACT_PERIOD_S = 100 * 3600.0
"""Time of a pad with one false contact."""
_MIN_S, _MEMORY_S = 60.0, 3600.0
"""Untouched time from which a scatter is known, and that over which it is a mean."""
_SETTLING_NS = 10_000_000_000
"""Time after a contact in which a sheet's remaining current isn't noise: the baseline's time constant."""


def begin_samples(begin_ms: float, period_ns: int) -> int:
    """Return how many samples in a row begin a contact: half a period less than the debounce is enough, and
    no debounce needs one."""
    if begin_ms <= 0:
        return 1
    return max(2, 1 + math.ceil((round(1e6 * begin_ms) - period_ns / 2) / period_ns))


def least_begin_counts(scatter_counts: float, samples_per_s: float) -> float:
    """Return the least sum of channels at which a contact may begin, by the standard deviation of the mean of
    as many samples as begin it; NaN if that is unknown."""
    return -NormalDist().inv_cdf(1 / (samples_per_s * FALSE_CONTACT_PERIOD_S)) * scatter_counts


def level_scatter(levels: FloatArray, samples: int) -> float:
    """Return the standard deviation of the means of `samples` successive levels, about the mean of all (m,);
    NaN for fewer than twice as many."""
    if len(levels) < 2 * samples:
        return math.nan
    return float(np.std(_running_means(levels - levels.mean(), samples)))


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
                _running_means(levels[-len(sync_ns) - count + 1 :], count),
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


def _running_means(levels: FloatArray, samples: int) -> FloatArray:
    """Return the means of `samples` successive rows (m - samples + 1, ...)."""
    if len(levels) < samples:
        return levels[:0]
    windows = np.lib.stride_tricks.sliding_window_view(levels, samples, axis=0)
    return np.asarray(windows.mean(axis=-1))
