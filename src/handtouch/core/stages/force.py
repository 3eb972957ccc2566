"""Force: from a contact's total current through the contact law, with its standard deviation.

The same law as `handtouch.field.contact_law`, which is the reference for contacts far from edges whose
parameters are exact. The force is the harmonic mean of its probability given the current: the value of the
least mean square error over the force, as mean and median are too high where forces hardly differ in current.
Its standard deviation is the root of the mean square difference from it. All forces up to the greatest of a
contact are equally likely before (by their logarithm); the logarithm of the resistance that the current
leaves is normal about that of each force, with the variance of noise, law, contact radius and distance from
the edge at that force. So it holds near the maximum current of the sheet. Where the current allows the
greatest force, what is likely before decides how likely that is: there the standard deviation is at least
such that the 95 % interval ends at the last force within 1.96 deviations of the current, by two Newton steps.

The integral is over ln x^2 = ln(A^2 rho / sigma), which is linear in the logarithm of the force. The radius
A is log-normal: mean and variance by it are those of the second-order expansion of that logarithm, whose
second derivative follows from the first, d f / d ln x^2 = (1 - x^2 f^2) / 2. Where the radius grows with the
force (Hertz), it is that of each force: A^3 ~ F, so ln F and ln A are still linear in ln x^2.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from handtouch.core.memory import RowArray, view_memory
from handtouch.field import contact_law
from handtouch.field.contact_law import log_stack_inverse
from handtouch.field.contact_stack import stack_factor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

FITTED, BOUNDED, NOT_ESTIMATED, WIDE = 0, 1, 2, 4
"""Status of an estimate: a force; a lower bound; none; a force whose spread is too wide to rely on"""
_FITTED, _BOUNDED, _NOT_ESTIMATED, _WIDE = FITTED, BOUNDED, NOT_ESTIMATED, WIDE
LAW_ROW = np.dtype(
    [
        ("log_x2", "<f8"),  # ln x^2 at 1 N
        ("power", "<f8"),  # derivative of ln force by it, 1 / alpha of a constant radius
        ("by_radius", "<f8"),  # 2 - 2 alpha, its derivative by that of the radius at one force
        ("log_radius", "<f8"),  # mean of the logarithm of the contact radius [m] at 1 N
        ("radius_variance", "<f8"),
        ("log_sheet", "<f8"),  # ln of the sheet resistance
        ("drive_v", "<f8"),
        ("log_reference", "<f8"),  # what ln of the pressure over the reference is less at ln x^2 = 0
        ("covariance", "<f8", 6),  # of the calibrated law: upper triangle, see `PadLaw`
        ("max_log_x2", "<f8"),  # at the greatest force, infinite where that is unknown
        ("min_factor", "<f8"),  # its stack factor, or 0
        ("growth", "<f8"),  # derivative of ln radius by ln x^2, 0 of a constant radius
        ("uneven", "<f8"),  # relative deviation of the stack factor by pressures that aren't even
    ]
)
"""Contact law of a pad, in logarithms"""
_BOUND_SIGMA, _MAX_CURRENT_FRACTION = contact_law.BOUND_SIGMA, contact_law.MAX_CURRENT_FRACTION
_MIN_LOG_SPREADING_RATIO = math.log(contact_law.MIN_SPREADING_RATIO)
_MIN_CURRENT_A, _MIN_LEFT = 1e-200, 1e-12
_TWO_PI, _INFINITY, _NAN = 2.0 * math.pi, math.inf, float("nan")
_MAX_SIGMA = 3.3  # of the quadrature over the stack factor
_STACK_INTERVALS = 2048
_SMALL_CONTACT_REST = 0.25  # of the stack factor over 2 / x^2, as x vanishes
_MIN_LOG_FACTOR, _MAX_LOG_FACTOR = -16.0, 32.0
_FIRST_LOG_X2, _LAST_LOG_X2, _LOG_X2_WIDTH = -24.0, 24.0, 1.0 / 16.0
FORCE_NODES = 12
"""Nodes of the quadrature over ln x^2. Beside 96 nodes, on 3,703 contacts of random sheet, law, radius,
current, place, up to the maximum current, forces are within 0.05 of their standard deviation (99 %: 0.007),
and that within 9 % (99 %: 1 %); with 8 nodes within 0.14 and 9 % (99 %: 0.03 and 2 %)"""
NEAR_FORCE_NODES = 5
"""The same where the force is nearly log-normal: beside 64 nodes, on 5,585 such contacts of 26,047 of random
sheet, law, radius, current and place, forces are within 0.01 of their standard deviation, that within 2 %"""
_MAX_NEAR_HALF, _MIN_NEAR_ROOM, _MAX_NEAR_SHIFT, _MAX_NEAR_CHANGE = 0.7, 2.0, 0.3, 0.05
"""Limits within which a force is nearly log-normal: half the range of its logarithm; distance of the greatest
one, shift of the range's middle and change of its half from those of a normal one, in such halves"""
_MIN_RELATIVE_VARIANCE = 1e-18
_MAX_SPREAD = 4.0
"""Mean times mean inverse of a force from which on its estimate is WIDE: open by a factor of three; so is one
whose standard deviation is so many times as large as the force"""
_UNLIMITED_SIGMA = 3.0
_INTERVAL_SIGMA = 1.96  # of 95 %
_MAX_LOG_FORCE, _MIN_LOG_X2 = 300.0, -300.0
_MAX_STEPS, _CONVERGED_SIGMA = 12, 0.1
_CROWDING_STEPS, _MIN_CROWDED_FACTOR = 4, 0.05
_BEND_ERROR, _CORNER_BEND_ERROR, _CUT_BEND_ERROR = 0.02, 0.1, 0.15  # standard deviations, relative
_CUT_AREA, _CUT_MORE_AREA, _CUT_SPREADING = 0.36, 0.72, 1.55
_CUT_ERROR, _CORNER_ERROR, _CUT_REST = 0.1, 0.3, 0.003  # standard deviations of ln of the part's radius
CUT_SPREADING = _CUT_SPREADING
"""By how much the sheet's resistance rises with less of ln of the radius of a part on the pad"""
_CUT_TURNING = 0.3  # of a contact over the edge, relative to the square of its distance
_TILT_REST = 0.1  # of the distance of both centres, over the pressure's from the middle


class StackTable:
    """The stack factor I0(x) / (x I1(x)) as a function of ln x^2, its inverse, and nodes of a quadrature.

    inverse: (4 inverse_intervals,) cubics of ln x^2 by the factor's logarithm, highest power first, intervals
    of `inverse_width` from `inverse_first` on. values: (2 (intervals + 1),) the factor and its derivative per
    interval at ln x^2 = first + k width; below, and above the inverse's last, it is 2 / x^2 + 1 / 4. nodes:
    (2 count,) of Gauss and Legendre on 0 to 1, and weights.
    """

    def __init__(self) -> None:
        knots = np.linspace(_MIN_LOG_FACTOR, _MAX_LOG_FACTOR, _STACK_INTERVALS + 1)
        width = float(knots[1] - knots[0])
        level, by_factor = log_stack_inverse(np.exp(knots))
        slope = by_factor * np.exp(knots) * width
        last = _STACK_INTERVALS
        chord, left, right = np.diff(level), slope[:last], slope[1:]
        pieces = np.stack(
            [left + right - 2 * chord, 3 * chord - 2 * left - right, left, level[:last]], axis=1
        )
        log_x2 = np.arange(_FIRST_LOG_X2, _LAST_LOG_X2 + _LOG_X2_WIDTH / 2, _LOG_X2_WIDTH)
        factor = stack_factor(np.exp(log_x2 / 2))
        by_log_x2 = (1 - np.exp(log_x2) * np.square(factor)) / 2
        points, weights = np.polynomial.legendre.leggauss(FORCE_NODES)
        near_points, near_weights = _normal_quadrature(NEAR_FORCE_NODES)
        rules = np.stack([np.append(points, near_points), np.append(weights, near_weights)], axis=1)
        rules[:, 0] = (1 + rules[:, 0]) / 2
        self.inverse, self.inverse_intervals = view_memory(np.ascontiguousarray(pieces)), _STACK_INTERVALS
        self.inverse_first, self.inverse_width = _MIN_LOG_FACTOR, width
        self.values = view_memory(np.stack([factor, by_log_x2 * _LOG_X2_WIDTH], axis=1))
        self.first, self.per_width, self.intervals = _FIRST_LOG_X2, 1.0 / _LOG_X2_WIDTH, len(factor) - 1
        self.nodes, self.any_count, self.near_count = view_memory(rules), FORCE_NODES, NEAR_FORCE_NODES


@cache
def stack_table() -> StackTable:
    """Return the table, which is the same for all pads."""
    return StackTable()


def _normal_quadrature(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights on -1 to 1 of Gauss's rule for the normal density within _MAX_SIGMA.

    By Stieltjes's recurrence and the eigenvalues of Golub and Welsch; the weights are over the density.
    """
    points, weights = np.polynomial.legendre.leggauss(20 * count)
    weights = weights * np.exp(-0.5 * np.square(_MAX_SIGMA * points))
    total = weights.sum()
    before, present, norm = np.zeros_like(points), np.full_like(points, total**-0.5), 0.0
    diagonal, beside = np.zeros(count), np.zeros(count)
    for k in range(count):
        diagonal[k] = weights @ (points * present**2)
        following = (points - diagonal[k]) * present - norm * before
        norm = beside[k] = np.sqrt(weights @ following**2)
        before, present = present, following / norm
    beside = np.diag(beside[: count - 1], 1)
    nodes, vectors = np.linalg.eigh(np.diag(diagonal) + beside + beside.T)
    return nodes, total * vectors[0] ** 2 * np.exp(0.5 * np.square(_MAX_SIGMA * nodes))


class PadLaw:
    """Contact law of one pad, in logarithms, and what it is applied to.

    parameters: (1,) a LAW_ROW. Its covariance is that of ln specific resistance, alpha and ln sheet
    resistance; `uneven` counts where the layer dominates. series: (n n,) quadratic form of the series
    resistors [ohm]; has_series: any isn't 0.
    """

    def __init__(self, parameters: RowArray, series: memoryview[float], has_series: bool) -> None:
        self.parameters = parameters
        self.series = series
        self.has_series = has_series


def empty_law() -> PadLaw:
    """Return a law to be set, without series resistors."""
    return PadLaw(np.zeros(1, LAW_ROW).view(np.recarray), view_memory(np.zeros(0)), has_series=False)


class ForceResult:
    """Force of one contact [N]; `std_n` is infinite where `status` is LOWER_BOUND.

    The rest is working memory. Of the contact: `left`, stack factor and spreading that its current leaves;
    `spreading` and `gradient2`, set before: ln of the spreading radius [m], and square of its gradient
    [1/m^2], at the contact's centre, where what `crowded_shift` found holds, or 0 without crowding; `high`,
    `low` and `bend`, at one radius: limits of the spreading, the lower one less `bend` times the share of the
    current that adapts to the edge; `by_radius`: derivative of their mean; `variance`, by noise, of the
    logarithm of `left`. At one ln x^2: standard deviation `std` of `left`; `sigma`, by how many of them its
    logarithm is above the expected one, `total`; `density` of the logarithm, over that of `sigma`; ln x^2 a
    standard deviation, `step`; the stack `factor`, the `share` of the current that the sheet decides, and the
    deviation by the edge, `half_width`. `by_stack`: derivative of ln of the part's radius by that of the
    whole contact; `cut_std`: `cut_error` of a contact over an edge. `moved`, `cut`, `cut_by_radius`,
    `cut_error`, `bend_error`: see `crowded_shift`. `turning`, `turning_by_factor`, `around`, `square`,
    `log_radius`, `shift_std`, `tilt_m`: see `find_crowding`."""

    def __init__(self) -> None:
        self.force_n = self.std_n = _NAN
        self.status = _NOT_ESTIMATED
        self.left = self.high = self.low = self.bend = self.by_radius = self.variance = 0.0
        self.spreading = self.gradient2 = self.total = 0.0
        self.moved = self.cut = self.cut_by_radius = 0.0
        self.by_stack, self.cut_std, self.cut_error, self.bend_error = 1.0, 0.0, 0.0, 0.0
        self.turning = self.turning_by_factor = self.around = self.square = self.log_radius = 0.0
        self.shift_std = self.tilt_m = 0.0
        self.sigma = self.std = self.step = self.density = 0.0
        self.factor = self.share = self.half_width = 0.0


def estimate_force(
    stack: StackTable,
    law: PadLaw,
    result: ForceResult,
    total_a: float,
    total_std_a: float,
    position_variance: float,
    series_ohm: float,
) -> None:
    """Estimate the force for a total current, by the result's `spreading` and `gradient2`.

    total_std_a: of noise and baseline. position_variance: what the position's uncertainty, with that of the
    total, makes of the stack factor's variance beyond noise of the total.
    """
    result.force_n = result.std_n = _NAN
    result.status = _NOT_ESTIMATED
    if not total_a > _BOUND_SIGMA * total_std_a:
        return
    whole = whole_factor(law, total_a)
    noise = whole * total_std_a / total_a
    resistors = whole / law.parameters[0].drive_v * total_a * series_ohm
    result.left = max(whole - resistors, _MIN_LEFT)
    result.variance = max(noise * noise + position_variance, 0.0) / (result.left * result.left)
    set_radius(result, law.parameters[0].log_radius)
    # beyond a share of the maximum current, forces hardly differ in current
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (result.high + resistors)
    top = law.parameters[0].max_log_x2
    if law.parameters[0].growth > 0.0:
        end = _find_end(stack, law, result, resistors)
        is_limited = top <= end
        top = min(top, end)
    else:
        is_limited = law.parameters[0].min_factor >= least
        least = max(least, law.parameters[0].min_factor)
        if not is_limited:
            top = find_log_x2(stack, least)
    log_x2 = _find_likely(stack, law, result, result.left, least, top)
    evaluate(stack, law, result, log_x2)
    if log_x2 >= top or not is_limited:
        sigma, std, total = result.sigma, result.std, result.total
        if log_x2 < top:
            evaluate(stack, law, result, top)
            sigma, std, total = result.sigma, result.std, result.total
            evaluate(stack, law, result, log_x2)
        # without a greatest force, those from the limit on differ too little in current to have a mean
        if not sigma > (-_BOUND_SIGMA if is_limited else _UNLIMITED_SIGMA):
            # a current far above all that the law allows contradicts it: the deviation is at least that far
            margin = max(sigma + _BOUND_SIGMA, -sigma) * std
            if law.parameters[0].growth > 0.0:
                result.left = total + margin
                log_x2 = _find_likely(stack, law, result, result.left, least, top)
            else:
                log_x2 = find_log_x2(stack, least + margin)
            log_force = (log_x2 - law.parameters[0].log_x2) * law.parameters[0].power
            result.force_n, result.std_n = math.exp(min(_MAX_LOG_FORCE, log_force)), _INFINITY
            result.status = _BOUNDED
            return
    _integrate(stack, law, result, log_x2, top)


def set_radius(result: ForceResult, log_radius: float) -> None:
    """Set the limits of the spreading from a contact of a radius [m], given by its logarithm."""
    ratio = result.spreading - log_radius
    result.high, result.low = max(ratio, _MIN_LOG_SPREADING_RATIO), max(ratio, 0.0)
    result.bend = result.by_radius = result.cut_std = 0.0
    result.by_stack = 1.0
    if ratio > 0.0:
        result.by_radius = -1.0 if ratio > _MIN_LOG_SPREADING_RATIO else -0.5
    if result.gradient2 > 0.0:
        result.bend = 0.25 * min(result.gradient2 * math.exp(2.0 * log_radius), 1.0)
        if result.cut < 0.0:
            result.high = result.low
            result.by_radius = -1.0 - _CUT_SPREADING * result.cut_by_radius
            result.by_stack = 1.0 + result.cut_by_radius
            result.cut_std = result.cut_error
        result.high -= result.moved
        result.low -= result.moved


def _find_end(stack: StackTable, law: PadLaw, result: ForceResult, resistors: float) -> float:
    """Return ln x^2 from which on forces of a contact that grows hardly differ in current.

    It has reached an edge, and the resistance of its layer is a small share.
    """
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (_MIN_LOG_SPREADING_RATIO + resistors)
    room = result.spreading - _MIN_LOG_SPREADING_RATIO - law.parameters[0].log_radius
    at_edge: float = law.parameters[0].log_x2 + room / law.parameters[0].growth
    return min(max(at_edge, find_log_x2(stack, least)), stack.first + stack.intervals / stack.per_width)


def _find_likely(
    stack: StackTable, law: PadLaw, result: ForceResult, left: float, least: float, top: float
) -> float:
    """Return ln x^2 of `left`, at most `top`; of a contact that grows by Newton steps on its logarithm.

    `least`: stack factor at `top`, whose inverse may be a little less than that.
    """
    log_x2, factor = top, left - 0.5 * (result.high + result.low)
    if factor > least:
        log_x2 = min(find_log_x2(stack, factor), top)
    if law.parameters[0].growth > 0.0:
        for _ in range(_MAX_STEPS):
            evaluate(stack, law, result, log_x2)
            if abs(result.sigma) < _CONVERGED_SIGMA:
                break
            log_x2 = max(_MIN_LOG_X2, min(top, log_x2 - result.sigma * result.step))
    return log_x2


def _integrate(stack: StackTable, law: PadLaw, result: ForceResult, log_x2: float, top: float) -> None:
    """Integrate over ln x^2 up to `top`, about a likely one, at which the result was evaluated."""
    power = law.parameters[0].power
    centre, half = log_x2 - result.sigma * result.step, _MAX_SIGMA * result.step
    last = min(top, log_x2 + (_INTERVAL_SIGMA - result.sigma) * result.step)
    low = max(_MIN_LOG_X2, log_x2 - (_MAX_SIGMA + result.sigma) * result.step)
    high = min(top, log_x2 + (_MAX_SIGMA - result.sigma) * result.step)
    evaluate(stack, law, result, low)
    low = max(_MIN_LOG_X2, low - (_MAX_SIGMA + result.sigma) * result.step)
    if high < top:
        evaluate(stack, law, result, high)
        high = min(top, high + (_MAX_SIGMA - result.sigma) * result.step)
    begin, end = 0, stack.any_count
    # a radius that grows may reach an edge, where derivatives jump
    is_far = law.parameters[0].growth == 0.0 and top - centre > _MIN_NEAR_ROOM * half
    if is_far and half * power < _MAX_NEAR_HALF:
        shift, change = 0.5 * (low + high) - centre, 0.5 * (high - low) - half
        if abs(shift) < _MAX_NEAR_SHIFT * half and abs(change) < _MAX_NEAR_CHANGE * half:
            begin, end = end, end + stack.near_count
    weights = inverse = mean = square = 0.0
    for k in range(begin, end):
        at = low + (high - low) * stack.nodes[2 * k]
        evaluate(stack, law, result, at)
        weight = stack.nodes[2 * k + 1] * math.exp(-0.5 * result.sigma * result.sigma) * result.density
        force = math.exp((at - log_x2) * power)
        weights += weight
        inverse += weight / force
        mean += weight * force
        square += weight * force * force
    if weights > 0.0:
        force = weights / inverse
        mean_square = (square - 2.0 * force * mean) / weights + force * force
        log_unit = (log_x2 - law.parameters[0].log_x2) * power
        unit = math.exp(max(-_MAX_LOG_FORCE, min(_MAX_LOG_FORCE, log_unit)))
        result.force_n = unit * force
        result.std_n = unit * math.sqrt(max(mean_square, _MIN_RELATIVE_VARIANCE * force * force))
        if high >= top:
            # this sets in gradually, as the greatest force comes within the quadrature's range
            evaluate(stack, law, result, top)
            cut = min((_MAX_SIGMA - result.sigma) / (_MAX_SIGMA - _INTERVAL_SIGMA), 1.0)
            evaluate(stack, law, result, last)
            last = min(top, last + (_INTERVAL_SIGMA - result.sigma) * result.step)
            reach = unit * (math.exp((last - log_x2) * power) - force) / _INTERVAL_SIGMA
            if cut > 0.0 and reach > result.std_n:
                result.std_n += cut * (reach - result.std_n)
        is_narrow = mean * inverse < _MAX_SPREAD * weights * weights
        result.status = _FITTED if is_narrow and result.std_n < _MAX_SPREAD * result.force_n else _WIDE


def evaluate(stack: StackTable, law: PadLaw, result: ForceResult, log_x2: float) -> None:
    """Compute how far the current is from that of a force, which is given by ln x^2.

    The sheet's resistance from the contact to the electrodes: that of a small contact is ln(R / A), less what
    the current's density inside it adapts to the gradient of the potential, (A grad ln R)^2 / 4 times
    I2(x) / I0(x) = 1 - 2 / (x^2 factor), with R at the contact's centre (see `bent`). Without crowding, a
    contact that hangs over the edge is between that of one moved inside and that of its current at its
    centre: the mean of the two limits, and their variance.
    """
    place = (log_x2 - stack.first) * stack.per_width
    if place < 0.0:
        slope = -2.0 * math.exp(-log_x2)
        factor = _SMALL_CONTACT_REST - slope
    else:
        k = int(place)
        if k > stack.intervals - 1:
            k = stack.intervals - 1
        t = place - k
        k *= 2
        rise = stack.values[k + 2] - stack.values[k]
        cubic = stack.values[k + 1] + stack.values[k + 3] - 2.0 * rise
        square = rise - stack.values[k + 1] - cubic
        factor = stack.values[k] + t * (stack.values[k + 1] + t * (square + t * cubic))
        slope = (stack.values[k + 1] + t * (2.0 * square + 3.0 * t * cubic)) * stack.per_width
    density = 1.0 - 2.0 * slope  # (x factor)^2
    growth = law.parameters[0].growth
    if growth > 0.0:
        set_radius(result, law.parameters[0].log_radius + growth * (log_x2 - law.parameters[0].log_x2))
    share = max(1.0 - 2.0 * factor / density, 0.0)
    bend = bent(result.bend, share)
    width = result.high - result.low + 2.0 * result.bend_error * bend
    total = factor + 0.5 * (result.high + result.low) + bend
    by_radius, radius_variance = law.parameters[0].by_radius, law.parameters[0].radius_variance
    first = by_radius * slope * result.by_stack + result.by_radius + 2.0 * bend
    second = -0.5 * by_radius * by_radius * density * (1.0 + 2.0 * slope / factor) - first * first / total
    by_sheet = total + slope
    by_alpha = slope * (
        log_x2 * (law.parameters[0].power - 2.0 * growth) - law.parameters[0].log_reference
    )  # the logarithm of the pressure
    # errors of the spreading don't grow with the rest: a logarithm's slope is that between the two values
    chord = (result.left + total + 4.0 * math.sqrt(result.left * total)) / 6.0
    width *= total / chord
    result.factor, result.share, result.half_width = factor, share, 0.5 * width
    variance = result.variance * total * total + 0.25 * width * width
    uneven = law.parameters[0].uneven * (1.0 + share) * factor
    variance += uneven * uneven
    cut2 = by_radius * slope * by_radius * slope + _CUT_SPREADING * _CUT_SPREADING
    variance += cut2 * result.cut_std * result.cut_std
    variance += radius_variance * (first * first + 0.5 * second * second * radius_variance)
    variance += law.parameters[0].covariance[0] * slope * slope
    variance += law.parameters[0].covariance[3] * by_alpha * by_alpha
    variance += law.parameters[0].covariance[5] * by_sheet * by_sheet
    mixed = law.parameters[0].covariance[4] * by_alpha * by_sheet
    mixed -= slope * (law.parameters[0].covariance[1] * by_alpha + law.parameters[0].covariance[2] * by_sheet)
    variance += 2.0 * mixed
    std = math.sqrt(max(variance, _MIN_RELATIVE_VARIANCE * factor * factor))
    slope += growth * result.by_radius
    result.std, result.step, result.density, result.total = std, -std / slope, total / std, total
    result.sigma = (math.log(result.left / total) - 0.5 * second * radius_variance / total) * result.density


def bent(limit: float, share: float) -> float:
    """Return by how much the sheet's resistance is less where the current adapts to the edge: twice that is
    between the contact's centre and the current's. limit: (A grad ln R)^2 / 4; share: I2(x) / I0(x)."""
    bend = limit * share
    return bend / (1.0 - bend * (1.0 + share))  # with the images of what turns: within 2 % of what is solved


def find_crowding(
    stack: StackTable,
    law: PadLaw,
    result: ForceResult,
    total_a: float,
    log_spreading_m: float,
    series_ohm: float,
) -> None:
    """Compute by how much the centre of a contact is farther from the edge than that of its current.

    Set what `crowded_shift` needs: `turning`, the share of the current that turns to the edge, s = I2(x) /
    I0(x), with its derivative by the stack factor, for the factor that is left by `around`, the sheet's
    resistance around a contact at the current's centre; `square` and `log_radius` of the radius. Set
    `shift_std` [m^2], the deviation of the shift by the radius and by the film's resistance.

    Set `tilt_m` [m]: how far the centres of current and pressure are from each other where the pressure
    rises from the middle to the rim by its mean. The pressure's is A / 4 from the middle, the current's is
    alpha I1(x) / (2 x I0(x)) A from it, to first order of the rise; what is left out, besides.
    """
    whole = whole_factor(law, total_a)
    left = max(whole - whole / law.parameters[0].drive_v * total_a * series_ohm, _MIN_LEFT)
    log_x2, growth = law.parameters[0].log_x2, law.parameters[0].growth
    radius = factor = 0.0
    for _ in range(1 if growth == 0.0 else _CROWDING_STEPS):
        radius = law.parameters[0].log_radius + growth * (log_x2 - law.parameters[0].log_x2)
        ratio = log_spreading_m - radius
        factor = left - 0.5 * (max(ratio, _MIN_LOG_SPREADING_RATIO) + max(ratio, 0.0))
        factor = max(factor, max(law.parameters[0].min_factor, _MIN_CROWDED_FACTOR))
        log_x2 = find_log_x2(stack, factor)
    x2 = math.exp(log_x2)
    slope = 0.5 * (1.0 - x2 * factor * factor)  # of the factor by ln x^2
    share = max(1.0 - 2.0 / (x2 * factor), 0.0)
    by_factor = (1.0 - share) * (1.0 + slope / factor) / slope
    result.square, result.log_radius = math.exp(2.0 * radius), radius
    result.turning, result.turning_by_factor, result.around = share, by_factor, left - factor
    by_radius = result.square * (share + 0.5 * by_factor) * slope / (slope - growth)
    # a film of more resistance leaves the layer less: the factor that is left goes as 1 over it
    by_film = result.square * (growth * share + 0.5 * by_factor * slope) / (slope - growth) * left
    variance = by_radius * by_radius * law.parameters[0].radius_variance
    result.shift_std = math.sqrt(variance + by_film * by_film * law.parameters[0].covariance[5])
    uneven = (1.0 - 0.5 * law.parameters[0].by_radius) * (1.0 - share) - 1.0
    result.tilt_m = 0.25 * math.exp(radius) * math.sqrt(uneven * uneven + _TILT_REST * _TILT_REST)


def crowded_shift(result: ForceResult, log_spreading_m: float, gradient2: float) -> float:
    """Return the shift of the current's centre [m^2], which with the gradient of ln R [1/m] gives that along
    it, where the contact's centre has this ln R and square of its gradient.

    It is s A^2 / 2, larger by 1 / (1 - s A^2 / R^2), as the current that is turned has an image, too. Of a
    contact over the edge (R < 2 A^2 |grad ln R|) only the part on the pad is turned: of a disc cut by a
    straight edge, with its centre of area R / 2 from it, within a tenth of what is solved.

    Set `moved`, by how much ln R is less at the current's centre, and `bend_error`, the relative deviation of
    what the resistance is less; and of a contact over the edge `cut`, ln of the radius of a disc as large as
    its part over the radius, its derivative by ln of the radius, and its deviation `cut_error`.
    """
    ratio, turning, square = log_spreading_m - result.log_radius, result.turning, result.square
    spreading2, inside = math.exp(2.0 * log_spreading_m), _INFINITY
    if gradient2 > 0.0:
        inside = 0.5 * math.sqrt(spreading2 / gradient2) / square
    limit = 0.25 * min(square * gradient2, 1.0)
    cornered = max(2.0 - math.sqrt(spreading2 * gradient2), 0.0)
    result.cut = result.cut_by_radius = 0.0
    result.bend_error = _BEND_ERROR + _CORNER_BEND_ERROR * cornered
    if inside < 1.0:
        square *= inside * (1.0 + _CUT_TURNING * (1.0 - inside))
        inside = math.sqrt(inside)
        outside = 1.0 - inside
        root = math.sqrt(outside)
        result.cut = -root * outside * (_CUT_AREA + _CUT_MORE_AREA * outside)
        result.bend_error += _CUT_BEND_ERROR
        result.cut_error = _CUT_REST - result.cut * (_CUT_ERROR + _CORNER_ERROR * cornered)
        result.cut_by_radius = -inside * root * (1.5 * _CUT_AREA + 2.5 * _CUT_MORE_AREA * outside)
    else:
        by_factor = result.turning_by_factor
        turning = (turning + by_factor * (result.around - ratio)) / (1.0 - by_factor * limit)
        turning = max(turning, 0.0)
    result.moved = 2.0 * bent(limit, turning)
    return 0.5 * turning * square / (1.0 - turning * square / spreading2)


def move_law(law: PadLaw, log_radius: float) -> None:
    """Change the radius of a law that is the same at every force but for its growth."""
    moved = log_radius - law.parameters[0].log_radius
    by_radius = law.parameters[0].by_radius * moved
    by_pressure = law.parameters[0].power - 2.0 * law.parameters[0].growth
    law.parameters[0].log_x2 += by_radius
    law.parameters[0].max_log_x2 += by_radius
    law.parameters[0].log_reference += 2.0 * moved + by_radius * by_pressure
    law.parameters[0].log_radius = log_radius


def set_part(part: PadLaw, law: PadLaw, cut: float) -> None:
    """Make `part` the law of a contact over an edge, whose part on the pad carries the whole force."""
    part.parameters[0] = law.parameters[0]
    move_law(part, law.parameters[0].log_radius + cut)
    factor = law.parameters[0].min_factor
    if factor > 0.0:
        slope = 0.5 * (1.0 / factor - math.exp(law.parameters[0].max_log_x2) * factor)
        part.parameters[0].min_factor *= math.exp(slope * law.parameters[0].by_radius * cut)


def max_force_n(law: PadLaw) -> float:
    """Return the greatest force of a contact [N], infinite where it is unknown."""
    room = (law.parameters[0].max_log_x2 - law.parameters[0].log_x2) * law.parameters[0].power
    return math.exp(min(_MAX_LOG_FORCE, room)) if room < _INFINITY else _INFINITY


def whole_factor(law: PadLaw, total_a: float) -> float:
    """Return the stack factor that would leave the drive's whole voltage to the contact."""
    per_sheet = _TWO_PI * math.exp(-law.parameters[0].log_sheet)
    factor: float = per_sheet * law.parameters[0].drive_v / max(total_a, _MIN_CURRENT_A)
    return factor


def sheet_ohm_per_square(law: PadLaw) -> float:
    """Return the sheet resistance of a law."""
    return math.exp(law.parameters[0].log_sheet)


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


def find_log_x2(stack: StackTable, factor: float) -> float:
    """Return ln x^2 where I0(x) / (x I1(x)) is `factor`."""
    place = (math.log(factor) - stack.inverse_first) / stack.inverse_width
    if place > stack.inverse_intervals:
        return math.log(2.0 / (factor - _SMALL_CONTACT_REST))
    k = int(place)
    if k < 0:
        k = 0
    if k > stack.inverse_intervals - 1:
        k = stack.inverse_intervals - 1
    t = place - k
    k *= 4
    square: float = stack.inverse[k] * t + stack.inverse[k + 1]
    level: float = (square * t + stack.inverse[k + 2]) * t + stack.inverse[k + 3]
    return level
