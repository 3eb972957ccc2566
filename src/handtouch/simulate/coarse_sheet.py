"""Sheet of variable conductivity, solved by sparse finite elements on few elements.

Public names: `CoarseGrid`, `CoarseSolution`. `handtouch.simulate.sheet_solver` solves even, intact sheets
without a sparse factorisation. The difference between two coarse solutions is added to its fine one, so that
the elements' own error cancels and the result is continuous as the variation vanishes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from handtouch.arrays import FloatArray
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import TABLE_NODES, ElectrodeGaps
from handtouch.simulate.spectral_elements import ElementAxis

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
