"""Tolerances of a pad's parts as a deployment states them, for the stages.

Public names: `stage_tolerances`.
"""

from __future__ import annotations

import numpy as np

from handtouch import config
from handtouch.core.pad_tables import CELLS_PER_TOLERANCE_CELL, ForwardTable, view_floats
from handtouch.core.stages.tolerances import PadTolerances
from handtouch.field.network import ElectrodeNetwork
from handtouch.hand.pads import log_aspect_std, pad_surface, relative_size_stds

_M_PER_MM = 1e-3


def stage_tolerances(
    pad: config.Pad,
    node: config.Node,
    sheet: config.Sheet,
    network: ElectrodeNetwork,
    table: ForwardTable,
) -> PadTolerances:
    """Return the tolerances of a pad, gains aside; `network` and `table` are the pad's."""
    surface = pad_surface(pad)
    size_x, size_y = relative_size_stds(pad, sheet)
    aspect_std = log_aspect_std(pad, sheet)
    end_stds = sheet.gap_std_mm * _M_PER_MM / np.array(_metres_per_unit(pad, network))
    end_vectors = np.ascontiguousarray(end_stds[:, None] * table.end_vectors)
    has_series = any(pad.series_ohm)
    return PadTolerances(
        view_floats(table.tolerance_nodes),
        len(table.tolerance_nodes) - 1,
        1 / CELLS_PER_TOLERANCE_CELL,
        view_floats(end_vectors),
        aspect_std,
        view_floats(table.series_vectors),
        node.series_std,
        sheet.ohm_per_square_std,
        has_series,
        surface.extent_m[0] / 2,
        size_x,
        size_y,
        not (end_vectors.any() or aspect_std or has_series),
    )


def _metres_per_unit(pad: config.Pad, network: ElectrodeNetwork) -> list[float]:
    """Return the length on the surface of a unit of the rectangle, along each electrode at each end."""
    surface, scales = pad_surface(pad), []
    for electrode in network.electrodes:
        for end in (electrode.start, electrode.stop):
            x, y = {
                "x0": (0.0, end),
                "xa": (network.a, end),
                "y0": (end, 0.0),
                "yb": (end, network.b),
            }[electrode.side]
            along_x, along_y = surface.scales(x, y)
            scales.append(float(along_x if electrode.side in ("y0", "yb") else along_y))
    return scales
