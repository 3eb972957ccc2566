"""Loads of sheets by their readings: creep and hysteresis inverted, adaptation added back.

Public names: `SheetInterval`, `SheetLoads`, `find_step`, `find_load`, `invert_creep`,
`load_before_hysteresis`, `invert_hysteresis`, `moved_play`. The equations are those of
`handtouch.sheet.SheetCompensator`, with the back force held between its updates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class SheetInterval:
    """Sheets of one behaviour over one interval of `dt_s`: rows `first` to `stop` of the sheets' state.

    number: of the behaviour. total: reading of an old load over the load; base: of the inverse hysteresis.
    arrays: `lines` (elements elements,) and `transition` (elements - 1, elements) of creep, `elements` with
    the load itself; `widths_n` and `weights` (plays,) of the inverse hysteresis.
    """

    def __init__(
        self, number: int, rows: slice, dt_s: float, total: float, base: float, arrays: Mapping[str, Any]
    ) -> None:
        self.number, self.first, self.stop, self.dt_s = number, rows.start, rows.stop, dt_s
        self.total, self.base = total, base
        self.lines, self.transition = arrays["lines"], arrays["transition"]
        self.widths_n, self.weights = arrays["widths_n"], arrays["weights"]
        self.elements, self.plays = math.isqrt(len(self.lines)), len(self.weights)


class SheetLoads:
    """State of the sheets of n pads; arrays: of `TickState`, by their names.

    rows: (n,) of the pads' sheets in that state, -1 without a modelled sheet. elements, plays: columns of its
    rows. `steps`: the intervals of a tick.
    """

    def __init__(self, arrays: Mapping[str, Any], rows: memoryview[int], elements: int, plays: int) -> None:
        self.rows, self.columns, self.play_columns = rows, elements, plays
        self.elements, self.plays = arrays["sheet_elements"], arrays["sheet_plays"]
        self.back_n, self.growth = arrays["back_n"], arrays["bank_growth"]
        self.load_is_old = arrays["load_is_old"]
        self.relative_std, self.log_gain_std = arrays["relative_std"], arrays["log_gain_std"]
        self.steps: list[SheetInterval] = []


def find_step(loads: SheetLoads, pad: int) -> SheetInterval | None:
    """Return the interval of a pad's sheet to the sample's time; None without a modelled sheet."""
    row = loads.rows[pad]
    if row >= 0:
        for k in range(len(loads.steps)):
            step = loads.steps[k]
            if step.first <= row < step.stop:
                return step
    return None


def find_load(loads: SheetLoads, step: SheetInterval, pad: int, reading: float) -> float:
    """Return the load of a sheet at the end of an interval by its reading, both [N]; the state stays as it
    is."""
    row = loads.rows[pad]
    effective = invert_creep(loads, step, row, reading) / loads.growth[row]
    return invert_hysteresis(loads, step, row, load_before_hysteresis(loads, row, effective))


def invert_creep(loads: SheetLoads, step: SheetInterval, row: int, reading: float) -> float:
    """Return the load of a reading: the largest solution of its straight lines."""
    if loads.load_is_old[step.number] != 0:
        return reading / step.total
    n, first, greatest = step.elements, row * loads.columns, 0.0
    for k in range(n):
        load = step.lines[k * n] * reading
        for i in range(1, n):
            load += step.lines[k * n + i] * loads.elements[first + i]
        if k == 0 or load > greatest:
            greatest = load
    return greatest


def load_before_hysteresis(loads: SheetLoads, row: int, effective: float) -> float:
    """Return the load before hysteresis: with the back force of the sheet's adaptation."""
    return effective + loads.back_n[row] if effective > 0.0 else 0.0


def invert_hysteresis(loads: SheetLoads, step: SheetInterval, row: int, before: float) -> float:
    """Return the load by the load before hysteresis."""
    if step.plays == 0:
        return before
    load, last = step.base * before, row * loads.play_columns
    for i in range(step.plays):
        load += step.weights[i] * moved_play(loads.plays[last + i], before, step.widths_n[i])
    return load


def moved_play(play: float, before: float, width_n: float) -> float:
    """Return a play of the hysteresis under a load."""
    if play > before:
        play = before
    if play < before - width_n:
        play = before - width_n
    return play
