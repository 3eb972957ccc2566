"""Known objects as signed distance functions: negative inside, in metres, with the unit gradient.

Public names: `KnownShape`, `build_shape`. Primitives are analytic; a mesh becomes a grid once per process.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.arrays import FloatArray
from handtouch.config.meshes import surface_triangles
from handtouch.config.objects import (
    BoltShape,
    BoxShape,
    CylinderShape,
    MeshShape,
    ObjectTable,
    SphereShape,
)
from handtouch.hand.body_distance import squared_distance_from_triangles

_M_PER_MM = 1e-3
_SHELL_M = 2e-3
"""Thickness of the shell whose points are projected to the surface: edges get about as many as a strip of
that width."""
_FEET = 512
_GRID_CELLS, _GRID_MARGIN_CELLS = 48, 4
_SAMPLES_PER_CELL = 3
_NEAREST = 4
_MIN_LENGTH = 1e-12
_IDENTITY, _FLIP = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])


class KnownShape:
    """A rigid object about its centre, the middle of its bounding box.

    `half_m` (3,): half of the bounding box. `frame_m` (3,): origin of the object's stated frame.
    `symmetries` (g, 4): quaternions (x, y, z, w) of turns that leave it unchanged, beside the free ones:
    `free_axes` is 0 for none, 1 about z, 3 about every axis.
    """

    def __init__(
        self,
        half_m: FloatArray,
        free_axes: int = 0,
        symmetries: FloatArray | None = None,
        frame_m: FloatArray | None = None,
    ) -> None:
        self.half_m, self.free_axes = half_m, free_axes
        self.symmetries = _IDENTITY[None] if symmetries is None else symmetries
        self.frame_m = np.zeros(3) if frame_m is None else frame_m
        self.radius_m = float(np.linalg.norm(half_m))

    def distance(self, points: FloatArray) -> FloatArray:
        """Return signed distances (...,) of points (..., 3) in the frame at the centre."""
        return self.distance_and_normal(points)[0]

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return signed distances (...,) and their unit gradients (..., 3)."""
        raise NotImplementedError

    def surface_points(self, rng: np.random.Generator, count: int = _FEET) -> tuple[FloatArray, FloatArray]:
        """Return points of the surface and outward normals (n, 3), evenly over faces, and on the edges with
        the normals that bodies touching there may have."""
        feet, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
        while sum(map(len, feet)) < count:
            near = rng.uniform(-1, 1, (32 * count, 3)) * (self.half_m + _SHELL_M)
            distance, normal = self.distance_and_normal(near)
            shell = (distance > 0) & (distance < _SHELL_M)
            feet.append((near - distance[:, None] * normal)[shell])
            normals.append(normal[shell])
        return np.concatenate(feet)[:count], np.concatenate(normals)[:count]


class _Ball(KnownShape):
    def __init__(self, radius_m: float) -> None:
        super().__init__(np.full(3, radius_m), free_axes=3)

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        length = np.linalg.norm(points, axis=-1)
        return length - self.half_m[0], points / np.maximum(length, _MIN_LENGTH)[..., None]


class _Block(KnownShape):
    def __init__(self, half_m: FloatArray) -> None:
        super().__init__(half_m, symmetries=_box_symmetries(half_m))

    def distance(self, points: FloatArray) -> FloatArray:
        # by components, as reductions over three elements are slow
        x, y, z = (np.abs(points[..., axis]) - self.half_m[axis] for axis in range(3))
        inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
        squares = (
            np.square(np.maximum(x, 0.0)) + np.square(np.maximum(y, 0.0)) + np.square(np.maximum(z, 0.0))
        )
        return np.asarray(np.sqrt(squares) + inside)

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        excess = np.abs(points) - self.half_m
        distance, way = _from_excess(excess)
        return distance, way * np.where(points < 0, -1.0, 1.0)


class _Turned(KnownShape):
    """Coaxial cylinders along z: rows of radius, middle and half length (n, 3) [m]."""

    def __init__(self, parts: FloatArray) -> None:
        low, high = (parts[:, 1] - parts[:, 2]).min(), (parts[:, 1] + parts[:, 2]).max()
        middle = (low + high) / 2
        self._parts = parts - [0.0, middle, 0.0]
        radius = parts[:, 0].max()
        flips = np.stack([_IDENTITY, _FLIP]) if len(parts) == 1 else None
        super().__init__(np.array([radius, radius, (high - low) / 2]), 1, flips)

    def distance(self, points: FloatArray) -> FloatArray:
        around, along = _length(points[..., 0], points[..., 1]), points[..., 2]
        found = np.full(around.shape, np.inf)
        for radius, middle, half in self._parts.tolist():
            a, b = around - radius, np.abs(along - middle) - half
            distance = _length(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(np.maximum(a, b), 0)
            np.minimum(found, distance, out=found)
        return found

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        around, along = _length(points[..., 0], points[..., 1]), points[..., 2]
        found, outward, upward = np.full(around.shape, np.inf), np.zeros(around.shape), np.zeros(around.shape)
        for radius, middle, half in self._parts.tolist():
            off = along - middle
            a, b = around - radius, np.abs(off) - half
            over_a, over_b = np.maximum(a, 0), np.maximum(b, 0)
            beyond = _length(over_a, over_b)
            distance = beyond + np.minimum(np.maximum(a, b), 0)
            nearer = distance < found
            is_inside = beyond == 0
            length = np.where(is_inside, 1.0, beyond)
            found = np.where(nearer, distance, found)
            outward = np.where(nearer, np.where(is_inside, a >= b, over_a / length), outward)
            up = np.where(is_inside, a < b, over_b / length)
            upward = np.where(nearer, np.copysign(up, off), upward)
        normal = np.empty(points.shape)
        scale = outward / np.maximum(around, _MIN_LENGTH)
        normal[..., 0], normal[..., 1], normal[..., 2] = (
            scale * points[..., 0],
            scale * points[..., 1],
            upward,
        )
        return found, normal


class _Grid(KnownShape):
    """Distances on a grid (x, y, z), linear in between; beyond it, those of its nearest point plus the way
    there."""

    def __init__(self, half_m: FloatArray, frame_m: FloatArray, cell_m: float, values: FloatArray) -> None:
        super().__init__(half_m, frame_m=frame_m)
        self._cell_m, self._last = cell_m, np.array(values.shape) - 1
        self._corner_m = -cell_m * self._last / 2
        slopes = np.stack([np.gradient(values, cell_m, axis=axis) for axis in range(3)], axis=-1)
        self._table = np.concatenate([values[..., None], slopes], axis=-1).reshape(-1, 4)

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = (points - self._corner_m) / self._cell_m
        inside = np.clip(at, 0.0, self._last - 1e-9)
        low = inside.astype(np.intp)
        part = inside - low
        first = (low[..., 0] * (self._last[1] + 1) + low[..., 1]) * (self._last[2] + 1) + low[..., 2]
        found = np.zeros((*points.shape[:-1], 4))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(np.array(corner, np.bool_), part, 1 - part), axis=-1)
            step = (corner[0] * (self._last[1] + 1) + corner[1]) * (self._last[2] + 1) + corner[2]
            found += weight[..., None] * self._table[first + step]
        way = (at - inside) * self._cell_m
        beyond = np.linalg.norm(way, axis=-1)
        slope = np.where(
            (beyond > _MIN_LENGTH)[..., None], found[..., 1:] * found[..., :1] + way, found[..., 1:]
        )
        length = np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), _MIN_LENGTH)
        return found[..., 0] + beyond, slope / length


def build_shape(known: ObjectTable) -> KnownShape:
    """Return the shape of a known object. Raises ValueError for a mesh that can't be used."""
    shape = known.shape
    if isinstance(shape, SphereShape):
        return _Ball(_M_PER_MM * shape.diameter_mm / 2)
    if isinstance(shape, BoxShape):
        return _Block(_M_PER_MM * np.array(shape.size_mm) / 2)
    if isinstance(shape, CylinderShape):
        return _Turned(_M_PER_MM / 2 * np.array([[shape.diameter_mm, 0.0, shape.length_mm]]))
    if isinstance(shape, BoltShape):
        head = [shape.head_diameter_mm, shape.head_length_mm, shape.head_length_mm]
        shank = [shape.diameter_mm, 2 * shape.head_length_mm + shape.length_mm, shape.length_mm]
        return _Turned(_M_PER_MM / 2 * np.array([head, shank]))
    assert isinstance(shape, MeshShape)
    return _grid_of_mesh(shape.file, shape.unit_mm * _M_PER_MM)


def _length(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return np.hypot for ordinary numbers, which takes a third of its time."""
    return np.asarray(np.sqrt(x * x + y * y))


def _from_excess(excess: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distance and gradient of a box from each coordinate's excess over its half size (..., k)."""
    beyond = np.maximum(excess, 0.0)
    outside = np.sqrt(np.einsum("...i,...i->...", beyond, beyond))
    nearest = excess.argmax(axis=-1)
    to_face = (np.arange(excess.shape[-1]) == nearest[..., None]).astype(np.float64)
    way = beyond / np.maximum(outside, _MIN_LENGTH)[..., None]
    is_outside = outside > 0
    distance = np.where(is_outside, outside, excess.max(axis=-1))
    return distance, np.where(is_outside[..., None], way, to_face)


def _box_symmetries(half_m: FloatArray) -> FloatArray:
    """Return the turns of a cube that keep these half sides in place."""
    turns = Rotation.create_group("O")
    kept = np.isclose(np.abs(turns.apply(half_m)), half_m).all(axis=1)
    return np.asarray(turns.as_quat()[kept])


# Meshes -----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _grid_of_mesh(file: str, unit_m: float) -> _Grid:
    surface = surface_triangles(file, unit_m)
    corners = surface.points[surface.triangles]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    corners = corners - middle
    cell_m = 2 * float(half.max()) / (_GRID_CELLS - 2 * _GRID_MARGIN_CELLS)
    counts = 2 * np.ceil(half / cell_m + _GRID_MARGIN_CELLS) + 1
    axes = [cell_m * (np.arange(n) - (n - 1) / 2) for n in counts.tolist()]
    inside = _inside_by_crossings(corners, axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = _distance_from_corners(corners, points, cell_m / _SAMPLES_PER_CELL).reshape(inside.shape)
    return _Grid(half, -middle, cell_m, np.where(inside, -distance, distance))


def _distance_from_corners(corners: FloatArray, points: FloatArray, spacing_m: float) -> FloatArray:
    """Return distances (n,) of points from triangles (t, 3, 3), found by samples so far apart."""
    from scipy.spatial import cKDTree  # only here, as few objects are meshes

    samples, owner = _sample_triangles(corners, spacing_m)
    nearest = np.asarray(cKDTree(samples).query(points, _NEAREST)[1])
    squares = [
        squared_distance_from_triangles(*(corners[owner[of]] - points[:, None]).transpose(1, 0, 2))
        for of in nearest.T
    ]
    return np.asarray(np.sqrt(np.min(squares, axis=0)))


def _sample_triangles(corners: FloatArray, spacing_m: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return points of triangles, and the number of the triangle of each."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / spacing_m).astype(np.intp), 1)
    points, owner = [], []
    for number, (a, b, c) in enumerate(corners):
        n = int(steps[number])
        u, v = (part.ravel() / n for part in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        kept = u + v <= 1 + 1e-9
        points.append(a + u[kept, None] * (b - a) + v[kept, None] * (c - a))
        owner.append(np.full(np.count_nonzero(kept), number))
    return np.concatenate(points), np.concatenate(owner)


def _inside_by_crossings(corners: FloatArray, axes: list[FloatArray]) -> NDArray[np.bool_]:
    """Return which points of a grid lie inside: the surface is crossed an odd number of times below them.

    Raises ValueError for a surface that isn't closed.
    """
    step = axes[0][1] - axes[0][0]
    xs, ys = axes[0] + 0.0137 * step, axes[1] + 0.0071 * step  # beside edges that lie on the grid
    crossings = np.zeros((len(xs), len(ys), len(axes[2])), np.intp)
    total = np.zeros((len(xs), len(ys)), np.intp)
    for a, b, c in corners:
        normal = np.cross(b - a, c - a)
        if abs(normal[2]) < _MIN_LENGTH:
            continue
        i0, i1 = np.searchsorted(xs, [min(a[0], b[0], c[0]), max(a[0], b[0], c[0])])
        j0, j1 = np.searchsorted(ys, [min(a[1], b[1], c[1]), max(a[1], b[1], c[1])])
        x, y = xs[i0:i1, None], ys[None, j0:j1]
        sides = [(v[0] - u[0]) * (y - u[1]) - (v[1] - u[1]) * (x - u[0]) for u, v in ((a, b), (b, c), (c, a))]
        over = np.all(np.stack(sides) * np.sign(normal[2]) > 0, axis=0)
        z = a[2] - (normal[0] * (x - a[0]) + normal[1] * (y - a[1])) / normal[2]
        crossings[i0:i1, j0:j1] += over[..., None] & (z[..., None] < axes[2])
        total[i0:i1, j0:j1] += over
    if np.any(total % 2):
        raise ValueError("the mesh has holes: its surface must be closed")
    return np.asarray(crossings % 2 == 1)
