"""Compensation of sheet behaviour in the forces of a tick: one row of the sheets' state a pad.

Public names: `SheetStage`. The equations are those of
`handtouch.sheet.SheetCompensator`, with the back force held between its updates.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from handtouch.core.memory import RowArray, view_rows
from handtouch.core.stages import loads
from handtouch.core.stages.force import BOUNDED
from handtouch.core.stages.loads import SheetInterval, SheetLoads
from handtouch.core.stages.rows import VALUE_ROW
from handtouch.field import contact_law

if TYPE_CHECKING:
    from handtouch.core.state import TickState

UPDATE_PERIOD_S = 0.1
"""Period of updates of back forces and uncertainties"""
SHEET_LOAD_ROW = np.dtype([("load", "<f8"), ("before", "<f8"), ("effective", "<f8"), ("reading", "<f8")])
"""Load of a sheet in a tick, that before hysteresis, the effective one, and the reading [N]"""
_BOUNDED, _BOUND_SIGMA = float(BOUNDED), contact_law.BOUND_SIGMA
_NAN, _INFINITY = float("nan"), float("inf")
_MAX_PAUSE_NS = 3600 * 1_000_000_000


class SheetUpdates(Protocol):
    """Computations of sheets that a tick doesn't need at once, and their intervals."""

    def update(self, uncertainties: bool) -> None:
        """Update back forces that are due; with `uncertainties` those of forces, too."""

    def update_began(self) -> None:
        """Update uncertainties of contacts that began in this tick, within the tick."""

    def make_steps(self, dt_s: float) -> list[SheetInterval]:
        """Return the intervals of all behaviours of a duration."""


class SheetStage:
    """Sheets of n pads, whose state is in `held`; `history`: the same, for loads by readings.

    pads: (sheets,) pad of each used row of the sheets' state; max_force_n: (sheets,) greatest force of each
    [N]. gain: (n,) of each pad's force. results: (n,) SHEET_LOAD_ROWs, of each row. owner: computes what
    isn't needed at once.
    """

    def __init__(
        self,
        held: TickState,
        history: SheetLoads,
        pads: memoryview[int],
        max_force_n: memoryview[float],
        gain: memoryview[float],
        results: RowArray,
        period_ns: int,
        owner: SheetUpdates,
    ) -> None:
        self.owner, self.history, arrays = owner, history, held.memory
        self.periods = -1
        self.due = self.began = self.back_due = False
        self.pads, self.sheets, self.gain, self.results = pads, len(pads), gain, results
        self.max_force_n, self.period_ns = max_force_n, period_ns
        self.touching, self.values = arrays["touching"], view_rows(held.values, VALUE_ROW)
        self.apparent_n, self.law_std_n = arrays["uncompensated_force_n"], arrays["uncompensated_std_n"]
        self.flow_s, self.impulse_ns = arrays["flow_s"], arrays["impulse_ns"]
        self.back_waited_s = arrays["back_waited_s"]
        self.force_n, self.std_n = arrays["compensated_force_n"], arrays["compensated_std_n"]
        self.relative_std = arrays["relative_std"]
        self.last_touch_ns, self.new_contact = arrays["last_touch_ns"], arrays["new_contact"]
        self.updated_ns, self.waited_s = arrays["sheets_updated_ns"], arrays["uncertainty_waited_s"]
        self.update_period_s = UPDATE_PERIOD_S

    def find_intervals(self, sync_ns: int) -> None:
        """Set the intervals of the history to those from the sheets' state to `sync_ns`; that stays as it
        is."""
        _find_steps(self, _periods_to(self, sync_ns))

    def compensate_forces(self, sync_ns: int) -> None:
        """Advance all sheets to `sync_ns`, and compensate the forces of touched pads with a model.

        They are those of the contact law in the state, `uncompensated_force_n` and `uncompensated_std_n`
        [N]; untouched pads count as 0.
        """
        periods = _elapsed_periods(self, sync_ns)
        _find_steps(self, periods)
        self.back_due = False
        steps = self.history.steps
        for k in range(len(steps)):
            if _compensate_sheets(self, steps[k]):
                self.back_due = True
        _find_pressed(self, periods * self.period_ns * 1e-9)
        if self.began:  # its first message has an uncertainty
            self.owner.update_began()
        self.store_forces()

    def complete_update(self) -> None:
        """Update what is due, which takes longer than all else here; once a tick, after its messages."""
        if self.back_due or self.due:
            uncertainties = self.due
            self.back_due = self.due = False
            self.owner.update(uncertainties)

    def store_forces(self) -> None:
        """Replace the forces of touched pads in the contacts' values by compensated ones.

        Lower bounds stay such: they are less by what the sheet's state leaves open.
        """
        for row in range(self.sheets):
            pad = self.pads[row]
            if not self.touching[pad]:
                continue
            force, relative = self.force_n[pad], self.relative_std[pad]
            law = self.law_std_n[pad] / self.apparent_n[pad] if self.apparent_n[pad] > 0.0 else 0.0
            if relative < law < _INFINITY:  # it has grown since the last update
                relative = law
            self.std_n[pad] = force * relative
            bounded = self.values[pad].force_status == _BOUNDED
            if bounded:
                force *= math.exp(-_BOUND_SIGMA * relative)
            if force > self.max_force_n[row]:
                force = self.max_force_n[row]
            self.values[pad].force_n = force if relative < _INFINITY else _NAN
            self.values[pad].force_std_n = _INFINITY if bounded else self.std_n[pad]


def _find_steps(stage: SheetStage, periods: int) -> None:
    """Set the intervals of the history to those of so many periods."""
    if periods != stage.periods:
        stage.periods = periods
        stage.history.steps = stage.owner.make_steps(periods * stage.period_ns * 1e-9)


def _periods_to(stage: SheetStage, sync_ns: int) -> int:
    """Return the whole periods since the last tick; 0 after a pause, or with another clock."""
    elapsed_ns: int = sync_ns - stage.updated_ns[0]
    if elapsed_ns > _MAX_PAUSE_NS or elapsed_ns < 0:
        return 0
    return (elapsed_ns + stage.period_ns // 2) // stage.period_ns


def _elapsed_periods(stage: SheetStage, sync_ns: int) -> int:
    """Advance the sheets' time; return the whole periods since the last tick, keeping the rest."""
    elapsed_ns: int = sync_ns - stage.updated_ns[0]
    if elapsed_ns > _MAX_PAUSE_NS or elapsed_ns < 0:
        stage.updated_ns[0] = sync_ns
        return 0
    periods = _periods_to(stage, sync_ns)
    stage.updated_ns[0] += periods * stage.period_ns
    return periods


def _compensate_sheets(stage: SheetStage, step: SheetInterval) -> bool:
    """Compute loads of sheets of one behaviour; return True if their back forces are to be updated."""
    for row in range(step.first, step.stop):
        _compensate_sheet(stage, step, row)
    stage.history.load_is_old[step.number] = 0
    waited_s: float = stage.back_waited_s[step.number] + step.dt_s
    stage.back_waited_s[step.number] = waited_s
    return waited_s >= stage.update_period_s


def _find_pressed(stage: SheetStage, dt_s: float) -> None:
    """Apply the gains to the forces of touched pads; decide whether uncertainties are due.

    They are at a contact's begin, of its pad, and periodically, at times that no contact decides: what is
    published of a pad doesn't depend on others.
    """
    pressed = stage.began = False
    for row in range(stage.sheets):
        pad = stage.pads[row]
        if stage.touching[pad]:
            pressed = True
            stage.last_touch_ns[pad] = stage.updated_ns[0]
            stage.force_n[pad] *= stage.gain[pad]
            if stage.new_contact[pad]:
                stage.began = True
    stage.waited_s[0] += dt_s
    stage.due = False
    if stage.waited_s[0] >= stage.update_period_s:
        if pressed:
            stage.due = True
        else:
            stage.waited_s[0] = 0.0


def _compensate_sheet(stage: SheetStage, step: SheetInterval, row: int) -> None:
    """Compute the load of one sheet; NaN where the apparent load isn't finite: the last one then goes on."""
    history, pad = stage.history, stage.pads[row]
    first, last = row * history.columns, row * history.play_columns
    apparent = stage.apparent_n[pad] if stage.touching[pad] else 0.0
    finite = -_INFINITY < apparent < _INFINITY
    if apparent <= 0.0:  # a release is immediate, and leaves no trace
        for i in range(step.elements):
            history.elements[first + i] = 0.0
        for i in range(step.plays):
            history.plays[last + i] = 0.0
        _write_result(stage, row, 0.0, 0.0, 0.0, 0.0)
        stage.force_n[pad] = 0.0
        return
    if finite:
        effective = loads.invert_creep(history, step, row, apparent)
    else:
        effective = history.elements[first]
        apparent = effective * step.total
    _advance_creep(history, step, first, effective)
    effective /= history.growth[row]
    before = loads.load_before_hysteresis(history, row, effective)
    if effective > 0.0:
        stage.impulse_ns[row] += step.dt_s * before
        stage.flow_s[row] += step.dt_s
    load = loads.invert_hysteresis(history, step, row, before)
    for i in range(step.plays):
        history.plays[last + i] = loads.moved_play(history.plays[last + i], before, step.widths_n[i])
    _write_result(stage, row, load, before, effective, apparent)
    stage.force_n[pad] = load if finite else _NAN


def _advance_creep(history: SheetLoads, step: SheetInterval, first: int, load: float) -> None:
    """Advance the elements under a load; none exceeds it."""
    n, old = step.elements, history.load_is_old[step.number] != 0
    history.elements[first] = load
    # an element needs only the load and itself
    for i in range(1, n):
        moved = load
        if not old:
            at = (i - 1) * n
            moved = step.transition[at] * load + step.transition[at + i] * history.elements[first + i]
        history.elements[first + i] = moved if moved < load else load


def _write_result(
    stage: SheetStage, row: int, load: float, before: float, effective: float, reading: float
) -> None:
    stage.results[row].load, stage.results[row].before = load, before
    stage.results[row].effective, stage.results[row].reading = effective, reading
