"""Surfaces of revolution with any smooth profile, tabulated to 1e-12 of its length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field.surface_base import Meridian, SweptSurface, arc_key, check_arc, surface_key

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

_STEPS_PER_SEGMENT = 128  # table steps per spline segment


@dataclass(frozen=True)
class RevolutionSurface(SweptSurface):
    """A patch of any surface of revolution, its profile a smooth curve (cubic spline) through given points.

    `axial_m`, `radius_m`: the points of the profile from electrode x0 to xa, at least two, no two the same,
    radii positive; the outside is the side away from the axis. Lengths and angles follow the spline to
    1e-12 of the profile's length.
    """

    kind: ClassVar[str] = "revolution"
    axial_m: tuple[float, ...] = surface_key(
        "profile_axial_mm",
        "points of the profile from electrode x0 to electrode xa: coordinate along the axis",
        above=None,
        is_list=True,
        example=[0.0, 10.0, 20.0, 30.0],
    )
    radius_m: tuple[float, ...] = surface_key(
        "profile_radius_mm",
        "radii at the same points, joined by a smooth curve",
        is_list=True,
        example=[9.0, 11.0, 10.0, 7.0],
    )
    arc_rad: float = arc_key()

    def __post_init__(self) -> None:
        check_arc(self.arc_rad)
        axial, radius = np.asarray(self.axial_m, float), np.asarray(self.radius_m, float)
        if axial.ndim != 1 or axial.size < 2 or not np.isfinite(axial).all():
            raise ValueError("axial_m must be a sequence of at least two finite numbers")
        if radius.shape != axial.shape:
            raise ValueError(f"radius_m must have as many points as axial_m, {axial.size}, got {radius.size}")
        if not (np.isfinite(radius).all() and (radius > 0).all()):
            raise ValueError("radius_m must be positive and finite at every point")
        if (np.hypot(np.diff(axial), np.diff(radius)) == 0).any():
            raise ValueError("axial_m and radius_m name the same point twice running")
        _ = self._profile  # built here to reject an impossible curve at once

    @cached_property
    def _profile(self) -> SplineProfile:
        return SplineProfile(np.asarray(self.axial_m, float), np.asarray(self.radius_m, float))

    @cached_property
    def a(self) -> float:
        return self._mid_radius * self._profile.conformal_length

    @cached_property
    def b(self) -> float:
        return self._mid_radius * self.arc_rad

    @property
    def extent_m(self) -> tuple[float, float]:
        return self._profile.length, self.b

    @cached_property
    def _mid_point(self) -> tuple[float, float, float]:
        """Conformal coordinate, axial position and radius half way along the profile."""
        half = np.array([self._profile.length / 2])
        parameter = self._profile.at_arc_length(half)
        axial, radius, _, _ = self._profile.curve(parameter)
        return float(self._profile.conformal(parameter)[0]), float(axial[0]), float(radius[0])

    @property
    def _mid_radius(self) -> float:
        return self._mid_point[2]

    @property
    def _curvature(self) -> float:
        return 1 / self._mid_radius

    @property
    def _middle(self) -> float:
        return self._mid_point[0] * self._mid_radius

    def _arc_length(self, x: FloatArray) -> FloatArray:
        return self._profile.arc_length(self._profile.at_conformal(x / self._mid_radius))

    def _conformal(self, u: FloatArray) -> FloatArray:
        return self._mid_radius * self._profile.conformal(self._profile.at_arc_length(u))

    def _meridian(self, x: FloatArray) -> Meridian:
        axial, radius, cosine, sine = self._profile.curve(self._profile.at_conformal(x / self._mid_radius))
        _, mid_axial, mid_radius = self._mid_point
        return Meridian(
            axial=axial - mid_axial,
            radial=radius - mid_radius,
            scale=radius / mid_radius,
            cosine=cosine,
            sine=sine,
        )


class SplineProfile:
    """Cubic spline (axial, radius) against chord length; the parameter t is the chord length.

    The axis is taken in the direction of travel, so that the outside is always the side away from it.
    """

    @np.errstate(all="ignore")
    def __init__(self, axial: FloatArray, radius: FloatArray) -> None:
        forward = 1.0 if axial[-1] >= axial[0] else -1.0
        # a power of two scales any unit to near 1, so that no square or quotient leaves the range of doubles
        self._unit = math.ldexp(1.0, math.frexp(float(np.abs([axial, radius]).max()))[1])
        points = np.stack([forward * axial, radius], axis=1) / self._unit
        knots = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        from scipy.interpolate import CubicSpline  # lazy, here and below: slow to import

        self._spline = CubicSpline(knots, points)
        steps = np.linspace(0, 1, _STEPS_PER_SEGMENT, endpoint=False)
        self._nodes = np.append((knots[:-1, None] + np.diff(knots)[:, None] * steps).ravel(), knots[-1])
        if not self._spline(self._nodes)[:, 1].min() > 0:
            raise ValueError(
                "radius_m: the smooth curve through the points crosses the axis; give more points"
            )
        abscissae, weights = np.polynomial.legendre.leggauss(8)
        half = np.diff(self._nodes) / 2
        samples = (self._nodes[:-1] + half)[:, None] + half[:, None] * abscissae
        speed = self._speed(samples)
        self._arc = self._table(half * (speed @ weights), self._speed(self._nodes))
        self._log = self._table(
            half * ((speed / self._spline(samples)[..., 1]) @ weights),
            self._speed(self._nodes) / self._spline(self._nodes)[..., 1],
        )
        self._from_arc = self._inverse(self._arc)
        self._from_log = self._inverse(self._log)

    @property
    def length(self) -> float:
        """Arc length of the whole profile."""
        return self._unit * float(self._arc(self._nodes[-1]))

    @property
    def conformal_length(self) -> float:
        """Integral of ds / r over the whole profile."""
        return float(self._log(self._nodes[-1]))

    def curve(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return axial position, radius, and cosine and sine of the slope at t; NaN outside the profile."""
        axial, radius = np.moveaxis(self._spline(t, extrapolate=False), -1, 0)
        forward, outward = np.moveaxis(self._spline(t, 1, extrapolate=False), -1, 0)
        speed = np.hypot(forward, outward)
        return self._unit * axial, self._unit * radius, forward / speed, outward / speed

    def arc_length(self, t: FloatArray) -> FloatArray:
        """Return the arc length from the start to t."""
        return np.asarray(self._unit * self._arc(t))

    def conformal(self, t: FloatArray) -> FloatArray:
        """Return the integral of ds / r from the start to t."""
        return np.asarray(self._log(t))

    def at_arc_length(self, length: FloatArray) -> FloatArray:
        """Return t at the given arc length."""
        return _solve(self._arc, self._from_arc, length / self._unit)

    def at_conformal(self, value: FloatArray) -> FloatArray:
        """Return t at the given conformal coordinate."""
        return _solve(self._log, self._from_log, value)

    def _speed(self, t: FloatArray) -> FloatArray:
        return np.asarray(np.hypot(*np.moveaxis(self._spline(t, 1), -1, 0)))

    def _table(self, pieces: FloatArray, slope: FloatArray) -> CubicHermiteSpline:
        return _hermite(self._nodes, np.concatenate([[0.0], np.cumsum(pieces)]), slope)

    def _inverse(self, table: CubicHermiteSpline) -> CubicHermiteSpline:
        return _hermite(table(self._nodes), self._nodes, 1 / table(self._nodes, 1))


def _hermite(x: FloatArray, y: FloatArray, slope: FloatArray) -> CubicHermiteSpline:
    from scipy import interpolate

    return interpolate.CubicHermiteSpline(x, y, slope, extrapolate=False)


def _solve(table: CubicHermiteSpline, inverse: CubicHermiteSpline, value: FloatArray) -> FloatArray:
    """Return the table's argument for a value: a start from the inverse table, then one Newton step."""
    first, last = inverse.x[0], inverse.x[-1]
    slack = 1e-12 * (last - first)  # rounding of the end itself
    inside = (value >= first - slack) & (value <= last + slack)
    value = np.where(inside, np.clip(value, first, last), np.nan)
    start = np.clip(inverse(value), table.x[0], table.x[-1])  # rounding may lead out of the table
    return np.clip(start - (table(start) - value) / table(start, 1), table.x[0], table.x[-1])
