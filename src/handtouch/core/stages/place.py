"""Placement: a contact on a pad's rectangle to position, normal and arc lengths in its link's frame."""

from __future__ import annotations

import math

from handtouch.core.stages import tables

_COLUMNS = 5


class PadSurface:
    """Surface of one pad in its link's frame, in smooth patches that meet at folds across y.

    values: one table a patch, as `read_table` needs them, of `patch_floats` floats each, from index `first`
    on; columns are position (3) [m] and arc lengths from the electrodes x0 and y0 (2) [m], on an even grid.
    ends: (patches,), where each patch ends along y. side_x: of the pad's rectangle.
    """

    def __init__(
        self,
        values: memoryview[float],
        first: int,
        cells: int,
        patch_floats: int,
        ends: memoryview[float],
        side_x: float,
    ) -> None:
        self.values = values
        self.first = first
        self.cells = cells
        self.patch_floats = patch_floats
        self.ends = ends
        self.patches = len(ends)
        self.side_x = side_x


class Placement:
    """A contact in its link's frame. `raw` (15,): what was read from the table."""

    def __init__(self, raw: memoryview[float]) -> None:
        self.raw = raw
        self.u_m = self.v_m = 0.0
        self.px = self.py = self.pz = 0.0
        self.nx = self.ny = self.nz = 0.0
        self.tx = self.ty = self.tz = 0.0  # tangents along x and y, metres per unit of the rectangle
        self.wx = self.wy = self.wz = 0.0
        self.along_m = self.around_m = 1.0  # their lengths
        self.scale_m = 1.0  # a contact's radius on the surface over that on the rectangle


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
    tables.read_table(
        surface.values, surface.first + patch * surface.patch_floats, cells, _COLUMNS, s, t, raw
    )
    placement.px, placement.py, placement.pz = raw[0], raw[1], raw[2]
    placement.u_m, placement.v_m = raw[3], raw[4]
    tx, ty, tz = raw[5] * per_x, raw[6] * per_x, raw[7] * per_x
    wx, wy, wz = raw[10] * per_y, raw[11] * per_y, raw[12] * per_y
    nx, ny, nz = ty * wz - tz * wy, tz * wx - tx * wz, tx * wy - ty * wx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    placement.nx, placement.ny, placement.nz = nx / length, ny / length, nz / length
    along, around = math.sqrt(tx * tx + ty * ty + tz * tz), math.sqrt(wx * wx + wy * wy + wz * wz)
    placement.along_m, placement.around_m = along, around
    placement.scale_m = 2.0 * along * around / (along + around)
    placement.tx, placement.ty, placement.tz = tx, ty, tz
    placement.wx, placement.wy, placement.wz = wx, wy, wz
