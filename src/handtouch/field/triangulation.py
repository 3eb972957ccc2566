"""Triangulated surfaces: STL files, the edge, refinement towards points.

Public names: `Triangulation`, `parse_stl`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray, IntArray

_MERGED = 1e-6  # distance of vertices that are one, over the extent
_STL_HEADER = 84
_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_MAX_ROUNDS = 60


def parse_stl(data: bytes) -> Triangulation:
    """Return the surface of a binary or ASCII STL file, in the file's unit; equal corners become one vertex.

    Raises ValueError for a file without triangles.
    """
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    if len(data) == _STL_HEADER + count * _STL_RECORD.itemsize:
        corners = np.frombuffer(data, _STL_RECORD, count, _STL_HEADER)["corners"].reshape(-1, 3)
    else:
        lines = (line.split() for line in data.decode("ascii", "replace").splitlines())
        rows = [line[1:4] for line in lines if line[:1] == ["vertex"]]
        try:
            corners = np.array(rows, np.float64)
        except ValueError:
            corners = np.zeros((0, 3))
    if not corners.size or len(corners) % 3 or not np.isfinite(corners).all():
        raise ValueError("no STL file with triangles")
    corners = corners.astype(np.float64).reshape(-1, 3)
    step = _MERGED * np.ptp(corners, axis=0).max()
    _, first, number = np.unique(np.round(corners / step), axis=0, return_index=True, return_inverse=True)
    triangles = number.reshape(-1, 3)
    real = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return Triangulation(corners[first], triangles[real])


@dataclass(frozen=True, eq=False)
class Triangulation:
    """A surface of triangles with one edge; its outside is where they are counter-clockwise.

    points: (n, 3). triangles: (t, 3), numbers of points.
    """

    points: FloatArray
    triangles: IntArray

    @cached_property
    def ring(self) -> IntArray:
        """Points on the edge, counter-clockwise seen from outside.

        Raises ValueError unless there is one edge, and triangles that share a side turn the same way.
        """
        begin, end = sides_of(self.triangles).T
        key, back = begin * len(self.points) + end, end * len(self.points) + begin
        if len(np.unique(key)) < len(key):
            raise ValueError("the surface has triangles that turn differently, or share a side with two")
        is_edge = ~np.isin(key, back)
        following = dict(zip(begin[is_edge].tolist(), end[is_edge].tolist(), strict=True))
        if not following:
            raise ValueError("the surface is closed; it needs an edge")
        ring = [min(following)]
        while (point := following[ring[-1]]) != ring[0] and len(ring) <= len(following):
            ring.append(point)
        if len(ring) != len(following):
            raise ValueError("the surface has several edges, or triangles that only share a corner")
        return np.array(ring)

    @cached_property
    def ring_lengths(self) -> FloatArray:
        """Lengths along the edge at the points of `ring`, from the first, and the whole (n + 1,)."""
        return self.lengths_around(self.ring)

    def lengths_around(self, ring: IntArray) -> FloatArray:
        """Return the lengths along the edge at its points (n,), from the first, and the whole (n + 1,)."""
        around = self.points[np.append(ring, ring[0])]
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1))])

    def nearest_on_edge(self, points: npt.ArrayLike) -> FloatArray:
        """Return the lengths along the edge, as in `ring_lengths`, of its places nearest to points (k, 3)."""
        start = self.points[self.ring]
        side = np.roll(start, -1, axis=0) - start
        away = np.asarray(points, np.float64)[:, None] - start
        part = np.clip((away * side).sum(axis=2) / (side * side).sum(axis=1), 0.0, 1.0)
        best = np.linalg.norm(away - part[:, :, None] * side, axis=2).argmin(axis=1)
        rows = np.arange(len(best))
        lengths = self.ring_lengths
        found = lengths[best] + part[rows, best] * (lengths[best + 1] - lengths[best])
        return np.asarray(found % lengths[-1])

    def in_pad_frame(self, corners: npt.ArrayLike) -> tuple[Triangulation, FloatArray, FloatArray]:
        """Return the surface in the frame of a pad with these corners (4, 3), and that frame: its axes, the
        columns of (3, 3), and its origin (3,).

        z is the mean of the outward normals, x points from the first side's corners (first and last) to those
        of the opposite one, and the origin is the point of the file that is nearest to the line along z
        through the mean of the corners.
        """
        first, second, third = self.points[self.triangles].transpose(1, 0, 2)
        z = np.cross(second - first, third - first).sum(axis=0)
        z /= np.linalg.norm(z)
        at = np.asarray(corners, np.float64)
        x = at[1] + at[2] - at[0] - at[3]
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z], axis=1)
        aside = (self.points - at.mean(axis=0)) @ axes[:, :2]
        origin = self.points[int(np.linalg.norm(aside, axis=1).argmin())]
        return Triangulation((self.points - origin) @ axes, self.triangles), axes, origin

    def with_edge_points(self, lengths: npt.ArrayLike) -> tuple[Triangulation, IntArray]:
        """Return the surface with points of its edge at these lengths (k,), and their numbers (k,)."""
        surface, whole = self, self.ring_lengths[-1]
        first = int(self.ring[0])
        numbers = []
        for length in np.asarray(lengths, np.float64).ravel().tolist():
            ring = np.roll(surface.ring, -int(np.flatnonzero(surface.ring == first)[0]))
            ends = surface.lengths_around(ring)
            at = length % whole
            k = int(np.abs(ends - at).argmin())
            if abs(ends[k] - at) <= _MERGED * whole:
                numbers.append(int(ring[k % len(ring)]))
                continue
            k = int(np.searchsorted(ends, at, side="right")) - 1
            part = (at - ends[k]) / (ends[k + 1] - ends[k])
            surface = surface._split(int(ring[k]), int(ring[(k + 1) % len(ring)]), part)
            numbers.append(len(surface.points) - 1)
        return surface, np.array(numbers, np.intp)

    def _split(self, i: int, j: int, part: float) -> Triangulation:
        """Return the surface with a point on the side from i to j of one triangle, `part` of the way."""
        new = len(self.points)
        points = np.concatenate([self.points, [(1 - part) * self.points[i] + part * self.points[j]]])
        has = (self.triangles == i).any(axis=1) & (self.triangles == j).any(axis=1)
        halves = [np.where(self.triangles[has] == end, new, self.triangles[has]) for end in (i, j)]
        return Triangulation(points, np.concatenate([self.triangles[~has], *halves]))

    def refined(self, size: float, towards: npt.ArrayLike, growth: float, smallest: float) -> Triangulation:
        """Return the surface with sides no longer than `size`, nor than `growth` times the distance from the
        points `towards` (k, 3), down to `smallest`; triangles are divided along their longest sides."""
        surface = self
        near = np.asarray(towards, np.float64).reshape(-1, 3)
        for _ in range(_MAX_ROUNDS):
            middle = surface.points[surface.triangles].mean(axis=1)
            allowed = np.full(len(middle), size)
            for point in near:
                away = growth * np.linalg.norm(middle - point, axis=1)
                allowed = np.minimum(allowed, np.maximum(away, smallest))
            divided = surface._divided(allowed)
            if divided is None:
                break
            surface = divided
        return surface

    def _divided(self, allowed: FloatArray) -> Triangulation | None:
        """Divide triangles (t,) whose longest side is above the allowed length, and those beside them that
        the division needs; None if there are none."""
        sides, count = np.sort(sides_of(self.triangles), axis=1), len(self.points)
        key, number = np.unique(sides[:, 0] * count + sides[:, 1], return_inverse=True)
        ends, number = np.stack([key // count, key % count], axis=1), number.reshape(-1, 3)
        length = np.linalg.norm(self.points[ends[:, 1]] - self.points[ends[:, 0]], axis=1)
        rank = np.empty(len(ends), np.intp)
        rank[np.argsort(length, kind="stable")] = np.arange(len(ends))  # the same longest side for both
        longest_at = rank[number].argmax(axis=1)
        rows = np.arange(len(number))
        longest = number[rows, longest_at]
        marked = np.zeros(len(ends), np.bool_)
        marked[longest[length[longest] > allowed]] = True
        if not marked.any():
            return None
        while True:
            before = int(marked.sum())
            marked[longest[marked[number].any(axis=1)]] = True
            if int(marked.sum()) == before:
                break
        middle = np.full(len(ends), -1)
        middle[marked] = len(self.points) + np.arange(int(marked.sum()))
        points = np.concatenate([self.points, self.points[ends[marked]].mean(axis=1)])
        turn = (longest_at[:, None] + np.arange(3)) % 3  # the longest side first
        a, b, c = np.take_along_axis(self.triangles, turn, axis=1).T
        ab, bc, ca = middle[np.take_along_axis(number, turn, axis=1)].T
        whole = ab < 0
        parts = [self.triangles[whole]]
        for p, q, pq in ((c, a, ca), (b, c, bc)):  # the halves, each with a side that may be divided
            once, twice = ~whole & (pq < 0), pq >= 0
            parts.append(np.stack([p, q, ab], axis=1)[once])
            parts += [np.stack([pq, q, ab], axis=1)[twice], np.stack([p, pq, ab], axis=1)[twice]]
        return Triangulation(points, np.concatenate(parts))


def sides_of(triangles: IntArray) -> IntArray:
    """Return the sides (3 t, 2) of triangles, as they turn."""
    return triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
