"""Pads on triangulated surfaces, from arrays or an STL file, whose sheet resistance may vary.

Public names: `MeshNetwork`, `read_stl`.

Potentials are piecewise linear on the triangles and solve Laplace's equation with the cotangent operator. At
the ends of electrodes they have a root of the distance, so errors go with the length of the edges; they are
extrapolated from the mesh and one with every triangle divided into four.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handtouch.field._series_resistors import GroundedElectrodes
from handtouch.field.model import FloatArray

IntArray = npt.NDArray[np.intp]
Point3 = tuple[float, float, float]

_MERGED = 1e-6  # distance of vertices that are one, over the extent
_STL_HEADER = 84
_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_INSIDE = -1e-9


def read_stl(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices (n, 3), in the file's unit, and triangles (t, 3) of a binary or ASCII STL file.

    Equal corners become one vertex. Raises ValueError for a file without triangles.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    if len(data) == _STL_HEADER + count * _STL_RECORD.itemsize:
        corners = np.frombuffer(data, _STL_RECORD, count, _STL_HEADER)["corners"].reshape(-1, 3)
    else:
        lines = (line.split() for line in data.decode("ascii", "replace").splitlines())
        corners = np.array([line[1:4] for line in lines if line[:1] == ["vertex"]], np.float64)
    if not corners.size or len(corners) % 3:
        raise ValueError(f"{path}: no STL file with triangles")
    corners = corners.astype(np.float64).reshape(-1, 3)
    step = _MERGED * np.ptp(corners, axis=0).max()
    _, first, number = np.unique(np.round(corners / step), axis=0, return_index=True, return_inverse=True)
    return corners[first], number.reshape(-1, 3)


class MeshNetwork(GroundedElectrodes):
    """A resistive sheet on a triangulated surface with electrodes on its edge; a `ForwardModel`.

    vertices: (n, 3). triangles: (t, 3), of one orientation or any. The surface has one edge and, seen along
    z, doesn't cover itself: x and y of a contact are those of the vertices, from the smallest ones on.
    electrodes: (start, stop) of each, points next to the edge, which is followed counter-clockwise seen
    from +z; ends are moved to the nearest vertices. relative_resistance: (t,), sheet resistance of each
    triangle in units of `sheet_ohm_per_square`, such as a function or an image sampled at the centres of
    the triangles.

    Fractions and conductance of a disc and of a spherical cap with four electrodes are accurate to three
    times the square of the edges' length over the extent. Arguments broadcast; points off the pad or NaN give
    NaN. Derivatives are those of the triangles, constant in each.

    Raises ValueError for surfaces with no edge or several, or seen edge-on, for electrodes that touch, and
    for impossible resistances.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        triangles: npt.ArrayLike,
        electrodes: Sequence[tuple[Point3, Point3]],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
        relative_resistance: npt.ArrayLike | None = None,
    ) -> None:
        points, corners = np.asarray(vertices, np.float64), np.asarray(triangles, np.intp)
        resistance = np.ones(len(corners)) if relative_resistance is None else np.asarray(relative_resistance)
        if resistance.shape != (len(corners),) or not (resistance > 0).all():
            raise ValueError(f"relative_resistance must be {len(corners)} positive values")
        if not sheet_ohm_per_square > 0:
            raise ValueError(f"sheet_ohm_per_square must be positive, got {sheet_ohm_per_square}")
        self.sheet_ohm_per_square = float(sheet_ohm_per_square)
        lowest = np.array([*points[:, :2].min(axis=0), 0.0])
        corners, points = _counter_clockwise(points, corners), points - lowest
        ring = _edge_ring(corners)
        ends = np.asarray(electrodes, np.float64) - lowest  # (m, 2, 3)
        away = np.linalg.norm(points[ring] - ends[:, :, None], axis=-1)
        spans = [(int(start), int(stop)) for start, stop in away.argmin(axis=-1)]
        marked = _mark(len(points), ring, spans)
        fine, divided, marks, midpoints = _divided(points, corners, marked)
        coarse_values, coarse_conductance = _solve(points, corners, resistance, marked, len(spans))
        values, conductance = _solve(fine, divided, np.tile(resistance, 4), marks, len(spans))
        between = np.concatenate([coarse_values, coarse_values[midpoints].mean(axis=1)])
        self._potentials, self._conductance = 2 * values - between, 2 * conductance - coarse_conductance
        self._potentials[marks >= 0] = values[marks >= 0]
        self._points, self._triangles = fine, divided
        flat = fine[divided][:, :, :2]
        self._corner = flat[:, 0]
        self._inverse = np.linalg.inv((flat[:, 1:] - flat[:, :1]).swapaxes(1, 2))
        self._set_series_resistors([0.0] * len(spans) if series_ohm is None else series_ohm, len(spans))

    @property
    def a(self) -> float:
        """Extent along x, from 0, in the unit of the vertices."""
        return float(self._points[:, 0].max())

    @property
    def b(self) -> float:
        """Extent along y, from 0."""
        return float(self._points[:, 1].max())

    @property
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square."""
        return self._conductance

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, shape (m, ...), summing to
        1.
        """
        return self._ideal_with_jacobian(x, y)[0]

    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...), constant in each triangle."""
        values, jacobian = self._ideal_with_jacobian(x, y)
        return self._mixed(values), self._mixed(jacobian)

    def _located(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return barycentric coordinates (3, n), NaN off the pad, and triangles (n,)."""
        found = np.full((3, x.size), np.nan)
        triangle = np.zeros(x.size, np.intp)
        for some in np.array_split(np.arange(x.size), max(1, x.size * len(self._triangles) // 4_000_000)):
            offset = np.stack([x[some], y[some]], axis=1)[:, None] - self._corner
            shares = np.einsum("tij,ntj->nti", self._inverse, offset)
            least = np.minimum(shares.min(axis=2), 1 - shares.sum(axis=2))
            triangle[some] = best = np.argmax(np.where(np.isnan(least), -np.inf, least), axis=1)
            rows = np.arange(len(some))
            on_pad = least[rows, best] >= _INSIDE
            first, second = shares[rows, best].T
            found[:, some] = np.where(on_pad, [1 - first - second, first, second], np.nan)
        return found, triangle

    def _ideal_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        shares, triangle = self._located(x.ravel(), y.ravel())
        corners = self._potentials[self._triangles[triangle]]  # (n, 3, m)
        values = np.einsum("kn,nkm->mn", shares, corners)
        rises = corners[:, 1:] - corners[:, :1]
        slopes = np.einsum("nim,nij->mjn", rises, self._inverse[triangle]) + 0 * shares[0]
        return values.reshape(-1, *x.shape), slopes.reshape(-1, 2, *x.shape)


def _counter_clockwise(points: FloatArray, triangles: IntArray) -> IntArray:
    """Return triangles, turned where clockwise seen from +z; raises ValueError for vertical ones."""
    flat = points[triangles][:, :, :2]
    turn = np.linalg.det(np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=1))
    if (np.abs(turn) <= 1e-12 * np.abs(turn).max()).any():
        raise ValueError("triangles: some are seen edge-on along z")
    return np.where(turn[:, None] < 0, triangles[:, ::-1], triangles)


def _edges(triangles: IntArray) -> IntArray:
    return triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)


def _edge_ring(triangles: IntArray) -> IntArray:
    """Return the vertices of the surface's edge, counter-clockwise; raises ValueError unless it is one."""
    directed = _edges(triangles)
    known = {(int(i), int(j)) for i, j in directed}
    following = {i: j for i, j in known if (j, i) not in known}
    if not following:
        raise ValueError("triangles: the surface is closed; it needs an edge")
    ring = [next(iter(following))]
    while (vertex := following[ring[-1]]) != ring[0] and len(ring) <= len(following):
        ring.append(vertex)
    if len(ring) != len(following):
        raise ValueError("triangles: the surface has several edges, or triangles that only share a vertex")
    return np.array(ring)


def _mark(count: int, ring: IntArray, spans: Sequence[tuple[int, int]]) -> IntArray:
    """Return the electrode of each vertex, -1 if none; raises ValueError where electrodes touch."""
    marked = np.full(count, -1)
    if len(spans) < 2:
        raise ValueError(f"electrodes: at least two are needed, got {len(spans)}")
    for number, (start, stop) in enumerate(spans):
        length = (stop - start) % len(ring)
        if not length:
            raise ValueError(f"electrode {number} is shorter than an edge of the triangles")
        covered = ring[(start + np.arange(-1, length + 2)) % len(ring)]
        if (marked[covered] >= 0).any():
            raise ValueError(f"electrode {number} touches another; a bare vertex must lie between")
        marked[covered[1:-1]] = number
    return marked


def _divided(
    points: FloatArray, triangles: IntArray, marked: IntArray
) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
    """Return points, triangles and marks with each triangle in four, and the ends (e, 2) of each new point.

    The new points follow the old; the parts of triangle k are k, k + t, k + 2 t and k + 3 t.
    """
    every = np.sort(_edges(triangles), axis=1)
    ends, number, uses = np.unique(every, axis=0, return_inverse=True, return_counts=True)
    new = len(points) + number.reshape(-1, 3)
    (i, j, k), (ij, jk, ki) = triangles.T, new.T
    parts = [(i, ij, ki), (j, jk, ij), (k, ki, jk), (ij, jk, ki)]
    same = (uses == 1) & (marked[ends[:, 0]] == marked[ends[:, 1]])
    marks = np.concatenate([marked, np.where(same, marked[ends[:, 0]], -1)])
    middle = points[ends].mean(axis=1)
    fine = np.concatenate([np.stack(part, axis=1) for part in parts])
    return np.concatenate([points, middle]), fine, marks, ends


def _solve(
    points: FloatArray, triangles: IntArray, resistance: FloatArray, marked: IntArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return unit potentials (vertices, electrodes) and the conductance (electrodes, electrodes)."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import splu

    corners = points[triangles]
    opposite = np.stack([corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)], axis=1)
    area = np.linalg.norm(np.cross(opposite[:, 0], opposite[:, 1]), axis=1)  # twice
    local = np.einsum("tia,tja->tij", opposite, opposite) / (2 * area * resistance)[:, None, None]
    rows, columns = np.broadcast_arrays(triangles[:, :, None], triangles[:, None, :])
    size = len(points)
    operator = coo_array((local.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()
    values = (marked[:, None] == np.arange(count)).astype(float)
    free = np.flatnonzero(marked < 0)
    values[free] = splu(operator[free][:, free].tocsc()).solve(-(operator @ values)[free])
    return values, np.asarray(values.T @ (operator @ values))
