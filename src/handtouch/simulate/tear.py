"""A sheet with a corner cut off: finite elements on what is left.

Public names: `torn`, `beyond`. The intact sheet is solved by `handtouch.simulate.sheet`; here both the cut
and the intact one are solved with the same coarser elements, and their difference is added to the fine
solution. So nothing jumps where the cut has no length.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from handtouch.simulate.elements import Axis
from handtouch.simulate.shape import Shape
from handtouch.simulate.sheet import TABLE_AT, Gaps, SheetMaps

FloatArray = NDArray[np.float64]
Cut = tuple[str, float, float]
"""The corner, as x0y0, and how much of the sides along x and y is gone [m]."""

_DEGREE = 3
_NOTHING = 1e-7  # conductivity beyond the cut, in that of the sheet


class _Coarse(NamedTuple):
    conductance: FloatArray
    shares: FloatArray


@lru_cache(maxsize=256)
def _solve(shape: Shape, gaps: Gaps, cut: Cut | None) -> _Coarse:
    """Conductances (4, 4) [S] and shares (4, n, n) on the table's nodes, for 1 ohm per square."""
    gaps = gaps.solvable(shape)
    ends_s = [end for a, b in (gaps.y0, gaps.yb) for end in (a, shape.length_m - b)]
    ends_phi = [end for a, b in (gaps.x0, gaps.xa) for end in (a, shape.arc - b)]
    s = Axis.graded(shape.length_m, ends_s, _DEGREE)
    phi = Axis.graded(shape.arc, ends_phi, _DEGREE)
    weight = np.outer(s.weights, phi.weights)
    if cut:
        at = np.stack(np.meshgrid(s.at / shape.length_m, phi.at / shape.arc, indexing="ij"))
        weight = np.where(beyond(shape, cut, at), _NOTHING, 1.0) * weight
    radius = shape.radius(s.at)[:, None]
    stiffness = _energy(s.slopes, phi.values, weight * radius) + _energy(
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
    for electrode, (nodes, place, gap) in enumerate(sides):
        slack = 1e-9 * place[-1]
        held[nodes[(place >= gap[0] - slack) & (place <= place[-1] - gap[1] + slack)], electrode] = 1
    free = np.flatnonzero(held.sum(1) == 0)
    fixed = stiffness @ held
    potential = held.copy()
    potential[free] = splu(stiffness[free][:, free].tocsc()).solve(-fixed[free])
    conductance = held.T @ (stiffness @ potential)
    to_s = s.at_points(shape.length_m * TABLE_AT)
    to_phi = phi.at_points(shape.arc * TABLE_AT)
    grids = potential.T.reshape(4, along_s, along_phi)
    return _Coarse(conductance, to_s @ grids @ to_phi.T)


def torn(shape: Shape, gaps: Gaps, maps: SheetMaps, cut: Cut) -> SheetMaps:
    """The maps of a sheet whose corner is cut off; the conformal radius is left as it was."""
    after, before = _solve(shape, gaps, cut), _solve(shape, gaps, None)
    table = maps.table.copy()
    table[:4] += after.shares - before.shares
    return SheetMaps(maps.conductance + after.conductance - before.conductance, table)


def beyond(shape: Shape, cut: Cut, place: FloatArray) -> NDArray[np.bool_]:
    """Which of the places (2, ...), fractions of the pad, lie beyond the cut (...)."""
    corner, along_x_m, along_y_m = cut
    if not along_x_m or not along_y_m:
        return np.zeros(place.shape[1:], np.bool_)
    x = place[0] if corner.startswith("x0") else 1 - place[0]
    y = place[1] if corner.endswith("y0") else 1 - place[1]
    width = shape.arc * float(shape.radius(0.0 if corner.startswith("x0") else shape.length_m))
    return np.asarray(x * shape.length_m / along_x_m + y * width / along_y_m < 1)


def _energy(of_s: FloatArray, of_phi: FloatArray, weight: FloatArray) -> sparse.csr_array:
    values = sparse.kron(sparse.csr_array(of_s), sparse.csr_array(of_phi), format="csr")
    return sparse.csr_array(values.T @ sparse.diags_array(weight.ravel()) @ values)
