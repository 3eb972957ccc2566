"""Fabrication drawing of a pad: sheet, electrodes, their tails to a connector, and dimensions.

Public name: `fabrication_drawing`.

Electrodes are strips on the margin outside the sensing area. A tail leaves each in its middle and runs on a
frame around the sheet to the connector beside electrode x0; tails of electrodes farther from the connector
run farther outside, so that none crosses another.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.design.drawing import LayeredDrawing
from handtouch.design.flat_pattern import FlatPattern, offset
from handtouch.design.layout import RING_OF_SIDES, ElectrodeLayout
from handtouch.design.pad_task import PadTask

MARGIN_MM = 3.0
"""Width of the electrodes, outside the sensing area."""
_TRACE_MM, _PITCH_MM = 0.8, 1.6
_CONNECTOR_PITCH_MM, _CONNECTOR_PAD_MM = 2.54, (4.0, 1.6)
_TAIL_MM = 12.0  # from the frame to the connector
_CUT_MM = 1.2  # film outside the outermost tail


def electrode_names(task: PadTask, layout: ElectrodeLayout) -> list[str]:
    """Return names of electrodes: of their sides, or e1, e2 ... counter-clockwise."""
    if layout.is_on_sides(task.boundary):
        return list(RING_OF_SIDES)
    return [f"e{number}" for number in range(1, layout.count + 1)]


def fabrication_drawing(task: PadTask, layout: ElectrodeLayout) -> LayeredDrawing:
    """Return the drawing of a layout on its flat pattern."""
    pattern = FlatPattern(task.surface, task.boundary)
    drawing = LayeredDrawing(f"{task.pad.link}: electrodes of an area touch sensor, mm")
    drawing.line("SHEET", pattern.outline)
    names = electrode_names(task, layout)
    leads = []
    for start, stop in layout.stretches_m:
        band = pattern.band(start, stop, MARGIN_MM)
        drawing.line("ELECTRODES", band)
        middle = pattern.stretch((start + stop) / 2 - 1e-5, (start + stop) / 2 + 1e-5)
        foot = offset(middle, MARGIN_MM)[0]
        leads.append((foot, foot - middle[0]))
    low, high = _frame(drawing)
    _draw_tails(drawing, leads, names, low, high)
    _draw_dimensions(drawing, pattern.outline, high)
    _draw_table(drawing, task, layout, names, pattern.note)
    return drawing


def _frame(drawing: LayeredDrawing) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest corner of what is drawn so far."""
    points = np.concatenate([points for _, points in drawing.lines])
    return points.min(axis=0), points.max(axis=0)


def _draw_tails(
    drawing: LayeredDrawing,
    leads: list[tuple[FloatArray, FloatArray]],
    names: list[str],
    low: FloatArray,
    high: FloatArray,
) -> None:
    """Draw tails, connector and the cut around all."""
    centre = (low + high) / 2
    upper = [number for number, (foot, _) in enumerate(leads) if foot[1] >= centre[1]]
    lower = [number for number in range(len(leads)) if number not in upper]
    # from the connector outwards: along side x0 first, then by x along the upper and the lower edge
    ranked = [sorted(half, key=lambda n: _distance(leads[n], low, high)) for half in (upper, lower)]
    lanes = max(len(half) for half in ranked)
    left = low[0] - _PITCH_MM * (lanes + 1)
    end = left - _TAIL_MM
    slots = [*ranked[0][::-1], *ranked[1]]  # from top to bottom
    top = centre[1] + _CONNECTOR_PITCH_MM * (len(slots) - 1) / 2
    for number, name in enumerate(names):
        foot, outward = leads[number]
        half = ranked[0] if number in upper else ranked[1]
        sign = 1.0 if number in upper else -1.0
        reach = _PITCH_MM * (half.index(number) + 1)
        y = top - _CONNECTOR_PITCH_MM * slots.index(number)
        edge_y = high[1] + reach if sign > 0 else low[1] - reach
        way: list[Any] = [foot - outward / 3]  # on the electrode
        if abs(outward[1]) >= abs(outward[0]):
            way += [(foot[0], edge_y), (low[0] - reach, edge_y)]
        elif outward[0] > 0:
            way += [(high[0] + reach, foot[1]), (high[0] + reach, edge_y), (low[0] - reach, edge_y)]
        else:
            way += [(low[0] - reach, foot[1])]
        way += [(low[0] - reach, y), (end, y)]
        drawing.line("TAILS", _widened(np.array(way)))
        length, width = _CONNECTOR_PAD_MM
        drawing.line("CONNECTOR", _rectangle(end - length, y - width / 2, end, y + width / 2))
        drawing.text("TEXT", end - length - 3.0, y - 0.6, name)
    around = _PITCH_MM * lanes + _CUT_MM
    lowest, highest = low - around, high + around
    tab = _CONNECTOR_PITCH_MM * len(slots) / 2 + 0.6
    tip = end - _CONNECTOR_PAD_MM[0] - 0.5
    drawing.line(
        "CUT",
        [
            lowest,
            (highest[0], lowest[1]),
            highest,
            (lowest[0], highest[1]),
            (lowest[0], centre[1] + tab),
            (tip, centre[1] + tab),
            (tip, centre[1] - tab),
            (lowest[0], centre[1] - tab),
            lowest,
        ],
    )


def _distance(lead: tuple[FloatArray, FloatArray], low: FloatArray, high: FloatArray) -> float:
    """Return the length of the way along the frame from the middle of its left edge to a tail's begin."""
    (x, y), outward = lead
    width, half = high[0] - low[0], (high[1] - low[1]) / 2
    aside = abs(y - low[1] - half)
    if abs(outward[1]) >= abs(outward[0]):
        return float(half + x - low[0])
    return float(2 * half + width - aside if outward[0] > 0 else aside)


def _widened(way: FloatArray) -> FloatArray:
    """Return the outline of a trace along a way."""
    keep = np.append(True, np.hypot(*np.diff(way, axis=0).T) > 1e-9)
    way = way[keep]
    right, left = (offset(way, side * _TRACE_MM / 2) for side in (1, -1))
    return np.concatenate([right, left[::-1], right[:1]])


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]


def _draw_dimensions(drawing: LayeredDrawing, outline: FloatArray, high: FloatArray) -> None:
    """Draw length and width of the sensing area."""
    (x0, y0), (x1, y1) = outline.min(axis=0), outline.max(axis=0)
    _, cut_high = _frame(drawing)
    y, x = cut_high[1] + 3.0, cut_high[0] + 3.0
    drawing.dimension((x0, y), (x1, y), f"{x1 - x0:.2f}")
    drawing.dimension((x, y0), (x, y1), f"{y1 - y0:.2f}")
    for end in (x0, x1):
        drawing.line("DIMENSIONS", [(end, high[1]), (end, y + 1)])
    for end in (y0, y1):
        drawing.line("DIMENSIONS", [(high[0], end), (x + 1, end)])


def _draw_table(
    drawing: LayeredDrawing, task: PadTask, layout: ElectrodeLayout, names: list[str], note: str
) -> None:
    """Write what each electrode measures below the drawing."""
    low, _ = _frame(drawing)
    gaps = layout.gaps_m(task.boundary)
    lines = [
        f"{task.pad.link}: x0 on the left, yb above; sensing area {note}",
        f"electrodes {MARGIN_MM:g} mm wide outside of it; sheet {task.sheet.ohm_per_square:g} ohm per square",
        "lengths in mm along the edge, counter-clockwise from the corner of x0 and y0:",
    ]
    for name, (start, stop), length, gap, ohm in zip(
        names, layout.stretches_m, layout.lengths_m, gaps, layout.series_ohm, strict=True
    ):
        resistor = f", {ohm:g} ohm in series" if ohm else ""
        lines.append(
            f"{name}: {1e3 * start:.2f} to {1e3 * stop:.2f}, long {1e3 * length:.2f}, then bare "
            f"{1e3 * gap:.2f}{resistor}"
        )
    for number, line in enumerate(lines, 1):
        drawing.text("TEXT", float(low[0]), float(low[1]) - 3.0 * number, line)
