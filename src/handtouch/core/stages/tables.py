"""Bicubic tables of smooth functions on a pad: values and first derivatives at any point; and with those of
its surface, a contact's position, normal and arc lengths in its link's frame.

A table holds, at each node of a square grid, the value of each column and its derivatives along both axes and
across, per cell. Between the nodes it is the bicubic Hermite polynomial of these.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from handtouch.core.memory import view_memory
from handtouch.core.pad_tables import hermite_table

if TYPE_CHECKING:
    from handtouch.arrays import FloatArray
    from handtouch.field.surface_base import Surface

_COLUMNS = 6  # of a surface
_SURFACE_CELLS = (8, 16, 32, 64)
_MAX_SURFACE_ERROR = 1e-7
"""Error between the nodes over a pad's size."""
_MAX_LOG_SCALE = 2.0  # of a contact, from its median; it vanishes at an outline's vertices


def read_table(
    table: memoryview[float], first: int, cells: int, columns: int, s: float, t: float, out: memoryview[float]
) -> None:
    """Write the values of all columns at (s, t), their derivatives by s and by t into `out`, (3 columns,).

    table: nodes in rows along t, each with its columns' values, derivatives by s, by t and by both, from
    index `first` on. s, t: in cells, 0 to `cells`.
    """
    i, j = int(s), int(t)
    if i > cells - 1:
        i = cells - 1
    if j > cells - 1:
        j = cells - 1
    p, q = s - i, t - j
    # cubic Hermite functions of both nodes' values (v, w) and slopes (d, e), and their derivatives
    v1 = p * p * (3.0 - 2.0 * p)
    v0 = 1.0 - v1
    d0, d1 = p * (1.0 - p) * (1.0 - p), p * p * (p - 1.0)
    v1_s = 6.0 * p * (1.0 - p)
    d0_s, d1_s = (1.0 - p) * (1.0 - 3.0 * p), p * (3.0 * p - 2.0)
    w1 = q * q * (3.0 - 2.0 * q)
    w0 = 1.0 - w1
    e0, e1 = q * (1.0 - q) * (1.0 - q), q * q * (q - 1.0)
    w1_t = 6.0 * q * (1.0 - q)
    e0_t, e1_t = (1.0 - q) * (1.0 - 3.0 * q), q * (3.0 * q - 2.0)
    node = 4 * columns
    near = first + (j * (cells + 1) + i) * node
    far = near + (cells + 1) * node
    for c in range(columns):
        a = near + c
        b = a + node
        # along s at both rows of nodes: values, derivatives by s, and those of the slopes by t
        row0 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        row0_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a += 2 * columns
        b += 2 * columns
        slope0 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        slope0_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a = far + c
        b = a + node
        row1 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        row1_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a += 2 * columns
        b += 2 * columns
        slope1 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        slope1_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        out[c] = w0 * row0 + w1 * row1 + e0 * slope0 + e1 * slope1
        out[columns + c] = w0 * row0_s + w1 * row1_s + e0 * slope0_s + e1 * slope1_s
        out[2 * columns + c] = w1_t * (row1 - row0) + e0_t * slope0 + e1_t * slope1


def read_values(
    table: memoryview[float], cells: int, columns: int, s: float, t: float, out: memoryview[float]
) -> None:
    """Write the values of all columns at (s, t) of a table in single precision into `out`, (columns,); see
    `read_table`."""
    i, j = int(s), int(t)
    if i > cells - 1:
        i = cells - 1
    if j > cells - 1:
        j = cells - 1
    p, q = s - i, t - j
    v1, w1 = p * p * (3.0 - 2.0 * p), q * q * (3.0 - 2.0 * q)
    v0, w0 = 1.0 - v1, 1.0 - w1
    d0, d1 = p * (1.0 - p) * (1.0 - p), p * p * (p - 1.0)
    e0, e1 = q * (1.0 - q) * (1.0 - q), q * q * (q - 1.0)
    # weights of a node's value and its slopes: near or far along s (0, 1), then near or far along t
    v00, s00, t00, b00 = v0 * w0, d0 * w0, v0 * e0, d0 * e0
    v10, s10, t10, b10 = v1 * w0, d1 * w0, v1 * e0, d1 * e0
    v01, s01, t01, b01 = v0 * w1, d0 * w1, v0 * e1, d0 * e1
    v11, s11, t11, b11 = v1 * w1, d1 * w1, v1 * e1, d1 * e1
    near = 4 * columns * (j * (cells + 1) + i)
    for c in range(columns):
        a = near + c
        value = v00 * table[a] + s00 * table[a + columns]
        value += t00 * table[a + 2 * columns] + b00 * table[a + 3 * columns]
        a += 4 * columns
        value += v10 * table[a] + s10 * table[a + columns]
        value += t10 * table[a + 2 * columns] + b10 * table[a + 3 * columns]
        a += 4 * columns * cells
        value += v01 * table[a] + s01 * table[a + columns]
        value += t01 * table[a + 2 * columns] + b01 * table[a + 3 * columns]
        a += 4 * columns
        value += v11 * table[a] + s11 * table[a + columns]
        value += t11 * table[a + 2 * columns] + b11 * table[a + 3 * columns]
        out[c] = value


class PadSurface:
    """Surface of one pad in its link's frame, in smooth patches that meet at folds across y.

    surface: `rotation` (3, 3) and `translation` (3,) carry its pad frame to the link's.
    nodes: (patches, cells + 1, cells + 1, 4, 6), one table a patch, as `read_table` needs them, of
    `patch_floats` floats each; columns are position (3) [m], arc lengths from the electrodes x0 and y0 (2)
    [m] and ln of a contact's scale, on an even grid. ends: (patches,), where each patch ends along y. side_x:
    of the pad's rectangle. curvature: Gauss's [1/m^2].
    """

    def __init__(self, surface: Surface, rotation: FloatArray, translation: FloatArray) -> None:
        self.nodes, ends = _tabulate_patches(surface, rotation, translation)
        self.values, self.ends = view_memory(self.nodes), view_memory(ends)
        self.cells, self.patch_floats = self.nodes.shape[1] - 1, self.nodes[0].size
        self.patches, self.side_x = len(ends), surface.a
        self.curvature = _mean_curvature_per_m2(surface)

    def __deepcopy__(self, _: object) -> PadSurface:
        """Return itself, which never changes: copies of a model share it."""
        return self


def _tabulate_patches(
    surface: Surface, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the tables of a surface's patches, and where each ends along y; see `PadSurface`."""
    ends = np.append(surface.folds, surface.b)
    begins = np.append(0.0, surface.folds)

    def evaluate(cells: int, inside: FloatArray) -> FloatArray:
        """Return values (patches, y, x, 6) at nodes or, `inside` of cells, between them."""
        s = inside / cells
        patches = []
        for begin, end in zip(begins, ends, strict=True):
            # a hair inside: on a fold, the surface is that of the next patch
            y_inside = begin + (end - begin) * np.clip(s, 1e-12, 1 - 1e-12)
            x, y = np.meshgrid(surface.a * s, y_inside)
            position = np.tensordot(rotation, surface.point(x, y), axes=1) + translation[:, None, None]
            log_scale = np.log(surface.scale(x, y))
            log_scale = np.clip(log_scale, *(np.median(log_scale) + _MAX_LOG_SCALE * np.array([-1, 1])))
            columns = [*position, *surface.from_rectangle(x, y), log_scale]
            patches.append(np.stack(columns, axis=-1))
        return np.stack(patches)

    size = max(surface.extent_m)
    for cells in _SURFACE_CELLS:
        nodes = np.stack([hermite_table(patch) for patch in evaluate(cells, np.arange(cells + 1.0))])
        between = evaluate(cells, np.arange(0.5, cells))
        error = np.abs(_mid_cell_values(nodes) - between)[..., :5]
        if error.max() < _MAX_SURFACE_ERROR * size:
            break
    return np.ascontiguousarray(nodes), ends


def _mean_curvature_per_m2(surface: Surface) -> float:
    """Return Gauss's curvature about a surface's middle: -laplace(ln scale) / scale^2 on the rectangle."""
    x, y, radius = surface.a / 2, surface.b / 2, min(surface.a, surface.b) / 8
    angle = np.arange(8) * np.pi / 4
    around = np.log(surface.scale(x + radius * np.cos(angle), y + radius * np.sin(angle))).mean()
    middle = float(surface.scale(x, y))
    return float(4 * (np.log(middle) - around) / (radius * middle) ** 2)


def _mid_cell_values(nodes: FloatArray) -> FloatArray:
    """Return the bicubics (..., y, x, columns) in the middle of the cells."""

    def middle(value: FloatArray, slope: FloatArray, axis: int) -> FloatArray:
        low, high = [slice(None)] * value.ndim, [slice(None)] * value.ndim
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        of_slopes = (slope[tuple(low)] - slope[tuple(high)]) / 8
        return np.asarray((value[tuple(low)] + value[tuple(high)]) / 2 + of_slopes)

    value, by_x, by_y, by_both = np.moveaxis(nodes, -2, 0)
    x_axis = value.ndim - 2
    return middle(middle(value, by_x, x_axis), middle(by_y, by_both, x_axis), x_axis - 1)


class Placement:
    """A contact in its link's frame. `raw` (18,): what was read from the table."""

    def __init__(self) -> None:
        self.raw = view_memory(np.zeros(3 * _COLUMNS))
        self.u_m = self.v_m = 0.0
        self.px = self.py = self.pz = 0.0
        self.nx = self.ny = self.nz = 0.0
        self.tx = self.ty = self.tz = 0.0  # tangents along x and y, metres per unit of the rectangle
        self.wx = self.wy = self.wz = 0.0
        self.along_m = self.around_m = 1.0  # their lengths
        self.scale_m = 1.0  # a contact's radius on the surface over that on the rectangle,
        self.slope_x = self.slope_y = 0.0  # and the derivatives of its logarithm


def place_contact(surface: PadSurface, placement: Placement, x: float, y: float) -> None:
    """Place a contact at (x, y) of the rectangle on the surface."""
    cells, patch = surface.cells, 0
    begin = 0.0
    while patch < surface.patches - 1 and y >= surface.ends[patch]:
        begin = surface.ends[patch]
        patch += 1
    per_x, per_y = cells / surface.side_x, cells / (surface.ends[patch] - begin)
    s, t = max(0.0, min(1.0 * cells, x * per_x)), max(0.0, min(1.0 * cells, (y - begin) * per_y))
    raw = placement.raw
    read_table(surface.values, patch * surface.patch_floats, cells, _COLUMNS, s, t, raw)
    placement.px, placement.py, placement.pz = raw[0], raw[1], raw[2]
    placement.u_m, placement.v_m = raw[3], raw[4]
    tx, ty, tz = raw[6] * per_x, raw[7] * per_x, raw[8] * per_x
    wx, wy, wz = raw[12] * per_y, raw[13] * per_y, raw[14] * per_y
    placement.slope_x, placement.slope_y = raw[11] * per_x, raw[17] * per_y
    nx, ny, nz = ty * wz - tz * wy, tz * wx - tx * wz, tx * wy - ty * wx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    placement.nx, placement.ny, placement.nz = nx / length, ny / length, nz / length
    along, around = math.sqrt(tx * tx + ty * ty + tz * tz), math.sqrt(wx * wx + wy * wy + wz * wz)
    placement.along_m, placement.around_m = along, around
    placement.scale_m = 2.0 * along * around / (along + around)
    placement.tx, placement.ty, placement.tz = tx, ty, tz
    placement.wx, placement.wy, placement.wz = wx, wy, wz
