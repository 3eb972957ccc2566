"""Geometry of a simulated pad, directly from the millimetres of the deployment.

Public names: `SimulatedSurface` and its subclasses, `SurfaceProjection`, `SheetMetric`, `profile_length_m`.
It is independent of `handtouch.field.surface`, so that a mistake in either shows as a position error instead
of cancelling.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, CubicSpline, PPoly

from handtouch.arrays import FloatArray

_ABSCISSAE, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_PROFILE_CELLS, _NEWTON_STEPS = 400, 3  # cells and steps of a projection to a spline profile
_HULL_CIRCLE_POINTS, _HULL_PROFILE_CIRCLES = 96, 24
_PLATE_THICKNESS_M = 4e-3


class SurfaceProjection(NamedTuple):
    """Feet of the normals from n points to a surface."""

    fraction: FloatArray
    """(n, 2), fractions from electrodes x0 and y0; outside 0 to 1 the foot isn't on the pad."""
    height_m: FloatArray
    """(n,), height of the points above the surface, negative below."""
    normal: FloatArray
    """(n, 3), outward normals in the pad's frame."""


@dataclass(frozen=True)
class SheetMetric:
    """Surface of revolution as the sheet's equation has it: arc length s, angle phi, radius r(s)."""

    length_m: float
    """Length of the profile."""
    arc: float
    """Angle phi at electrode yb."""

    def radius(self, s_m: ArrayLike) -> FloatArray:
        """Return metres along the surface per unit of phi at `s_m` (...)."""
        raise NotImplementedError

    def isothermal(self, s_m: ArrayLike) -> FloatArray:
        """Return the integral of ds / radius from electrode x0 to `s_m` (...); with phi, a conformal map."""
        half = np.asarray(s_m, np.float64)[..., None] / 2
        return np.asarray((half / self.radius(half * (1 + _ABSCISSAE))) @ _WEIGHTS)


@dataclass(frozen=True)
class SimulatedSurface(SheetMetric):
    """Surface of revolution, a cylinder, a cone or a sphere; or a plane.

    Its coordinates are the arc length s along the profile, in metres from electrode x0, and the angle phi, in
    radians from electrode y0. On a plane phi is in metres, and the radius is 1.
    """

    start_radius_m: float
    """Radius at s = 0, of a straight profile."""
    slope: float = 0.0
    """Change of radius per metre of a straight profile."""
    sphere_from_rad: float | None = None
    """Latitude at s = 0 if the profile is a meridian of a sphere, whose radius is `start_radius_m`."""
    flat: bool = False
    resistivity_ratio: float = 1.0
    """Resistivity along s over that along phi; the sheet's resistance is their geometric mean."""

    @property
    def metric(self) -> SheetMetric:
        """Equivalent surface with an isotropic sheet: s is stretched if the sheet is anisotropic."""
        return self if self.resistivity_ratio == 1 else _StretchedMetric.of_surface(self)

    @property
    def stretch(self) -> float:
        """Length of s in `metric` relative to that on the surface."""
        return math.sqrt(self.resistivity_ratio)

    def resized(self, longer_m: float, wider_m: float) -> SimulatedSurface:
        """Return a pad longer along x, and wider along y in its middle, which stays where it is."""
        if not (longer_m or wider_m):
            return self
        wider_arc = wider_m / float(self.radius(self.length_m / 2))
        start_rad = self.sphere_from_rad
        if start_rad is not None:
            start_rad -= longer_m / 2 / self.start_radius_m
        return replace(
            self,
            length_m=self.length_m + longer_m,
            arc=self.arc + wider_arc,
            start_radius_m=self.start_radius_m - self.slope * longer_m / 2,
            sphere_from_rad=start_rad,
        )

    def radius(self, s_m: ArrayLike) -> FloatArray:
        """Return metres along the surface per unit of phi at `s_m` (...)."""
        s = np.asarray(s_m, np.float64)
        if self.flat:
            return np.ones_like(s)
        if self.sphere_from_rad is None:
            return np.asarray(self.start_radius_m + self.slope * s)
        return np.asarray(self.start_radius_m * np.cos(self.sphere_from_rad + s / self.start_radius_m))

    def point(self, s_m: float, phi: float) -> FloatArray:
        """Return a position (3,) [m] in the pad's frame: origin at its centre, x towards xa, z outward."""
        if self.flat:
            return np.array([s_m - self.length_m / 2, phi - self.arc / 2, 0.0])
        axial, radius = self._profile(s_m)
        middle_axial, middle_radius = self._profile(self.length_m / 2)
        angle = phi - self.arc / 2
        return self._to_pad_frame(
            axial - middle_axial, radius * math.sin(angle), radius * math.cos(angle) - middle_radius
        )

    def normal(self, s_m: float, phi: float) -> FloatArray:
        """Return the outward unit normal (3,) in the pad's frame."""
        if self.flat:
            return np.array([0.0, 0.0, 1.0])
        angle, climb = phi - self.arc / 2, self._profile_angle(s_m)
        return self._to_pad_frame(
            -math.sin(climb), math.cos(climb) * math.sin(angle), math.cos(climb) * math.cos(angle)
        )

    def arc_lengths(self, s_m: float, phi: float) -> tuple[float, float]:
        """Return the lengths along the surface from electrodes x0 and y0."""
        return s_m, phi * float(self.radius(s_m))

    def film_fractions(self, place_m: FloatArray) -> FloatArray:
        """Return the fractions (n, 2) of places (n, 2) on the pad's film, as `arc_lengths` counts them."""
        around = self.arc * self.radius(place_m[:, 0])
        return np.stack([place_m[:, 0] / self.length_m, place_m[:, 1] / around], axis=1)

    def metres_per_fraction(self, x: float, y: float) -> FloatArray:  # noqa: ARG002
        """Return the derivatives (2, 2) of positions along the surface by the fractions of the pad."""
        return np.diag([self.length_m, self.arc * float(self.radius(x * self.length_m))])

    def fractions_of(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return short vectors (2, n) [m] along the surface at positions (2, n), in fractions of the pad."""
        across_m = self.arc * self.radius(position[0] * self.length_m)
        return vector_m / np.stack([np.full_like(across_m, self.length_m), across_m])

    def fractions_beside(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return fractions of the pad (k, 2, n) at vectors (k, 2, n) [m] from positions (2, k).

        The vectors are those of the plane that touches the conformal image of the surface, of its scale at
        the position: a disc there is one in which every potential has its mean in the centre.
        """
        found = self.fractions_of(np.repeat(position, vector_m.shape[2], axis=1), _flat(vector_m))
        step = 1e-3 * self.length_m
        s_m = position[0] * self.length_m
        wider = np.log(self.radius(s_m + step) / self.radius(s_m - step)) / (2 * step)
        along = vector_m[:, 0] * (1 + wider[:, None] * vector_m[:, 0] / 2)
        beside = position.T[:, :, None] + found.reshape(2, *vector_m[:, 0].shape).transpose(1, 0, 2)
        beside[:, 0] = position[0][:, None] + along / self.length_m
        return beside

    def side_units(self) -> tuple[float, float, float, float]:
        """Return metres along the sides x0, xa, y0, yb per unit of the coordinate along them."""
        near, far = self.radius([0.0, self.length_m]).tolist()
        return near, far, 1.0, 1.0

    def project(self, points_m: FloatArray) -> SurfaceProjection:
        """Project points (n, 3) in the pad's frame; for points on the surface's axis any foot is correct."""
        if self.flat:
            x, y, z = points_m.T
            along = np.stack([x / self.length_m + 0.5, y / self.arc + 0.5], axis=1)
            return SurfaceProjection(along, z.copy(), np.tile([0.0, 0.0, 1.0], (len(x), 1)))
        middle_axial, middle_radius = self._profile(self.length_m / 2)
        tilt = self._profile_angle(self.length_m / 2)
        cos, sin = math.cos(tilt), math.sin(tilt)
        x, y, z = points_m.T
        axial, outward = cos * x - sin * z + middle_axial, sin * x + cos * z + middle_radius
        angle, away = np.arctan2(y, outward), np.hypot(y, outward)
        s, height, climb = self._project_to_profile(axial, away)
        across, up, along_axis = np.cos(climb) * np.sin(angle), np.cos(climb) * np.cos(angle), -np.sin(climb)
        normal = [cos * along_axis + sin * up, across, cos * up - sin * along_axis]
        return SurfaceProjection(
            np.stack([s / self.length_m, angle / self.arc + 0.5], axis=1), height, np.stack(normal, axis=1)
        )

    def hull_points(self) -> list[FloatArray]:
        """Return points (3,) in the pad's frame whose convex hull is the body under the surface."""
        around = 2 * np.pi * np.arange(_HULL_CIRCLE_POINTS) / _HULL_CIRCLE_POINTS
        return [self.point(s, phi) for s in self._hull_lengths_m() for phi in around]

    def _hull_lengths_m(self) -> Sequence[float]:
        return 0.0, self.length_m

    def _project_to_profile(
        self, axial: FloatArray, away: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return arc length, height and profile angle (n,) of points along the axis and away from it."""
        if self.sphere_from_rad is None:
            climb = math.asin(self.slope)
            rise = away - self.start_radius_m
            s = axial * math.cos(climb) + rise * math.sin(climb)
            height = rise * math.cos(climb) - axial * math.sin(climb)
            return s, height, np.full(np.shape(s), climb)
        latitude = np.arctan2(axial, away)
        s = self.start_radius_m * (latitude - self.sphere_from_rad)
        return s, np.hypot(axial, away) - self.start_radius_m, -latitude

    def _profile(self, s_m: float) -> tuple[float, float]:
        """Return the position along the axis and the distance from it [m]."""
        if self.sphere_from_rad is None:
            axial = s_m * math.cos(self._profile_angle(s_m))
        else:
            axial = self.start_radius_m * math.sin(self.sphere_from_rad + s_m / self.start_radius_m)
        return axial, float(self.radius(s_m))

    def _profile_angle(self, s_m: float) -> float:
        """Return the angle between profile and axis, positive where it widens."""
        if self.sphere_from_rad is None:
            return math.asin(self.slope)
        return -(self.sphere_from_rad + s_m / self.start_radius_m)

    def _to_pad_frame(self, axial: float, aside: float, outward: float) -> FloatArray:
        tilt = self._profile_angle(self.length_m / 2)
        cos, sin = math.cos(tilt), math.sin(tilt)
        return np.array([cos * axial + sin * outward, aside, cos * outward - sin * axial])


def _flat(vector: FloatArray) -> FloatArray:
    """Return vectors (k, 2, n) as (2, k n)."""
    return np.asarray(vector.transpose(1, 0, 2).reshape(2, -1))


@dataclass(frozen=True)
class _StretchedMetric(SheetMetric):
    """Metric of an anisotropic sheet: along s, lengths are multiplied by sqrt(resistivity_ratio)."""

    surface: SimulatedSurface

    @classmethod
    def of_surface(cls, surface: SimulatedSurface) -> _StretchedMetric:
        return cls(surface.length_m * surface.stretch, surface.arc, surface)

    def radius(self, s_m: ArrayLike) -> FloatArray:
        return self.surface.radius(np.asarray(s_m, np.float64) / self.surface.stretch)

    def isothermal(self, s_m: ArrayLike) -> FloatArray:
        stretch = self.surface.stretch
        return stretch * self.surface.isothermal(np.asarray(s_m, np.float64) / stretch)


@dataclass(frozen=True)
class SimulatedPrism(SimulatedSurface):
    """Strip bent along lines parallel to x; phi is the length along its cross-section, in metres."""

    corners_m: tuple[tuple[float, float], ...] = ()
    """Corners (aside, up) of the cross-section from electrode y0 to yb."""

    def resized(self, longer_m: float, wider_m: float) -> SimulatedPrism:
        """Return a longer strip, and a wider one by the same ratio for every face."""
        ratio = 1 + wider_m / self.arc
        corners = tuple((ratio * aside, ratio * up) for aside, up in self.corners_m)
        return replace(self, length_m=self.length_m + longer_m, arc=ratio * self.arc, corners_m=corners)

    def point(self, s_m: float, phi: float) -> FloatArray:
        """Return a position (3,) [m] in the pad's frame."""
        aside, up = self._to_middle(self._section(phi) - self._section(self.arc / 2))
        return np.array([s_m - self.length_m / 2, aside, up])

    def normal(self, s_m: float, phi: float) -> FloatArray:  # noqa: ARG002
        """Return the outward unit normal (3,) in the pad's frame; on a fold that of the later face."""
        aside, up = self._to_middle(self._direction(phi))
        return np.array([0.0, -up, aside])

    def project(self, points_m: FloatArray) -> SurfaceProjection:
        """Project points (n, 3) in the pad's frame to the nearest face."""
        nearest = np.full(len(points_m), np.inf)
        phi, height = np.zeros(len(points_m)), np.zeros(len(points_m))
        normal = np.zeros((len(points_m), 3))
        section = points_m[:, 1:]
        for begin, end, first, last in self._faces():
            along = (last - first) / (end - begin)
            outward = np.array([-along[1], along[0]])
            into = np.clip((section - first) @ along, 0.0, end - begin)
            distance = np.linalg.norm(section - first - into[:, None] * along, axis=1)
            closer = distance < nearest
            nearest[closer], phi[closer] = distance[closer], begin + into[closer]
            height[closer] = ((section - first) @ outward)[closer]
            normal[closer] = np.append(0.0, outward)
        s = points_m[:, 0] + self.length_m / 2
        return SurfaceProjection(np.stack([s / self.length_m, phi / self.arc], axis=1), height, normal)

    def hull_points(self) -> list[FloatArray]:
        """Return the corners (3,) of the plate under the surface, in the pad's frame."""
        under = np.array([0.0, 0.0, -_PLATE_THICKNESS_M])
        corners = [0.0, *(end for _, end, _, _ in self._faces())]
        top = [self.point(s, phi) for s in (0.0, self.length_m) for phi in corners]
        return [*top, *(point + under for point in top)]

    def _faces(self) -> list[tuple[float, float, FloatArray, FloatArray]]:
        """Return begin and end [m] of each face along the section, and its ends (2,) in the pad's frame."""
        ends = [0.0, *np.cumsum(self._widths()).tolist()]
        middle = self._section(self.arc / 2)
        points = [self._to_middle(np.array(corner) - middle) for corner in self.corners_m]
        return list(zip(ends[:-1], ends[1:], points[:-1], points[1:], strict=True))

    def _widths(self) -> FloatArray:
        return np.asarray(np.linalg.norm(np.diff(self.corners_m, axis=0), axis=1))

    def _section(self, phi: float) -> FloatArray:
        ends = np.concatenate([[0.0], np.cumsum(self._widths())])
        return np.array([np.interp(phi, ends, along) for along in np.array(self.corners_m).T])

    def _direction(self, phi: float) -> FloatArray:
        ends = np.cumsum(self._widths())
        face = min(int(np.searchsorted(ends, phi, side="right")), len(ends) - 1)
        return np.asarray(np.diff(self.corners_m, axis=0)[face] / self._widths()[face])

    def _to_middle(self, vector: FloatArray) -> FloatArray:
        """Rotate a vector (aside, up) of the section to the pad's frame, whose y is along the middle face."""
        cos, sin = self._direction(self.arc / 2)
        return np.array([cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0]])


@dataclass(frozen=True)
class SimulatedRevolution(SimulatedSurface):
    """Surface of revolution with a cubic spline through given points as its profile."""

    points_m: tuple[tuple[float, float], ...] = ()
    """Points (axial, radius) from electrode x0 to xa; the axis points from the first to the last."""

    def resized(self, longer_m: float, wider_m: float) -> SimulatedRevolution:
        """Return a similar profile of another length, with the arc of another width in its middle."""
        ratio = 1 + longer_m / self.length_m
        points = tuple((ratio * axial, ratio * radius) for axial, radius in self.points_m)
        middle_m = float(self.radius(self.length_m / 2))
        return replace(
            self,
            length_m=ratio * self.length_m,
            arc=(self.arc + wider_m / middle_m) / ratio,
            start_radius_m=ratio * self.start_radius_m,
            points_m=points,
        )

    def radius(self, s_m: ArrayLike) -> FloatArray:
        """Return metres along the surface per unit of phi at `s_m` (...)."""
        return np.asarray(_profile(self.points_m).curve(self._parameter(s_m))[..., 1])

    def isothermal(self, s_m: ArrayLike) -> FloatArray:
        """Return the integral of ds / radius from electrode x0 to `s_m` (...); with phi, a conformal map."""
        return np.asarray(_profile(self.points_m).isothermal(self._parameter(s_m)))

    def _hull_lengths_m(self) -> Sequence[float]:
        return [self.length_m * k / (_HULL_PROFILE_CIRCLES - 1) for k in range(_HULL_PROFILE_CIRCLES)]

    def _project_to_profile(
        self, axial: FloatArray, away: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Find the nearest point of the profile for each point, by Newton's method."""
        cells = np.linspace(0.0, self.length_m, _PROFILE_CELLS + 1)
        on_profile = np.stack(self._profile_points(cells))
        squared = ((np.stack([axial, away])[:, :, None] - on_profile[:, None]) ** 2).sum(0)
        s = cells[squared.argmin(axis=1)]
        for _ in range(_NEWTON_STEPS):
            at_axial, at_radius = self._profile_points(s)
            climb = self._profile_angles(s)
            s = s + np.cos(climb) * (axial - at_axial) + np.sin(climb) * (away - at_radius)
            s = np.clip(s, 0.0, self.length_m)
        at_axial, at_radius = self._profile_points(s)
        climb = self._profile_angles(s)
        height = np.cos(climb) * (away - at_radius) - np.sin(climb) * (axial - at_axial)
        return s, height, climb

    def _profile_points(self, s_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        axial, radius = np.moveaxis(_profile(self.points_m).curve(self._parameter(s_m)), -1, 0)
        return axial, radius

    def _profile_angles(self, s_m: FloatArray) -> FloatArray:
        axial, radius = np.moveaxis(_profile(self.points_m).curve(self._parameter(s_m), 1), -1, 0)
        return np.asarray(np.arctan2(radius, axial))

    def _parameter(self, s_m: ArrayLike) -> FloatArray:
        return np.asarray(_profile(self.points_m).from_length(np.asarray(s_m, np.float64)))

    def _profile(self, s_m: float) -> tuple[float, float]:
        axial, radius = self._profile_points(np.array(s_m))
        return float(axial), float(radius)

    def _profile_angle(self, s_m: float) -> float:
        return float(self._profile_angles(np.array(s_m)))


@dataclass(frozen=True)
class _SplineProfile:
    """Spline profile: curve by parameter, and tables to and from arc length and isothermal coordinate."""

    curve: CubicSpline
    length_m: float
    from_length: BPoly
    isothermal: PPoly


@lru_cache(maxsize=64)
def _profile(points_m: tuple[tuple[float, float], ...]) -> _SplineProfile:
    points = np.array(points_m)
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = CubicSpline(knots, points)
    t = np.unique(np.concatenate([np.linspace(a, b, 129) for a, b in itertools.pairwise(knots)]))
    speed = np.linalg.norm(curve(t, 1), axis=1)
    half = np.diff(t)[:, None] / 2
    samples = t[:-1, None] + half * (1 + _ABSCISSAE)
    lengths = np.linalg.norm(curve(samples, 1), axis=2) * half
    s = np.concatenate([[0.0], np.cumsum(lengths @ _WEIGHTS)])
    logs = np.concatenate([[0.0], np.cumsum((lengths / curve(samples)[..., 1]) @ _WEIGHTS)])
    from_length = BPoly.from_derivatives(s, np.stack([t, 1 / speed], axis=1))
    isothermal = PPoly.from_bernstein_basis(
        BPoly.from_derivatives(t, np.stack([logs, speed / curve(t)[:, 1]], axis=1))
    )
    return _SplineProfile(curve, float(s[-1]), from_length, isothermal)


def profile_length_m(points_m: tuple[tuple[float, float], ...]) -> float:
    """Return the length of the spline profile through points (axial, radius)."""
    return _profile(points_m).length_m
