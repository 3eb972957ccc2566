"""Changes of the electrodes' current shares by a cut across a corner: finite differences on the rectangle.

Public: `cut_share_changes`. The intact and the cut sheet are solved on one coarse grid; only their difference
is used, in which most of the grid's error cancels.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import splu

from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.supervisor.diagnose.model import FloatArray

_CELLS_PER_SIDE = 40  # a side
_CUT_CONDUCTIVITY = 1e-9  # beyond the cut, relative
_MIRRORED_ELECTRODES = np.array([0, 1, 3, 2, -1])  # electrodes with y reversed
CORNERS = {("x0", "y0"): (0, 0), ("x0", "yb"): (0, 1), ("xa", "y0"): (1, 0), ("xa", "yb"): (1, 1)}


def cut_share_changes(
    network: ElectrodeNetwork,
    surface: Surface,
    cuts: Iterable[tuple[tuple[int, int], float, float]],
    at: FloatArray,
) -> list[tuple[FloatArray, NDArray[np.bool_]]]:
    """Return the changes of the shares by each cut: corner (0 or 1 along x, y), fractions of the sides.

    A cut is straight in arc length and angle. at: (k,) coordinates as fractions of a side of the rectangle.
    Returns changes (k, k, 4), x first, and a mask of the positions beyond the cut. Resistors to ground are
    neglected.
    """
    nodes = np.linspace(0, 1, _CELLS_PER_SIDE + 1)
    x, y = np.meshgrid(nodes, nodes, indexing="ij")
    owner = _electrode_of_nodes(network, x, y)
    intact = _electrode_shares(network, owner, x, y, None)
    along = np.linspace(0, 1, 8 * _CELLS_PER_SIDE + 1)
    arc = surface.from_rectangle(along * network.a, 0 * along)[0] / surface.extent_m[0]
    grid = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1)
    symmetric = bool((_MIRRORED_ELECTRODES[owner[:, ::-1]] == owner).all())
    computed: dict[tuple[int, float, float], FloatArray] = {}
    found = []
    for corner, along_x, along_y in cuts:
        inside = (corner, along_x, along_y)
        if symmetric and (corner[0], along_x, along_y) in computed:
            change = computed.pop((corner[0], along_x, along_y))[_MIRRORED_ELECTRODES[:4], :, ::-1]
        else:
            change = _electrode_shares(network, owner, np.interp(x, along, arc), y, inside) - intact
            computed[corner[0], along_x, along_y] = change
        sampled = RegularGridInterpolator((nodes, nodes), np.moveaxis(change, 0, -1))(grid)
        found.append(
            (np.asarray(sampled), _is_cut_off(np.interp(grid[..., 0], along, arc), grid[..., 1], inside))
        )
    return found


def _is_cut_off(x: FloatArray, y: FloatArray, cut: tuple[tuple[int, int], float, float]) -> NDArray[np.bool_]:
    (right, top), along_x, along_y = cut
    return np.asarray((1 - x if right else x) / along_x + (1 - y if top else y) / along_y < 1)


def _electrode_of_nodes(network: ElectrodeNetwork, x: FloatArray, y: FloatArray) -> NDArray[np.intp]:
    """Return the index of the electrode at each node, -1 for none."""
    owner = np.full(x.shape, -1)
    for number, electrode in enumerate(network.electrodes):
        along, length = (y, network.b) if electrode.side in ("x0", "xa") else (x, network.a)
        on_side = {"x0": x == 0, "xa": x == 1, "y0": y == 0, "yb": y == 1}[electrode.side]
        owner[on_side & (along * length >= electrode.start) & (along * length <= electrode.stop)] = number
    return owner


def _electrode_shares(
    network: ElectrodeNetwork,
    owner: NDArray[np.intp],
    x: FloatArray,
    y: FloatArray,
    cut: tuple[tuple[int, int], float, float] | None,
) -> FloatArray:
    """Return potentials (4, nodes, nodes) with one electrode at 1: its share of a contact's current there."""
    n = owner.shape[0]
    index = np.arange(n * n).reshape(n, n)
    rows, columns, values = [], [], []
    for axis, ratio in ((0, network.b / network.a), (1, network.a / network.b)):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(2))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(2))
        edge = np.full(index[low].shape, ratio)
        ends = (slice(None), [0, -1]) if axis == 0 else ([0, -1], slice(None))
        edge[ends] /= 2  # along the rim, the sheet is on one side only
        if cut is not None:
            beyond = _is_cut_off((x[low] + x[high]) / 2, (y[low] + y[high]) / 2, cut)
            edge[beyond] *= _CUT_CONDUCTIVITY
        rows.append(index[low].ravel())
        columns.append(index[high].ravel())
        values.append(edge.ravel())
    i, j, g = (np.concatenate(v) for v in (rows, columns, values))
    matrix = sparse.coo_matrix((np.r_[g, g], (np.r_[i, j], np.r_[j, i])), shape=(n * n, n * n)).tocsc()
    laplacian = sparse.diags(np.asarray(matrix.sum(axis=1)).ravel()).tocsc() - matrix
    held = owner.ravel() >= 0
    fixed = (owner.ravel()[held][:, None] == np.arange(4)).astype(np.float64)
    free = splu(laplacian[~held][:, ~held].tocsc()).solve(-(laplacian[~held][:, held] @ fixed))
    potentials = np.zeros((n * n, 4))
    potentials[held], potentials[~held] = fixed, free
    return potentials.T.reshape(4, n, n)
