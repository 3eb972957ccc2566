"""Random numbers as a function of key and time, independent of the order of requests.

Public names: `stream_key`, `standard_normal`, `mix_keys`, `normal_of_mixed`, `random_walk`. Numbers are
hashes (SplitMix64's finaliser) of key and time, so that a day of samples needs neither state nor a loop.
"""

from __future__ import annotations

import math
import zlib
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from handtouch.arrays import FloatArray
from handtouch.simulate.smoothstep import smoothstep_array

KeyArray = NDArray[np.uint64]

WAVE_PERIODS_S: Final = (30.0, 120.0, 480.0, 1920.0, 7680.0, 30720.0)
"""Periods of the waves of a random walk, spaced like its spectrum."""

_MAX_SLOPE = 3.0  # slope of a wave of amplitude 1 and period 1: a smoothstep from -1 to 1
_MAX_TIMES_AT_ONCE = 4096
_PERIODS_S = np.array(WAVE_PERIODS_S)
_AMPLITUDES = np.sqrt(_PERIODS_S) / (_MAX_SLOPE * (_PERIODS_S**-0.5).sum())


def stream_key(seed: int, *names: str) -> np.uint64:
    """Return the key of a random stream."""
    return np.uint64(zlib.crc32("/".join(names).encode()) | (zlib.crc32(str(seed).encode()) << 32))


def mix_keys(keys: ArrayLike) -> KeyArray:
    """Return keys as `normal_of_mixed` takes them, to mix those once that are used again and again."""
    with np.errstate(over="ignore"):
        return _mix_bits(np.asarray(np.asarray(keys, np.uint64) + np.uint64(0x9E3779B97F4A7C15)))


def normal_of_mixed(mixed_keys: KeyArray, counters: ArrayLike) -> FloatArray:
    """Return `standard_normal` of keys that `mix_keys` returned."""
    uniform = _uniform(mixed_keys, counters)
    return np.asarray(ndtri(uniform, out=uniform) if uniform.ndim else ndtri(uniform))


def standard_normal(keys: ArrayLike, counters: ArrayLike) -> FloatArray:
    """Return standard normal numbers (...) of integer keys and counters, which broadcast."""
    return normal_of_mixed(mix_keys(keys), counters)


def random_walk(keys: KeyArray, times_s: ArrayLike) -> FloatArray:
    """Return smooth random walks (keys, times) of mean 0 and a slope of at most 1 per second.

    They are sums of waves of `WAVE_PERIODS_S` with amplitudes proportional to the root of the period.
    """
    t = np.atleast_1d(np.asarray(times_s, np.float64))
    if len(t) <= _MAX_TIMES_AT_ONCE:
        return _sum_waves(keys, t)
    chunks = np.array_split(t, math.ceil(len(t) / _MAX_TIMES_AT_ONCE))
    return np.concatenate([_sum_waves(keys, chunk) for chunk in chunks], axis=1)


def _sum_waves(keys: KeyArray, times_s: FloatArray) -> FloatArray:
    phase = times_s / _PERIODS_S[:, None]
    before = np.floor(phase)
    numbers = before.astype(np.int64)
    ends = (
        _wave_ends_at(keys.tobytes(), tuple(numbers[:, 0].tolist()))
        if len(times_s) == 1
        else _wave_ends(keys, numbers)
    )
    low, high = ends[:, 0], ends[:, 1]
    waves = low + smoothstep_array(phase - before) * (high - low)
    walk = np.zeros((len(keys), len(times_s)))
    for number, amplitude in enumerate(_AMPLITUDES.tolist()):  # in this order for any number of times
        walk += amplitude * waves[:, number]
    return walk


def _wave_ends(keys: KeyArray, numbers: NDArray[np.int64]) -> FloatArray:
    """Return the values (keys, 2, periods, times) of waves at both ends of a period, by its number."""
    first = (numbers << 4) + np.arange(len(_PERIODS_S))[:, None]
    return 2 * _uniform(mix_keys(keys)[:, None, None, None], np.stack([first, first + (1 << 4)])) - 1


@lru_cache(maxsize=4096)
def _wave_ends_at(keys: bytes, numbers: tuple[int, ...]) -> FloatArray:
    """Return `_wave_ends` at one time: a live hand needs the same ones for half a minute."""
    return _wave_ends(np.frombuffer(keys, np.uint64), np.array(numbers)[:, None])


def _uniform(mixed_keys: KeyArray, counters: ArrayLike) -> FloatArray:
    """Return uniform numbers in the open interval from 0 to 1."""
    with np.errstate(over="ignore"):
        of_counters = np.asarray(counters, np.int64).astype(np.uint64) * np.uint64(0xD1B54A32D192ED03)
        mixed = _mix_bits(np.asarray(mixed_keys ^ of_counters))
    mixed >>= np.uint64(11)
    uniform = np.asarray(mixed.astype(np.float64))
    uniform += 0.5
    uniform *= 2.0**-53
    return uniform


def _mix_bits(bits: KeyArray) -> KeyArray:
    """Mix the bits of an array, in place."""
    bits ^= bits >> np.uint64(30)
    bits *= np.uint64(0xBF58476D1CE4E5B9)
    bits ^= bits >> np.uint64(27)
    bits *= np.uint64(0x94D049BB133111EB)
    bits ^= bits >> np.uint64(31)
    return bits
