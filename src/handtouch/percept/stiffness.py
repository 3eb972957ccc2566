"""Stiffness from a squeeze, or from the joint growth of force and contact area.

A squeeze gives pairs of force F and depth d along the contact's normal, both with noise. For F = c (d - d0)^p
the number F^(1/p) is linear in d, so that one fit, of a line with errors in both variables (Deming, 1943),
serves p = 1 (spring, flat punch), 3/2 (sphere: Hertz, 1882) and 2 (cone: Sneddon, 1965). The result is the
slope dF/dd at a stated force: among the samples, exponents hardly differ in it.

Forces must be those on the object: a sheet's own creep must have been compensated, or it counts as the
object's. Depth is that of object, skin and the object's support in series.

Public names: `estimate_stiffness`, `estimate_stiffness_from_area`, `StiffnessEstimate`,
`class_probabilities`, `STIFFNESS_CLASSES`, `UNCOMPENSATED_SHEET_STD`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

STIFFNESS_CLASSES = ("soft", "medium", "hard")
CLASS_BOUNDS_N_PER_M = (1e3, 1e4)
"""Bounds between the classes; labels are names of ranges of stiffness, nothing more."""
PRIOR_RANGE_N_PER_M = (10.0, 1e7)
"""Prior: the logarithm of the stiffness is uniform within this range."""
EXPONENTS = (1.0, 1.5, 2.0)
UNCOMPENSATED_SHEET_STD = 0.25
"""Relative deviation of a stiffness from creep, adaptation and hysteresis of a sheet whose behaviour isn't
modelled: between a sheet without any and one that loses four tenths of the force's rise."""

_MIN_SAMPLES = 16
_MIN_FORCE_RISE_SIGMA = 8.0  # of the force, relative to a sample's noise
_MIN_FORCE_RISE_FRACTION = 0.3  # of the force: a smaller rise could be drift
_FORCE_BINS = 6
_MIN_FORCE_FRACTION = 0.08  # of the peak force: below, roots are mostly noise
_MAX_LOG_INTERVAL = math.log(4.0)  # width of the 95 % interval, beyond which there is no estimate
_MAX_COMMON_LOG_INTERVAL = math.log(
    20.0
)  # the same from errors that all samples share, which longer squeezes don't reduce
_Z_95 = 1.96
_KAPPA_GRID = np.linspace(-1.0, 1.0, 41)
_LOG_KAPPA_REACH = np.geomspace(1e-5, math.log(PRIOR_RANGE_N_PER_M[1] / PRIOR_RANGE_N_PER_M[0]), 48)
_NORMAL_Z = np.linspace(-6.0, 6.0, 1201)
_NORMAL_CDF = np.array(
    [0.5 * math.erfc(-z / math.sqrt(2)) for z in _NORMAL_Z.tolist()]
)  # of the standard normal distribution


@dataclass(frozen=True)
class StiffnessEstimate:
    """Tangent stiffness dF/dd [N/m] at `at_force_n`; low and high are the ends of the 95 % interval.

    state: estimated, undetermined (reason says what is missing; low and high hold if finite) or invalid.
    exponent: most probable p of F = c (d - d0)^p. unloading_n_per_m: slope on the way back, NaN if unknown.
    common_relative_std: the part of the relative deviation that all forces share. samples: of the branch
    used.
    """

    state: str
    reason: str = ""
    stiffness_n_per_m: float = math.nan
    std_n_per_m: float = math.nan
    low_n_per_m: float = PRIOR_RANGE_N_PER_M[0]
    high_n_per_m: float = PRIOR_RANGE_N_PER_M[1]
    at_force_n: float = math.nan
    exponent: float = math.nan
    unloading_n_per_m: float = math.nan
    common_relative_std: float = 0.0
    branch: str = ""
    samples: int = 0
    probabilities: dict[str, float] = field(default_factory=dict)


def estimate_stiffness(
    force_n: ArrayLike,
    depth_m: ArrayLike,
    force_std_n: ArrayLike = 0.0,
    depth_std_m: float | None = None,
    *,
    skin_m_per_n: float = 0.0,
    skin_std_m_per_n: float = 0.0,
    object_motion_fraction: float = 0.0,
    sheet_relative_std: float = 0.0,
) -> StiffnessEstimate:
    """Estimate the stiffness of a squeezed object from forces (n,) and depths (n,), in order of time.

    depth_m: from joint states, or as commanded, up to a constant. force_std_n: () or (n,), error that all
    forces share, such as that of a wrong contact radius; the noise of single samples is estimated from their
    scatter. depth_std_m: noise of depths; None: estimated from the samples as white noise. skin_m_per_n:
    compliance of the pad's own skin, with its deviation; it is subtracted. object_motion_fraction: part of
    the depth that may be motion of the object (1 sigma). sheet_relative_std: of the result, because the
    sheet's behaviour isn't compensated; UNCOMPENSATED_SHEET_STD for an unknown sheet. Raises ValueError
    unless shapes match.
    """
    force, depth = np.asarray(force_n, np.float64), np.asarray(depth_m, np.float64)
    if force.ndim != 1 or force.shape != depth.shape:
        raise ValueError(f"force_n has shape {force.shape}, depth_m {depth.shape}: they must be one, (n,)")
    spread = np.broadcast_to(np.asarray(force_std_n, np.float64), force.shape)
    known = np.isfinite(force) & np.isfinite(depth)
    force, depth, spread = force[known], depth[known] - skin_m_per_n * force[known], spread[known]
    if len(force) < _MIN_SAMPLES:
        return StiffnessEstimate(
            "undetermined", f"{len(force)} of {_MIN_SAMPLES} samples with force and depth"
        )
    noise = max(_white_noise_std(force), 1e-6 * float(np.ptp(force)))
    depth_noise = _white_noise_std(depth) if depth_std_m is None else depth_std_m
    loading, unloading = _loading_branches(force)
    noises = noise, max(depth_noise, 1e-9)
    more = *noises, skin_std_m_per_n, object_motion_fraction, sheet_relative_std
    found, back = _fit_branch(force[loading], depth[loading], spread[loading], *more), math.nan
    if not found.samples:  # the contact began under load
        found = _fit_branch(force[unloading], depth[unloading], spread[unloading], *more)
        return replace(found, branch="unloading", unloading_n_per_m=found.stiffness_n_per_m)
    down = force[unloading] > max(_MIN_FORCE_FRACTION * float(force.max()), 3 * noise)
    if (
        np.count_nonzero(down) >= _MIN_SAMPLES
        and np.ptp(force[unloading][down]) > _MIN_FORCE_RISE_SIGMA * noise
    ):
        power = found.exponent
        line = _fit_line(force[unloading][down], depth[unloading][down], power, noise**2, noises[1] ** 2)
        back = line.kappa * power * found.at_force_n ** (1 - 1 / power)
    return replace(found, branch="loading", unloading_n_per_m=back)


def estimate_stiffness_from_area(
    force_n: ArrayLike,
    radius_m: ArrayLike,
    log_std: ArrayLike,
    object_radius_m: float = 0.015,
    object_radius_log_std: float = 0.7,
    sheet_log_std: float = 0.1,
) -> StiffnessEstimate:
    """Estimate the stiffness of a round object pressed by a flat pad, from forces and contact radii (n,).

    Needs no joint states; forces and radii as two sheets in one sandwich measure them (`field.Sandwich`).
    log_std: (2,) noise of ln force and of ln radius of a sample. By Hertz d = a^2 / R, so dF/dd = 3/2 F R /
    a^2: the radius R of the object must be known otherwise. sheet_log_std: of ln F / a^2, from unknown
    parameters of the sheets; two sheets known within 2 % leave this much. The default radius is a prior for
    objects in a hand, 15 mm within a factor of 2, and then dominates the deviation. The result is invalid
    unless the radius grows as force^(1/3), as Hertz's law demands.
    """
    force, radius = np.asarray(force_n, np.float64), np.asarray(radius_m, np.float64)
    force_std, radius_std = np.asarray(log_std, np.float64)
    known = np.isfinite(force) & np.isfinite(radius) & (force > 0) & (radius > 0)
    x, y = np.log(force[known]), np.log(radius[known])
    if len(x) < _MIN_SAMPLES:
        return StiffnessEstimate("undetermined", f"{len(x)} of {_MIN_SAMPLES} samples with force and area")
    if np.ptp(x) < math.log(1.5):
        return StiffnessEstimate("undetermined", "the force must grow by half to determine the area's growth")
    variance = force_std**2 / 9 + radius_std**2
    slope = _unweighted_deming_slope(x, y, force_std, radius_std)
    slope_std = math.sqrt(variance / float(((x - x.mean()) ** 2).sum()))
    if abs(slope - 1 / 3) > 3 * slope_std + 0.05:
        grows = f"radius grows as force^{slope:.2f} +- {slope_std:.2f}"
        return StiffnessEstimate("invalid", f"{grows}, a round elastic body's as force^0.33", samples=len(x))
    at = float(x.mean())
    log_k = math.log(1.5 * object_radius_m) + at - 2 * float(y.mean())
    std = math.hypot(2 * math.sqrt(variance / len(x)), object_radius_log_std, sheet_log_std)
    return _from_log_posterior(np.array([log_k]), np.ones(1), std, math.exp(at), 1.5, len(x), math.inf)


def class_probabilities(log_stiffness: FloatArray, weights: FloatArray, std: float) -> dict[str, float]:
    """Return probabilities of STIFFNESS_CLASSES for a posterior of ln stiffness and an extra deviation."""
    below = [0.0]
    for bound in CLASS_BOUNDS_N_PER_M:
        z = (math.log(bound) - log_stiffness) / max(std, 1e-6)
        below.append(float(weights @ np.interp(z, _NORMAL_Z, _NORMAL_CDF)))
    below.append(1.0)
    return {name: max(below[k + 1] - below[k], 0.0) for k, name in enumerate(STIFFNESS_CLASSES)}


def _white_noise_std(values: FloatArray) -> float:
    """Return the standard deviation of white noise on a smooth signal, from second differences."""
    second = np.diff(values, 2)
    return math.sqrt(float(second @ second) / (6 * len(second)))


def _loading_branches(force: FloatArray) -> tuple[slice, slice]:
    """Return the slices where the force rises to its maximum, and where it falls from there."""
    width = max(len(force) // 64, 1)
    smooth = np.convolve(force, np.full(width, 1 / width), mode="valid")
    top = int(np.argmax(smooth))
    bottom, end = int(np.argmin(smooth[: top + 1])), top + int(np.argmin(smooth[top:]))
    middle = width // 2
    return slice(bottom + middle, top + middle + 1), slice(top + middle, end + middle + 1)


@dataclass(frozen=True)
class _DemingLine:
    """Line u = kappa (d - d0), u = F^(1/p): weighted moments, and chi^2 as a function of kappa."""

    moments: tuple[float, float, float]
    """of u u, u d, d d about the means"""
    variance_ratio: float
    """variance of d's noise over that of u's"""
    kappa: float
    residual: FloatArray
    """in units of noise"""
    excess_n2: float
    """variance of the force's scatter beyond its noise"""

    @property
    def min_chi2(self) -> float:
        """Minimum of chi^2."""
        return float(self.residual @ self.residual)

    def chi2(self, kappa: FloatArray) -> FloatArray:
        uu, ud, dd = self.moments
        at = (1 + self.kappa**2 * self.variance_ratio) / (1 + np.square(kappa) * self.variance_ratio)
        return np.asarray((uu - 2 * kappa * ud + np.square(kappa) * dd) * at)


def _fit_line(
    force: FloatArray, d: FloatArray, exponent: float, variance_n2: float, d_var: float
) -> _DemingLine:
    """Return the weighted Deming fit."""
    u, by_force = force ** (1 / exponent), force ** (1 / exponent - 1) / exponent
    u_var = by_force**2 * variance_n2
    ratio = float(d_var / u_var.mean())
    kappa = float(u.std() / max(float(d.std()), 1e-12))
    for _ in range(3):
        weight = 1 / (u_var + kappa**2 * d_var)
        total = weight.sum()
        du, dd = u - weight @ u / total, d - weight @ d / total
        moments = float(weight @ (du * du)), float(weight @ (du * dd)), float(weight @ (dd * dd))
        last, kappa = kappa, max(_deming_slope(moments, ratio), 1e-9)
    scaled = (1 + last**2 * ratio) / (1 + kappa**2 * ratio)
    moments = moments[0] * scaled, moments[1] * scaled, moments[2] * scaled
    residual = (du - kappa * dd) * np.sqrt(weight * scaled)
    over = float(residual @ residual) / max(len(u) - 2, 1) - 1
    excess = over * float(np.mean((u_var + kappa**2 * d_var) / by_force**2))
    return _DemingLine(moments, ratio, kappa, residual, excess)


def _deming_slope(moments: tuple[float, float, float], ratio: float) -> float:
    """Return the slope of u over d with the least chi^2, for a given ratio of noise variances."""
    uu, ud, dd = moments
    if ratio * uu < 1e-9 * dd or ud == 0:
        return ud / max(dd, 1e-300)
    off = dd - ratio * uu
    return (-off + math.sqrt(off * off + 4 * ratio * ud * ud)) / (2 * ratio * ud)


def _unweighted_deming_slope(x: FloatArray, y: FloatArray, x_std: float, y_std: float) -> float:
    dx, dy = x - x.mean(), y - y.mean()
    return _deming_slope((float(dy @ dy), float(dy @ dx), float(dx @ dx)), (x_std / y_std) ** 2)


def _fit_branch(
    force: FloatArray,
    depth: FloatArray,
    spread: FloatArray,
    noise: float,
    depth_noise: float,
    skin_std: float,
    object_motion_fraction: float,
    sheet_relative_std: float,
) -> StiffnessEstimate:
    """Return the posterior of the tangent stiffness of one branch."""
    keep = force > max(_MIN_FORCE_FRACTION * float(force.max(initial=0.0)), 3 * noise)
    force, depth, spread = force[keep], depth[keep], spread[keep]
    if len(force) < _MIN_SAMPLES:
        return StiffnessEstimate("undetermined", "squeeze for longer: the force hardly rises")
    rise = float(np.ptp(force))
    if rise < max(_MIN_FORCE_RISE_SIGMA * noise, _MIN_FORCE_RISE_FRACTION * float(force.max())):
        return StiffnessEstimate("undetermined", f"squeeze harder: the force rose by {rise:.2g} N only")
    at_n = float(force.mean())
    variance = noise**2
    for _ in range(2):  # second differences miss correlated noise: use the residuals' scatter
        lines = [_fit_line(force, depth, exponent, variance, depth_noise**2) for exponent in EXPONENTS]
        best = int(np.argmin([line.min_chi2 for line in lines]))
        correlation = _correlation_length(lines[best].residual)
        excess = lines[best].excess_n2 * (1 - 1 / correlation)  # white excess is random
        last, variance = variance, max(variance + excess, noise**2)
        if variance < 1.05 * last:
            break
    logs, weights = _posterior(lines, best, correlation, at_n)
    independent = len(force) / correlation
    scale = math.hypot(
        _common_relative_std(force, spread),
        skin_std * math.exp(float(weights @ logs)),
        object_motion_fraction,
        sheet_relative_std,
    )
    return _from_log_posterior(logs, weights, scale, at_n, EXPONENTS[best], len(force), independent - 2)


def _posterior(
    lines: Sequence[_DemingLine], best: int, correlation: float, at_n: float
) -> tuple[FloatArray, FloatArray]:
    """Return ln stiffness and weights, over all exponents."""
    least = lines[best].min_chi2
    inflate = correlation * max(least / max(len(lines[best].residual) - 2, 1), 1.0)
    logs, scores, widths = [], [], []
    for line, exponent in zip(lines, EXPONENTS, strict=True):
        factor = exponent * at_n ** (1 - 1 / exponent)
        low, high = (math.log(edge / factor) for edge in PRIOR_RANGE_N_PER_M)
        width = _log_kappa_width(line, inflate)
        centre = min(max(math.log(line.kappa), low), high)
        ends = max(centre - width, low), min(centre + width, high)
        log_kappa = ends[0] + (ends[1] - ends[0]) * (_KAPPA_GRID + 1) / 2
        logs.append(log_kappa + math.log(factor))
        scores.append((line.chi2(np.exp(log_kappa)) - least) / (2 * inflate))
        widths.append(np.full(len(log_kappa), ends[1] - ends[0]))
    score = np.concatenate(scores)  # the minimum is far from `min_chi2` where that is outside the range
    weights = np.exp(score.min() - score) * np.concatenate(widths)
    return np.concatenate(logs), weights / weights.sum()


def _log_kappa_width(line: _DemingLine, inflate: float) -> float:
    """Return the distance from the best ln kappa at which the posterior is negligible."""
    both = np.exp(np.stack([-_LOG_KAPPA_REACH, _LOG_KAPPA_REACH])) * line.kappa
    over = ((line.chi2(both) - line.min_chi2) > 30 * inflate).all(axis=0)
    return float(_LOG_KAPPA_REACH[int(np.argmax(over))]) if over.any() else float(_LOG_KAPPA_REACH[-1])


def _correlation_length(residual: FloatArray) -> float:
    """Return the samples per independent sample: 1 + 2 sum of autocorrelations, up to where they vanish."""
    lags = min(len(residual) // 3, 128)
    power = float(residual @ residual)
    if power <= 0 or lags < 2:
        return 1.0
    size = 1 << (2 * len(residual) - 1).bit_length()
    spectrum = np.fft.rfft(residual, size)
    rho = np.fft.irfft(np.abs(spectrum) ** 2)[1 : lags + 1] / power
    vanished = int(np.argmax(rho < 0.05)) if (rho < 0.05).any() else lags
    return 1 + 2 * float(rho[:vanished].sum())


def _common_relative_std(force: FloatArray, spread: FloatArray) -> float:
    """Return the relative deviation of slopes from errors that all forces share (gain, contact radius).

    Independent causes add their variances, a^2 + b^2 F^2, of which b tilts the line; a single cause, such as
    a radius, tilts it by the local change of its deviation with the force. The greater of the two counts.
    """
    std = np.where(np.isfinite(spread), spread, force)
    square = force * force
    away = square - square.mean()
    of_gain = float(away @ (std * std)) / max(float(away @ away), 1e-300)
    parts = np.array_split(np.argsort(force), _FORCE_BINS)
    mean = np.array([(force[part].mean(), std[part].mean()) for part in parts])
    steps = np.diff(mean, axis=0)
    of_one = float(np.max(np.abs(steps[:, 1]) / np.maximum(steps[:, 0], 1e-9 * force.max())))
    return min(max(math.sqrt(max(of_gain, 0.0)), of_one), 1.0)


def _from_log_posterior(
    logs: FloatArray, weights: FloatArray, scale: float, at_n: float, exponent: float, n: int, freedom: float
) -> StiffnessEstimate:
    """Return the estimate for a posterior of ln stiffness and a common relative deviation."""
    order = np.argsort(logs)
    mass = np.cumsum(weights[order]) - weights[order] / 2
    low, median, high = np.interp([0.025, 0.5, 0.975], mass, logs[order])
    own = math.sqrt(float(weights @ (logs - weights @ logs) ** 2))
    freedom = max(freedom, 1.0)
    wider = (1 + (_Z_95**2 + 1) / (4 * freedom)) if math.isfinite(freedom) else 1.0  # Student's t
    low, high = (
        median - math.hypot(wider * (median - low), _Z_95 * scale),
        median + math.hypot(wider * (high - median), _Z_95 * scale),
    )
    log_std = math.hypot(wider * own, scale)
    ends = math.exp(low), math.exp(high)
    probabilities = class_probabilities(logs, weights, math.hypot(scale, (wider - 1) * own))
    state, reason = "estimated", ""
    anything = f"anything from {ends[0]:.2g} to {ends[1]:.2g} N/m fits"
    if 2 * _Z_95 * scale > _MAX_COMMON_LOG_INTERVAL:
        state, reason = "undetermined", f"force or depth isn't known well enough: {anything}"
    elif high - low > math.hypot(_MAX_LOG_INTERVAL, 2 * _Z_95 * scale):
        state, reason = "undetermined", f"squeeze harder: {anything}"
    k = math.exp(median)
    return StiffnessEstimate(
        state, reason, k, k * log_std, *ends, at_n, exponent, math.nan, scale, "", n, probabilities
    )
