"""Sheet with a corner cut off, solved by finite elements on the remaining area.

Public names: `cut_sheet_maps`, `is_beyond_cut`. `handtouch.simulate.sheet_solver` solves the intact sheet.
Here the cut and the intact sheet are solved with the same coarser elements, and their difference is added to
the fine solution, so that the result is continuous as the cut vanishes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.simulate.coarse_sheet import CoarseGrid, CoarseSolution
from handtouch.simulate.mesh_geometry import SimulatedMesh
from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import ElectrodeGaps, SheetMaps

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
