"""Sheets of variable conductivity, uneven or cut at a corner, by sparse finite elements on few elements.

Public names: `uneven_sheet_maps`, `cut_sheet_maps`, `is_beyond_cut`; `CoarseGrid`, `CoarseSolution`.
`handtouch.simulate.sheet_solver` solves even, intact sheets without a sparse factorisation. The difference
between two coarse solutions is added to its fine one, so that the elements' own error cancels and the result
is continuous as the variation, or the cut, vanishes.

The shares of the electrodes and the conductances between them are those of the uneven sheet. The resistance
of a contact of radius A is that of the layer on a sheet of the local resistance, and
rho(P) / 2 pi ln(R / A) of the sheet around it, where R is the table's conformal radius: it follows from the
resistances of a smeared source on the uneven and on the even sheet, whose difference hardly depends on the
source's size: 1e-3 of ln R where the resistance varies by 20 %, 3e-3 by 100 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from handtouch.arrays import FloatArray
from handtouch.simulate.mesh_geometry import SimulatedMesh
from handtouch.simulate.mesh_solver import solve_mesh
from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.outline_solver import solve_outline
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import (
    EDGE_INSET_FRACTION,
    TABLE_NODES,
    ArcEnds,
    ElectrodeGaps,
    SheetMaps,
    solve_sheet,
)
from handtouch.simulate.spectral_elements import ElementAxis, lobatto_nodes
from handtouch.simulate.unevenness import Unevenness

_DEGREE = 3
_SMEAR_FRACTION = 0.04  # standard deviation of a smeared source, of the root of the pad's area


class CoarseGrid:
    """Elements of a pad, and the nodes under its electrodes."""

    def __init__(self, shape: SimulatedSurface, gaps: ElectrodeGaps) -> None:
        metric = self._metric = shape.metric
        gaps = gaps.stretched(shape.stretch).regularised(metric)
        ends_s = [end for a, b in (gaps.y0, gaps.yb) for end in (a, metric.length_m - b)]
        ends_phi = [end for a, b in (gaps.x0, gaps.xa) for end in (a, metric.arc - b)]
        self._s = ElementAxis.graded(metric.length_m, ends_s, _DEGREE)
        self._phi = ElementAxis.graded(metric.arc, ends_phi, _DEGREE)
        self._radius = metric.radius(self._s.quadrature_points)
        self._weights = np.outer(self._s.weights, self._phi.weights)
        fractions = (
            self._s.quadrature_points / metric.length_m,
            self._phi.quadrature_points / metric.arc,
        )
        self.points = np.stack(np.meshgrid(*fractions, indexing="ij"))
        """(2, n, m), points at which conductivity is defined, as fractions of the pad."""
        self.on_electrode = self._electrode_nodes(gaps)
        """(nodes, 4), 1 for the nodes under each electrode."""
        self._free = np.flatnonzero(self.on_electrode.sum(1) == 0)

    def solve(self, conductivity: FloatArray) -> CoarseSolution:
        """Factorise the sheet with conductivities (n, m) [S] at `points`."""
        weight, radius = conductivity * self._weights, self._radius[:, None]
        stiffness = _stiffness_matrix(self._s.slopes, self._phi.values, weight * radius)
        stiffness = stiffness + _stiffness_matrix(self._s.values, self._phi.slopes, weight / radius)
        factors = splu(
            stiffness[self._free][:, self._free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},  # it is positive definite
        )
        potential = self.on_electrode.copy()
        potential[self._free] = factors.solve(-(stiffness @ self.on_electrode)[self._free])
        conductance = self.on_electrode.T @ (stiffness @ potential)
        nodes = TABLE_NODES
        to_s = self._s.evaluate_basis(self._metric.length_m * nodes)
        to_phi = self._phi.evaluate_basis(self._metric.arc * nodes)
        grids = potential.T.reshape(4, len(self._s.nodes), len(self._phi.nodes))
        return CoarseSolution(conductance, to_s @ grids @ to_phi.T, factors)

    def self_resistance(self, solution: CoarseSolution, nodes: FloatArray) -> FloatArray:
        """Return the resistance (k, k) to grounded electrodes of smeared sources centred on a grid.

        nodes: (k,), fractions of both sides.
        """
        metric, found = self._metric, []
        width_m = _SMEAR_FRACTION * np.sqrt(self._weights.sum(1) @ self._radius)
        for s_m in (metric.length_m * nodes).tolist():
            away = self._s.quadrature_points - s_m
            around = float(metric.radius(s_m)) * (self._phi.quadrature_points[:, None] - metric.arc * nodes)
            along = np.exp(-((away / width_m) ** 2) / 2) * self._s.weights * self._radius
            across = np.exp(-((around / width_m) ** 2) / 2) * self._phi.weights[:, None]
            load = np.einsum(
                "i,jk->ijk",
                self._s.values.T @ along / along.sum(),
                self._phi.values.T @ across / across.sum(0),
            ).reshape(-1, len(nodes))[self._free]
            found.append(np.einsum("ik,ik->k", load, solution.factors.solve(load)))
        return np.array(found)

    def _electrode_nodes(self, gaps: ElectrodeGaps) -> FloatArray:
        shape = len(self._s.nodes), len(self._phi.nodes)
        number = np.arange(shape[0] * shape[1]).reshape(shape)
        sides = (
            (number[0], self._phi.nodes, gaps.x0),
            (number[-1], self._phi.nodes, gaps.xa),
            (number[:, 0], self._s.nodes, gaps.y0),
            (number[:, -1], self._s.nodes, gaps.yb),
        )
        held = np.zeros((number.size, 4))
        for electrode, (nodes, coordinate, gap) in enumerate(sides):
            slack = 1e-9 * coordinate[-1]
            covered = (coordinate >= gap[0] - slack) & (coordinate <= coordinate[-1] - gap[1] + slack)
            held[nodes[covered], electrode] = 1
        return held


@dataclass(frozen=True, eq=False)
class CoarseSolution:
    """Potentials of a sheet with each electrode at 1 V and the others grounded."""

    conductance: FloatArray
    """(4, 4) [S]."""
    shares: FloatArray
    """(4, n, n), at the nodes of the tables of `SheetMaps`."""
    factors: SuperLU
    """Factors of the stiffness matrix of the nodes without electrode."""


def _stiffness_matrix(of_s: FloatArray, of_phi: FloatArray, weight: FloatArray) -> sparse.csr_array:
    values = sparse.kron(sparse.csr_array(of_s), sparse.csr_array(of_phi), format="csr")
    return sparse.csr_array(values.T @ sparse.diags_array(weight.ravel()) @ values)


CornerCut = tuple[str, float, float]
"""Corner, such as x0y0, and lost lengths of the sides along x and y [m]."""

_CUT_CONDUCTIVITY = 1e-7  # beyond the cut, relative to the sheet's


@lru_cache(maxsize=256)
def _solve_coarse(shape: SimulatedSurface, gaps: ElectrodeGaps, cut: CornerCut | None) -> CoarseSolution:
    """Return the solution for 1 ohm per square, with or without its corner."""
    grid = CoarseGrid(shape, gaps)
    beyond = is_beyond_cut(shape, cut, grid.points) if cut else np.zeros(grid.points.shape[1:], np.bool_)
    return grid.solve(np.where(beyond, _CUT_CONDUCTIVITY, 1.0))


def cut_sheet_maps(
    shape: SimulatedSurface, gaps: ElectrodeGaps, maps: SheetMaps, cut: CornerCut
) -> SheetMaps:
    """Return the maps of a sheet whose corner is cut off, with the conformal radius of the intact sheet.

    Raises ValueError for a pad of any outline, whose cuts aren't simulated.
    """
    if isinstance(shape, SimulatedOutline | SimulatedMesh):
        raise ValueError("a torn sheet is simulated on rectangles only; give the fault to another pad")
    after, before = _solve_coarse(shape, gaps, cut), _solve_coarse(shape, gaps, None)
    table = maps.table.copy()
    table[:4] += after.shares - before.shares
    return SheetMaps(maps.conductance + after.conductance - before.conductance, table)


def is_beyond_cut(shape: SimulatedSurface, cut: CornerCut, position: FloatArray) -> NDArray[np.bool_]:
    """Return which positions (2, ...), fractions of the pad, lie beyond the cut: (...)."""
    corner, along_x_m, along_y_m = cut
    if not along_x_m or not along_y_m:
        return np.zeros(position.shape[1:], np.bool_)
    x = position[0] if corner.startswith("x0") else 1 - position[0]
    y = position[1] if corner.endswith("y0") else 1 - position[1]
    width = shape.arc * float(shape.radius(0.0 if corner.startswith("x0") else shape.length_m))
    return np.asarray(x * shape.length_m / along_x_m + y * width / along_y_m < 1)


_RADIUS_DEGREE = 8
_NODES = 0.5 + (0.5 - EDGE_INSET_FRACTION) * lobatto_nodes(_RADIUS_DEGREE)
_TO_TABLE = np.linalg.solve(  # interpolates values at the nodes to the tables' nodes
    np.polynomial.legendre.legvander(2 * _NODES - 1, _RADIUS_DEGREE).T,
    np.polynomial.legendre.legvander(2 * TABLE_NODES - 1, _RADIUS_DEGREE).T,
).T


@lru_cache(maxsize=64)
def uneven_sheet_maps(
    shape: SimulatedSurface, gaps: ElectrodeGaps | ArcEnds, unevenness: Unevenness
) -> SheetMaps:
    """Return the maps of an uneven sheet of nominally 1 ohm per square; cached."""
    if isinstance(shape, SimulatedOutline):
        return solve_outline(shape, gaps, unevenness)
    if isinstance(shape, SimulatedMesh):
        return solve_mesh(shape, gaps, unevenness)
    assert isinstance(gaps, ElectrodeGaps)
    maps = solve_sheet(shape, gaps)
    if unevenness.is_even:
        return maps
    grid = CoarseGrid(shape, gaps)
    even, uneven = (
        grid.solve(conductivity)
        for conductivity in (np.ones(grid.points.shape[1:]), 1 / unevenness.ohm_ratio(grid.points))
    )
    at_nodes = np.stack(np.meshgrid(_NODES, _NODES, indexing="ij"))
    more_ohm = grid.self_resistance(uneven, _NODES) / unevenness.ohm_ratio(at_nodes)
    more_ohm -= grid.self_resistance(even, _NODES)
    table = maps.table.copy()
    table[:4] += uneven.shares - even.shares
    table[4] += 2 * math.pi * (_TO_TABLE @ more_ohm @ _TO_TABLE.T)
    return SheetMaps(maps.conductance + uneven.conductance - even.conductance, table)
