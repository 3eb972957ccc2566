"""What the fast half knows of a unit and is worth storing now and then: baseline and state of its sheet.

Public: `Upkeep`; `back_force`, which reads a sheet's state from the store again.
"""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np

from handtouch.supervise.calibration import Offsets, SheetState, Version, four
from handtouch.supervise.link import Block, FloatArray

_OFTEN_NS, _FIRST_NS = 3_600_000_000_000, 60_000_000_000
"""Time between two of a unit that are stored, and before the first."""
_MOVED = 2.0
"""Counts, and standard deviations of a reading, that a channel must have moved by to be worth it."""
_USED = 0.1
"""Of the back force, and at least newtons / 10, that it must have changed by."""
_KIND, _VERSION = "back force", 1
_RECOVERY_S = 3600.0
"""Without potential a sheet recovers in hours, and nobody knows whether it had any."""


class Upkeep:
    """Of n pads; `take` every block."""

    def __init__(self, pads: int) -> None:
        self._block: Block | None = None
        self._offset: FloatArray = np.full((pads, 4), np.nan)
        self._back = np.full(pads, np.nan)
        self._next_ns = np.full(pads, -1, dtype=np.int64)

    def take(self, block: Block) -> None:
        """See what the fast half has by now."""
        self._block = block

    def forget(self, pad: int) -> None:
        """Another unit is in the place of a pad."""
        self._offset[pad], self._back[pad], self._next_ns[pad] = np.nan, np.nan, -1

    def due(self, pad: int, t_ns: int, last: bool = False) -> tuple[Offsets | None, SheetState | None]:
        """What of a unit is to be stored now, None where nothing new is; `last`: it is the end."""
        if self._next_ns[pad] < 0:
            self._next_ns[pad] = t_ns + _FIRST_NS
        if self._block is None or (t_ns < self._next_ns[pad] and not last):
            return None, None
        self._next_ns[pad] = t_ns + _OFTEN_NS
        return self._baseline(pad, self._block), self._sheet(pad, self._block)

    def _baseline(self, pad: int, block: Block) -> Offsets | None:
        offset, std, noise = block.offset_counts[pad], block.offset_std[pad], block.noise_counts[pad]
        if not np.isfinite(std):
            return None
        moved = np.abs(offset - self._offset[pad])
        if (moved < _MOVED * np.maximum(1.0, noise)).all():  # False for NaN
            return None
        self._offset[pad] = offset
        return Offsets(four(offset), four(np.full(4, std**2 / 4)), four(noise))

    def _sheet(self, pad: int, block: Block) -> SheetState | None:
        back, std = float(block.back_n[pad]), float(block.back_std_n[pad])
        before = self._back[pad]
        if not math.isfinite(back) or abs(back - before) < _USED * max(before, 1.0):
            return None
        self._back[pad] = back
        return SheetState(_KIND, _VERSION, msgpack.packb([back, std]))


def back_force(version: Version, away_s: float) -> tuple[float, float] | None:
    """Back force of a sheet and its standard deviation [N], so long after it was stored; None if unknown."""
    state = version.calibration.sheet
    if state is None or (state.kind, state.version) != (_KIND, _VERSION):
        return None
    try:
        back, std = map(float, _numbers(state.data))
    except (ValueError, TypeError):
        return None
    return back, math.hypot(std, back * -math.expm1(-away_s / _RECOVERY_S))


def _numbers(data: bytes) -> Any:
    try:
        return msgpack.unpackb(data)
    except msgpack.exceptions.UnpackException as error:
        raise ValueError("no msgpack") from error
