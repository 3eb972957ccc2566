"""Tolerances of a pad's parts as a deployment states them, for the stages.

Public names: `stage_tolerances`, `shape_error`, `overhangs`, `OVERHANG_STEP`.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config.channels import channel_states
from handtouch.core.memory import view_memory
from handtouch.core.pad_tables import CELLS_PER_TOLERANCE_CELL, ForwardTable
from handtouch.core.stages.tolerances import PadTolerances
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.hand.pads import (
    log_aspect_std,
    metres_per_unit,
    pad_surface,
    relative_size_stds,
    series_ohm_stds,
)

FloatArray = NDArray[np.float64]
_M_PER_MM = 1e-3
OVERHANG_STEP = 1 / 16
_STATE_STD = 0.08
"""Standard deviation of the logarithm of a contact's current in one state of a schedule, by its force."""
_STATE_GRID = (np.arange(12) + 0.5) / 12
_MARGIN = 0.1  # of the sides, of typical contacts
_MIN_SERIES_STD = 1e-6  # relative; that of the sheet resistance is in multiples of it
_OVERHANGS, _DIRECTIONS, _SEGMENT_POINTS = 33, 8, 24


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
    end_stds = sheet.gap_std_mm * _M_PER_MM / metres_per_unit(pad, network)
    end_vectors = np.ascontiguousarray(end_stds[:, None] * table.end_vectors)
    series_ohm = np.array(pad.series_ohm)
    series_stds = np.maximum(series_ohm_stds(pad, node), _MIN_SERIES_STD * series_ohm)
    series_vectors = np.ascontiguousarray(series_stds[:, None] * table.series_vectors)
    has_series = bool(series_vectors.any())
    by_sheet = sheet.ohm_per_square_std * series_ohm / np.where(series_stds > 0, series_stds, 1.0)
    elongations = _elongations(sheet, surface, table.nodes_x[::CELLS_PER_TOLERANCE_CELL, 0])
    is_elongated = bool(elongations.any())
    radius_m = math.hypot(sheet.contact_radius_mm, sheet.contact_radius_std_mm) * _M_PER_MM
    return PadTolerances(
        view_memory(table.tolerance_nodes),
        len(table.tolerance_nodes) - 1,
        1 / CELLS_PER_TOLERANCE_CELL,
        view_memory(end_vectors),
        aspect_std,
        sheet.unevenness_std,
        view_memory(series_vectors),
        view_memory(by_sheet),
        has_series,
        surface.extent_m[0] / 2,
        size_x,
        size_y,
        view_memory(elongations),
        view_memory(radius_m * overhangs(sheet.contact_elongation_std)),
        radius_m * OVERHANG_STEP,
        is_elongated,
        sheet.contact_tilt_std,
        math.sinh(sheet.contact_elongation_std),
        pad.state_count,
        view_memory(np.array(channel_states(pad) or [0] * len(pad.electrode_names), dtype=np.intp)),
        _STATE_STD if pad.switch_states else 0.0,
        _state_ohm_std(network) / node.drive_v,
        not (end_vectors.any() or aspect_std or sheet.unevenness_std or has_series or is_elongated),
    )


def _state_ohm_std(network: ElectrodeNetwork) -> float:
    """Return the root mean square, over the pad, of what a contact's resistance to ground differs by between
    the states of its schedule [ohm]; 0 without one."""
    if not network.states:
        return 0.0
    x, y = np.meshgrid(network.a * _STATE_GRID, network.b * _STATE_GRID)
    return math.sqrt(network.state_resistance(x, y).var(axis=0).mean())


@cache
def overhangs(elongation_std: float) -> FloatArray:
    """Return the root mean square shift (k,) of positions found at multiples of `OVERHANG_STEP` from an edge.

    In contact radii. elongation_std: of the logarithm of length over width. The current of an elliptical
    patch is that of the segment between its foci with the density (1 - t^2)^(1/2); what hangs over an edge
    enters at the edge. So the centre of the current, which is the position found, is farther inside than the
    patch's, which is equally likely anywhere on the pad, in any direction.
    """
    deviations = np.linspace(-3.5, 3.5, 36)
    ratio = np.exp(elongation_std * np.abs(deviations))
    directions = (np.arange(_DIRECTIONS) + 0.5) * np.pi / 2 / _DIRECTIONS
    reach = np.outer(np.sqrt(ratio - 1 / ratio), np.cos(directions)).ravel()
    angles = np.pi * np.arange(1, _SEGMENT_POINTS + 1) / (_SEGMENT_POINTS + 1)
    points, share = np.cos(angles)[:, None], np.sin(angles) ** 2 / (np.sin(angles) ** 2).sum()
    found_at = OVERHANG_STEP * np.arange(_OVERHANGS)
    centre = np.linspace(0.0, found_at[-1], 8 * _OVERHANGS)
    square, weight = np.zeros((2, _OVERHANGS))
    for length, likely in zip(reach, np.repeat(np.exp(-0.5 * deviations**2), _DIRECTIONS), strict=True):
        found = share @ np.maximum(centre + length * points, 0.0)
        shift = np.interp(found_at, found, found - centre, left=0.0)
        # no patch of this length is found nearer than one on the edge
        density = np.interp(found_at, found, np.gradient(centre, found), left=0.0)
        square += likely * density * shift**2
        weight += likely * density
    return np.asarray(np.sqrt(square / np.maximum(weight, 1e-300)))


def shape_error(pad: config.Pad, sheet: config.Sheet, table: ForwardTable) -> float:
    """Return a typical standard deviation of a fraction by contacts that are elongated as stated."""
    x, y = (nodes[::CELLS_PER_TOLERANCE_CELL, 0] for nodes in (table.nodes_x, table.nodes_y))
    second = table.tolerance_nodes[:, :, 0, -2 * table.electrodes :].astype(np.float64)
    square = (second**2).sum(axis=2) / table.electrodes * _elongations(sheet, pad_surface(pad), x) ** 2
    inside = [(at > _MARGIN * at[-1]) & (at < (1 - _MARGIN) * at[-1]) for at in (y, x)]
    return float(np.sqrt(np.median(square[np.ix_(*inside)])))


def _elongations(sheet: config.Sheet, surface: Surface, x: FloatArray) -> FloatArray:
    """Return half the standard deviation of the difference of variances of a contact's current, at x (k,).

    Along the rectangle's axes, in squares of its unit, of elliptical patches of pressure in all directions.
    """
    area_m2 = (sheet.contact_radius_mm**2 + sheet.contact_radius_std_mm**2) * _M_PER_MM**2
    difference_m2 = area_m2 / 4 * 2 * math.sinh(sheet.contact_elongation_std)
    inside = np.clip(x, 1e-6 * surface.a, (1 - 1e-6) * surface.a)
    along_x, along_y = surface.scales(inside, np.full(len(x), surface.b / 2))
    return np.ascontiguousarray(difference_m2 / (2 * math.sqrt(2)) / (along_x * along_y))
