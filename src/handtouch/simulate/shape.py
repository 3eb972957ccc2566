"""The shape of a simulated pad: its profile and its points, straight from the deployment's millimetres.

Public names: `Shape`, `shape_of`. Written apart from `handtouch.field.surface`, so that a mistake in either
one shows as a location error instead of cancelling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config

FloatArray = NDArray[np.float64]
_ABSCISSAE, _WEIGHTS = np.polynomial.legendre.leggauss(20)


@dataclass(frozen=True)
class Shape:
    """A surface swept about an axis: a cylinder, a cone or a sphere; or a plane.

    Coordinates on it are the arc length s along the profile, metres from electrode x0, and the angle phi,
    radians from electrode y0. On a plane phi is in metres, and the radius is 1.
    """

    length_m: float
    """Of the profile."""
    arc: float
    """phi at electrode yb."""
    start_radius_m: float
    """Radius at s = 0, of a straight profile."""
    slope: float = 0.0
    """Change of radius per metre of a straight profile."""
    sphere_from_rad: float | None = None
    """Latitude at s = 0 if the profile is a meridian of a sphere, whose radius is `start_radius_m`."""
    flat: bool = False

    def radius(self, s_m: ArrayLike) -> FloatArray:
        """Metres along the surface per unit of phi at `s_m` (...)."""
        s = np.asarray(s_m, np.float64)
        if self.flat:
            return np.ones_like(s)
        if self.sphere_from_rad is None:
            return np.asarray(self.start_radius_m + self.slope * s)
        return np.asarray(self.start_radius_m * np.cos(self.sphere_from_rad + s / self.start_radius_m))

    def isothermal(self, s_m: ArrayLike) -> FloatArray:
        """Integral of ds / radius from electrode x0 to `s_m` (...); with phi, a plane map."""
        half = np.asarray(s_m, np.float64)[..., None] / 2
        return np.asarray((half / self.radius(half * (1 + _ABSCISSAE))) @ _WEIGHTS)

    def point(self, s_m: float, phi: float) -> FloatArray:
        """Position (3,) [m] in the pad frame: origin in the middle of the pad, x towards xa, z outward."""
        if self.flat:
            return np.array([s_m - self.length_m / 2, phi - self.arc / 2, 0.0])
        axial, radius = self._profile(s_m)
        middle_axial, middle_radius = self._profile(self.length_m / 2)
        angle = phi - self.arc / 2
        return self._into_pad_frame(
            axial - middle_axial, radius * math.sin(angle), radius * math.cos(angle) - middle_radius
        )

    def normal(self, s_m: float, phi: float) -> FloatArray:
        """Outward unit normal (3,) in the pad frame."""
        if self.flat:
            return np.array([0.0, 0.0, 1.0])
        angle, climb = phi - self.arc / 2, self._climb(s_m)
        return self._into_pad_frame(
            -math.sin(climb), math.cos(climb) * math.sin(angle), math.cos(climb) * math.cos(angle)
        )

    def _profile(self, s_m: float) -> tuple[float, float]:
        """Position along the axis and distance from it [m]."""
        if self.sphere_from_rad is None:
            axial = s_m * math.cos(self._climb(s_m))
        else:
            axial = self.start_radius_m * math.sin(self.sphere_from_rad + s_m / self.start_radius_m)
        return axial, float(self.radius(s_m))

    def _climb(self, s_m: float) -> float:
        """Angle of the profile against the axis, positive where it widens."""
        if self.sphere_from_rad is None:
            return math.asin(self.slope)
        return -(self.sphere_from_rad + s_m / self.start_radius_m)

    def _into_pad_frame(self, axial: float, aside: float, outward: float) -> FloatArray:
        tilt = self._climb(self.length_m / 2)
        cos, sin = math.cos(tilt), math.sin(tilt)
        return np.array([cos * axial + sin * outward, aside, cos * outward - sin * axial])


def shape_of(surface: config.Surface) -> Shape:
    """The shape that a pad's `surface` table describes."""
    if isinstance(surface, config.Plane):
        return Shape(surface.length_mm * 1e-3, surface.width_mm * 1e-3, 1.0, flat=True)
    arc = math.radians(surface.arc_deg)
    if isinstance(surface, config.Cylinder):
        return Shape(surface.length_mm * 1e-3, arc, surface.radius_mm * 1e-3)
    if isinstance(surface, config.Cone):
        slope = (surface.far_radius_mm - surface.near_radius_mm) / surface.slant_mm
        return Shape(surface.slant_mm * 1e-3, arc, surface.near_radius_mm * 1e-3, slope)
    start = math.radians(surface.from_deg)
    radius = surface.radius_mm * 1e-3
    length = radius * math.radians(surface.to_deg - surface.from_deg)
    return Shape(length, arc, radius, sphere_from_rad=start)
