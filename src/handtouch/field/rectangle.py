"""The ideal pad: a rectangle with four electrodes along its whole sides, exact both ways in double
precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray
from handtouch.field._separable import SideRatio, theta_four, theta_two
from handtouch.field.estimate import PointEstimate, estimate

MAX_ASPECT_RATIO = 1e100
_HALF_PI = math.pi / 2
_MAX_UNSCALED_SIDE = 1e100  # sides within this factor of 1 need no scaling against overflow
_MIN_EDGE_DISTANCE = 1e-300  # distance over a side: closer points are on the edge
_MIN_DERIVATIVE_DISTANCE = 1e-140  # distance over a side: derivatives of closer points are taken here


@dataclass(frozen=True)
class Location:
    """Exact inverse of four currents; arrays of one shape (...), or scalars.

    x, y: position, in the unit of the pad; NaN where the currents don't determine it.

    total: sum of the four currents.

    residual: signed excess of (x0 + xa) over that of a point at (x, y), divided by the total; positive for a
    contact elongated along x. It vanishes for a point (paper, eqs. 14-15).
    """

    x: FloatArray
    y: FloatArray
    total: FloatArray
    residual: FloatArray


@dataclass(frozen=True)
class Rectangle:
    """A pad 0 <= x <= a, 0 <= y <= b with a grounded electrode along each whole side.

    a, b: lengths of the sides, in any common unit. ValueError unless both are positive and finite, and one is
    at most 1e100 times as long as the other.

    All sides are treated alike; accurate for aspect ratios from 1e-3 to 1e3, down to 1e-12 of a side from
    edges and corners. Points that are NaN or off the pad give NaN in their own element.
    """

    a: float
    b: float

    def __post_init__(self) -> None:
        for name in ("a", "b"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value!r}: a side of a rectangle is positive and finite")
            object.__setattr__(self, name, value)
        if max(self.a, self.b) / MAX_ASPECT_RATIO > min(self.a, self.b):
            raise ValueError(
                f"sides {self.a!r} and {self.b!r}: one is more than {MAX_ASPECT_RATIO:g} times as long as "
                "the other"
            )

    # Forward ----------------------------------------------------------------------------------------------

    def side_fractions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the fractions of the current that sides x0, xa, y0, yb collect, shape (4, ...), sum 1.

        They are the harmonic measures of the sides seen from (x, y): the sums of eqs. 3-5 in closed form.
        Error: a few 1e-16 absolute and, down to 1e-290, 1e-12 relative. At a corner exactly the two sides
        share equally.
        """
        ratio_x, ratio_y = self._ratios(*self._on_pad(x, y))
        with np.errstate(all="ignore"):
            return np.asarray(np.arctan2(*self._tangents(ratio_x, ratio_y)) / _HALF_PI)

    def fractions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return `side_fractions`, shape (4, ...), which an ideal pad measures unchanged."""
        return self.side_fractions(x, y)

    def fractions_with_jacobian(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `side_fractions` and their derivatives by (x, y), shape (4, 2, ...), per unit of a and b.

        On an edge the derivatives are those a rounding error inside it; at a corner they are unbounded.
        """
        x, y = self._on_pad(x, y)
        with np.errstate(all="ignore"):
            x, y = (
                np.clip(s, _MIN_DERIVATIVE_DISTANCE * side, np.nextafter(side, 0))
                for s, side in zip((x, y), self._sides, strict=True)
            )
            ratios = self._ratios(x, y)
            numerator, denominator = self._tangents(*ratios)
            tangent = numerator / denominator
            weight = 2 / math.pi / (tangent + 1 / tangent)  # sin(pi f) / pi
            across, along = self._log_slopes(*ratios)
            jacobian = np.empty((4, 2, *x.shape))
            for i, (own, other) in enumerate(((0, 1), (0, 1), (1, 0), (1, 0))):
                jacobian[i, own] = weight[i] * across[own] * (1 if i % 2 else -1)
                jacobian[i, other] = weight[i] * along[other]
            return np.arctan2(numerator, denominator) / _HALF_PI, jacobian * self._unit

    def conformal_radius(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the conformal radius of the pad seen from (x, y), shape (...), in the unit of a and b.

        A small contact of radius A meets the sheet resistance ln(radius / A) / (2 pi) ohm per ohm per square.
        Relative error a few 1e-16; it vanishes at the edges.
        """
        ratios = self._ratios(*self._on_pad(x, y))
        with np.errstate(all="ignore"):
            across, along = self._log_slopes(*ratios)
            gradient = np.hypot(along[self._long], across[1 - self._long])
            return np.asarray(2 / gradient / self._unit)[()]

    # Inverse ----------------------------------------------------------------------------------------------

    def locate(self, currents: ArrayLike) -> Location:
        """Return the point contact whose currents x0, xa, y0, yb are `currents`, shape (4, ...), any unit.

        x follows from x0 and xa as fractions of the total, y from y0 and yb; the remainder is the residual.
        An element with a negative or NaN current is NaN (`estimate` handles noise), as is a coordinate that
        the currents don't determine: both of its currents underflowed, or zero.
        """
        currents = np.asarray(currents, dtype=np.float64)
        if currents.shape[:1] != (4,):
            raise ValueError(f"currents have shape {currents.shape}: the first axis is x0, xa, y0, yb")
        shape = currents.shape[1:]
        pairs = currents.reshape(2, 2, -1)
        with np.errstate(all="ignore"):
            sums = pairs[:, 0] + pairs[:, 1]
            total = sums[0] + sums[1]
            tangents, measured = _half_angle_tangents(pairs, total)
            x, y, expected = self._invert(tangents)
            residual = measured - expected
        return Location(*(v.reshape(shape)[()] for v in (x, y, total, residual)))

    def estimate(
        self, currents: ArrayLike, noise: ArrayLike, start: ArrayLike | None = None
    ) -> PointEstimate:
        """Return the maximum-likelihood contact from all four noisy currents; see `estimate`."""
        return estimate(self, currents, noise, start)

    # Details ----------------------------------------------------------------------------------------------

    @cached_property
    def _unit(self) -> float:
        """Power of two that scales extreme sides to near 1, so that no intermediate leaves double range."""
        largest = max(self.a, self.b)
        if 1 / _MAX_UNSCALED_SIDE < largest < _MAX_UNSCALED_SIDE:
            return 1.0
        return math.ldexp(1.0, min(1000, -math.frexp(largest)[1]))

    @cached_property
    def _sides(self) -> tuple[float, float]:
        return self.a * self._unit, self.b * self._unit

    @cached_property
    def _long(self) -> int:
        """Axis of the longer sides."""
        return 0 if self.a >= self.b else 1

    @cached_property
    def _pairs(self) -> tuple[SideRatio, SideRatio]:
        a, b = self._sides
        return SideRatio(a, b), SideRatio(b, a)

    @cached_property
    def _coupling(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Per axis: numerator factor, delta and slope of the algebra in `_separable`.

        Ratios along the longer axis keep the factor `root`, which may underflow, and those along the shorter
        one are divided by it; the factors here compensate for that.
        """
        long = self._long
        root = self._pairs[long].root
        nome = math.exp(-math.pi * self._sides[long] / self._sides[1 - long])
        strong = 8 * (theta_two(nome) / theta_four(nome)) ** 2
        short_slope = self._pairs[1 - long].slope * self._pairs[1 - long].root
        by_length = np.array(
            [[strong, 4 / strong], [4 / strong, strong * root], [self._pairs[long].slope, short_slope]]
        )
        numerator, delta, slope = by_length if long == 0 else by_length[:, ::-1]
        return numerator, delta, slope

    @cached_property
    def _inverse(self) -> RatioInverse:
        """Inverse for both axes or, on a strip, for its shorter axis."""
        short = self._pairs[1 - self._long]
        return RatioInverse((short,) if self._is_strip else self._pairs)

    @cached_property
    def _is_strip(self) -> bool:
        return self._sides[self._long] > LOGARITHMIC_DEPTH * self._sides[1 - self._long]

    def _on_pad(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x and y as float64 of one shape, NaN off the pad, scaled by `_unit`."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        with np.errstate(all="ignore"):
            on = (x >= 0) & (x <= self.a) & (y >= 0) & (y <= self.b)
            # Points so near an edge that a ratio could overflow are on it, and so is -0.0.
            x, y = (
                np.where(x > _MIN_EDGE_DISTANCE * self.a, x, 0.0),
                np.where(y > _MIN_EDGE_DISTANCE * self.b, y, 0.0),
            )
            return np.where(on, x, np.nan) * self._unit, np.where(on, y, np.nan) * self._unit

    def _ratios(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the ratios G of the two sides of either pair, (2, ...) each; the short axis' without its
        root.
        """
        with np.errstate(all="ignore"):
            ratios = [np.stack(pair(s)) for pair, s in zip(self._pairs, (x, y), strict=True)]
            ratios[1 - self._long] /= self._pairs[1 - self._long].root
            return ratios[0], ratios[1]

    def _tangents(self, ratio_x: FloatArray, ratio_y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return numerators and denominators of tan(pi f / 2), shape (4, ...) each."""
        numerator, delta, _ = self._coupling
        sum_x, sum_y = ratio_x[0] + ratio_x[1], ratio_y[0] + ratio_y[1]
        below_x, below_y = sum_y + np.hypot(sum_y, delta[1]), sum_x + np.hypot(sum_x, delta[0])
        return (
            np.concatenate([numerator[0] * ratio_x, numerator[1] * ratio_y]),
            np.stack([below_x, below_x, below_y, below_y]),
        )

    def _log_slopes(
        self, ratio_x: FloatArray, ratio_y: FloatArray
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return per axis how fast ln T falls with distance from its own side, and rises in the other
        pair.
        """
        _, delta, slope = self._coupling
        ratios = (ratio_x, ratio_y)
        across = [slope[i] * np.hypot(ratios[i][0] + ratios[i][1], delta[i]) for i in range(2)]
        along = [slope[i] * (ratios[i][0] - ratios[i][1]) for i in range(2)]
        return across, along

    def _invert(self, tangents: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x, y and the fraction expected in the pair x0, xa, from T of shape (2 pairs, 2 sides, n)."""
        ratio = tangents[:, 0] / tangents[:, 1]
        mirrored = ratio < 1
        ratio = np.where(mirrored, 1 / ratio, ratio)
        if self._is_strip:
            short = 1 - self._long
            near = np.maximum(tangents[self._long, 0], tangents[self._long, 1])
            distance = np.empty_like(ratio)
            distance[short] = self._inverse(ratio[[short]])[0]
            distance[self._long] = distance_in_strip(self._pairs[self._long], near, distance[short])
        else:
            distance = self._inverse(ratio)
        x, y = np.where(mirrored, np.array(self._sides)[:, None] - distance, distance) / self._unit
        if self._is_strip:
            expected = self.side_fractions(x, y)[:2].sum(axis=0)
        else:
            root = np.sqrt(ratio)
            g = root + 1 / root
            expected = np.arctan(self._complementary_ratio * (g[0] / g[1])) / _HALF_PI
        return x, y, expected

    @cached_property
    def _complementary_ratio(self) -> float:
        """k' / k of the rectangle: the tangent of pi / 2 times the x0 + xa fraction at its centre."""
        _, delta, _ = self._coupling
        return float(delta[1] / 2) if self._long == 0 else float(2 / delta[0])


def _half_angle_tangents(pairs: FloatArray, total: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T = tan(pi f / 2) of every current, (2 pairs, 2 sides, n), and the fraction in the first
    pair.
    """
    fractions = np.where(pairs >= 0, np.abs(pairs), np.nan) / total  # -0.0 is not negative
    sums = fractions[:, 0] + fractions[:, 1]
    rest = fractions[:, ::-1] + sums[::-1, None]  # not 1 - f: the rest of a large f keeps its digits
    tangents = np.tan(_HALF_PI * np.minimum(fractions, rest))
    return np.where(fractions > rest, 1 / tangents, tangents), sums[0]


# --- distance from a side by the ratio of its current to the opposite one: Landen's transformation

_MIN_MODULUS = 1e-15  # a smaller modulus changes the inverse by less than rounding
_MAX_TRIGONOMETRIC_MODULUS = 6e-9  # a complementary modulus below this leaves an arctangent
LOGARITHMIC_DEPTH = 12.0  # depth / length from which the modulus is below _MIN_MODULUS


def landen_moduli(k: float, k_complement: float) -> list[tuple[float, float]]:
    """Return (k, k') of every step of the descending Landen transformation, until k is negligible."""
    steps = []
    while k > _MIN_MODULUS:
        steps.append((k, k_complement))
        k, k_complement = k * k / (1 + k_complement) ** 2, 2 * math.sqrt(k_complement) / (1 + k_complement)
    return steps


class RatioInverse:
    """Solves T0 / T1 = ratio for the distance to the nearer side, for one or both pairs of sides at once."""

    def __init__(self, pairs: Sequence[SideRatio]) -> None:
        self._pairs = tuple(pairs)

    @cached_property
    def _trigonometric(self) -> bool:
        return all(pair.moduli[1] < _MAX_TRIGONOMETRIC_MODULUS for pair in self._pairs)

    @cached_property
    def _first(self) -> FloatArray:
        """1 / k of each pair."""
        return np.array([[1 / pair.moduli[0]] for pair in self._pairs])

    @cached_property
    def _steps(self) -> list[tuple[FloatArray, FloatArray]]:
        """k^2 and (1 + k')^2 of each step, for each pair; a pair that finishes early takes idle steps."""
        chains = [landen_moduli(*pair.moduli) for pair in self._pairs]
        longest = max(map(len, chains))
        chains = [chain + [(1.0, 0.0)] * (longest - len(chain)) for chain in chains]
        return [
            (np.array([[k * k] for k, _ in step]), np.array([[(1 + kc) ** 2] for _, kc in step]))
            for step in zip(*chains, strict=True)
        ]

    @cached_property
    def _scale(self) -> FloatArray:
        """Distance per unit of the final arsinh."""
        scales = np.array([[1 / pair.wavenumber] for pair in self._pairs])
        if not self._trigonometric:
            for _, factor in self._steps:
                scales = scales / np.sqrt(factor)
        return scales

    def __call__(self, ratio: FloatArray) -> FloatArray:
        """Return the distance to the nearer side, for `ratio` >= 1 of its T to the opposite one; (pairs,
        n).
        """
        squared = self._first / ratio  # sc(kappa d; k')^2
        if self._trigonometric:
            return np.asarray(np.arctan(np.sqrt(squared)) * self._scale)
        for modulus, factor in self._steps:
            squared = squared * (squared + 1) * factor / (squared * modulus + 1)
        return np.asarray(np.arcsinh(np.sqrt(squared)) * self._scale)


def distance_in_strip(pair: SideRatio, near: FloatArray, across: FloatArray) -> FloatArray:
    """Return the distance to the nearer side of a pair more than LOGARITHMIC_DEPTH times as deep as long.

    `near` is the T of that side, `across` the distance to the nearer long side. The other end of such a strip
    collects no measurable current, so this end alone decides: sinh(pi d / length) = sin(pi across / length) /
    T. NaN where the current of this end has underflowed as well.
    """
    shift = math.pi / pair.length
    across = np.where(np.isnan(across), pair.length / 2, across)  # NaN only on the end itself
    sine = np.sin(shift * across)
    log_sinh = np.log(sine) - np.log(near)
    distance = np.where(log_sinh > 20, log_sinh + math.log(2), np.arcsinh(sine / near))
    return np.asarray(np.where(near >= np.finfo(float).tiny, distance / shift, np.nan))
