"""Changes of the electrodes' current shares by cuts of the sheet: finite differences.

Public: `SheetChanges`. The whole and the cut sheet are solved on one coarse grid of the rectangle; only
their difference is used, in which most of the grid's error cancels. The currents i of electrodes with series
resistors R, at the shares f of grounded electrodes and the conductance G between them, are (1 + G R)^-1 f.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import splu

from handtouch.arrays import FloatArray
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface_base import Surface

_CELLS_PER_SIDE = 40  # a side
_CUT_CONDUCTIVITY = 1e-9  # beyond the cut, relative
_OPEN_OHM = 1e12
_MIRRORED_ELECTRODES = np.array([0, 1, 3, 2, -1])  # electrodes with y reversed
CORNERS = {("x0", "y0"): (0, 0), ("x0", "yb"): (0, 1), ("xa", "y0"): (1, 0), ("xa", "yb"): (1, 1)}


class SheetChanges:
    """Changes of the shares at a grid of positions, `at` (k,) and (l,) fractions of the sides of a pad's
    rectangle along x and y."""

    def __init__(
        self, network: ElectrodeNetwork, surface: Surface, at: tuple[FloatArray, FloatArray]
    ) -> None:
        self._network = network
        nodes = np.linspace(0, 1, _CELLS_PER_SIDE + 1)
        x, y = np.meshgrid(nodes, nodes, indexing="ij")
        along = np.linspace(0, 1, 8 * _CELLS_PER_SIDE + 1)
        arc = surface.from_rectangle(along * network.a, 0 * along)[0] / surface.extent_m[0]
        self._x, self._y = np.interp(x, along, arc), y
        self._owner = _electrode_of_nodes(network, x, y)
        grid = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1)
        self._at = np.interp(grid[..., 0], along, arc), grid[..., 1]
        self._grid, self._nodes = grid, nodes
        self._series_ohm = np.minimum(network.series_ohm, _OPEN_OHM)
        self._even = self._shares(lambda x, _: np.ones(x.shape))

    def by_cuts(
        self, cuts: Iterable[tuple[tuple[int, int], float, float]]
    ) -> Iterator[tuple[FloatArray, NDArray[np.bool_]]]:
        """Yield the change (k, l, 4), x first, by each cut, and a mask of the positions beyond it.

        cuts: corner (0 or 1 along x, y), fractions of the sides. A cut is straight in arc length and angle.
        """
        symmetric = bool((_MIRRORED_ELECTRODES[self._owner[:, ::-1]] == self._owner).all())
        symmetric &= bool((self._series_ohm[_MIRRORED_ELECTRODES[:4]] == self._series_ohm).all())
        computed: dict[tuple[int, float, float], FloatArray] = {}
        for cut in cuts:
            (right, _), along_x, along_y = cut
            key = right, along_x, along_y
            if symmetric and key in computed:
                change = computed.pop(key)[_MIRRORED_ELECTRODES[:4], :, ::-1]
            else:
                change = computed[key] = self._cut_change(cut)
            yield self._sample(change), _is_cut_off(*self._at, cut)

    def _cut_change(self, cut: tuple[tuple[int, int], float, float]) -> FloatArray:
        return (
            self._shares(lambda x, y: np.where(_is_cut_off(x, y, cut), _CUT_CONDUCTIVITY, 1.0)) - self._even
        )

    def _sample(self, change: FloatArray) -> FloatArray:
        nodes = self._nodes
        return np.asarray(RegularGridInterpolator((nodes, nodes), np.moveaxis(change, 0, -1))(self._grid))

    def _shares(self, conductivity: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
        """Return each electrode's share (4, nodes, nodes) of a contact's current.

        With all electrodes grounded, it is the potential with that electrode at 1.
        """
        x, y, n = self._x, self._y, len(self._x)
        index = np.arange(n * n).reshape(n, n)
        rows, columns, values = [], [], []
        ratios = self._network.b / self._network.a, self._network.a / self._network.b
        for axis, ratio in enumerate(ratios):
            low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(2))
            high = tuple(slice(1, None) if k == axis else slice(None) for k in range(2))
            edge = np.full(index[low].shape, ratio)
            ends = (slice(None), [0, -1]) if axis == 0 else ([0, -1], slice(None))
            edge[ends] /= 2  # along the rim, the sheet is on one side only
            edge *= conductivity((x[low] + x[high]) / 2, (y[low] + y[high]) / 2)
            rows.append(index[low].ravel())
            columns.append(index[high].ravel())
            values.append(edge.ravel())
        i, j, g = (np.concatenate(v) for v in (rows, columns, values))
        matrix = sparse.coo_matrix((np.r_[g, g], (np.r_[i, j], np.r_[j, i])), shape=(n * n, n * n)).tocsc()
        laplacian = sparse.diags(np.asarray(matrix.sum(axis=1)).ravel()).tocsc() - matrix
        held = self._owner.ravel() >= 0
        fixed = (self._owner.ravel()[held][:, None] == np.arange(4)).astype(np.float64)
        free = splu(laplacian[~held][:, ~held].tocsc()).solve(-(laplacian[~held][:, held] @ fixed))
        potentials = np.zeros((n * n, 4))
        potentials[held], potentials[~held] = fixed, free
        if self._series_ohm.any():
            conductance = potentials.T @ (laplacian @ potentials) / self._network.sheet_ohm_per_square
            potentials = np.linalg.solve(np.eye(4) + conductance * self._series_ohm, potentials.T).T
        return potentials.T.reshape(4, n, n)


def _is_cut_off(x: FloatArray, y: FloatArray, cut: tuple[tuple[int, int], float, float]) -> NDArray[np.bool_]:
    (right, top), along_x, along_y = cut
    return np.asarray((1 - x if right else x) / along_x + (1 - y if top else y) / along_y < 1)


def _electrode_of_nodes(network: ElectrodeNetwork, x: FloatArray, y: FloatArray) -> NDArray[np.intp]:
    """Return the index of the electrode at each node, -1 for none."""
    a, b = network.a, network.b
    owner = np.full(x.shape, -1)
    sides = ((y == 0, a * x), (x == 1, a + b * y), (y == 1, 2 * a + b - a * x), (x == 0, 2 * (a + b) - b * y))
    for on_side, position in sides:
        owner[on_side] = np.maximum(owner[on_side], network.electrode_at(position[on_side]))
    return owner
