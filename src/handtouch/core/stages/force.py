"""Force: from a contact's total current through the contact law, with its standard deviation.

The same law as `handtouch.field.contact_law`, which is the reference for contacts far from edges whose
parameters are exact. The force is the geometric mean of its probability given the current, and its standard
deviation the root of the mean square difference from it: all forces up to the greatest of a contact are
equally likely before (by their logarithm), and the stack factor that the current leaves is normal about that
of each force and radius, with the variance of noise, law and distance from the edge at that force. So it
holds near the maximum current of the sheet, where forces hardly differ in current.
"""

from __future__ import annotations

import math

from handtouch.field import contact_law

_VALID, _LOWER_BOUND, _NOT_ESTIMATED = 0, 1, 2  # of a result's status
_LOG_LAYER, _ALPHA, _LOG_RADIUS, _RADIUS_STD, _LOG_SHEET, _DRIVE, _LOG_REFERENCE, _AXES = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
)
_MIN_FACTORS = 16
LAW_PARAMETERS = 19
RADIUS_NODES = (0.0, 1.7320508075688772, -1.7320508075688772)
"""Errors of the radius, in standard deviations, that the quadrature evaluates (Gauss and Hermite)."""
MIN_RADIUS_RATIO = 0.25
"""Least radius of these, relative to the stated one."""
_RADIUS_NODE, _MIN_RADIUS_RATIO = RADIUS_NODES[1], MIN_RADIUS_RATIO
_MIDDLE_WEIGHT, _OUTER_WEIGHT = 2.0 / 3.0, 1.0 / 6.0
_BOUND_SIGMA, _MAX_CURRENT_FRACTION = contact_law.BOUND_SIGMA, contact_law.MAX_CURRENT_FRACTION
_MIN_LOG_SPREADING_RATIO = math.log(contact_law.MIN_SPREADING_RATIO)
_MIN_CURRENT_A = 1e-200
_TWO_PI, _LOG_PI, _INFINITY = 2.0 * math.pi, math.log(math.pi), math.inf
_NAN = float("nan")
_STEP_SIGMA, _MAX_SIGMA, _MAX_NODES = 0.9, 3.2, 32  # of the quadrature over the stack factor
_MIN_RELATIVE_VARIANCE = 1e-18
_UNLIMITED_SIGMA = 3.0


class StackTable:
    """Inverse of the stack factor I0(x) / (x I1(x)): ln x^2 as cubic polynomials of the factor's logarithm.

    coefficients: (4 intervals,), highest power first, intervals of `width` from `first` on.
    """

    def __init__(self, coefficients: memoryview[float], intervals: int, first: float, width: float) -> None:
        self.coefficients = coefficients
        self.intervals = intervals
        self.first = first
        self.width = width


class PadLaw:
    """Contact law of one pad, in logarithms, and what it is applied to.

    parameters: (LAW_PARAMETERS,) ln of specific resistance times reference pressure^alpha; alpha; ln of the
    contact radius [m] and its standard deviation; ln of the sheet resistance; drive voltage; ln of the
    reference pressure; three axes of the calibrated law's covariance, one standard deviation each of (ln
    specific resistance, alpha, ln sheet resistance); and the stack factors of the greatest force, at the
    radii of RADIUS_NODES, 0 where it is unknown. series: (n n,) quadratic form of the series resistors [ohm];
    has_series: any isn't 0.
    """

    def __init__(self, parameters: memoryview[float], series: memoryview[float], has_series: bool) -> None:
        self.parameters = parameters
        self.series = series
        self.has_series = has_series


class ForceResult:
    """Force of one contact [N]; `std_n` is infinite where `status` is LOWER_BOUND.

    The rest is working memory. `whole`, `resistors`, `log_spreading_m`, `gradient2`, `variance`: of the
    contact, see `estimate_force`; `log_radius_m` assumed for it. Of the force that leaves a stack factor:
    `log_force`, its derivative `slope` by the factor, the factor's standard deviation `std`, and the
    difference `excess` of what the current leaves from it. `weights`, `log_mean`, `mean`, `square`: integrals
    of the probability, and of the force relative to that of `log_unit`: its logarithm, itself, its square.
    """

    def __init__(self) -> None:
        self.force_n = self.std_n = _NAN
        self.status = _NOT_ESTIMATED
        self.whole = self.resistors = self.log_spreading_m = self.gradient2 = self.variance = 0.0
        self.log_radius_m = self.log_force = self.slope = self.std = self.excess = 0.0
        self.weights = self.log_mean = self.mean = self.square = self.log_unit = 0.0


def estimate_force(
    stack: StackTable,
    law: PadLaw,
    result: ForceResult,
    total_a: float,
    total_std_a: float,
    log_spreading_m: float,
    gradient2: float,
    position_variance: float,
    series_ohm: float,
) -> None:
    """Estimate the force for a total current.

    total_std_a: of noise and baseline. log_spreading_m: ln of the spreading radius; gradient2: square of its
    gradient [1/m^2]. position_variance: what the position's uncertainty, with that of the total, makes of
    the stack factor's variance beyond noise of the total.
    """
    result.force_n = result.std_n = _NAN
    result.status = _NOT_ESTIMATED
    if not total_a > _BOUND_SIGMA * total_std_a:
        return
    p = law.parameters
    whole = whole_factor(law, total_a)
    noise = whole * total_std_a / total_a
    result.whole, result.resistors = whole, _TWO_PI * math.exp(-p[_LOG_SHEET]) * series_ohm
    result.log_spreading_m, result.gradient2 = log_spreading_m, gradient2
    result.variance = max(noise * noise + position_variance, 0.0)
    result.log_radius_m = p[_LOG_RADIUS]
    spread = max(log_spreading_m - p[_LOG_RADIUS], _MIN_LOG_SPREADING_RATIO)
    limit = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (spread + result.resistors)
    least = max(p[_MIN_FACTORS], limit)
    _evaluate_factor(stack, law, result, least)
    by_radius = (-1.0 + (2.0 - 2.0 * p[_ALPHA]) / (result.slope * p[_ALPHA])) * p[_RADIUS_STD]
    std = math.sqrt(result.std * result.std + by_radius * by_radius)
    # without a greatest force, those from the limit on are equally likely, and have no mean
    reach = -_BOUND_SIGMA if p[_MIN_FACTORS] > limit else _UNLIMITED_SIGMA
    result.status = _LOWER_BOUND
    if result.excess > reach * std:
        result.log_unit = result.log_force
        result.weights = result.log_mean = result.mean = result.square = 0.0
        _integrate(stack, law, result, 0.0, _MIDDLE_WEIGHT, least)
        if p[_RADIUS_STD] > 0.0:
            _integrate(stack, law, result, _RADIUS_NODE, _OUTER_WEIGHT, max(p[_MIN_FACTORS + 1], limit))
            _integrate(stack, law, result, -_RADIUS_NODE, _OUTER_WEIGHT, max(p[_MIN_FACTORS + 2], limit))
        if result.weights > 0.0:
            force = math.exp(result.log_mean / result.weights)
            mean_square = (result.square - 2.0 * force * result.mean) / result.weights + force * force
            unit = math.exp(min(300.0, result.log_unit))
            result.force_n = unit * force
            result.std_n = unit * math.sqrt(max(mean_square, _MIN_RELATIVE_VARIANCE * force * force))
            result.status = _VALID
    if result.status == _LOWER_BOUND:
        result.log_radius_m = p[_LOG_RADIUS]
        _evaluate_factor(stack, law, result, max(least + result.excess + _BOUND_SIGMA * std, least))
        result.force_n, result.std_n = math.exp(min(300.0, result.log_force)), _INFINITY


def _integrate(
    stack: StackTable, law: PadLaw, result: ForceResult, radius_sigma: float, share: float, least: float
) -> None:
    """Add the integrals over the stack factor, from the least one up, at a radius of this probability.

    Trapezoids: steps are in proportion to the factor's standard deviation.
    """
    p = law.parameters
    ratio = max(1.0 + radius_sigma * p[_RADIUS_STD], _MIN_RADIUS_RATIO)
    result.log_radius_m = p[_LOG_RADIUS] + math.log(ratio)
    factor, step_before = _lowest_factor(stack, law, result, least), 0.0
    for _ in range(_MAX_NODES):
        _evaluate_factor(stack, law, result, factor)
        sigma = result.excess / result.std
        step = _STEP_SIGMA * result.std
        weight = 0.5 * (step_before + step) * share * math.exp(-0.5 * sigma * sigma)
        weight *= -result.slope / result.std
        log_force = result.log_force - result.log_unit
        force = math.exp(log_force)
        result.weights += weight
        result.log_mean += weight * log_force
        result.mean += weight * force
        result.square += weight * force * force
        if sigma < -_MAX_SIGMA:
            break
        step_before = step
        factor += step


def _lowest_factor(stack: StackTable, law: PadLaw, result: ForceResult, least: float) -> float:
    """Return the stack factor from which on the quadrature has to begin."""
    _evaluate_factor(stack, law, result, least)
    factor = max(least + result.excess, least)
    _evaluate_factor(stack, law, result, factor)
    factor = max(factor + result.excess, least)  # the spreading depends on it near edges
    factor = max(least, factor / (1.0 + _MAX_SIGMA * result.std / factor))
    _evaluate_factor(stack, law, result, factor)
    missing = _MAX_SIGMA * result.std - result.excess
    return max(least, factor - missing) if missing > 0.0 else factor


def _evaluate_factor(stack: StackTable, law: PadLaw, result: ForceResult, factor: float) -> None:
    """Compute the force that leaves a stack factor, and how far the current is from it.

    The sheet's resistance from the contact to the electrodes: that of a small contact is ln(R / A), less what
    the current's density inside it adapts to the gradient of the potential, (A grad ln R)^2 / 4 times
    I2(x) / I0(x) = 1 - 2 / (x^2 factor); a contact that hangs over the edge is between that of one moved
    inside and that of its current at its centre. The mean of the two limits, and their variance.
    """
    p = law.parameters
    alpha, log_radius_m = p[_ALPHA], result.log_radius_m
    log_x2, slope = _log_x2(stack, factor), _log_x2_slope(stack, factor)
    log_specific = p[_LOG_SHEET] + 2.0 * log_radius_m - log_x2  # ln of ohm m^2
    log_pressure = (p[_LOG_LAYER] - log_specific) / alpha
    by_log_x2 = 1.0 / slope
    ratio = result.log_spreading_m - log_radius_m
    adaptation = max(1.0 - 2.0 * math.exp(-min(log_x2, 700.0)) / factor, 0.0)
    steepness = min(result.gradient2 * math.exp(2.0 * log_radius_m), 1.0)
    high = max(ratio, _MIN_LOG_SPREADING_RATIO)
    low = max(ratio, 0.0) - 0.25 * steepness * adaptation
    spread = 0.5 * (high + low)
    result.log_force = _LOG_PI + 2.0 * log_radius_m + log_pressure
    result.slope = slope / alpha
    result.excess = result.whole - result.resistors - spread - factor
    variance = result.variance + 0.25 * (high - low) * (high - low)
    by_sheet, by_alpha = factor + spread + by_log_x2, by_log_x2 * (log_pressure - p[_LOG_REFERENCE])
    for k in range(_AXES, _AXES + 9, 3):
        change = by_alpha * p[k + 1] - by_log_x2 * p[k] + by_sheet * p[k + 2]
        variance += change * change
    result.std = math.sqrt(max(variance, _MIN_RELATIVE_VARIANCE * factor * factor))


def whole_factor(law: PadLaw, total_a: float) -> float:
    """Return the stack factor that would leave the drive's whole voltage to the contact."""
    p = law.parameters
    return _TWO_PI * math.exp(-p[_LOG_SHEET]) * p[_DRIVE] / max(total_a, _MIN_CURRENT_A)


def series_resistance(law: PadLaw, currents: memoryview[float], first: int, electrodes: int) -> float:
    """Return the resistance from contact to ground that the series resistors add [ohm], for its currents."""
    if not law.has_series:
        return 0.0
    total = form = 0.0
    for i in range(electrodes):
        total += currents[first + i]
        row = 0.0
        for j in range(electrodes):
            row += law.series[i * electrodes + j] * currents[first + j]
        form += currents[first + i] * row
    return form / (total * total) if total > 0.0 else 0.0


def _log_x2(stack: StackTable, factor: float) -> float:
    """Return ln x^2 where I0(x) / (x I1(x)) is `factor`."""
    place = (math.log(factor) - stack.first) / stack.width
    k = _interval(stack, place)
    t = place - k
    c = stack.coefficients
    if t < 0.0 or t > 1.0:  # straight beyond the table
        edge = 0.0 if t < 0.0 else 1.0
        level = ((c[4 * k] * edge + c[4 * k + 1]) * edge + c[4 * k + 2]) * edge + c[4 * k + 3]
        rate = (3.0 * c[4 * k] * edge + 2.0 * c[4 * k + 1]) * edge + c[4 * k + 2]
        return level + rate * (t - edge)
    return ((c[4 * k] * t + c[4 * k + 1]) * t + c[4 * k + 2]) * t + c[4 * k + 3]


def _log_x2_slope(stack: StackTable, factor: float) -> float:
    """Return the derivative of ln x^2 by the factor."""
    place = (math.log(factor) - stack.first) / stack.width
    k = _interval(stack, place)
    t = max(0.0, min(1.0, place - k))
    c = stack.coefficients
    return ((3.0 * c[4 * k] * t + 2.0 * c[4 * k + 1]) * t + c[4 * k + 2]) / (stack.width * factor)


def _interval(stack: StackTable, place: float) -> int:
    if place <= 0.0:
        return 0
    if place >= stack.intervals:
        return stack.intervals - 1
    return int(place)
