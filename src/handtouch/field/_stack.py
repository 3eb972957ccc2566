"""The modified-Bessel factor of a disc on a sheet (eq. 11), and a table of its inverse."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import i0e, i1e

FloatArray = npt.NDArray[np.float64]

_REACH, _NODES = 16.0, 2049  # the table holds |ln x| up to this


def stack_factor(x: FloatArray) -> FloatArray:
    """I0(x) / (x I1(x)) for any x >= 0, by scaled functions: 2 / x^2 + 1/4 for small x, 1 / x for large."""
    x = np.minimum(x, 1e300)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(i0e(x) / i1e(x) / x)


class StackInverse(Protocol):
    """Ln x^2 and its derivative, where I0(x) / (x I1(x)) - growth ln x^2 has a given value."""

    def __call__(self, value: FloatArray) -> tuple[FloatArray, FloatArray]: ...


@cache
def stack_inverse(growth: float) -> StackInverse:
    """The inverse for contacts whose radius grows as x^(2 growth); relative error of x^2 below 1e-9.

    Cubic Hermite pieces in ln(value), or asinh(value) where growth > 0, for then values may be negative.
    Beyond the table, whose ends are the asymptotes, it goes on straight.
    """
    log_x = np.linspace(_REACH, -_REACH, _NODES)
    x = np.exp(log_x)
    value = stack_factor(x) - 2 * growth * log_x
    ratio = i0e(x) / i1e(x)
    slope = -(ratio - 1) * (ratio + 1) / 2 - growth  # d value / d ln x^2
    if growth == 0:
        knots, rates = np.log(value), value / slope
    else:
        knots, rates = np.arcsinh(value), np.hypot(1, value) / slope
    widths = np.diff(knots)
    levels = 2 * log_x
    chord = np.diff(levels)
    left, right = rates[:-1] * widths, rates[1:] * widths
    quadratic, cubic = 3 * chord - 2 * left - right, left + right - 2 * chord
    table = np.stack([levels[:-1], left, quadratic, cubic, knots[:-1], 1 / widths])

    def inverse(value: FloatArray) -> tuple[FloatArray, FloatArray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.log(value) if growth == 0 else np.arcsinh(value)
            inside = np.minimum(np.maximum(place, knots[0]), knots[-1])
            piece = np.minimum(np.searchsorted(knots, inside, side="right") - 1, _NODES - 2)
            constant, linear, quadratic, cubic, start, per_width = table.take(piece, axis=1)
            t = (inside - start) * per_width
            level = ((cubic * t + quadratic) * t + linear) * t + constant
            rate = ((3 * cubic * t + 2 * quadratic) * t + linear) * per_width
            level = level + rate * (place - inside)
            return level, rate / (value if growth == 0 else np.hypot(1, value))

    return inverse
