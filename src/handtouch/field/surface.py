"""Sensor surfaces, each with the conformal map that makes it a rectangle.

Public names: `PlaneSurface`, `CylinderSurface`, `ConeSurface`, `SphereSurface`; `AnisotropicSurface` wraps
any `Surface`. Other kinds have modules of their own, see `SURFACES`.

The currents of a sensor don't change under a conformal map, so a pad is solved on its rectangle [0, a] x [0,
b] and only the result is carried to the surface. For a surface of revolution of radius r(u) at arc length u
the rectangle is x = r_mid * integral du / r(u), y = r_mid * angle, where r_mid is the radius half way along
the profile: there, at the centre of the pad, a rectangle unit is a metre. The isotropic sheet resistance
stays unchanged; a contact of radius A becomes one of radius A / `scale`.

Coordinates

    x, y   on the rectangle; electrode x0 lies at x = 0, xa at x = a, y0 at y = 0, yb at y = b
    u, v   metres along the surface: u along the profile from x0, v along the parallel at that u from y0
    pad frame   metres; origin on the surface at u = u_max / 2, half way round; z is the outward normal
                there, x points towards electrode xa, y = z cross x towards yb

Arguments broadcast. Outside the patch the surface is continued as far as it exists; beyond that the result is
NaN.

To add a shape, write a dataclass here that sets `kind` and declares its fields by `surface_key`; the
deployment file, its checks and its schema follow. The simulator's independent geometry is in
`handtouch.simulate.pad_geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.surface_base import (
    Meridian,
    Surface,
    SweptSurface,
    arc_key,
    check_arc,
    check_lengths,
    ratio_or_one,
    surface_key,
)


class _DevelopableSurface(SweptSurface):
    """A plane or a cylinder: the conformal coordinate is the arc length."""

    @property
    def extent_m(self) -> tuple[float, float]:
        return self.a, self.b

    @property
    def _middle(self) -> float:
        return self.a / 2

    def _arc_length(self, x: FloatArray) -> FloatArray:
        return +x

    def _conformal(self, u: FloatArray) -> FloatArray:
        return +u

    def _meridian(self, x: FloatArray) -> Meridian:
        zero, one = np.zeros_like(x), np.ones_like(x)
        return Meridian(axial=x - self._middle, radial=zero, scale=one, cosine=one, sine=zero)


@dataclass(frozen=True)
class PlaneSurface(_DevelopableSurface):
    """A flat rectangle; rectangle units are metres.

    `width_m` runs along x, from electrode x0 to xa; `height_m` along y.
    """

    kind: ClassVar[str] = "plane"
    width_m: float = surface_key("length_mm", "from electrode x0 to electrode xa")
    height_m: float = surface_key("width_mm", "from electrode y0 to electrode yb")

    def __post_init__(self) -> None:
        check_lengths(width_m=self.width_m, height_m=self.height_m)

    @property
    def a(self) -> float:
        return self.width_m

    @property
    def b(self) -> float:
        return self.height_m

    @property
    def _curvature(self) -> float:
        return 0.0

    def describe_side(self, side: str) -> str:  # noqa: ARG002
        return "the edge"


@dataclass(frozen=True)
class CylinderSurface(_DevelopableSurface):
    """A patch of a cylinder: x along the axis, y around it; developable, so rectangle units are metres."""

    kind: ClassVar[str] = "cylinder"
    radius_m: float = surface_key("radius_mm", "radius of the sensing surface")
    length_m: float = surface_key("length_mm", "along the axis, from electrode x0 to electrode xa")
    arc_rad: float = arc_key()

    def __post_init__(self) -> None:
        check_lengths(radius_m=self.radius_m, length_m=self.length_m)
        check_arc(self.arc_rad)

    @property
    def a(self) -> float:
        return self.length_m

    @property
    def b(self) -> float:
        return self.radius_m * self.arc_rad

    @property
    def _curvature(self) -> float:
        return 1 / self.radius_m


@dataclass(frozen=True)
class ConeSurface(SweptSurface):
    """A patch of a cone between two of its circles; log(radius) and the angle are its rectangle.

    `near_radius_m`, `far_radius_m`: radius of the circle at electrode x0 and at xa. `slant_m`: length
    between them along the surface. Either end may be the wider one; equal radii make a cylinder, |far -
    near| = slant a flat ring.
    """

    kind: ClassVar[str] = "cone"
    near_radius_m: float = surface_key("near_radius_mm", "radius of the circle at electrode x0")
    far_radius_m: float = surface_key("far_radius_mm", "radius of the circle at electrode xa")
    slant_m: float = surface_key("slant_mm", "along the surface, from electrode x0 to electrode xa")
    arc_rad: float = arc_key()

    @classmethod
    def check_keys(cls, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        least = abs(values["far_radius_mm"] - values["near_radius_mm"])
        if values["slant_mm"] < least:
            yield (
                "slant_mm",
                f"is too short for a cone; must be at least the difference of the two radii, {least:.4g}",
            )

    def __post_init__(self) -> None:
        check_lengths(near_radius_m=self.near_radius_m, far_radius_m=self.far_radius_m, slant_m=self.slant_m)
        check_arc(self.arc_rad)
        if abs(self.far_radius_m - self.near_radius_m) > self.slant_m:
            raise ValueError(
                f"slant_m must be at least the difference of the radii, "
                f"{abs(self.far_radius_m - self.near_radius_m)} m, got {self.slant_m}"
            )

    @cached_property
    def a(self) -> float:
        return float(self._conformal(np.array(self.slant_m)))

    @cached_property
    def b(self) -> float:
        return self._mid_radius * self.arc_rad

    @property
    def extent_m(self) -> tuple[float, float]:
        return self.slant_m, self.b

    @cached_property
    def _mid_radius(self) -> float:
        return (self.near_radius_m + self.far_radius_m) / 2

    @cached_property
    def _slope(self) -> float:
        return (self.far_radius_m - self.near_radius_m) / self.slant_m

    @property
    def _curvature(self) -> float:
        return 1 / self._mid_radius

    @cached_property
    def _middle(self) -> float:
        return float(self._conformal(np.array(self.slant_m / 2)))

    def _arc_length(self, x: FloatArray) -> FloatArray:
        growth = x * (self._slope / self._mid_radius)
        return np.asarray(
            x * (self.near_radius_m / self._mid_radius) * ratio_or_one(np.expm1(growth), growth)
        )

    def _conformal(self, u: FloatArray) -> FloatArray:
        growth = u * (self._slope / self.near_radius_m)
        with np.errstate(invalid="ignore", divide="ignore"):  # no point at or beyond the apex
            logarithm = np.where(growth > -1, np.log1p(growth), np.nan)
        return np.asarray(u * (self._mid_radius / self.near_radius_m) * ratio_or_one(logarithm, growth))

    def _meridian(self, x: FloatArray) -> Meridian:
        from_centre = self._arc_length(x) - self.slant_m / 2
        cosine = math.sqrt((1 - self._slope) * (1 + self._slope))
        scale = 1 + from_centre * (self._slope / self._mid_radius)
        return Meridian(
            axial=cosine * from_centre,
            radial=self._slope * from_centre,
            scale=scale,
            cosine=np.full_like(scale, cosine),
            sine=np.full_like(scale, self._slope),
        )


@dataclass(frozen=True)
class SphereSurface(SweptSurface):
    """A patch of a sphere between two parallels and two meridians; Mercator's coordinate is its x.

    `from_rad`, `to_rad`: latitudes of electrodes x0 and xa, inside (-pi/2, pi/2), either one the northern.
    """

    kind: ClassVar[str] = "sphere"
    radius_m: float = surface_key("radius_mm", "radius of the sensing surface")
    from_rad: float = surface_key("from_deg", "latitude of electrode x0", above=-90.0, below=90.0)
    to_rad: float = surface_key("to_deg", "latitude of electrode xa", above=-90.0, below=90.0)
    arc_rad: float = arc_key()

    @classmethod
    def check_keys(cls, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        if values["to_deg"] <= values["from_deg"]:
            yield "to_deg", f"must be above from_deg = {values['from_deg']}"

    def describe_side(self, side: str) -> str:
        if side not in ("x0", "xa"):
            return "the side"
        here, there = (self.to_rad, self.from_rad) if side == "xa" else (self.from_rad, self.to_rad)
        return "the tip" if abs(here) > abs(there) else "the rim"

    def __post_init__(self) -> None:
        check_lengths(radius_m=self.radius_m)
        check_arc(self.arc_rad)
        for name, latitude in (("from_rad", self.from_rad), ("to_rad", self.to_rad)):
            if not abs(latitude) < math.pi / 2:
                raise ValueError(
                    f"{name} must be a latitude between -pi/2 and pi/2, poles excluded, got {latitude}"
                )
        if self.from_rad == self.to_rad:
            raise ValueError(f"to_rad must differ from from_rad, got {self.to_rad} for both")

    @cached_property
    def a(self) -> float:
        return float(self._conformal(np.array(self.extent_m[0])))

    @cached_property
    def b(self) -> float:
        return self._mid_radius * self.arc_rad

    @property
    def extent_m(self) -> tuple[float, float]:
        return self.radius_m * abs(self.to_rad - self.from_rad), self.b

    @cached_property
    def _start(self) -> float:
        # the pole that x points to is taken as the north pole
        return self.from_rad if self.to_rad > self.from_rad else -self.from_rad

    @cached_property
    def _mid_latitude(self) -> float:
        return self._start + abs(self.to_rad - self.from_rad) / 2

    @cached_property
    def _mid_radius(self) -> float:
        return self.radius_m * math.cos(self._mid_latitude)

    @property
    def _curvature(self) -> float:
        return 1 / self._mid_radius

    @cached_property
    def _middle(self) -> float:
        return float(self._conformal(np.array(self.extent_m[0] / 2)))

    def _latitude_above_start(self, x: FloatArray) -> FloatArray:
        """Return the latitude above electrode x0's; differences are formed before the functions, so none
        cancels.
        """
        half = x / (2 * self._mid_radius)
        return np.asarray(2 * np.arctan(np.sinh(half) / np.cosh(half + math.asinh(math.tan(self._start)))))

    def _arc_length(self, x: FloatArray) -> FloatArray:
        return self.radius_m * self._latitude_above_start(x)

    def _conformal(self, u: FloatArray) -> FloatArray:
        half = u / (2 * self.radius_m)
        latitude = self._start + 2 * half
        rise = 2 * np.cos(self._start + half) * np.sin(half)  # difference of the sines of latitude
        with np.errstate(divide="ignore", invalid="ignore"):  # at the pole
            mercator = np.arcsinh(rise / (np.cos(latitude) * math.cos(self._start)))
        return np.asarray(np.where(np.abs(latitude) < np.pi / 2, self._mid_radius * mercator, np.nan))

    def _meridian(self, x: FloatArray) -> Meridian:
        latitude = self._start + self._latitude_above_start(x)
        half = (latitude - self._mid_latitude) / 2
        mean = (latitude + self._mid_latitude) / 2
        cosine, sine = np.cos(latitude), np.sin(latitude)
        chord = 2 * self.radius_m * np.sin(half)
        return Meridian(
            axial=chord * np.cos(mean),
            radial=-chord * np.sin(mean),
            scale=cosine / math.cos(self._mid_latitude),
            cosine=cosine,
            sine=-sine,
        )


@dataclass(frozen=True)
class AnisotropicSurface(Surface):
    """A surface whose sheet conducts differently along x and y; the rectangle is stretched along x.

    `resistivity_ratio` is rho_x / rho_y; the rectangle then belongs to an isotropic sheet of sqrt(rho_x
    rho_y) / w ohm per square (paper 3.3).
    """

    surface: Surface
    resistivity_ratio: float

    def __post_init__(self) -> None:
        check_lengths(resistivity_ratio=self.resistivity_ratio)

    @cached_property
    def _stretch(self) -> float:
        return math.sqrt(self.resistivity_ratio)

    @property
    def a(self) -> float:
        return self.surface.a * self._stretch

    @property
    def b(self) -> float:
        return self.surface.b

    @property
    def extent_m(self) -> tuple[float, float]:
        return self.surface.extent_m

    def grid_lines(self, cells: int) -> tuple[FloatArray, FloatArray]:
        x, y = self.surface.grid_lines(cells)
        return x * self._stretch, y

    @property
    def folds(self) -> FloatArray:
        return self.surface.folds

    def describe_side(self, side: str) -> str:
        return self.surface.describe_side(side)

    @property
    def frame(self) -> tuple[FloatArray, FloatArray]:
        return self.surface.frame

    def electrode_span(self, side: str, low_m: float, high_m: float) -> tuple[float, float]:
        factor = self._stretch if side in ("y0", "yb") else 1.0
        start, stop = self.surface.electrode_span(side, low_m, high_m)
        return factor * start, factor * stop

    def side_lengths_m(self) -> tuple[float, float, float]:
        return self.surface.side_lengths_m()

    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        return self.surface.from_rectangle(self._unstretched(x), y)

    @np.errstate(all="ignore")
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = self.surface.to_rectangle(u, v)
        return np.asarray(x * self._stretch), y

    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return self.surface.point(self._unstretched(x), y)

    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return self.surface.tangents(self._unstretched(x), y)

    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return self.surface.normal(self._unstretched(x), y)

    @np.errstate(all="ignore")
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        along, around = self.surface.scales(self._unstretched(x), y)
        return np.stack([along / self._stretch, around])

    def _unstretched(self, x: npt.ArrayLike) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray(np.asarray(x, np.float64) / self._stretch)
