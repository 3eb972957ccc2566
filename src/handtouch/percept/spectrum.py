"""Period and roughness of a surface: what the total current does while a contact slides, by distance.

The current's logarithm, less a slow trend, is put on an even grid of distance; a peak of its periodogram (A.
Schuster, 1898) is compared with its neighbours, as neither sheets nor surfaces are white. It is a period if
chance hardly makes one as high, and if it holds all along the slide. Its deviation is the Cramer-Rao bound of
a sine in such noise. Periods below two steps between samples can't be seen: `finest_m`; what is finer may
look like a coarser one, unless the speed changed.

Public names: `texture`, `Found`, `detrended`, `CLASSES`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CLASSES = ("periodic", "rough", "smooth")

_LEAST = 48  # samples
_PERIODS = 4.0  # of the longest that a slide can tell, at least
_SEARCHED = 3.0  # fewer leak into more
_PERIODIC_ODDS = 0.05  # prior
_HOLDS = 0.7
_BESIDE = 12  # independent frequencies to each side that a peak is compared with
_TREND = 3  # degree
_SURE = 0.9
_PADDED = 4  # finer than the independent frequencies


@dataclass(frozen=True)
class Found:
    """What a slide tells. `finest_m`, `longest_m`: the periods that it could tell.

    amplitude: of the period, relative to the current. roughness: root mean square of all that the current
    does beyond its noise, relative; floor: that noise. aliased: whether a finer texture would look the same.
    false_alarm: how often chance makes such a peak.
    """

    state: str
    label: str = ""
    reason: str = ""
    period_m: float = math.nan
    period_std_m: float = math.nan
    amplitude: float = math.nan
    roughness: float = math.nan
    roughness_std: float = math.nan
    floor: float = math.nan
    finest_m: float = math.nan
    longest_m: float = math.nan
    aliased: bool = True
    false_alarm: float = 1.0
    samples: int = 0
    distance_m: float = 0.0
    probabilities: dict[str, float] = field(default_factory=dict)


def texture(
    current_a: FloatArray, distance_m: FloatArray, noise: float | None = None, distance_std: float = 0.0
) -> Found:
    """Texture from currents (n,) at distances (n,) along a slide, in order, evenly in time.

    noise: relative standard deviation of a current at rest; None: the finest periods are taken for noise.
    distance_std: relative error that all distances share. Raises ValueError unless shapes are one, (n,).
    """
    current, way = np.asarray(current_a, np.float64), np.asarray(distance_m, np.float64)
    if current.ndim != 1 or current.shape != way.shape:
        raise ValueError(f"current_a has shape {current.shape}, distance_m {way.shape}: must be one, (n,)")
    part = _stretch(way)
    current, way = current[part], way[part]
    if len(way) < _LEAST:
        return Found("unestimated", reason=f"slides for {len(way)} of {_LEAST} samples", samples=len(way))
    if not (current > 0).all():
        return Found("invalid", reason="a current isn't positive", samples=len(way))
    way = np.abs(way - way[0])
    length = float(way[-1])
    finest, longest = 2 * _tenth(np.diff(way)), length / _PERIODS
    if longest < 2 * finest:
        reason = f"{1e3 * length:.2g} mm in {len(way)} samples: slide further, or more slowly"
        return Found("unestimated", "", reason, finest_m=finest, longest_m=longest, samples=len(way))
    y = detrended(np.log(current), way / length)
    peak = _peak(y, way, length, _SEARCHED / length, 1 / finest)
    floor = math.sqrt(peak.white * len(y)) if noise is None else noise
    total = float(y @ y) / len(y)
    roughness = math.sqrt(max(total - floor**2, 0.0))
    variance_std = total * math.sqrt(2 / (len(y) / 2))
    probabilities = _probabilities(peak.false_alarm, (total - floor**2) / variance_std)
    label = max(probabilities, key=probabilities.__getitem__)
    period = 1 / peak.frequency
    aliased, finer = _aliases(y, way, peak, finest)
    state, reason = "estimated", ""
    if probabilities[label] < _SURE:
        state, reason = "unestimated", "slide further: what the current does is near its noise"
    elif label == "periodic" and peak.at_end:
        state, reason = "unestimated", f"longer than {1e3 * longest:.2g} mm: slide further"
    elif label == "periodic" and (finer or peak.holds < _HOLDS):
        why = "may be finer than" if finer else "no period holds all along; it may be finer than"
        state, reason = "unestimated", f"{why} {1e3 * finest:.2g} mm: slide more slowly"
    return Found(
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


def _stretch(way: FloatArray) -> slice:
    """The longest part in which it moves on, one way."""
    if len(way) < 3 or not np.isfinite(way).all():
        return slice(0, 0)
    step = np.diff(way)
    fast = _tenth(np.abs(step))
    if fast <= 0:
        return slice(0, 0)
    forward = (step if step.sum() > 0 else -step) > 0.2 * fast
    edges = np.flatnonzero(np.diff(np.concatenate([[False], forward, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    return slice(int(begins[best]), int(ends[best]) + 1)


def _tenth(values: FloatArray) -> float:
    """What a tenth of them exceed."""
    return float(np.sort(values)[int(0.9 * (len(values) - 1))])


def detrended(y: FloatArray, u: FloatArray) -> FloatArray:
    """Less the cubic that fits best; u (n,) from 0 to 1."""
    basis = np.polynomial.legendre.legvander(2 * u - 1, _TREND)
    return np.asarray(y - basis @ np.linalg.solve(basis.T @ basis, basis.T @ y))


@dataclass(frozen=True)
class _Peak:
    frequency: float
    std: float
    amplitude: float
    power: float
    """of the peak, as `white`, mean |Y|^2 / n^2 of noise at the finest periods"""
    white: float
    false_alarm: float
    at_end: bool
    """at the longest period that could be told"""
    holds: float
    """1: as strong and in step in each quarter of the slide; 1/4: in one of them alone"""


def _peak(y: FloatArray, way: FloatArray, length: float, lowest: float, highest: float) -> _Peak:
    """The highest peak above the mean of its neighbours, and the noise once it is taken out."""
    n = len(y)
    even = np.linspace(0, length, n)
    power, frequency = _periodogram(np.interp(even, way, y), length, lowest, highest)
    floor, _ = _neighbours(power)
    best, amplitude2 = _refined(y, way, float(frequency[int(np.argmax(power / floor))]), 1 / length)
    wave = np.exp(2j * math.pi * best * way)
    rest = y - 2 * (wave * np.mean(y * wave.conj())).real
    power, frequency = _periodogram(np.interp(even, way, rest), length, lowest, highest)
    floor, count = _neighbours(power)
    at = min(int(np.searchsorted(frequency, best)), len(frequency) - 1)
    level = amplitude2 / 4 / float(floor[at])
    single = (1 + level / count[at]) ** -float(count[at])  # F of 2 and 2 `count` degrees of freedom
    independent = max((highest - lowest) * length, 1.0)
    chance = -math.expm1(independent * math.log1p(-min(single, 1 - 1e-12)))
    std = math.sqrt(6 * float(floor[at]) / max(amplitude2, 1e-300)) / (math.pi * length)
    white = float(np.mean(floor[-max(len(floor) // 8, 1) :]))
    at_end = best < 0.98 * _PERIODS / length
    holds = _holds(y, way, best)
    return _Peak(best, std, math.sqrt(amplitude2), amplitude2 / 4, white, min(chance, 1.0), at_end, holds)


def _periodogram(
    even: FloatArray, length: float, lowest: float, highest: float
) -> tuple[FloatArray, FloatArray]:
    """|Y|^2 / n^2 of an even grid, and its frequencies from lowest to highest."""
    n = len(even)
    size = _PADDED << (n - 1).bit_length()
    power = np.abs(np.fft.rfft(even, size)) ** 2 / n**2
    step = (n - 1) / length / size
    first, last = math.ceil(lowest / step), math.floor(highest / step)
    frequency = step * np.arange(first, last + 1, dtype=np.float64)
    return np.asarray(power[first : last + 1], np.float64), frequency


def _neighbours(power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean power of the neighbours of each frequency, and how many of them are independent."""
    width, hole = _BESIDE * _PADDED, 2 * _PADDED
    sums = np.concatenate([[0.0], np.cumsum(power)])
    at, n = np.arange(len(power)), len(power)

    def within(reach: int) -> tuple[FloatArray, FloatArray]:
        low, high = np.maximum(at - reach, 0), np.minimum(at + reach + 1, n)
        return sums[high] - sums[low], (high - low).astype(np.float64)

    (wide, many), (near, few) = within(width), within(hole)
    mean = np.maximum((wide - near) / np.maximum(many - few, 1), 1e-300)
    return mean, np.maximum((many - few) / (2 * _PADDED), 2.0)


def _holds(y: FloatArray, way: FloatArray, frequency: float) -> float:
    quarter = len(y) // 4 * 4
    waves = (y * np.exp(-2j * math.pi * frequency * way))[:quarter].reshape(4, -1).mean(axis=1)
    return float(abs(waves.mean()) ** 2 / max(float((np.abs(waves) ** 2).mean()), 1e-300))


def _power_at(y: FloatArray, way: FloatArray, frequency: FloatArray) -> FloatArray:
    """|Y|^2 / n^2 at frequencies (m,), of samples where they are."""
    turns = (2 * math.pi) * frequency[:, None] * way
    return np.asarray(((np.cos(turns) @ y) ** 2 + (np.sin(turns) @ y) ** 2) / len(y) ** 2)


def _refined(y: FloatArray, way: FloatArray, frequency: float, width: float) -> tuple[float, float]:
    """Frequency of the highest power near one, by a parabola, and the squared amplitude there."""
    for reach in (0.3, 0.05):
        near = frequency + reach * width * np.array([-1.0, 0.0, 1.0])
        low, middle, high = _power_at(y, way, near).tolist()
        bend = low - 2 * middle + high
        if bend < 0:
            frequency += reach * width * min(max(0.5 * (low - high) / bend, -1.5), 1.5)
    return frequency, 4 * float(_power_at(y, way, np.array([frequency]))[0])


def _aliases(y: FloatArray, way: FloatArray, peak: _Peak, finest: float) -> tuple[bool, bool]:
    """Whether a finer texture fits about as well, and whether one fits better."""
    step, length = float(np.diff(way).mean()), float(way[-1])
    around = np.arange(-4, 5) / (4 * length)
    tried = np.concatenate([1 / step + around + sign * peak.frequency for sign in (-1, 1)])
    tried = tried[tried > 1 / finest]
    if not len(tried):
        return False, False
    power = float(_power_at(y, way, tried).max())
    return power > 0.5 * peak.power, power > 1.5 * peak.power


def _probabilities(false_alarm: float, excess: float) -> dict[str, float]:
    """Of CLASSES; of a period by the bound on the odds that a false-alarm rate can mean (Sellke, 2001)."""
    p = min(max(false_alarm, 1e-30), math.exp(-1))
    odds = _PERIODIC_ODDS / (-math.e * p * math.log(p))
    periodic = odds / (1 + odds)
    rough = 0.5 * math.erfc(-(excess - 2.0) / math.sqrt(2))
    return {"periodic": periodic, "rough": (1 - periodic) * rough, "smooth": (1 - periodic) * (1 - rough)}
