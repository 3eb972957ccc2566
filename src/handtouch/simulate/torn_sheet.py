"""Sheet with a corner cut off, solved by finite elements on the remaining area.

Public names: `cut_sheet_maps`, `is_beyond_cut`. `handtouch.simulate.sheet_solver` solves the intact sheet.
Here the cut and the intact sheet are solved with the same coarser elements, and their difference is added to
the fine solution, so that the result is continuous as the cut vanishes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import TABLE_NODES, ElectrodeGaps, SheetMaps
from handtouch.simulate.spectral_elements import ElementAxis

FloatArray = NDArray[np.float64]
CornerCut = tuple[str, float, float]
"""Corner, such as x0y0, and lost lengths of the sides along x and y [m]."""

_DEGREE = 3
_CUT_CONDUCTIVITY = 1e-7  # beyond the cut, relative to the sheet's


class _CoarseSolution(NamedTuple):
    conductance: FloatArray
    shares: FloatArray


@lru_cache(maxsize=256)
def _solve_coarse(shape: SimulatedSurface, gaps: ElectrodeGaps, cut: CornerCut | None) -> _CoarseSolution:
    """Return conductances (4, 4) [S] and shares (4, n, n) at the table's nodes, for 1 ohm per square."""
    metric = shape.metric
    gaps = gaps.stretched(shape.stretch).regularised(metric)
    ends_s = [end for a, b in (gaps.y0, gaps.yb) for end in (a, metric.length_m - b)]
    ends_phi = [end for a, b in (gaps.x0, gaps.xa) for end in (a, metric.arc - b)]
    s = ElementAxis.graded(metric.length_m, ends_s, _DEGREE)
    phi = ElementAxis.graded(metric.arc, ends_phi, _DEGREE)
    weight = np.outer(s.weights, phi.weights)
    if cut:
        points = np.stack(
            np.meshgrid(
                s.quadrature_points / metric.length_m, phi.quadrature_points / metric.arc, indexing="ij"
            )
        )
        weight = np.where(is_beyond_cut(shape, cut, points), _CUT_CONDUCTIVITY, 1.0) * weight
    radius = metric.radius(s.quadrature_points)[:, None]
    stiffness = _stiffness_matrix(s.slopes, phi.values, weight * radius) + _stiffness_matrix(
        s.values, phi.slopes, weight / radius
    )
    along_s, along_phi = len(s.nodes), len(phi.nodes)
    number = np.arange(along_s * along_phi).reshape(along_s, along_phi)
    sides = (
        (number[0], phi.nodes, gaps.x0),
        (number[-1], phi.nodes, gaps.xa),
        (number[:, 0], s.nodes, gaps.y0),
        (number[:, -1], s.nodes, gaps.yb),
    )
    held = np.zeros((number.size, 4))
    for electrode, (nodes, coordinate, gap) in enumerate(sides):
        slack = 1e-9 * coordinate[-1]
        covered = (coordinate >= gap[0] - slack) & (coordinate <= coordinate[-1] - gap[1] + slack)
        held[nodes[covered], electrode] = 1
    free = np.flatnonzero(held.sum(1) == 0)
    fixed = stiffness @ held
    potential = held.copy()
    potential[free] = splu(stiffness[free][:, free].tocsc()).solve(-fixed[free])
    conductance = held.T @ (stiffness @ potential)
    to_s = s.evaluate_basis(metric.length_m * TABLE_NODES)
    to_phi = phi.evaluate_basis(metric.arc * TABLE_NODES)
    grids = potential.T.reshape(4, along_s, along_phi)
    return _CoarseSolution(conductance, to_s @ grids @ to_phi.T)


def cut_sheet_maps(
    shape: SimulatedSurface, gaps: ElectrodeGaps, maps: SheetMaps, cut: CornerCut
) -> SheetMaps:
    """Return the maps of a sheet whose corner is cut off, with the conformal radius of the intact sheet."""
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


def _stiffness_matrix(of_s: FloatArray, of_phi: FloatArray, weight: FloatArray) -> sparse.csr_array:
    values = sparse.kron(sparse.csr_array(of_s), sparse.csr_array(of_phi), format="csr")
    return sparse.csr_array(values.T @ sparse.diags_array(weight.ravel()) @ values)
