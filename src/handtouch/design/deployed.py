"""A designed pad in its deployment file.

Public names: `pad_with_layout`, `deployment_text`.
"""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from handtouch import config
from handtouch.config.channels import parse_object
from handtouch.config.eds import EdsError
from handtouch.config.surfaces import SurfaceTable, surface_table
from handtouch.design.fabrication import electrode_names
from handtouch.design.layout import RING_OF_SIDES, ElectrodeLayout
from handtouch.design.pad_task import PadTask
from handtouch.field.outline_surface import OutlineSurface

_DIGITS = 4  # digits of lengths in mm
_OUTLINED = {"plane": "outline", "cylinder": "outline_on_cylinder"}
"""Kinds of surfaces that are also pads with a rectangular outline"""
_FILES_OF_HANDS, _FILES_OF_NODES, _FILES_OF_DAEMON = ("urdf",), ("eds",), ("keys", "store")


def pad_with_layout(task: PadTask, layout: ElectrodeLayout) -> config.Pad:
    """Return the pad's table with a layout, of electrodes anywhere on an outline.

    Raises ValueError where a deployment can't describe it.
    """
    if not layout.is_on_sides(task.boundary):
        return _pad_with_arcs(task, layout)
    corners = task.boundary.corners_m
    gaps = np.abs(layout.stretches_m - np.column_stack([corners[:-1], corners[1:]])) * 1e3
    by_side, ohm = {}, {}
    for side, pair, resistor in zip(RING_OF_SIDES, gaps.tolist(), layout.series_ohm.tolist(), strict=True):
        by_side[side] = pair if side in ("y0", "xa") else pair[::-1]
        ohm[side] = resistor
    least = round(min(map(min, by_side.values())), _DIGITS)
    sides = ("x0", "xa", "y0", "yb")
    offsets = [tuple(max(0.0, round(gap - least, _DIGITS)) for gap in by_side[side]) for side in sides]
    return task.pad.model_copy(
        update={
            "gap_mm": least,
            "gap_offsets_mm": tuple(offsets),
            "series_ohm": tuple(ohm[side] for side in sides),
        }
    )


def _pad_with_arcs(task: PadTask, layout: ElectrodeLayout) -> config.Pad:
    if task.pad.shear is not None:
        raise ValueError(
            f'an outline can\'t lie above a shear pad, and this pad has shear = "{task.pad.shear}"'
        )
    surface, first_mm = _outline_of(task)
    whole_mm = 1e3 * task.boundary.perimeter_m
    arcs = {}
    for name, (start, stop) in zip(electrode_names(task, layout), layout.stretches_m.tolist(), strict=True):
        begin = (1e3 * start + first_mm) % whole_mm
        arcs[name] = (round(begin, _DIGITS), round(begin + 1e3 * (stop - start), _DIGITS))
    return task.pad.model_copy(
        update={
            "node": _node_name(task, layout.count),
            "surface": surface,
            "gap_mm": 0.0,
            "gap_offsets_mm": ((0.0, 0.0),) * layout.count,
            "electrodes": tuple(arcs),
            "electrode_arcs_mm": arcs,
            "series_ohm": tuple(layout.series_ohm.tolist()),
        }
    )


def _outline_of(task: PadTask) -> tuple[SurfaceTable, float]:
    """Return the pad's surface with an outline, and the length [mm] along it of the corner x0, y0."""
    table, kind = task.pad.surface, task.pad.surface.kind
    built = table.build()
    if isinstance(built, OutlineSurface):
        return table, 1e3 * built.corners_m[0]
    if kind not in _OUTLINED or table.resistivity_ratio != 1:
        *others, last = sorted(_OUTLINED)
        raise ValueError(
            f"a deployment describes electrodes anywhere on pads with an outline, and on those whose "
            f"surface.kind is {', '.join(others)} or {last}; this pad's is {kind}"
        )
    x, y = (1e3 * np.diff(task.boundary.corners_m)[:2]).round(_DIGITS).tolist()
    keys = {"radius_mm": table.model_dump()["radius_mm"]} if kind == "cylinder" else {}
    outline = surface_table(
        _OUTLINED[kind],
        outline_x_mm=(0.0, x, x, 0.0),
        outline_y_mm=(0.0, 0.0, y, y),
        edge_turn_deg=(0.0,) * 4,
        corners_mm=(0.0, x, x + y, 2 * x + y),
        **keys,
    )
    return outline, 0.0


def _node_name(task: PadTask, channels: int) -> str:
    """Return the name of the kind of node with so many channels, derived from the pad's."""
    return task.pad.node if len(task.node.channels) == channels else f"{task.pad.node}_{channels}"


def _channels(objects: tuple[str, ...], count: int) -> list[str]:
    """Return `count` objects that continue those given: INDEX:1, INDEX:2 ... or raise ValueError."""
    try:
        addresses = [parse_object(text)[:2] for text in objects]
    except EdsError as error:
        raise ValueError(str(error)) from error
    index, first = addresses[0]
    if addresses != [(index, first + k) for k in range(len(addresses))]:
        raise ValueError(
            f"the node's channels {', '.join(objects)} don't follow each other, so that further ones are "
            "unknown; write a [node] table with as many channels as electrodes, and let the pad name it"
        )
    _, _, kind = objects[0].partition(":")[2].partition(":")
    return [f"0x{index:04X}:{first + k}" + (f":{kind}" if kind else "") for k in range(count)]


def deployment_text(path: Path, task: PadTask, layout: ElectrodeLayout, folder: Path) -> str:
    """Return the text of a deployment file in `folder`: that of `path` with the layout in the pad's table.

    Comments stay; paths of files are made relative to the folder. Raises ValueError as `pad_with_layout`.
    """
    pad = pad_with_layout(task, layout)
    document: Any = tomlkit.parse(path.read_text(encoding="utf-8"))
    hand = next(hand for hand in document["hand"] if hand["name"] == task.hand)
    table = next(entry for entry in hand["pad"] if entry["link"] == pad.link)
    table["gap_mm"] = pad.gap_mm
    count = layout.count
    if pad.electrode_arcs_mm is not None:
        _write_arcs(document, table, task, pad)
    for key, value, default in (
        ("gap_offsets_mm", [list(pair) for pair in pad.gap_offsets_mm], [[0.0, 0.0]] * count),
        ("series_ohm", list(pad.series_ohm), [0.0] * count),
    ):
        if value != default:
            table[key] = value
        elif key in table:
            del table[key]
    tables: list[tuple[Any, tuple[str, ...]]] = [(entry, _FILES_OF_HANDS) for entry in document["hand"]]
    tables += [(entry, _FILES_OF_NODES) for entry in document["node"].values()]
    tables += [(document["daemon"], _FILES_OF_DAEMON)] if "daemon" in document else []
    for entry, keys in tables:
        for key in keys:
            file = path.parent / str(entry.get(key, ""))
            if key in entry and file.exists():
                entry[key] = os.path.relpath(file, folder)
    return tomlkit.dumps(document)


def _write_arcs(document: Any, table: Any, task: PadTask, pad: config.Pad) -> None:
    """Write the outline and arcs of a pad to its table, and its kind of node to the document."""
    arcs = pad.electrode_arcs_mm or {}
    if "electrodes" in table:
        del table["electrodes"]
    table["electrode_arcs_mm"] = {name: list(arc) for name, arc in arcs.items()}
    table["surface"] = {
        key: list(value) if isinstance(value, tuple) else value
        for key, value in pad.surface.model_dump(exclude_defaults=True).items()
    }
    table["node"] = pad.node
    if pad.node in document["node"]:
        return
    node = copy.deepcopy(document["node"][task.pad.node].unwrap())
    for key in ("eds", "channel_scale", "idle"):  # have as many entries as the node has channels
        node.pop(key, None)
    document["node"][pad.node] = node | {"channels": _channels(task.node.channels, len(arcs))}
