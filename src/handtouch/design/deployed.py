"""A designed pad in its deployment file.

Public names: `pad_with_layout`, `deployment_text`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from handtouch import config
from handtouch.design.layout import RING_OF_SIDES, ElectrodeLayout
from handtouch.design.pad_task import PadTask

_DIGITS = 4  # of lengths in mm
_FILES_OF_HANDS, _FILES_OF_NODES, _FILES_OF_DAEMON = ("urdf",), ("eds",), ("keys", "store")


def pad_with_layout(task: PadTask, layout: ElectrodeLayout) -> config.Pad:
    """Return the pad's table with a layout. Raises ValueError where a deployment can't describe it."""
    if not layout.is_on_sides(task.boundary):
        raise ValueError(
            f"a deployment describes pads with one electrode on each side, not {layout.count} electrodes "
            "anywhere: its nodes have four channels"
        )
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


def deployment_text(path: Path, task: PadTask, layout: ElectrodeLayout, folder: Path) -> str:
    """Return the text of a deployment file in `folder`: that of `path` with the layout in the pad's table.

    Comments stay; paths of files are made relative to the folder. Raises ValueError as `pad_with_layout`.
    """
    pad = pad_with_layout(task, layout)
    document: Any = tomlkit.parse(path.read_text(encoding="utf-8"))
    hand = next(hand for hand in document["hand"] if hand["name"] == task.hand)
    table = next(entry for entry in hand["pad"] if entry["link"] == pad.link)
    table["gap_mm"] = pad.gap_mm
    for key, value, default in (
        ("gap_offsets_mm", [list(pair) for pair in pad.gap_offsets_mm], [[0.0, 0.0]] * 4),
        ("series_ohm", list(pad.series_ohm), [0.0] * 4),
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
