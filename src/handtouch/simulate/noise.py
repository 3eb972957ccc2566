"""Chance as a function of time: the same key and time give the same number, whoever asks when.

Public names: `key`, `normal`, `wander`. Numbers come from a hash (SplitMix64's finaliser) of key and time, so
that a day of samples needs no state and no loop.
"""

from __future__ import annotations

import math
import zlib
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

FloatArray = NDArray[np.float64]
KeyArray = NDArray[np.uint64]

PERIODS_S: Final = (30.0, 120.0, 480.0, 1920.0, 7680.0, 30720.0)
"""Of the waves that a wander is made of, spaced like the spectrum of a random walk."""

_STEEPEST = 3.0  # slope of a wave of amplitude 1 and period 1: a smoothstep from -1 to 1


def key(seed: int, *names: str) -> np.uint64:
    """What tells one source of chance from another."""
    return np.uint64(zlib.crc32("/".join(names).encode()) | (zlib.crc32(str(seed).encode()) << 32))


def normal(keys: ArrayLike, counters: ArrayLike) -> FloatArray:
    """Standard normal numbers (...) of keys and counters, integers, that broadcast."""
    return np.asarray(ndtri(_uniform(keys, counters)))


def wander(keys: KeyArray, times_s: ArrayLike) -> FloatArray:
    """Smooth random walks (keys, times): never steeper than 1 a second, 0 in the mean.

    Waves of `PERIODS_S` whose amplitude goes as the root of their period.
    """
    t = np.atleast_1d(np.asarray(times_s, np.float64))
    scale = 1 / (_STEEPEST * sum(period**-0.5 for period in PERIODS_S))
    walk = np.zeros((len(keys), len(t)))
    for number, period in enumerate(PERIODS_S):
        at = t / period
        before = np.floor(at)
        part = at - before
        part = part * part * (3 - 2 * part)
        first = (before.astype(np.int64) << 4) + number
        low, high = (2 * _uniform(keys[:, None], counter) - 1 for counter in (first, first + (1 << 4)))
        walk += scale * math.sqrt(period) * (low + part * (high - low))
    return walk


def _uniform(keys: ArrayLike, counters: ArrayLike) -> FloatArray:
    """Evenly between 0 and 1, neither included."""
    with np.errstate(over="ignore"):
        mixed = _mix(np.asarray(keys, np.uint64) + np.uint64(0x9E3779B97F4A7C15))
        mixed = _mix(
            mixed ^ (np.asarray(counters, np.int64).astype(np.uint64) * np.uint64(0xD1B54A32D192ED03))
        )
    return np.asarray(((mixed >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53)


def _mix(bits: KeyArray) -> KeyArray:
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(bits ^ (bits >> np.uint64(31)))
