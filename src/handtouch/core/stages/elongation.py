"""Elongation of a contact: length and direction with intervals, as far as the currents of its pad carry them.

Outside a contact its currents follow from its total, its centre and its second moments; of these only their
difference along two axes at right angles counts, and the same at 45 degrees (theory, "Two contacts and
elongated ones"; paper, eqs. 14 and 15 are one combination of them). Four channels leave one number over for
them, five and more leave two. Both are estimated linearly about the point that explains the currents best,
with its position and total free, and are stated as the line with the same moments.

Public names: `Elongation`, `estimate_elongation`.
"""

from __future__ import annotations

import math

import numpy as np

from handtouch.core.memory import view_memory
from handtouch.core.stages import locate, tolerances

_SIGMAS = 1.959964  # of the interval, 95 %
_MIN_CHI_SQUARED = 5.991465  # of two numbers, 95 %
_LINE = 24.0  # squared length of a line over half the difference of its variances along and across
_MAX_STD_SIDES = 0.5  # length in shorter sides, as a deviation, beyond which nothing is known
_RELATIVE_STD = 0.15
"""Relative error of the moments, by what is beyond them and by crowding: by coverage in `ideal` and
`default`, tuning family, 240 touches."""
_NAN, _INFINITY, _PI = float("nan"), math.inf, math.pi
_AXIS_STD_RAD = 0.25 * math.pi / math.sqrt(3.0)
"""Of a direction equally likely within 45 degrees: of one number, whose sign alone is known"""


class Elongation:
    """Result of `estimate_elongation`; NaN where it isn't known.

    length_m: of the line with the contact's moments; least_m, most_m: its interval of 95 %. angle, angle_std:
    of its direction from the pad's x towards y [rad]. along, across (n,): working memory.
    """

    def __init__(self, channels: int) -> None:
        self.length_m = self.least_m = self.most_m = self.angle = self.angle_std = _NAN
        self.along, self.across = view_memory(np.zeros(channels)), view_memory(np.zeros(channels))
        self.aa = self.ab = self.bb = self.a = self.b = 0.0


def estimate_elongation(found: Elongation, table: locate.ModelTable, fit: locate.Fit, metres2: float) -> None:
    """Estimate the elongation of the contact in `fit`, just located.

    metres2: area on the surface of the rectangle's unit square there.
    """
    found.length_m = found.least_m = found.most_m = found.angle = found.angle_std = _NAN
    determinant = fit.xx * fit.yy - fit.xy * fit.xy
    if not (table.is_potential and determinant > 1e-12 * fit.xx * fit.yy):
        return
    _read_derivatives(found, table, fit)
    _project(found, fit, table.electrodes, determinant)
    # the information about both numbers, in its principal axes; the prior that is in the whitening goes out
    half, middle = 0.5 * (found.aa - found.bb), 0.5 * (found.aa + found.bb)
    radius = math.sqrt(half * half + found.ab * found.ab)
    turn = 0.5 * math.atan2(found.ab, half)
    cosine, sine = math.cos(turn), math.sin(turn)
    prior = tolerances.elongation_std(fit.whitening.pad, fit.whitened_s)
    side = _MAX_STD_SIDES * min(table.side_x, table.side_y)
    most = side * side / _LINE
    variance = _variance(middle + radius, prior * prior)
    if not variance < most * most:
        return
    first = (found.a * cosine + found.b * sine) / (middle + radius)
    other_variance = _variance(middle - radius, prior * prior)
    if other_variance < most * most:
        second = (found.b * cosine - found.a * sine) / (middle - radius)
        _state_two(found, first, second, variance, other_variance, turn)
    else:
        _state_one(found, first, variance, turn)
    scale = math.sqrt(metres2)
    found.length_m *= scale
    found.least_m *= scale
    found.most_m *= scale


def _read_derivatives(found: Elongation, table: locate.ModelTable, fit: locate.Fit) -> None:
    """Whiten what a unit of both numbers adds to the currents: second derivatives by x x and x y."""
    n, whitening = table.electrodes, fit.whitening
    if whitening.pad.is_shape_exact:
        tolerances.read_second_derivatives(whitening, fit.s, fit.t)
    for i in range(n):
        fit.scaled[i] = tolerances.second_derivative(whitening, i, 1.0, 0.0) * fit.total * fit.weight[i]
    tolerances.apply_whitening(whitening, fit.scaled, 0, found.along)
    for i in range(n):
        fit.scaled[i] = tolerances.second_derivative(whitening, i, 0.0, 1.0) * fit.total * fit.weight[i]
    tolerances.apply_whitening(whitening, fit.scaled, 0, found.across)


def _project(found: Elongation, fit: locate.Fit, n: int, determinant: float) -> None:
    """Compute information and gradient of both numbers, with position and total free."""
    aa = ab = bb = a = b = 0.0
    af = bf = ax = ay = bx = by = df = dx = dy = 0.0
    for i in range(n):
        h, k, d = found.along[i], found.across[i], fit.data[i]
        f, x, y = fit.fractions[i], fit.slope_x[i], fit.slope_y[i]
        aa += h * h
        ab += h * k
        bb += k * k
        a += h * d
        b += k * d
        af += h * f
        bf += k * f
        ax += h * x
        ay += h * y
        bx += k * x
        by += k * y
        df += d * f
        dx += d * x
        dy += d * y
    xx, xy, yy = fit.xx / determinant, fit.xy / determinant, fit.yy / determinant
    a_x, a_y = yy * ax - xy * ay, xx * ay - xy * ax  # of the step that undoes it
    b_x, b_y = yy * bx - xy * by, xx * by - xy * bx
    found.aa = aa - af * af / fit.norm - a_x * ax - a_y * ay
    found.ab = ab - af * bf / fit.norm - a_x * bx - a_y * by
    found.bb = bb - bf * bf / fit.norm - b_x * bx - b_y * by
    found.a = a - af * df / fit.norm - a_x * dx - a_y * dy
    found.b = b - bf * df / fit.norm - b_x * dx - b_y * dy


def _variance(information: float, prior: float) -> float:
    """Return the variance of a number by what the currents say, without its prior variance."""
    if not information > 0.0:
        return _INFINITY
    return max(1.0 / information - prior, 1e-6 / information)


def _state_two(
    found: Elongation, first: float, second: float, variance: float, other: float, turn: float
) -> None:
    """State the line of two numbers along principal axes at `turn`, in units of the rectangle."""
    size2 = first * first + second * second
    size = math.sqrt(size2)
    chi2 = first * first / variance + second * second / other
    error2 = _RELATIVE_STD * _RELATIVE_STD * size2
    along2 = (variance * first * first + other * second * second) / max(size2, 1e-300) + error2
    across2 = (variance * second * second + other * first * first) / max(size2, 1e-300) + error2
    if chi2 < _MIN_CHI_SQUARED:
        along2 = max(variance, other) + error2
    _state_length(found, size, math.sqrt(along2))
    found.most_m = math.sqrt(_LINE * (size + _SIGMAS * math.sqrt(along2)))
    if chi2 < _MIN_CHI_SQUARED:
        found.least_m = 0.0
        return
    found.angle = 0.5 * (turn + math.atan2(second, first))
    found.angle_std = 0.5 * math.sqrt(across2) / size


def _state_one(found: Elongation, first: float, variance: float, turn: float) -> None:
    """State the shortest line of one number: along the direction that shows it most, or across."""
    error = _RELATIVE_STD * first
    std = math.sqrt(variance + error * error)
    _state_length(found, abs(first), std)
    if abs(first) > _SIGMAS * std:
        found.angle = 0.5 * (turn if first > 0.0 else turn + _PI)
        found.angle_std = _AXIS_STD_RAD


def _state_length(found: Elongation, size: float, std: float) -> None:
    """State length and lower end of its interval of half a difference of variances."""
    found.length_m = math.sqrt(_LINE * size)
    found.least_m = math.sqrt(_LINE * max(size - _SIGMAS * std, 0.0))
