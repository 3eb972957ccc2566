"""Sheet whose resistance varies from place to place.

Public name: `uneven_sheet_maps`.

The shares of the electrodes and the conductances between them are those of the uneven sheet. The resistance
of a contact of radius A is that of the layer on a sheet of the local resistance, and
rho(P) / 2 pi ln(R / A) of the sheet around it, where R is the table's conformal radius: it follows from the
resistances of a smeared source on the uneven and on the even sheet, whose difference hardly depends on the
source's size: 1e-3 of ln R where the resistance varies by 20 %, 3e-3 by 100 %.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from handtouch.simulate.coarse_sheet import CoarseGrid
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
from handtouch.simulate.spectral_elements import lobatto_nodes
from handtouch.simulate.unevenness import Unevenness

_DEGREE = 8
_NODES = 0.5 + (0.5 - EDGE_INSET_FRACTION) * lobatto_nodes(_DEGREE)
_TO_TABLE = np.linalg.solve(  # interpolates values at the nodes to the tables' nodes
    np.polynomial.legendre.legvander(2 * _NODES - 1, _DEGREE).T,
    np.polynomial.legendre.legvander(2 * TABLE_NODES - 1, _DEGREE).T,
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
