"""Geometry of a simulated pad on the triangles of an STL file, taken as they are.

Public names: `SimulatedMesh`, `MeshElements`. It is independent of `handtouch.field`: the pad's surface is
the file's facets, which the estimator takes for samples of a smooth surface, and potentials are by elements
of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray, IntArray
from handtouch.config.meshes import surface_triangles
from handtouch.simulate.pad_geometry import SimulatedSurface, SurfaceProjection

if TYPE_CHECKING:
    from handtouch.config.meshes import SurfaceTriangles


CELLS = 45.0
"""Square root of the area over the longest side of an element."""
_GROWTH, _SMALLEST = 0.25, 1e-3
"""Sides of elements over the distance from the nearest end of an electrode, and at it over the longest."""
_CANDIDATES = 16
"""Triangles whose centres are nearest, among which one that holds a point is sought."""
_PLATE_THICKNESS_M = 4e-3
_MIDDLE_POINTS = 201


class MeshElements:
    """Piecewise linear potentials on a surface of triangles.

    sides: points on the sides y0, xa, yb and x0, each from its begin to its end counter-clockwise.
    """

    def __init__(self, surface: SurfaceTriangles, corners: IntArray) -> None:
        self.points, self.triangles = surface.points, surface.triangles
        ring = surface.ring
        ring = np.roll(ring, -int(np.flatnonzero(ring == corners[0])[0]))
        self.ring = np.append(ring, ring[0])
        begins = [int(np.flatnonzero(ring == corner)[0]) for corner in corners] + [len(ring)]
        self.sides = [self.ring[begins[k] : begins[k + 1] + 1] for k in range(4)]
        steps = np.linalg.norm(np.diff(self.points[self.ring], axis=0), axis=1)
        self.ring_m = np.concatenate([[0.0], np.cumsum(steps)])
        """Lengths along the edge at the points of `ring`, from the first corner."""
        self.corners_m = self.ring_m[begins]
        """Lengths along the edge at the corners, and the whole."""
        first, second, third = self.points[self.triangles].transpose(1, 0, 2)
        outward = np.cross(second - first, third - first)
        self.areas = np.linalg.norm(outward, axis=1) / 2
        self.facet_normals = outward / (2 * self.areas)[:, None]
        along = (second - first) / np.linalg.norm(second - first, axis=1)[:, None]
        across = np.cross(self.facet_normals, along)
        flat = np.stack(
            [[np.einsum("tk,tk->t", p - first, axis) for axis in (along, across)] for p in (second, third)]
        )  # (2 corners, 2 axes, t)
        inverse = np.linalg.inv(np.moveaxis(flat, 2, 0))  # (t, axis, corner)
        self.gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2)
        """(t, 2, 3), of the potentials that are 1 at one corner, in the facet's plane [1/m]."""

    def stiffness(self, conductivity: FloatArray) -> Any:
        """Return the matrix (points, points) of a sheet of conductivity (t, 2, 2) in the facets' planes."""
        from scipy.sparse import coo_array

        flow = conductivity @ self.gradients
        local = self.areas[:, None, None] * (self.gradients.transpose(0, 2, 1) @ flow)
        at = [np.repeat(self.triangles, 3, axis=1), np.tile(self.triangles, 3)]
        size = len(self.points)
        return coo_array((local.ravel(), (at[0].ravel(), at[1].ravel())), shape=(size, size)).tocsr()

    @cached_property
    def fractions(self) -> FloatArray:
        """(points, 2), potentials between electrodes x0 and xa, and y0 and yb, on an even sheet."""
        even = self.stiffness(np.broadcast_to(np.eye(2), (len(self.triangles), 2, 2)))
        found = []
        for zero, one in ((3, 1), (0, 2)):
            values = np.zeros((len(self.points), 1))
            values[self.sides[one]] = 1.0
            held = np.union1d(self.sides[zero], self.sides[one])
            found.append(HeldPotentials(even, held).complete(values, np.zeros_like(values))[:, 0])
        return np.stack(found, axis=1)

    @cached_property
    def slopes(self) -> FloatArray:
        """(t, 2, 2), gradients of both `fractions` in the facets' planes [1/m]."""
        return np.asarray(np.einsum("tak,tkf->tfa", self.gradients, self.fractions[self.triangles]))

    @cached_property
    def aspect(self) -> float:
        """Length over width of the rectangle that is a conformal image of the surface."""
        energy = np.einsum("t,tfa,tfa->f", self.areas, self.slopes, self.slopes)
        return float(np.sqrt(energy[1] / energy[0]))

    @cached_property
    def metres(self) -> FloatArray:
        """(points,), lengths on the surface per unit of the first fraction."""
        energy = np.einsum("tfa,tfa->tf", self.slopes, self.slopes) / [1.0, self.aspect**2]
        return 1 / np.sqrt(self.at_points(energy.mean(axis=1)))

    @cached_property
    def normals(self) -> FloatArray:
        """(points, 3), outward unit normals."""
        normals = self.at_points(self.facet_normals)
        return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])

    def at_points(self, values: FloatArray) -> FloatArray:
        """Return means (points, ...) of values (t, ...) of the triangles around each point, by area."""
        total = np.zeros((len(self.points), *values.shape[1:]))
        weight = np.zeros(len(self.points))
        weighted = values * self.areas.reshape(-1, *(1,) * (values.ndim - 1))
        for corner in self.triangles.T:
            np.add.at(total, corner, weighted)
            np.add.at(weight, corner, self.areas)
        return total / weight.reshape(-1, *(1,) * (values.ndim - 1))

    def locate(self, fractions: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the triangles (n,) that hold fractions (n, 2) of the pad, and barycentric coordinates."""
        _, near = self._fraction_tree.query(fractions, k=_CANDIDATES)
        first, inverse = self._flat_corners
        offset = fractions[:, None] - first[near]
        parts = np.einsum("nkij,nkj->nki", inverse[near], offset)
        weights = np.concatenate([1 - parts.sum(axis=2, keepdims=True), parts], axis=2)
        best = weights.min(axis=2).argmax(axis=1)
        rows = np.arange(len(fractions))
        weights = np.clip(weights[rows, best], 0.0, None)
        return near[rows, best], weights / weights.sum(axis=1, keepdims=True)

    def values_at(self, fractions: FloatArray, values: FloatArray) -> FloatArray:
        """Return values (n, ...) of potentials (points, ...) at fractions (n, 2) of the pad."""
        triangle, weights = self.locate(fractions)
        return np.asarray(np.einsum("nk,nk...->n...", weights, values[self.triangles[triangle]]))

    @cached_property
    def _flat_corners(self) -> tuple[FloatArray, FloatArray]:
        """First corners (t, 2) in the plane of the fractions, and matrices (t, 2, 2) to barycentric
        coordinates."""
        corners = self.fractions[self.triangles]
        sides = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        sides[np.linalg.det(sides) == 0] = np.eye(2)  # in a corner, where all points have one fraction
        return corners[:, 0], np.asarray(np.linalg.inv(sides))

    @cached_property
    def _fraction_tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.fractions[self.triangles].mean(axis=1))

    @cached_property
    def space_tree(self) -> Any:
        """Tree of the triangles' centres."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points[self.triangles].mean(axis=1))


class HeldPotentials:
    """Potentials of a sheet that are given at some points."""

    def __init__(self, stiffness: Any, held: IntArray) -> None:
        from scipy.sparse.linalg import splu

        self._stiffness = stiffness
        self._free = np.setdiff1d(np.arange(stiffness.shape[0]), held)
        self._factors = splu(
            stiffness[self._free][:, self._free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def complete(self, given: FloatArray, loads: FloatArray) -> FloatArray:
        """Return potentials (points, k) from those at the held points, 0 elsewhere, and currents into all."""
        whole = given.copy()
        whole[self._free] = self._factors.solve((loads - self._stiffness @ given)[self._free])
        return whole


@dataclass(frozen=True)
class SimulatedMesh(SimulatedSurface):
    """A pad on the triangles of a file; its sides are the parts of the edge between the marked corners.

    Its coordinates are fractions of the pad times `length_m` and `arc`, the lengths of the middle lines; the
    fractions are the potentials of an even sheet between opposite sides, so that they are conformal. Gaps
    are in the same units, in proportion to the lengths of the sides.
    """

    file: str = ""
    """Embedded content."""
    corners_m: tuple[tuple[float, float, float], ...] = ()
    grown: tuple[float, float] = (1.0, 1.0)
    """Factors along x and y of the middle."""

    @classmethod
    def from_table(cls, table: Any) -> SimulatedMesh:
        """Return the geometry of a pad's `surface` table."""
        corners = np.stack([table.corner_x_mm, table.corner_y_mm, table.corner_z_mm], axis=1) * 1e-3
        made = cls(1.0, 1.0, 1.0, flat=True, file=table.file, corners_m=tuple(map(tuple, corners.tolist())))
        return made._measured()

    def _measured(self) -> SimulatedMesh:
        way, half = np.linspace(0, 1, _MIDDLE_POINTS), np.full(_MIDDLE_POINTS, 0.5)
        lines = (self._points_at(np.stack(line, axis=1)) for line in ((way, half), (half, way)))
        along, across = (float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines)
        return replace(self, length_m=along, arc=across)

    def resized(self, longer_m: float, wider_m: float) -> SimulatedMesh:
        """Return a pad stretched along x and y of its middle, by about these lengths unless it is bent."""
        if not (longer_m or wider_m):
            return self
        return replace(self, grown=(1 + longer_m / self.length_m, 1 + wider_m / self.arc))._measured()

    @property
    def elements(self) -> MeshElements:
        """Potentials on the surface without electrodes."""
        return self.elements_with(())

    def elements_with(self, ends_m: Sequence[float], cells: float = CELLS) -> MeshElements:
        """Return potentials on the surface, with points at these lengths along the edge from the first
        corner."""
        return _elements(self.file, self.corners_m, self.grown, tuple(ends_m), cells)

    def side_units(self) -> tuple[float, float, float, float]:
        """Return metres along the sides x0, xa, y0, yb per unit of the coordinate along them."""
        y0, xa, yb, x0 = np.diff(self.elements.corners_m).tolist()
        return x0 / self.arc, xa / self.arc, y0 / self.length_m, yb / self.length_m

    def point(self, s_m: float, phi: float) -> FloatArray:
        """Return a position (3,) [m] in the pad's frame."""
        return np.asarray(self._points_at(np.array([[s_m / self.length_m, phi / self.arc]]))[0])

    def _points_at(self, fractions: FloatArray) -> FloatArray:
        return self.elements.values_at(fractions, self.elements.points)

    def normal(self, s_m: float, phi: float) -> FloatArray:
        """Return the outward unit normal (3,) in the pad's frame."""
        at = np.array([[s_m / self.length_m, phi / self.arc]])
        normal = self.elements.values_at(at, self.elements.normals)[0]
        return np.asarray(normal / np.linalg.norm(normal))

    def arc_lengths(self, s_m: float, phi: float) -> tuple[float, float]:
        """Return the coordinates."""
        return s_m, phi

    def film_fractions(self, place_m: FloatArray) -> FloatArray:
        """Return the fractions (n, 2) of places (n, 3) in the frame of the file."""
        _, axes, origin = surface_triangles(self.file, 1e-3).in_pad_frame(self.corners_m)
        return self.project((place_m - origin) @ axes).fraction

    def _metres(self, position: FloatArray) -> FloatArray:
        """Return metres (2, n) per unit of the fractions at positions (2, n)."""
        along = self.elements.values_at(position.T, self.elements.metres)
        return np.stack([along, along / self.elements.aspect])

    def metres_per_fraction(self, x: float, y: float) -> FloatArray:
        """Return the derivatives (2, 2) of positions along the surface by the fractions of the pad."""
        return np.diag(self._metres(np.array([[x], [y]]))[:, 0])

    def fractions_of(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return short vectors (2, n) [m] along the surface at positions (2, n), in fractions of the pad."""
        return np.asarray(vector_m / self._metres(position))

    def fractions_beside(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return fractions of the pad (k, 2, n) at vectors (k, 2, n) [m] from positions (2, k).

        They are those of the rectangle, a conformal image of the surface, in metres on the latter.
        """
        return np.asarray(position.T[:, :, None] + vector_m / self._metres(position).T[:, :, None])

    def scale_at(self, position: FloatArray) -> FloatArray:
        """Return metres on the surface (n,) per metre of `plane` at fractions of the pad (2, n)."""
        return np.asarray(self._metres(position)[0] / self.length_m)

    def plane(self, position: ArrayLike) -> FloatArray:
        """Return the places (2, ...) [m] of fractions of the pad (2, ...) in its conformal image, of the
        isotropic equivalent of the sheet."""
        x, y = np.asarray(position, np.float64)
        return np.stack([self.stretch * self.length_m * x, self.length_m / self.elements.aspect * y])

    def project(self, points_m: FloatArray) -> SurfaceProjection:
        """Project points (n, 3) in the pad's frame."""
        mesh = self.elements
        _, near = mesh.space_tree.query(points_m, k=_CANDIDATES)
        corners = mesh.points[mesh.triangles[near]]  # (n, k, 3 corners, 3)
        first, sides = corners[:, :, 0], corners[:, :, 1:] - corners[:, :, :1]
        gram = sides @ sides.swapaxes(2, 3)
        right = np.einsum("nkij,nkj->nki", sides, points_m[:, None] - first)
        parts = np.linalg.solve(gram, right[..., None])[..., 0]
        weights = np.concatenate([1 - parts.sum(axis=2, keepdims=True), parts], axis=2)
        inside = np.clip(weights, 0.0, None)
        foot = np.einsum("nkc,nkcj->nkj", inside / inside.sum(axis=2, keepdims=True), corners)
        best = np.linalg.norm(points_m[:, None] - foot, axis=2).argmin(axis=1)
        rows = np.arange(len(points_m))
        at = mesh.triangles[near[rows, best]]
        weight = weights[rows, best]  # of a point beside the pad: beyond its edge
        normal = np.einsum("nc,ncj->nj", inside[rows, best], mesh.normals[at])
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        on_facet = np.einsum("nc,ncj->nj", weight, mesh.points[at])
        fraction = np.einsum("nc,ncf->nf", weight, mesh.fractions[at])
        return SurfaceProjection(fraction, ((points_m - on_facet) * normal).sum(axis=1), normal)

    def hull_points(self) -> list[FloatArray]:
        """Return points (3,) in the pad's frame whose convex hull is the body under the surface."""
        mesh = self.elements
        inward = -_PLATE_THICKNESS_M * mesh.normals.mean(axis=0)
        return [*mesh.points, *(mesh.points[mesh.ring] + inward)]


@lru_cache(maxsize=32)
def _elements(
    file: str,
    corners_m: tuple[tuple[float, float, float], ...],
    grown: tuple[float, float],
    ends_m: tuple[float, ...],
    cells: float,
) -> MeshElements:
    """Return the elements of a pad; `ends_m`: of its electrodes along the edge from the first corner."""
    surface, axes, origin = surface_triangles(file, 1e-3).in_pad_frame(corners_m)
    corners = (np.array(corners_m) - origin) @ axes
    at = surface.nearest_on_edge(corners)
    if grown != (1.0, 1.0):  # about the middle, whose directions are those of the file's pad
        middle = _elements(file, corners_m, (1.0, 1.0), (), CELLS)
        origin, axes = _frame(middle)
        factors = np.array([*grown, 1.0])
        grown_points = ((surface.points - origin) @ axes.T * factors) @ axes + origin
        moved = ((corners - origin) @ axes.T * factors) @ axes + origin
        surface = replace(surface, points=grown_points)
        at = surface.nearest_on_edge(moved)
    surface, numbers = surface.with_edge_points(np.concatenate([at, at[0] + np.array(ends_m)]))
    size = float(np.sqrt(_area(surface)))
    towards = surface.points[numbers]
    longest = size / cells
    return MeshElements(surface.refined(longest, towards, _GROWTH, _SMALLEST * longest), numbers[:4])


def _area(surface: SurfaceTriangles) -> float:
    first, second, third = surface.points[surface.triangles].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


def _frame(mesh: MeshElements) -> tuple[FloatArray, FloatArray]:
    """Return the middle (3,) of a pad, and the rows x, y and outward there (3, 3)."""
    ways = np.array([[0.45, 0.5], [0.55, 0.5], [0.5, 0.5]])
    low, high, middle = mesh.values_at(ways, mesh.points)
    outward = mesh.values_at(ways[2:], mesh.normals)[0]
    outward /= np.linalg.norm(outward)
    along = high - low - ((high - low) @ outward) * outward
    along /= np.linalg.norm(along)
    return middle, np.stack([along, np.cross(outward, along), outward])
