"""Force: from a contact's total current through the contact law, with its standard deviation.

The same law as `handtouch.field.contact_law`, which is the reference. The standard deviation is by quadrature
over contact radius and law, not by slopes: on soft sheets that by the radius passes through zero, and towards
the maximum current of the sheet forces grow without bound.
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
LAW_PARAMETERS = 16
_MIN_ALPHA = 0.1
_BOUND_SIGMA, _MAX_CURRENT_FRACTION = contact_law.BOUND_SIGMA, contact_law.MAX_CURRENT_FRACTION
_MIN_LOG_SPREADING_RATIO = math.log(contact_law.MIN_SPREADING_RATIO)
_MIN_CURRENT_A = 1e-200
_TWO_PI, _LOG_PI, _INFINITY = 2.0 * math.pi, math.log(math.pi), math.inf
_NAN = float("nan")
# Gauss-Hermite quadrature of five nodes; the middle one is the reported force itself
_NEAR_NODE, _FAR_NODE = 1.3556261799742657, 2.8569700138728056
_NEAR_WEIGHT, _FAR_WEIGHT = 0.22207592200561263, 0.011257411327720693


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
    reference pressure; and three axes of the calibrated law's covariance, one standard deviation each of (ln
    specific resistance, alpha, ln sheet resistance). series: (n n,) quadratic form of the series resistors
    [ohm]; has_series: any isn't 0.
    """

    def __init__(self, parameters: memoryview[float], series: memoryview[float], has_series: bool) -> None:
        self.parameters = parameters
        self.series = series
        self.has_series = has_series


class ForceResult:
    """Force of one contact [N]; `std_n` is infinite where `status` is LOWER_BOUND."""

    def __init__(self) -> None:
        self.force_n = self.std_n = _NAN
        self.status = _NOT_ESTIMATED


def estimate_force(
    stack: StackTable,
    law: PadLaw,
    result: ForceResult,
    total_a: float,
    total_std_a: float,
    log_spreading_m: float,
    position_variance: float,
    series_ohm: float,
) -> None:
    """Estimate the force for a total current.

    total_std_a: of noise and baseline. log_spreading_m: ln of the spreading radius;
    position_variance: what the position's uncertainty, with that of the total, makes of the stack factor's
    variance beyond noise of the total.
    """
    result.force_n = result.std_n = _NAN
    result.status = _NOT_ESTIMATED
    if not total_a > _BOUND_SIGMA * total_std_a:
        return
    p = law.parameters
    alpha, radius_std = p[_ALPHA], p[_RADIUS_STD]
    per_sheet = _TWO_PI * math.exp(-p[_LOG_SHEET])
    resistors = per_sheet * series_ohm
    spread = max(log_spreading_m - p[_LOG_RADIUS], _MIN_LOG_SPREADING_RATIO)
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (spread + resistors)
    whole = whole_factor(law, total_a)
    factor = whole - resistors - spread
    noise = whole * total_std_a / total_a
    variance = noise * noise + position_variance
    margin = _BOUND_SIGMA * math.sqrt(variance + radius_std * radius_std)
    if factor - margin <= least:
        margin /= max(1.0 - _BOUND_SIGMA * total_std_a / total_a, 0.1)  # the factor is inverse to the current
        result.force_n = _force_at(
            stack, p[_LOG_LAYER], alpha, p[_LOG_RADIUS], p[_LOG_SHEET], max(factor + margin, least)
        )
        result.std_n = _INFINITY
        result.status = _LOWER_BOUND
        return
    force = _force_at(stack, p[_LOG_LAYER], alpha, p[_LOG_RADIUS], p[_LOG_SHEET], factor)
    slope = force / alpha * _log_x2_slope(stack, factor)
    square = slope * slope * variance
    if radius_std > 0.0:
        near, far = _NEAR_NODE * radius_std, _FAR_NODE * radius_std
        square += _NEAR_WEIGHT * (
            _squared_change(stack, law, force, near, log_spreading_m, whole, resistors)
            + _squared_change(stack, law, force, -near, log_spreading_m, whole, resistors)
        )
        square += _FAR_WEIGHT * (
            _squared_change(stack, law, force, far, log_spreading_m, whole, resistors)
            + _squared_change(stack, law, force, -far, log_spreading_m, whole, resistors)
        )
    for k in range(_AXES, _AXES + 9, 3):
        if p[k] != 0.0 or p[k + 1] != 0.0 or p[k + 2] != 0.0:
            square += _NEAR_WEIGHT * (
                _squared_change_along(stack, law, force, k, _NEAR_NODE, spread, whole, resistors)
                + _squared_change_along(stack, law, force, k, -_NEAR_NODE, spread, whole, resistors)
            )
            square += _FAR_WEIGHT * (
                _squared_change_along(stack, law, force, k, _FAR_NODE, spread, whole, resistors)
                + _squared_change_along(stack, law, force, k, -_FAR_NODE, spread, whole, resistors)
            )
    result.force_n, result.std_n, result.status = force, math.sqrt(square), _VALID


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


def _squared_change(
    stack: StackTable,
    law: PadLaw,
    force: float,
    log_ratio: float,
    log_spreading_m: float,
    whole: float,
    resistors: float,
) -> float:
    """Return the squared change of the force with a radius larger by the factor exp(log_ratio)."""
    p = law.parameters
    log_radius_m = p[_LOG_RADIUS] + log_ratio
    spread = max(log_spreading_m - log_radius_m, _MIN_LOG_SPREADING_RATIO)
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (spread + resistors)
    factor = max(whole - resistors - spread, least)
    change = _force_at(stack, p[_LOG_LAYER], p[_ALPHA], log_radius_m, p[_LOG_SHEET], factor) - force
    return change * change


def _squared_change_along(
    stack: StackTable,
    law: PadLaw,
    force: float,
    axis: int,
    sigma: float,
    spread: float,
    whole: float,
    resistors: float,
) -> float:
    """Return the squared change of the force with a law that differs by `sigma` along an axis of its
    covariance."""
    p = law.parameters
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (spread + resistors)
    # a larger sheet resistance makes the factor smaller
    log_sheet_change = sigma * p[axis + 2]
    factor = max((whole - resistors) * math.exp(-log_sheet_change) - spread, least)
    alpha = max(p[_ALPHA] + sigma * p[axis + 1], _MIN_ALPHA)
    log_layer = p[_LOG_LAYER] + sigma * p[axis] + (alpha - p[_ALPHA]) * p[_LOG_REFERENCE]
    log_sheet = p[_LOG_SHEET] + log_sheet_change
    change = _force_at(stack, log_layer, alpha, p[_LOG_RADIUS], log_sheet, factor) - force
    return change * change


def _force_at(
    stack: StackTable, log_layer: float, alpha: float, log_radius_m: float, log_sheet: float, factor: float
) -> float:
    """Return the force [N] at a stack factor: pressure from the layer's resistance, times the area."""
    log_resistance = _log_x2(stack, factor) - log_sheet - 2.0 * log_radius_m  # minus ln of ohm m^2
    return math.exp(min(700.0, _LOG_PI + 2.0 * log_radius_m + (log_resistance + log_layer) / alpha))


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
