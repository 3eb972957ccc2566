"""Pads of any outline, cut from a flat, cylindrical or spherical sheet.

Public names: `OutlineSurface` and its kinds on a cylinder and a sphere, `OutlineOnCylinder` and
`OutlineOnSphere`.

The outline is drawn on a plane in metres, x towards electrode xa. On a cylinder the drawing is wrapped around
the axis, which is parallel to x; on a sphere it is the stereographic projection from the point opposite to
the drawing's centre, which keeps angles and circles. The drawing touches the surface at the centre of its
bounding box, the origin of the pad's frame. Both maps are conformal, so the rectangle of the pad is that of
the drawing.

The arc lengths (u, v) of these surfaces are the coordinates of the drawing, from the bounding box's lower
left corner.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field._conformal import ConformalRectangle
from handtouch.field.outline import ComplexArray, Outline
from handtouch.field.surface_base import Surface, broadcast_finite, check_lengths, surface_key

_SIDES = ("y0", "xa", "yb", "x0")  # counter-clockwise from corner (0, 0)
_MAX_TURN_DEG = 280.0
_WHOLE_TURN = 2 * math.pi


@dataclass(frozen=True)
class OutlineSurface(Surface):
    """A flat pad of any outline of straight edges and arcs, with an electrode between each two corners.

    The electrodes are the four parts of the outline between `corners_m`, less the gaps.
    """

    kind: ClassVar[str] = "outline"
    outline_x_m: tuple[float, ...] = surface_key(
        "outline_x_mm", "x of the outline's vertices, counter-clockwise", above=None, is_list=True
    )
    outline_y_m: tuple[float, ...] = surface_key(
        "outline_y_mm", "y of the same vertices", above=None, is_list=True
    )
    turns_rad: tuple[float, ...] = surface_key(
        "edge_turn_deg",
        "turn of the edge that begins at each vertex: 0 straight, 90 a quarter of a circle, bulging outward, "
        "negative: inward; less than 280 either way",
        above=-_MAX_TURN_DEG,
        below=_MAX_TURN_DEG,
        is_list=True,
    )
    corners_m: tuple[float, ...] = surface_key(
        "corners_mm",
        "where electrodes x0 and y0, y0 and xa, xa and yb, yb and x0 meet: lengths along the outline from "
        "its first vertex",
        above=None,
        is_list=True,
    )

    @classmethod
    def check_keys(cls, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        count = len(values["outline_x_mm"])
        for key, needed in (("outline_y_mm", count), ("edge_turn_deg", count), ("corners_mm", 4)):
            if len(values[key]) != needed:
                yield key, f"needs {needed} values, has {len(values[key])}"
        if values["resistivity_ratio"] != 1:
            yield "resistivity_ratio", "an anisotropic sheet of any outline isn't supported; must be 1"

    def __post_init__(self) -> None:
        if not len(self.outline_x_m) == len(self.outline_y_m) == len(self.turns_rad):
            raise ValueError("outline_x_m, outline_y_m and turns_rad must have one value for each vertex")
        if self.outline.signs[0] < 0:
            raise ValueError("outline_x_m: the vertices are in clockwise order; reverse them")
        length = self.outline.perimeter()
        if not all(0 <= corner <= length for corner in self.corners_m):
            raise ValueError(f"corners_m: the outline is {1e3 * length:.5g} mm long; must be 0 to that")
        if min(self._side_lengths) <= 0 or not math.isclose(sum(self._side_lengths), length, rel_tol=1e-6):
            raise ValueError("corners_m must follow each other counter-clockwise along the outline")

    @cached_property
    def outline(self) -> Outline:
        """The drawing."""
        return _draw(self.outline_x_m, self.outline_y_m, self.turns_rad)

    @cached_property
    def _map(self) -> ConformalRectangle:
        return _map_outline(self.outline_x_m, self.outline_y_m, self.turns_rad, self.corners_m)

    @cached_property
    def _side_lengths(self) -> list[float]:
        """Lengths of sides y0, xa, yb and x0 of the drawing."""
        length = self.outline.perimeter()
        return [
            (self.corners_m[(side + 1) % 4] - self.corners_m[side]) % length
            for side in range(len(self.corners_m))
        ]

    @cached_property
    def _lower_left(self) -> complex:
        x0, y0, _, _ = self.outline.bounds
        return complex(x0, y0)

    @cached_property
    def _centre(self) -> complex:
        x0, y0, x1, y1 = self.outline.bounds
        return complex(x0 + x1, y0 + y1) / 2

    @property
    def a(self) -> float:
        return self._map.a

    @property
    def b(self) -> float:
        return self._map.b

    @property
    def extent_m(self) -> tuple[float, float]:
        x0, y0, x1, y1 = self.outline.bounds
        return x1 - x0, y1 - y0

    def describe_side(self, side: str) -> str:
        return f"the edge under electrode {side}"

    def side_lengths_m(self) -> tuple[float, float, float]:
        y0, xa, yb, x0 = self._side_lengths
        return min(y0, yb), x0, xa

    def electrode_span(self, side: str, low_m: float, high_m: float) -> tuple[float, float]:
        number = _SIDES.index(side)
        length = self._side_lengths[number]
        # the outline passes sides yb and x0 from their higher to their lower coordinate
        ends = (low_m, length - high_m) if number < 2 else (length - low_m, high_m)
        perimeter = self.outline.perimeter()
        points = [self.outline.boundary_point((self.corners_m[number] + end) % perimeter) for end in ends]
        x, y = self._map.from_outline(np.array([complex(*point) for point in points]))
        start, stop = (x if side in ("y0", "yb") else y).tolist()
        return start, stop

    @property
    def perimeter_m(self) -> float:
        return self.outline.perimeter()

    def perimeter_positions(self, ends_m: npt.ArrayLike) -> FloatArray:
        length = self.outline.perimeter()
        found: list[float] = []
        whole, begins = 2 * (self.a + self.b), np.cumsum([0.0, self.a, self.b, self.a])
        for position in np.ravel(ends_m).tolist():
            beyond = [(position - corner) % length for corner in self.corners_m]
            side = next(k for k in range(4) if beyond[k] <= self._side_lengths[k])
            x, y = (
                float(at)
                for at in self._map.from_outline(
                    np.asarray(complex(*self.outline.boundary_point(position % length)))
                )
            )
            along = (x, y, self.a - x, self.b - y)[side]
            place = float(begins[side] + np.clip(along, 0.0, (self.a, self.b)[side % 2]))
            while found and place <= found[-1]:
                place += whole
            found.append(place)
        return np.reshape(found, (-1, 2))

    def edge_m(self, cells: int) -> FloatArray:
        count = 4 * cells
        length = self.outline.perimeter()
        places = sorted({*np.linspace(0, length, count, endpoint=False).tolist(), *self._vertex_positions()})
        points = np.array([self.outline.boundary_point(place) for place in places])
        middle = self._centre.imag
        return np.asarray(points - [self._lower_left.real, middle])

    def _vertex_positions(self) -> list[float]:
        return [0.0, *itertools.accumulate(edge.length for edge in self.outline.contours[0][:-1])]

    @np.errstate(all="ignore")
    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        drawn = self._drawing(x, y)[0] - self._lower_left
        return drawn.real, drawn.imag

    @np.errstate(all="ignore")
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        u, v = broadcast_finite(u, v)
        return self._map.from_outline(np.asarray(u + 1j * v) + self._lower_left)

    @np.errstate(all="ignore")
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return self._place(self._drawing(x, y)[0] - self._centre)

    @np.errstate(all="ignore")
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        drawn, slope = self._drawing(x, y)
        first, second = self._tangents(drawn - self._centre)
        turn = slope / np.abs(slope)
        return np.stack([turn.real * first + turn.imag * second, turn.real * second - turn.imag * first])

    @np.errstate(all="ignore")
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        first, second = self._tangents(self._drawing(x, y)[0] - self._centre)
        return np.cross(first, second, axis=0)

    @np.errstate(all="ignore")
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        drawn, slope = self._drawing(x, y)
        scale = np.abs(slope) * self._stretch(drawn - self._centre)
        return np.stack([scale, scale])

    def _drawing(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return points of the drawing, and the derivatives of the map from the rectangle."""
        return self._map.to_outline(*broadcast_finite(x, y))

    def _place(self, z: ComplexArray) -> FloatArray:
        """Return positions (3, ...) in the pad's frame of points of the drawing, from its centre."""
        return np.stack([z.real, z.imag, np.zeros_like(z.real)])

    def _tangents(self, z: ComplexArray) -> FloatArray:
        """Return unit vectors (2, 3, ...) along the drawing's x and y."""
        one, zero = np.ones_like(z.real), np.zeros_like(z.real)
        return np.stack([np.stack([one, zero, zero]), np.stack([zero, one, zero])])

    def _stretch(self, z: ComplexArray) -> FloatArray:
        """Return metres on the surface per metre of the drawing."""
        return np.ones_like(z.real)


@dataclass(frozen=True)
class OutlineOnCylinder(OutlineSurface):
    """A pad of any outline, wrapped around a cylinder whose axis is parallel to the drawing's x."""

    kind: ClassVar[str] = "outline_on_cylinder"
    radius_m: float = surface_key("radius_mm", "radius of the sensing surface")

    def __post_init__(self) -> None:
        check_lengths(radius_m=self.radius_m)
        super().__post_init__()
        if self.extent_m[1] > _WHOLE_TURN * self.radius_m:
            raise ValueError("radius_m: the outline is wider than the cylinder's circumference")

    def _place(self, z: ComplexArray) -> FloatArray:
        angle = z.imag / self.radius_m
        drop = -self.radius_m * 2 * np.sin(angle / 2) ** 2
        return np.stack([z.real, self.radius_m * np.sin(angle), drop])

    def _tangents(self, z: ComplexArray) -> FloatArray:
        angle, zero = z.imag / self.radius_m, np.zeros_like(z.real)
        return np.stack([np.stack([zero + 1, zero, zero]), np.stack([zero, np.cos(angle), -np.sin(angle)])])


@dataclass(frozen=True)
class OutlineOnSphere(OutlineSurface):
    """A pad of any outline on a sphere; the drawing is its stereographic projection."""

    kind: ClassVar[str] = "outline_on_sphere"
    radius_m: float = surface_key("radius_mm", "radius of the sensing surface")

    def __post_init__(self) -> None:
        check_lengths(radius_m=self.radius_m)
        super().__post_init__()

    def _place(self, z: ComplexArray) -> FloatArray:
        stretch = self._stretch(z)
        drop = -stretch * np.abs(z) ** 2 / (2 * self.radius_m)
        return np.stack([stretch * z.real, stretch * z.imag, drop])

    def _tangents(self, z: ComplexArray) -> FloatArray:
        """Rotate the plane's unit vectors with the normal, about the axis across the way from the centre."""
        stretch, half = self._stretch(z), z / (2 * self.radius_m)
        x, y = half.real, half.imag
        first = np.stack([1 - 2 * stretch * x * x, -2 * stretch * x * y, -2 * stretch * x])
        second = np.stack([-2 * stretch * x * y, 1 - 2 * stretch * y * y, -2 * stretch * y])
        return np.stack([first, second])

    def _stretch(self, z: ComplexArray) -> FloatArray:
        return np.asarray(1 / (1 + np.abs(z / (2 * self.radius_m)) ** 2))


def _draw(x_m: tuple[float, ...], y_m: tuple[float, ...], turns_rad: tuple[float, ...]) -> Outline:
    bulges = [math.tan(turn / 4) for turn in turns_rad]
    return Outline(list(zip(x_m, y_m, strict=True)), bulges)


@lru_cache(maxsize=64)
def _map_outline(
    x_m: tuple[float, ...],
    y_m: tuple[float, ...],
    turns_rad: tuple[float, ...],
    corners_m: tuple[float, ...],
) -> ConformalRectangle:
    """Return the map of a drawing; solving takes seconds, and each user of a pad builds its surface anew."""
    return ConformalRectangle(_draw(x_m, y_m, turns_rad), corners_m)
