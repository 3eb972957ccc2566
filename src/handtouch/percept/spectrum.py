"""Period and roughness of a surface, from the total current over distance while a contact slides.

The logarithm of the current, less a slow trend, is resampled on an even grid of distance; a peak of its
periodogram (A. Schuster, 1898) is compared with its neighbours, as neither sheets nor surfaces are white. It
is a period if chance rarely makes one as high, and if it persists along the whole slide. Its deviation is the
Cramer-Rao bound of a sine in such noise. Periods below two sample spacings can't be resolved
(`min_period_m`); finer ones may alias to a coarser one, unless the speed changed.

Public names: `estimate_texture`, `TextureEstimate`, `detrended`, `TEXTURE_CLASSES`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

TEXTURE_CLASSES = ("periodic", "rough", "smooth")

_MIN_SAMPLES = 48
_MIN_PERIODS = 4.0  # in a slide, of the longest period it resolves
_MIN_SEARCHED_PERIODS = 3.0  # fewer leak into higher frequencies
_PERIODIC_PRIOR_ODDS = 0.05
_MIN_PERSISTENCE = 0.7
_NEIGHBOUR_FREQUENCIES = 12  # independent frequencies on each side of a peak
_TREND_DEGREE = 3
_MIN_PROBABILITY = 0.9
_ZERO_PADDING = 4  # frequency grid per independent frequency


@dataclass(frozen=True)
class TextureEstimate:
    """Texture from one slide. `min_period_m`, `max_period_m`: range of the periods it could resolve.

    amplitude: of the period, relative to the current. roughness: root mean square of the current's relative
    variation beyond its noise; noise_floor: that noise. aliased: True if a finer texture would look the same.
    false_alarm_probability: of such a peak by chance.
    """

    state: str
    label: str = ""
    reason: str = ""
    period_m: float = math.nan
    period_std_m: float = math.nan
    amplitude: float = math.nan
    roughness: float = math.nan
    roughness_std: float = math.nan
    noise_floor: float = math.nan
    min_period_m: float = math.nan
    max_period_m: float = math.nan
    aliased: bool = True
    false_alarm_probability: float = 1.0
    samples: int = 0
    distance_m: float = 0.0
    probabilities: dict[str, float] = field(default_factory=dict)


def estimate_texture(
    current_a: FloatArray, distance_m: FloatArray, noise: float | None = None, distance_std: float = 0.0
) -> TextureEstimate:
    """Estimate texture from currents (n,) at distances (n,) along a slide, sampled evenly in time.

    noise: relative standard deviation of a current at rest; None: the finest periods are taken as noise.
    distance_std: relative error common to all distances. Raises ValueError unless both shapes are (n,).
    """
    current, way = np.asarray(current_a, np.float64), np.asarray(distance_m, np.float64)
    if current.ndim != 1 or current.shape != way.shape:
        raise ValueError(f"current_a has shape {current.shape}, distance_m {way.shape}: must be one, (n,)")
    part = _longest_slide(way)
    current, way = current[part], way[part]
    if len(way) < _MIN_SAMPLES:
        return TextureEstimate(
            "undetermined", reason=f"slid for {len(way)} of {_MIN_SAMPLES} samples", samples=len(way)
        )
    if not (current > 0).all():
        return TextureEstimate("invalid", reason="a current is zero or negative", samples=len(way))
    way = np.abs(way - way[0])
    length = float(way[-1])
    finest, longest = 2 * _ninetieth_percentile(np.diff(way)), length / _MIN_PERIODS
    if longest < 2 * finest:
        reason = f"{1e3 * length:.2g} mm in {len(way)} samples: slide further, or more slowly"
        return TextureEstimate(
            "undetermined", "", reason, min_period_m=finest, max_period_m=longest, samples=len(way)
        )
    y = detrended(np.log(current), way / length)
    peak = _highest_peak(y, way, length, _MIN_SEARCHED_PERIODS / length, 1 / finest)
    floor = math.sqrt(peak.white_power * len(y)) if noise is None else noise
    total = float(y @ y) / len(y)
    roughness = math.sqrt(max(total - floor**2, 0.0))
    variance_std = total * math.sqrt(2 / (len(y) / 2))
    probabilities = _class_probabilities(peak.false_alarm, (total - floor**2) / variance_std)
    label = max(probabilities, key=probabilities.__getitem__)
    period = 1 / peak.frequency
    aliased, finer = _find_aliases(y, way, peak, finest)
    state, reason = "estimated", ""
    if probabilities[label] < _MIN_PROBABILITY:
        state, reason = "undetermined", "slide further: the current's variation is near its noise"
    elif label == "periodic" and peak.at_longest_period:
        state, reason = "undetermined", f"longer than {1e3 * longest:.2g} mm: slide further"
    elif label == "periodic" and (finer or peak.persistence < _MIN_PERSISTENCE):
        why = "may be finer than" if finer else "no period persists along the slide; it may be finer than"
        state, reason = "undetermined", f"{why} {1e3 * finest:.2g} mm: slide more slowly"
    return TextureEstimate(
        state,
        label if state == "estimated" else "",
        reason,
        period,
        period * math.hypot(peak.std / peak.frequency, distance_std),
        peak.amplitude,
        roughness,
        variance_std / (2 * max(roughness, math.sqrt(variance_std))),
        floor,
        finest,
        longest,
        aliased,
        peak.false_alarm,
        len(y),
        length,
        probabilities,
    )


def _longest_slide(way: FloatArray) -> slice:
    """Return the longest part that moves in one direction."""
    if len(way) < 3 or not np.isfinite(way).all():
        return slice(0, 0)
    step = np.diff(way)
    fast = _ninetieth_percentile(np.abs(step))
    if fast <= 0:
        return slice(0, 0)
    forward = (step if step.sum() > 0 else -step) > 0.2 * fast
    edges = np.flatnonzero(np.diff(np.concatenate([[False], forward, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    return slice(int(begins[best]), int(ends[best]) + 1)


def _ninetieth_percentile(values: FloatArray) -> float:
    """Return the 90th percentile."""
    return float(np.sort(values)[int(0.9 * (len(values) - 1))])


def detrended(y: FloatArray, u: FloatArray) -> FloatArray:
    """Return y less its best-fitting cubic; u (n,) from 0 to 1."""
    basis = np.polynomial.legendre.legvander(2 * u - 1, _TREND_DEGREE)
    return np.asarray(y - basis @ np.linalg.solve(basis.T @ basis, basis.T @ y))


@dataclass(frozen=True)
class _SpectralPeak:
    frequency: float
    std: float
    amplitude: float
    power: float
    """power of the peak and of white noise at the finest periods, as mean |Y|^2 / n^2"""
    white_power: float
    false_alarm: float
    at_longest_period: bool
    """True at the longest period that could be resolved"""
    persistence: float
    """1: equally strong and in phase in each quarter of the slide; 1/4: in one of them alone"""


def _highest_peak(
    y: FloatArray, way: FloatArray, length: float, lowest: float, highest: float
) -> _SpectralPeak:
    """Return the peak that is highest relative to its neighbours, and the noise without it."""
    n = len(y)
    even = np.linspace(0, length, n)
    power, frequency = _periodogram(np.interp(even, way, y), length, lowest, highest)
    floor, _ = _neighbour_power(power)
    best, amplitude2 = _refine_frequency(y, way, float(frequency[int(np.argmax(power / floor))]), 1 / length)
    wave = np.exp(2j * math.pi * best * way)
    remainder = y - 2 * (wave * np.mean(y * wave.conj())).real
    power, frequency = _periodogram(np.interp(even, way, remainder), length, lowest, highest)
    floor, count = _neighbour_power(power)
    at = min(int(np.searchsorted(frequency, best)), len(frequency) - 1)
    level = amplitude2 / 4 / float(floor[at])
    single = (1 + level / count[at]) ** -float(count[at])  # F of 2 and 2 `count` degrees of freedom
    independent = max((highest - lowest) * length, 1.0)
    chance = -math.expm1(independent * math.log1p(-min(single, 1 - 1e-12)))
    std = math.sqrt(6 * float(floor[at]) / max(amplitude2, 1e-300)) / (math.pi * length)
    white = float(np.mean(floor[-max(len(floor) // 8, 1) :]))
    at_end = best < 0.98 * _MIN_PERIODS / length
    holds = _persistence(y, way, best)
    return _SpectralPeak(
        best, std, math.sqrt(amplitude2), amplitude2 / 4, white, min(chance, 1.0), at_end, holds
    )


def _periodogram(
    even: FloatArray, length: float, lowest: float, highest: float
) -> tuple[FloatArray, FloatArray]:
    """Return |Y|^2 / n^2 of an even grid, and its frequencies from lowest to highest."""
    n = len(even)
    size = _ZERO_PADDING << (n - 1).bit_length()
    power = np.abs(np.fft.rfft(even, size)) ** 2 / n**2
    step = (n - 1) / length / size
    first, last = math.ceil(lowest / step), math.floor(highest / step)
    frequency = step * np.arange(first, last + 1, dtype=np.float64)
    return np.asarray(power[first : last + 1], np.float64), frequency


def _neighbour_power(power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean power next to each frequency, and how many of the neighbours are independent."""
    width, hole = _NEIGHBOUR_FREQUENCIES * _ZERO_PADDING, 2 * _ZERO_PADDING
    sums = np.concatenate([[0.0], np.cumsum(power)])
    at, n = np.arange(len(power)), len(power)

    def within(reach: int) -> tuple[FloatArray, FloatArray]:
        low, high = np.maximum(at - reach, 0), np.minimum(at + reach + 1, n)
        return sums[high] - sums[low], (high - low).astype(np.float64)

    (wide, many), (near, few) = within(width), within(hole)
    mean = np.maximum((wide - near) / np.maximum(many - few, 1), 1e-300)
    return mean, np.maximum((many - few) / (2 * _ZERO_PADDING), 2.0)


def _persistence(y: FloatArray, way: FloatArray, frequency: float) -> float:
    quarter = len(y) // 4 * 4
    waves = (y * np.exp(-2j * math.pi * frequency * way))[:quarter].reshape(4, -1).mean(axis=1)
    return float(abs(waves.mean()) ** 2 / max(float((np.abs(waves) ** 2).mean()), 1e-300))


def _power_at(y: FloatArray, way: FloatArray, frequency: FloatArray) -> FloatArray:
    """Return |Y|^2 / n^2 at frequencies (m,), of samples at their own distances."""
    turns = (2 * math.pi) * frequency[:, None] * way
    return np.asarray(((np.cos(turns) @ y) ** 2 + (np.sin(turns) @ y) ** 2) / len(y) ** 2)


def _refine_frequency(y: FloatArray, way: FloatArray, frequency: float, width: float) -> tuple[float, float]:
    """Return the frequency of the highest power nearby, by parabolas, and the squared amplitude there."""
    for reach in (0.3, 0.05):
        near = frequency + reach * width * np.array([-1.0, 0.0, 1.0])
        low, middle, high = _power_at(y, way, near).tolist()
        bend = low - 2 * middle + high
        if bend < 0:
            frequency += reach * width * min(max(0.5 * (low - high) / bend, -1.5), 1.5)
    return frequency, 4 * float(_power_at(y, way, np.array([frequency]))[0])


def _find_aliases(y: FloatArray, way: FloatArray, peak: _SpectralPeak, finest: float) -> tuple[bool, bool]:
    """Return whether a finer texture fits about as well, and whether one fits better."""
    step, length = float(np.diff(way).mean()), float(way[-1])
    around = np.arange(-4, 5) / (4 * length)
    tried = np.concatenate([1 / step + around + sign * peak.frequency for sign in (-1, 1)])
    tried = tried[tried > 1 / finest]
    if not len(tried):
        return False, False
    power = float(_power_at(y, way, tried).max())
    return power > 0.5 * peak.power, power > 1.5 * peak.power


def _class_probabilities(false_alarm: float, excess: float) -> dict[str, float]:
    """Return the probabilities of TEXTURE_CLASSES.

    That of a period by the bound on the odds that a false-alarm rate implies (Sellke, 2001).
    """
    p = min(max(false_alarm, 1e-30), math.exp(-1))
    odds = _PERIODIC_PRIOR_ODDS / (-math.e * p * math.log(p))
    periodic = odds / (1 + odds)
    rough = 0.5 * math.erfc(-(excess - 2.0) / math.sqrt(2))
    return {"periodic": periodic, "rough": (1 - periodic) * rough, "smooth": (1 - periodic) * (1 - rough)}
