"""Pads of any shape, on the triangles of an STL file.

Public name: `MeshSurface`.

Two potentials on the triangles, one between electrodes x0 and xa, one between y0 and yb, each with the other
sides insulated, are the coordinates of the rectangle; the ratio of its sides follows from their energies. The
triangles are divided until the potentials are smooth on them, also at the corners, where the edge may have
any angle. Between its vertices, which lie on the true surface, it is a smooth interpolant of them.

The arc lengths (u, v) of this surface are the coordinates of the rectangle, scaled to the lengths of its
middle lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray, IntArray
from handtouch.field.embedded_file import read_embedded
from handtouch.field.surface_base import Surface, broadcast_finite, surface_key
from handtouch.field.triangulation import Triangulation, parse_stl

_SIDES = ("y0", "xa", "yb", "x0")  # counter-clockwise from corner (0, 0)
_M_PER_UNIT = 1e-3
_CELLS = 60.0
"""Square root of the area over the longest side of a triangle that potentials are solved on."""
_GROWTH, _SMALLEST = 0.2, 2e-4
"""Sides of triangles over the distance from the nearest corner, and at it over the longest."""
_MAX_CORNER_DISTANCE = 0.05
"""Distance of a corner from the edge over the square root of the area: farther is a slip."""
_STEP = 1e-4
"""Step of differences, in sides."""
_INSIDE = 1e-9
_MIDDLE_POINTS = 201


class _Rectangle(NamedTuple):
    """The rectangle of a surface of triangles."""

    a: float
    b: float
    places: FloatArray
    """(n, 2), its coordinates at points of the surface."""
    points: FloatArray
    """(n, 3) [m]."""
    ring_m: FloatArray
    """Lengths along the edge from the first corner, of many points and the whole."""
    ring: FloatArray
    """Lengths along the rectangle's boundary from corner (0, 0), of the same."""
    corners_m: FloatArray
    """(5,), lengths along the edge at the corners, the last the whole."""
    frame: tuple[FloatArray, FloatArray] = np.eye(3), np.zeros(3)


@dataclass(frozen=True)
class MeshSurface(Surface):
    """A pad on the triangles of an STL file in millimetres, with four sides between points of its edge.

    The surface has one edge; its outside is where the triangles are counter-clockwise. Its frame is that of
    `Triangulation.in_pad_frame`, and a mount is stated for the file's frame.
    """

    kind: ClassVar[str] = "mesh"
    file: str = surface_key(
        "file",
        "STL file in millimetres, relative to this file, of the sensing surface alone: one edge, triangles "
        "counter-clockwise seen from outside, their sides at most a tenth of the pad's. mount is then the "
        "pose of the file's frame: none is needed if it is drawn in that of the link. A recording has a "
        "data: URL in its place",
        is_file=True,
        example="fingertip.stl",
    )
    corner_x_m: tuple[float, ...] = surface_key(
        "corner_x_mm",
        "x of the points of the edge where electrodes x0 and y0, y0 and xa, xa and yb, yb and x0 meet, "
        "counter-clockwise seen from outside; moved to the nearest point of the edge",
        above=None,
        is_list=True,
        example=[5.2, 22.8, 22.8, 5.2],
    )
    corner_y_m: tuple[float, ...] = surface_key(
        "corner_y_mm",
        "y of the same points",
        above=None,
        is_list=True,
        example=[-6.0, -4.8, 4.8, 6.0],
    )
    corner_z_m: tuple[float, ...] = surface_key(
        "corner_z_mm",
        "z of the same points",
        above=None,
        is_list=True,
        example=[3.0, 3.0, 3.0, 3.0],
    )

    @classmethod
    def check_keys(cls, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        for key in ("corner_x_mm", "corner_y_mm", "corner_z_mm"):
            if len(values[key]) != 4:
                yield key, f"needs 4 values, one for each corner, has {len(values[key])}"

    def __post_init__(self) -> None:
        _ = self._rectangle

    @cached_property
    def _rectangle(self) -> _Rectangle:
        try:
            surface = parse_stl(read_embedded(self.file))
            surface = Triangulation(_M_PER_UNIT * surface.points, surface.triangles)
            surface, axes, origin = surface.in_pad_frame(self._corners)
            stated = (self._corners - origin) @ axes
            corners = surface.nearest_on_edge(stated)
        except ValueError as error:
            raise ValueError(f"file: {error}") from error
        size = float(np.sqrt(_areas(surface).sum()))
        whole = surface.ring_lengths[-1]
        around = np.diff(np.append(corners, corners[0])) % whole
        if not np.isclose(around.sum(), whole) or not (around > 1e-3 * size).all():
            raise ValueError("corner_x_m: the corners must follow each other counter-clockwise on the edge")
        known = len(surface.points)
        surface, numbers = surface.with_edge_points(corners)
        away = np.linalg.norm(surface.points[numbers] - stated, axis=1)
        if away.max() > _MAX_CORNER_DISTANCE * size:
            k = int(away.argmax())
            raise ValueError(f"corner_x_m: corner {k + 1} is {1e3 * away[k]:.3g} mm from the edge")
        known = max(known, int(numbers.max()) + 1)
        longest = size / _CELLS
        surface = surface.refined(longest, surface.points[numbers], _GROWTH, _SMALLEST * longest)
        return _map_to_rectangle(surface, numbers, known)._replace(frame=(axes, origin))

    @property
    def _corners(self) -> FloatArray:
        return np.stack([self.corner_x_m, self.corner_y_m, self.corner_z_m], axis=1)

    @cached_property
    def _interpolant(self) -> Any:
        """Points (..., 3) by rectangle coordinates (..., 2) over the sides: continuous, with slopes."""
        from scipy.interpolate import CloughTocher2DInterpolator  # not loaded with the package

        places = self._rectangle.places / [self.a, self.b]
        return CloughTocher2DInterpolator(places, self._rectangle.points)

    @property
    def a(self) -> float:
        return self._rectangle.a

    @property
    def b(self) -> float:
        return self._rectangle.b

    @cached_property
    def extent_m(self) -> tuple[float, float]:
        way, half = np.linspace(0, 1, _MIDDLE_POINTS), np.full(_MIDDLE_POINTS, 0.5)
        lines = (self.point(self.a * s, self.b * t) for s, t in ((way, half), (half, way)))
        along, across = (float(np.linalg.norm(np.diff(line), axis=0).sum()) for line in lines)
        return along, across

    @property
    def frame(self) -> tuple[FloatArray, FloatArray]:
        return self._rectangle.frame

    @property
    def perimeter_m(self) -> float:
        return float(self._rectangle.ring_m[-1])

    def describe_side(self, side: str) -> str:
        return f"the edge under electrode {side}"

    def side_lengths_m(self) -> tuple[float, float, float]:
        y0, xa, yb, x0 = np.diff(self._rectangle.corners_m).tolist()
        return min(y0, yb), x0, xa

    def electrode_span(self, side: str, low_m: float, high_m: float) -> tuple[float, float]:
        number = _SIDES.index(side)
        begin, end = self._rectangle.corners_m[number : number + 2]
        # the edge passes sides yb and x0 from their higher to their lower coordinate
        ends = (begin + low_m, end - high_m) if number < 2 else (end - low_m, begin + high_m)
        before = np.cumsum([0.0, self.a, self.b, self.a])[number]
        start, stop = np.interp(ends, self._rectangle.ring_m, self._rectangle.ring) - before
        return (start, stop) if number < 2 else tuple((self.a, self.b)[number % 2] - np.array([start, stop]))

    def perimeter_positions(self, ends_m: npt.ArrayLike) -> FloatArray:
        ends = np.ravel(ends_m)
        whole = 2 * (self.a + self.b)
        found = np.interp(ends % self.perimeter_m, self._rectangle.ring_m, self._rectangle.ring)
        turns = np.concatenate([[0.0], np.cumsum(np.diff(found) <= 0)])
        return (found + whole * turns).reshape(-1, 2)

    @np.errstate(all="ignore")
    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = broadcast_finite(x, y)
        along, across = self.extent_m
        return np.asarray(x * (along / self.a)), np.asarray(y * (across / self.b))

    @np.errstate(all="ignore")
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        u, v = broadcast_finite(u, v)
        along, across = self.extent_m
        return np.asarray(u * (self.a / along)), np.asarray(v * (self.b / across))

    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return self._points_at(self._places(x, y))

    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        first, second = self._slopes(x, y)
        first = first / np.linalg.norm(first, axis=0)
        outward = np.cross(first, second, axis=0)
        return np.stack([first, np.cross(outward / np.linalg.norm(outward, axis=0), first, axis=0)])

    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        first, second = self.tangents(x, y)
        return np.cross(first, second, axis=0)

    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return np.asarray(np.linalg.norm(self._slopes(x, y), axis=1))

    def _places(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return coordinates (..., 2) over the sides, those on the boundary a hair inside."""
        place = np.stack(broadcast_finite(x, y), axis=-1) / [self.a, self.b]
        on_pad = ((place >= -_INSIDE) & (place <= 1 + _INSIDE)).all(axis=-1, keepdims=True)
        return np.where(on_pad, np.clip(place, _INSIDE, 1 - _INSIDE), np.nan)

    def _points_at(self, place: FloatArray) -> FloatArray:
        found = self._interpolant(place.reshape(-1, 2)).reshape(*place.shape[:-1], 3)
        return np.moveaxis(found, -1, 0)

    def _slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return derivatives (2, 3, ...) of points by x and y."""
        place = self._places(x, y)
        found = []
        for axis, side in enumerate((self.a, self.b)):
            step = _STEP * np.eye(2)[axis]
            ends = [np.clip(place + way * step, _INSIDE, 1 - _INSIDE) for way in (-1, 1)]
            low, high = map(self._points_at, ends)
            found.append((high - low) / (side * (ends[1] - ends[0])[..., axis]))
        return np.stack(found)


def _areas(surface: Triangulation) -> FloatArray:
    """Return the areas (t,) of triangles."""
    a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _map_to_rectangle(surface: Triangulation, corners: IntArray, known: int) -> _Rectangle:
    """Return the rectangle of a surface whose edge has corners (4,), with the first `known` points."""
    at = [int(np.flatnonzero(surface.ring == corner)[0]) for corner in corners]
    ring = np.roll(surface.ring, -at[0])
    begins = np.append([(place - at[0]) % len(ring) for place in at], len(ring))
    sides = [np.append(ring, ring[0])[begins[k] : begins[k + 1] + 1] for k in range(4)]
    stiffness = _stiffness(surface)
    u, v = (_potential(stiffness, sides[low], sides[high]) for low, high in ((3, 1), (0, 2)))
    # both energies are above those of smooth potentials, b / a and a / b, by as much
    ratio = np.sqrt((v @ (stiffness @ v)) / (u @ (stiffness @ u)))
    a = float(np.sqrt(_areas(surface).sum() * ratio))
    b = a / float(ratio)
    places = np.stack([a * u, b * v], axis=1)
    lengths = surface.lengths_around(ring)
    along = [places[sides[0], 0], a + places[sides[1], 1]]
    along += [2 * a + b - places[sides[2], 0], 2 * (a + b) - places[sides[3], 1]]
    boundary = np.concatenate([*(side[:-1] for side in along[:3]), along[3]])
    return _Rectangle(
        a=a,
        b=b,
        places=places[:known],
        points=surface.points[:known],
        ring_m=lengths,
        ring=np.maximum.accumulate(boundary),
        corners_m=lengths[begins],
    )


def _stiffness(surface: Triangulation) -> Any:
    """Return the stiffness matrix (points, points) of piecewise linear potentials."""
    from scipy.sparse import coo_array

    corners = surface.points[surface.triangles]
    opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
    local = np.einsum("tik,tjk->tij", opposite, opposite) / (4 * _areas(surface))[:, None, None]
    rows, columns = np.broadcast_arrays(surface.triangles[:, :, None], surface.triangles[:, None, :])
    size = len(surface.points)
    return coo_array((local.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()


def _potential(stiffness: Any, zero: IntArray, one: IntArray) -> FloatArray:
    """Return the potential (points,) that is 0 and 1 on two sides, the rest of the edge insulated."""
    from scipy.sparse.linalg import splu

    values = np.zeros(stiffness.shape[0])
    values[one] = 1.0
    free = np.setdiff1d(np.arange(len(values)), np.concatenate([zero, one]))
    factors = splu(
        stiffness[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )
    values[free] = factors.solve(-(stiffness @ values)[free])
    return values
