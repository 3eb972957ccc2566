"""Solve the potential of a sheet on the triangles of a file: the simulator's forward model for them.

Public names: `solve_mesh` -> `SheetMaps`, `mesh_mutual_resistance`.

Potentials are piecewise linear on the file's own facets, divided towards the ends of the electrodes, which
are points of the edge. It uses nothing of `handtouch.field`, so that the two can be checked against each
other.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.simulate.mesh_geometry import CELLS, HeldPotentials, SimulatedMesh
from handtouch.simulate.outline_solver import RADIUS_TABLE_NODES, log_radius_table
from handtouch.simulate.sheet_solver import (
    RADIUS_NODES,
    TABLE_NODES,
    ArcEnds,
    ElectrodeGaps,
    MutualResistance,
    SheetMaps,
)
from handtouch.simulate.unevenness import Unevenness

_MIN_GAP_FRACTION = 1e-3  # bare gap over a side
_MUTUAL_CELLS = 25.0  # as `CELLS`, for the many sources of mutual resistances
_SIDE_OF_ELECTRODE = (3, 1, 0, 2)
"""Numbers, counter-clockwise, of the sides of electrodes x0, xa, y0 and yb."""


@lru_cache(maxsize=32)
def solve_mesh(shape: SimulatedMesh, gaps: ElectrodeGaps | ArcEnds, unevenness: Unevenness) -> SheetMaps:
    """Return the maps of a sheet of nominally 1 ohm per square; cached.

    Shares and conductance are those of the uneven sheet, the conformal radius that of an even one.
    """
    sheet = _MeshSheet(shape, gaps, unevenness)
    grid = _grid(TABLE_NODES)
    shares = sheet.mesh.values_at(grid.T, sheet.unit_potentials).T.reshape(-1, *2 * (len(TABLE_NODES),))
    even = sheet if unevenness.is_even else _MeshSheet(shape, gaps, Unevenness())
    coarse = _grid(RADIUS_TABLE_NODES)
    regular = np.einsum("kk->k", even.mesh.values_at(coarse.T, even.regular_parts(coarse)))
    log_radius = 2 * math.pi * regular + np.log(shape.scale_at(coarse)) - math.log((1 + shape.stretch) / 2)
    table = log_radius_table(log_radius, isinstance(gaps, ElectrodeGaps))
    return SheetMaps(sheet.conductance, np.concatenate([shares, table[None]]))


class _MeshMutualResistance(MutualResistance):
    """Green's function of a sheet on triangles with grounded electrodes, as a resistance."""

    def __init__(self, shape: SimulatedMesh, gaps: ElectrodeGaps | ArcEnds) -> None:
        self._mesh_shape = shape
        sheet, grid = _MeshSheet(shape, gaps, Unevenness(), _MUTUAL_CELLS), _grid(RADIUS_NODES)
        table = sheet.mesh.values_at(grid.T, sheet.regular_parts(grid))
        self._table = table.reshape(4 * (len(RADIUS_NODES),))

    def resistance_ohm(self, one: FloatArray, other: FloatArray, nearest_m: FloatArray) -> FloatArray:
        """Return the resistance (n,) between positions (2, n) [fractions], at least `nearest_m` apart."""
        shape = self._mesh_shape
        distance = np.hypot(*(shape.plane(one) - shape.plane(other)))
        distance = np.maximum(distance, nearest_m / shape.scale_at(one))
        return np.asarray(self._regular_part(one, other) - np.log(distance) / (2 * math.pi))


@lru_cache(maxsize=24)
def mesh_mutual_resistance(shape: SimulatedMesh, gaps: ElectrodeGaps | ArcEnds) -> MutualResistance:
    """Return the Green's function of a sheet; cached."""
    return _MeshMutualResistance(shape, gaps)


class _MeshSheet:
    """Solutions on one sheet with its electrodes."""

    def __init__(
        self,
        shape: SimulatedMesh,
        gaps: ElectrodeGaps | ArcEnds,
        unevenness: Unevenness,
        cells: float = CELLS,
    ) -> None:
        self._shape = shape
        arcs = _arcs_m(shape, gaps) if isinstance(gaps, ElectrodeGaps) else gaps
        self.mesh = mesh = shape.elements_with([end for arc in arcs for end in arc], cells)
        whole = mesh.ring_m[-1]
        slack = 1e-7 * whole
        at = mesh.ring_m[:-1]
        self._electrodes = [
            mesh.ring[:-1][(at - begin + slack) % whole <= (end - begin) % whole + 2 * slack]
            for begin, end in arcs
        ]
        self._stiffness = mesh.stiffness(self._conductivity(unevenness))
        self._held = HeldPotentials(self._stiffness, np.concatenate(self._electrodes))
        potentials = np.zeros((len(mesh.points), len(arcs)))
        for electrode, points in enumerate(self._electrodes):
            potentials[points, electrode] = 1.0
        self.unit_potentials = self._held.complete(potentials, np.zeros_like(potentials))
        """(points, m), with one electrode at 1."""
        self.conductance: FloatArray = self.unit_potentials.T @ (self._stiffness @ self.unit_potentials)

    def _conductivity(self, unevenness: Unevenness) -> FloatArray:
        """Return conductivities (t, 2, 2) in the facets' planes: principal axes along x and y of the pad."""
        mesh, stretch = self.mesh, self._shape.stretch
        along = mesh.slopes[:, 0] / np.linalg.norm(mesh.slopes[:, 0], axis=1)[:, None]
        both = along[:, :, None] * along[:, None, :]
        tensor = both / stretch + (np.eye(2) - both) * stretch
        ratio = unevenness.ohm_ratio(mesh.fractions[mesh.triangles].mean(axis=1).T)
        return np.asarray(tensor / ratio[:, None, None])

    def regular_parts(self, position: FloatArray) -> FloatArray:
        """Return the regular part (points, k) of the potential of a unit current at positions (2, k), of an
        even sheet.

        It compensates the values of -ln(d) / 2 pi on the electrodes and its flux through the bare edge, d the
        distance in the pad's conformal image, where both are harmonic.
        """
        mesh, shape = self.mesh, self._shape
        place, source = shape.plane(mesh.fractions.T), shape.plane(position)
        apart = place[:, mesh.ring, None] - source[:, None]
        on_edge = np.log(np.hypot(*apart)) / (2 * math.pi)  # (ring, k)
        potentials = np.zeros((len(mesh.points), position.shape[1]))
        number = {point: at for at, point in reversed(list(enumerate(mesh.ring.tolist())))}
        is_held = np.zeros(len(mesh.points), np.bool_)
        for points in self._electrodes:
            potentials[points] = on_edge[[number[point] for point in points.tolist()]]
            is_held[points] = True
        loads = np.zeros_like(potentials)
        begin, end = mesh.ring[:-1], mesh.ring[1:]
        bare = np.flatnonzero(~(is_held[begin] & is_held[end]))
        # the angle that a side of the edge is seen under, in two halves, each to its nearer end
        low, high = apart[:, bare], apart[:, bare + 1]
        middle = (low + high) / 2
        for points, one, other in ((begin, low, middle), (end, middle, high)):
            turn = np.arctan2(one[0] * other[1] - one[1] * other[0], (one * other).sum(axis=0))
            np.add.at(loads, points[bare], turn / (2 * math.pi))
        return self._held.complete(potentials, loads)


def _grid(nodes: FloatArray) -> FloatArray:
    """Return the fractions (2, n n) of a grid of nodes."""
    return np.stack(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)


def _arcs_m(shape: SimulatedMesh, gaps: ElectrodeGaps) -> ArcEnds:
    """Return begin and end of electrodes x0, xa, y0 and yb along the edge from the first corner."""
    corners, units = shape.elements.corners_m, shape.side_units()
    arcs = []
    for side, pair, unit in zip(_SIDE_OF_ELECTRODE, gaps, units, strict=True):
        begin, end = corners[side : side + 2]
        low, high = (max(unit * gap, _MIN_GAP_FRACTION * (end - begin)) for gap in pair)
        before, after = (low, high) if side < 2 else (high, low)  # yb and x0 run against the coordinate
        arcs.append((float(begin + before), float(end - after)))
    return tuple(arcs)
