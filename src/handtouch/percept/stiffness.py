"""Stiffness from a squeeze, or from how force and area grow together.

A squeeze gives pairs of force F and depth d along the contact's normal, both with noise. For F = c (d - d0)^p
the number F^(1/p) is straight in d, so that one fit, of a line with errors in both variables (Deming, 1943),
serves p = 1 (spring, flat punch), 3/2 (sphere: Hertz, 1882) and 2 (cone: Sneddon, 1965). What is told is the
slope dF/dd at a stated force: where the samples are, exponents hardly differ in it.

Forces have to be those on the object: a sheet's own creep must have been taken out before, or it counts as
the object's. Depth is that of object, skin and what carries the object, one after the other.

Public names: `stiffness`, `stiffness_from_area`, `Stiffness`, `label_probabilities`, `CLASSES`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

CLASSES = ("soft", "medium", "hard")
BOUNDS_N_PER_M = (1e3, 1e4)
"""Between them. Labels are names for ranges of stiffness, nothing more."""
RANGE_N_PER_M = (10.0, 1e7)
"""Prior: the logarithm of the stiffness is anywhere between, evenly."""
EXPONENTS = (1.0, 1.5, 2.0)

_LEAST_SAMPLES = 16
_LEAST_RISE = 8.0  # of force, in standard deviations of a sample's noise
_LEAST_SHARE = 0.3  # of the force, that has to be rise: less tells nothing that drift wouldn't
_PARTS = 6
_LOW = 0.08  # of the greatest force: below, roots are mostly noise
_VAGUE = math.log(4.0)  # from one end of the 95 % interval to the other: wider is no estimate
_UNKNOWN = math.log(20.0)  # the same by what all samples share, which no longer squeeze makes less
_Z = 1.96
_GRID = np.linspace(-1.0, 1.0, 41)
_REACH = np.geomspace(1e-5, math.log(RANGE_N_PER_M[1] / RANGE_N_PER_M[0]), 48)
_Z_OF = np.linspace(-6.0, 6.0, 1201)
_BELOW = np.array([0.5 * math.erfc(-z / math.sqrt(2)) for z in _Z_OF.tolist()])  # of a normal number


@dataclass(frozen=True)
class Stiffness:
    """Tangent stiffness dF/dd [N/m] at `force_n`; `low`, `high` end the 95 % interval.

    state: estimated, unestimated (reason says what is missing; low and high hold where finite) or invalid.
    exponent: p of F = c (d - d0)^p, the most probable. unloading_n_per_m: slope on the way back, NaN without.
    scale_std: the part of the relative deviation that all forces share. samples: of the branch used.
    """

    state: str
    reason: str = ""
    stiffness_n_per_m: float = math.nan
    std_n_per_m: float = math.nan
    low_n_per_m: float = RANGE_N_PER_M[0]
    high_n_per_m: float = RANGE_N_PER_M[1]
    force_n: float = math.nan
    exponent: float = math.nan
    unloading_n_per_m: float = math.nan
    scale_std: float = 0.0
    branch: str = ""
    samples: int = 0
    probabilities: dict[str, float] = field(default_factory=dict)


def stiffness(
    force_n: ArrayLike,
    depth_m: ArrayLike,
    force_std_n: ArrayLike = 0.0,
    depth_std_m: float | None = None,
    *,
    skin_m_per_n: float = 0.0,
    skin_std_m_per_n: float = 0.0,
    moves: float = 0.0,
) -> Stiffness:
    """Stiffness of what a squeeze (n,) pressed: forces, and depths that grow as the hand closes, in order.

    depth_m: from joints, or as commanded; where it is 0 doesn't matter. force_std_n: () or (n,) of forces,
    taken for what all share, as a wrong contact radius; what each sample has by itself is told from the
    scatter. depth_std_m: noise of depths, None: told from the samples, as if it were white. skin_m_per_n:
    compliance of the pad's own skin, with its deviation: it is taken out. moves: which share of the depth may
    be the object's own way instead (1 sigma). Raises ValueError unless shapes fit.
    """
    force, depth = np.asarray(force_n, np.float64), np.asarray(depth_m, np.float64)
    if force.ndim != 1 or force.shape != depth.shape:
        raise ValueError(f"force_n has shape {force.shape}, depth_m {depth.shape}: they must be one, (n,)")
    spread = np.broadcast_to(np.asarray(force_std_n, np.float64), force.shape)
    known = np.isfinite(force) & np.isfinite(depth)
    force, depth, spread = force[known], depth[known] - skin_m_per_n * force[known], spread[known]
    if len(force) < _LEAST_SAMPLES:
        return Stiffness("unestimated", f"{len(force)} of {_LEAST_SAMPLES} samples with force and depth")
    noise = max(_noise(force), 1e-6 * float(np.ptp(force)))
    depth_noise = _noise(depth) if depth_std_m is None else depth_std_m
    loading, unloading = _branches(force)
    noises = noise, max(depth_noise, 1e-9)
    more = *noises, skin_std_m_per_n, moves
    found, back = _fit(force[loading], depth[loading], spread[loading], *more), math.nan
    if not found.samples:  # it began pressed
        found = _fit(force[unloading], depth[unloading], spread[unloading], *more)
        return replace(found, branch="unloading", unloading_n_per_m=found.stiffness_n_per_m)
    down = force[unloading] > max(_LOW * float(force.max()), 3 * noise)
    if np.count_nonzero(down) >= _LEAST_SAMPLES and np.ptp(force[unloading][down]) > _LEAST_RISE * noise:
        power = found.exponent
        line = _line(force[unloading][down], depth[unloading][down], power, noise**2, noises[1] ** 2)
        back = line.kappa * power * found.force_n ** (1 - 1 / power)
    return replace(found, branch="loading", unloading_n_per_m=back)


def stiffness_from_area(
    force_n: ArrayLike,
    radius_m: ArrayLike,
    log_std: ArrayLike,
    object_radius_m: float = 0.015,
    object_radius_log_std: float = 0.7,
    sheet_log_std: float = 0.1,
) -> Stiffness:
    """Stiffness of a round object pressed by a flat pad, from forces and contact radii (n,); no joints.

    Both as two sheets in one sandwich tell them (`field.Sandwich`). log_std: (2,) noise of ln force and of ln
    radius of a sample. By Hertz d = a^2 / R, so dF/dd = 3/2 F R / a^2: the radius R of the object must come
    from elsewhere. sheet_log_std: of ln F / a^2, by what isn't known of the sheets; two that are known within
    2 % leave so much. The default of the radius is a prior for things in a hand, 15 mm within a factor of 2,
    and then most of the deviation. invalid where the radius doesn't grow as force^(1/3): then it isn't Hertz.
    """
    force, radius = np.asarray(force_n, np.float64), np.asarray(radius_m, np.float64)
    force_std, radius_std = np.asarray(log_std, np.float64)
    known = np.isfinite(force) & np.isfinite(radius) & (force > 0) & (radius > 0)
    x, y = np.log(force[known]), np.log(radius[known])
    if len(x) < _LEAST_SAMPLES:
        return Stiffness("unestimated", f"{len(x)} of {_LEAST_SAMPLES} samples with force and area")
    if np.ptp(x) < math.log(1.5):
        return Stiffness("unestimated", "the force has to grow by half to tell how the area does")
    variance = force_std**2 / 9 + radius_std**2
    slope = _deming(x, y, force_std, radius_std)
    slope_std = math.sqrt(variance / float(((x - x.mean()) ** 2).sum()))
    if abs(slope - 1 / 3) > 3 * slope_std + 0.05:
        grows = f"radius grows as force^{slope:.2f} +- {slope_std:.2f}"
        return Stiffness("invalid", f"{grows}, a round elastic body's as force^0.33", samples=len(x))
    at = float(x.mean())
    log_k = math.log(1.5 * object_radius_m) + at - 2 * float(y.mean())
    std = math.hypot(2 * math.sqrt(variance / len(x)), object_radius_log_std, sheet_log_std)
    return _of_logs(np.array([log_k]), np.ones(1), std, math.exp(at), 1.5, len(x), math.inf)


def label_probabilities(log_stiffness: FloatArray, weights: FloatArray, std: float) -> dict[str, float]:
    """Probability of each of CLASSES, from a posterior of ln stiffness and a deviation that comes on top."""
    below = [0.0]
    for bound in BOUNDS_N_PER_M:
        z = (math.log(bound) - log_stiffness) / max(std, 1e-6)
        below.append(float(weights @ np.interp(z, _Z_OF, _BELOW)))
    below.append(1.0)
    return {name: max(below[k + 1] - below[k], 0.0) for k, name in enumerate(CLASSES)}


def _noise(values: FloatArray) -> float:
    """Standard deviation of white noise on something smooth, from second differences."""
    second = np.diff(values, 2)
    return math.sqrt(float(second @ second) / (6 * len(second)))


def _branches(force: FloatArray) -> tuple[slice, slice]:
    """Where the force rises to its greatest, and where it falls from there."""
    width = max(len(force) // 64, 1)
    smooth = np.convolve(force, np.full(width, 1 / width), mode="valid")
    top = int(np.argmax(smooth))
    bottom, end = int(np.argmin(smooth[: top + 1])), top + int(np.argmin(smooth[top:]))
    middle = width // 2
    return slice(bottom + middle, top + middle + 1), slice(top + middle, end + middle + 1)


@dataclass(frozen=True)
class _Line:
    """u = kappa (d - d0), u = F^(1/p): weighted moments, and chi^2 as a function of kappa."""

    moments: tuple[float, float, float]
    """of u u, u d, d d about the means"""
    ratio: float
    """variance of d's noise over that of u's"""
    kappa: float
    residual: FloatArray
    """in units of noise"""
    excess_n2: float
    """variance of the force that scatters beyond what noise would"""

    @property
    def least(self) -> float:
        """chi^2 at its least."""
        return float(self.residual @ self.residual)

    def chi2(self, kappa: FloatArray) -> FloatArray:
        uu, ud, dd = self.moments
        at = (1 + self.kappa**2 * self.ratio) / (1 + np.square(kappa) * self.ratio)
        return np.asarray((uu - 2 * kappa * ud + np.square(kappa) * dd) * at)


def _line(force: FloatArray, d: FloatArray, exponent: float, variance_n2: float, d_var: float) -> _Line:
    """Weighted Deming fit."""
    u, by_force = force ** (1 / exponent), force ** (1 / exponent - 1) / exponent
    u_var = by_force**2 * variance_n2
    ratio = float(d_var / u_var.mean())
    kappa = float(u.std() / max(float(d.std()), 1e-12))
    for _ in range(3):
        weight = 1 / (u_var + kappa**2 * d_var)
        total = weight.sum()
        du, dd = u - weight @ u / total, d - weight @ d / total
        moments = float(weight @ (du * du)), float(weight @ (du * dd)), float(weight @ (dd * dd))
        last, kappa = kappa, max(_slope(moments, ratio), 1e-9)
    scaled = (1 + last**2 * ratio) / (1 + kappa**2 * ratio)
    moments = moments[0] * scaled, moments[1] * scaled, moments[2] * scaled
    residual = (du - kappa * dd) * np.sqrt(weight * scaled)
    over = float(residual @ residual) / max(len(u) - 2, 1) - 1
    excess = over * float(np.mean((u_var + kappa**2 * d_var) / by_force**2))
    return _Line(moments, ratio, kappa, residual, excess)


def _slope(moments: tuple[float, float, float], ratio: float) -> float:
    """Of the line with the least chi^2: u by d, with noises of a given ratio of variances."""
    uu, ud, dd = moments
    if ratio * uu < 1e-9 * dd or ud == 0:
        return ud / max(dd, 1e-300)
    off = dd - ratio * uu
    return (-off + math.sqrt(off * off + 4 * ratio * ud * ud)) / (2 * ratio * ud)


def _deming(x: FloatArray, y: FloatArray, x_std: float, y_std: float) -> float:
    dx, dy = x - x.mean(), y - y.mean()
    return _slope((float(dy @ dy), float(dy @ dx), float(dx @ dx)), (x_std / y_std) ** 2)


def _fit(
    force: FloatArray,
    depth: FloatArray,
    spread: FloatArray,
    noise: float,
    depth_noise: float,
    skin_std: float,
    moves: float,
) -> Stiffness:
    """Posterior of the tangent stiffness of one branch."""
    keep = force > max(_LOW * float(force.max(initial=0.0)), 3 * noise)
    force, depth, spread = force[keep], depth[keep], spread[keep]
    if len(force) < _LEAST_SAMPLES:
        return Stiffness("unestimated", "squeeze for longer: the force hardly rises")
    rise = float(np.ptp(force))
    if rise < max(_LEAST_RISE * noise, _LEAST_SHARE * float(force.max())):
        return Stiffness("unestimated", f"squeeze more: the force rose by {rise:.2g} N only")
    at_n = float(force.mean())
    variance = noise**2
    for _ in range(2):  # noise that is correlated doesn't show in second differences: look at what scatters
        lines = [_line(force, depth, exponent, variance, depth_noise**2) for exponent in EXPONENTS]
        best = int(np.argmin([line.least for line in lines]))
        correlation = _correlation(lines[best].residual)
        excess = lines[best].excess_n2 * (1 - 1 / correlation)  # white excess is chance
        last, variance = variance, max(variance + excess, noise**2)
        if variance < 1.05 * last:
            break
    logs, weights = _posterior(lines, best, correlation, at_n)
    independent = len(force) / correlation
    scale = math.hypot(_common(force, spread), skin_std * math.exp(float(weights @ logs)), moves)
    return _of_logs(logs, weights, scale, at_n, EXPONENTS[best], len(force), independent - 2)


def _posterior(
    lines: Sequence[_Line], best: int, correlation: float, at_n: float
) -> tuple[FloatArray, FloatArray]:
    """Ln stiffness and weights, over all exponents."""
    least = lines[best].least
    inflate = correlation * max(least / max(len(lines[best].residual) - 2, 1), 1.0)
    logs, scores, widths = [], [], []
    for line, exponent in zip(lines, EXPONENTS, strict=True):
        factor = exponent * at_n ** (1 - 1 / exponent)
        low, high = (math.log(edge / factor) for edge in RANGE_N_PER_M)
        width = _width(line, inflate)
        centre = min(max(math.log(line.kappa), low), high)
        ends = max(centre - width, low), min(centre + width, high)
        log_kappa = ends[0] + (ends[1] - ends[0]) * (_GRID + 1) / 2
        logs.append(log_kappa + math.log(factor))
        scores.append((line.chi2(np.exp(log_kappa)) - least) / (2 * inflate))
        widths.append(np.full(len(log_kappa), ends[1] - ends[0]))
    score = np.concatenate(scores)  # the least of them is far from `least` where that lies beyond the range
    weights = np.exp(score.min() - score) * np.concatenate(widths)
    return np.concatenate(logs), weights / weights.sum()


def _width(line: _Line, inflate: float) -> float:
    """How far from the best ln kappa the posterior has fallen to nothing."""
    both = np.exp(np.stack([-_REACH, _REACH])) * line.kappa
    over = ((line.chi2(both) - line.least) > 30 * inflate).all(axis=0)
    return float(_REACH[int(np.argmax(over))]) if over.any() else float(_REACH[-1])


def _correlation(residual: FloatArray) -> float:
    """Samples for one independent of them: 1 + 2 sum of autocorrelations, up to where they have died away."""
    lags = min(len(residual) // 3, 128)
    power = float(residual @ residual)
    if power <= 0 or lags < 2:
        return 1.0
    size = 1 << (2 * len(residual) - 1).bit_length()
    spectrum = np.fft.rfft(residual, size)
    rho = np.fft.irfft(np.abs(spectrum) ** 2)[1 : lags + 1] / power
    gone = int(np.argmax(rho < 0.05)) if (rho < 0.05).any() else lags
    return 1 + 2 * float(rho[:gone].sum())


def _common(force: FloatArray, spread: FloatArray) -> float:
    """Relative deviation that slopes have from what all forces share, as a wrong gain or contact radius.

    Independent causes add their variances, a^2 + b^2 F^2, of which b tilts; one alone, as a radius, tilts by
    how its deviation changes with the force, here and there. The greater of the two.
    """
    std = np.where(np.isfinite(spread), spread, force)
    square = force * force
    away = square - square.mean()
    of_gain = float(away @ (std * std)) / max(float(away @ away), 1e-300)
    parts = np.array_split(np.argsort(force), _PARTS)
    mean = np.array([(force[part].mean(), std[part].mean()) for part in parts])
    steps = np.diff(mean, axis=0)
    of_one = float(np.max(np.abs(steps[:, 1]) / np.maximum(steps[:, 0], 1e-9 * force.max())))
    return min(max(math.sqrt(max(of_gain, 0.0)), of_one), 1.0)


def _of_logs(
    logs: FloatArray, weights: FloatArray, scale: float, at_n: float, exponent: float, n: int, freedom: float
) -> Stiffness:
    """What a posterior of ln stiffness and a common relative deviation say."""
    order = np.argsort(logs)
    mass = np.cumsum(weights[order]) - weights[order] / 2
    low, median, high = np.interp([0.025, 0.5, 0.975], mass, logs[order])
    own = math.sqrt(float(weights @ (logs - weights @ logs) ** 2))
    freedom = max(freedom, 1.0)
    wider = (1 + (_Z**2 + 1) / (4 * freedom)) if math.isfinite(freedom) else 1.0  # Student's t
    low, high = (
        median - math.hypot(wider * (median - low), _Z * scale),
        median + math.hypot(wider * (high - median), _Z * scale),
    )
    log_std = math.hypot(wider * own, scale)
    ends = math.exp(low), math.exp(high)
    probabilities = label_probabilities(logs, weights, math.hypot(scale, (wider - 1) * own))
    state, reason = "estimated", ""
    anything = f"anything from {ends[0]:.2g} to {ends[1]:.2g} N/m fits"
    if 2 * _Z * scale > _UNKNOWN:
        state, reason = "unestimated", f"force or depth isn't known well enough: {anything}"
    elif high - low > math.hypot(_VAGUE, 2 * _Z * scale):
        state, reason = "unestimated", f"squeeze more: {anything}"
    k = math.exp(median)
    return Stiffness(
        state, reason, k, k * log_std, *ends, at_n, exponent, math.nan, scale, "", n, probabilities
    )
