"""The modified-Bessel factor of a disc on a sheet (eq. 11), and a table of its inverse."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray

_MAX_ABS_LOG_X, _TABLE_NODES = 16.0, 2049  # the table holds |ln x| up to this
_MIN_ASYMPTOTIC_X = 32.0  # from here on the asymptotic series of the Bessel functions are exact to rounding
_CONTINUED_FRACTION_TERMS, _ASYMPTOTIC_TERMS = 64, 20


def stack_factor(x: FloatArray) -> FloatArray:
    """Return I0(x) / (x I1(x)) for any x >= 0: 2 / x^2 + 1/4 for small x, 1 / x for large."""
    x = np.minimum(x, 1e300)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(bessel_ratio(x) / x)


def bessel_ratio(x: npt.ArrayLike) -> FloatArray:
    """Return I0(x) / I1(x) for x >= 0, to a few 1e-16: infinite at 0, NaN for NaN.

    For small x by I_(n-1) / I_n = 2 n / x + I_(n+1) / I_n from its tail on, where every term is positive; for
    large x by the two asymptotic series. Implemented here because importing scipy.special takes a fifth of a
    daemon's start.
    """
    x = np.asarray(x, np.float64)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        per_x = 2 / np.minimum(x, _MIN_ASYMPTOTIC_X)
        near = (_CONTINUED_FRACTION_TERMS + 1) * per_x
        for n in range(_CONTINUED_FRACTION_TERMS, 0, -1):
            near = n * per_x + 1 / near
        far = np.maximum(x, _MIN_ASYMPTOTIC_X)
        return np.asarray(
            np.where(x > _MIN_ASYMPTOTIC_X, _asymptotic_series(0, far) / _asymptotic_series(1, far), near)
        )


def _asymptotic_series(order: int, x: FloatArray) -> FloatArray:
    """Return I_order(x) sqrt(2 pi x) exp(-x) for large x."""
    total = np.ones_like(x)
    for k in range(_ASYMPTOTIC_TERMS, 0, -1):
        total = 1 - total * ((4 * order**2 - (2 * k - 1) ** 2) / (8 * k)) / x
    return total


class StackInverse(Protocol):
    """Function that returns ln x^2 and its derivative where I0(x) / (x I1(x)) - growth ln x^2 has a given
    value.
    """

    def __call__(self, value: FloatArray) -> tuple[FloatArray, FloatArray]: ...


@cache
def stack_inverse(growth: float) -> StackInverse:
    """Return the inverse for contacts whose radius grows as x^(2 growth); relative error of x^2 below
    1e-9.

    Cubic Hermite pieces in ln(value), or asinh(value) where growth > 0, because values may then be negative.
    Linear beyond the table, whose ends are the asymptotes.
    """
    log_x = np.linspace(_MAX_ABS_LOG_X, -_MAX_ABS_LOG_X, _TABLE_NODES)
    x = np.exp(log_x)
    value = stack_factor(x) - 2 * growth * log_x
    ratio = bessel_ratio(x)
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
            piece = np.minimum(np.searchsorted(knots, inside, side="right") - 1, _TABLE_NODES - 2)
            constant, linear, quadratic, cubic, start, per_width = table.take(piece, axis=1)
            t = (inside - start) * per_width
            level = ((cubic * t + quadratic) * t + linear) * t + constant
            rate = ((3 * cubic * t + 2 * quadratic) * t + linear) * per_width
            level = level + rate * (place - inside)
            return level, rate / (value if growth == 0 else np.hypot(1, value))

    return inverse
