"""Least threshold of a pad: how low contacts may begin, by the noise and drift that it shows while untouched.

Public names: `level_scatter`, `least_begin_counts`, `begin_samples`, `running_means`, and the period
`FALSE_CONTACT_PERIOD_S`.

A contact begins once k samples in a row exceed `begin_threshold_n`; then their mean exceeds it, too. The
standard deviation of that mean from the tracked baseline holds all that begins false contacts: noise, white
or not, hum, and the drift by which the baseline lags. Taken as normal, with a trial in each sample, it
exceeds `least_begin_counts` once in `FALSE_CONTACT_PERIOD_S`. Single pulses of interference aren't normal:
they aren't covered.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from handtouch.arrays import FloatArray

FALSE_CONTACT_PERIOD_S = 100 * 3600.0
"""Time of a pad with one false contact."""


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
    return float(np.std(running_means(levels - levels.mean(), samples)))


def running_means(levels: FloatArray, samples: int) -> FloatArray:
    """Return the means of `samples` successive rows (m - samples + 1, ...)."""
    if len(levels) < samples:
        return levels[:0]
    windows = np.lib.stride_tricks.sliding_window_view(levels, samples, axis=0)
    return np.asarray(windows.mean(axis=-1))
