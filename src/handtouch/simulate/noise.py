"""Random numbers as a function of key and time, independent of the order of requests.

Public names: `stream_key`, `standard_normal`, `random_walk`. Numbers are hashes (SplitMix64's finaliser) of
key and time, so that a day of samples needs neither state nor a loop.
"""

from __future__ import annotations

import math
import zlib
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from handtouch.simulate.smoothstep import smoothstep_array

FloatArray = NDArray[np.float64]
KeyArray = NDArray[np.uint64]

WAVE_PERIODS_S: Final = (30.0, 120.0, 480.0, 1920.0, 7680.0, 30720.0)
"""Periods of the waves of a random walk, spaced like its spectrum."""

_MAX_SLOPE = 3.0  # slope of a wave of amplitude 1 and period 1: a smoothstep from -1 to 1


def stream_key(seed: int, *names: str) -> np.uint64:
    """Return the key of a random stream."""
    return np.uint64(zlib.crc32("/".join(names).encode()) | (zlib.crc32(str(seed).encode()) << 32))


def standard_normal(keys: ArrayLike, counters: ArrayLike) -> FloatArray:
    """Return standard normal numbers (...) of integer keys and counters, which broadcast."""
    return np.asarray(ndtri(_uniform(keys, counters)))


def random_walk(keys: KeyArray, times_s: ArrayLike) -> FloatArray:
    """Return smooth random walks (keys, times) of mean 0 and a slope of at most 1 per second.

    They are sums of waves of `WAVE_PERIODS_S` with amplitudes proportional to the root of the period.
    """
    t = np.atleast_1d(np.asarray(times_s, np.float64))
    scale = 1 / (_MAX_SLOPE * sum(period**-0.5 for period in WAVE_PERIODS_S))
    walk = np.zeros((len(keys), len(t)))
    for number, period in enumerate(WAVE_PERIODS_S):
        phase = t / period
        before = np.floor(phase)
        part = smoothstep_array(phase - before)
        first = (before.astype(np.int64) << 4) + number
        low, high = (2 * _uniform(keys[:, None], counter) - 1 for counter in (first, first + (1 << 4)))
        walk += scale * math.sqrt(period) * (low + part * (high - low))
    return walk


def _uniform(keys: ArrayLike, counters: ArrayLike) -> FloatArray:
    """Return uniform numbers in the open interval from 0 to 1."""
    with np.errstate(over="ignore"):
        mixed = _mix_bits(np.asarray(keys, np.uint64) + np.uint64(0x9E3779B97F4A7C15))
        mixed = _mix_bits(
            mixed ^ (np.asarray(counters, np.int64).astype(np.uint64) * np.uint64(0xD1B54A32D192ED03))
        )
    return np.asarray(((mixed >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53)


def _mix_bits(bits: KeyArray) -> KeyArray:
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(bits ^ (bits >> np.uint64(31)))
