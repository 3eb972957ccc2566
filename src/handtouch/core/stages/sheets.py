"""Compensation of sheet behaviour in the forces of a tick: one row of the sheets' state a pad.

Public names: `SheetStage`, `SheetInterval`. The equations are those of
`handtouch.sheet.SheetCompensator`, with the back force held between its updates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from handtouch.core.stages.force import BOUNDED
from handtouch.core.stages.solve import VALUE_COUNT, VALUE_SLICES

_VALUES = VALUE_COUNT
_FORCE, _FORCE_STD = VALUE_SLICES["force_n"].start, VALUE_SLICES["force_std_n"].start
_FORCE_STATUS = VALUE_SLICES["force_status"].start
_BOUNDED = float(BOUNDED)
_INVALID = 2  # ForceReliability
_NAN, _INFINITY = float("nan"), float("inf")
_MAX_PAUSE_NS = 3600 * 1_000_000_000


class SheetInterval:
    """Sheets of one behaviour over one interval of `dt_s`: rows `first` to `stop` of the sheets' state.

    number: of the behaviour. lines (elements elements,), transition (elements - 1, elements): of creep,
    `elements` with the load itself; total: reading of an old load over the load. base, widths_n, weights
    (plays,): of the inverse hysteresis.
    """

    def __init__(
        self,
        number: int,
        first: int,
        stop: int,
        dt_s: float,
        total: float,
        base: float,
        lines: memoryview[float],
        transition: memoryview[float],
        widths_n: memoryview[float],
        weights: memoryview[float],
        elements: int,
    ) -> None:
        self.number, self.first, self.stop, self.dt_s = number, first, stop, dt_s
        self.total, self.base, self.lines, self.transition = total, base, lines, transition
        self.widths_n, self.weights = widths_n, weights
        self.elements, self.plays = elements, len(weights)


class SheetStage:
    """Sheets of n pads. arrays: flat memory of the arrays of `TickState` by their names.

    pads: (n,) pad of each row of the sheets' state, of which the first `sheets` are used. gain: (n,) of each
    pad's force. results: (4 n,) load, load before hysteresis, effective load and reading of each row.
    update: called with True when uncertainties of forces are to be updated, with False when back forces only:
    within a tick for contacts that began in it, else by `complete_update`.
    make_steps: returns the intervals of all behaviours of a duration [s].
    """

    def __init__(
        self,
        arrays: Mapping[str, Any],
        pads: memoryview[int],
        sheets: int,
        gain: memoryview[float],
        results: memoryview[float],
        elements: int,
        plays: int,
        period_ns: int,
        update_period_s: float,
        update: Callable[[bool], None],
        update_began: Callable[[], None],
        make_steps: Callable[[float], list[SheetInterval]],
    ) -> None:
        self.update, self.update_began, self.make_steps = update, update_began, make_steps
        self.periods, self.steps = -1, make_steps(0.0)
        self.due = self.began = self.back_due = False
        self.pads, self.sheets, self.gain, self.results = pads, sheets, gain, results
        self.columns, self.play_columns = elements, plays
        self.rows = len(pads)
        self.period_ns, self.update_period_s = period_ns, update_period_s
        self.touching, self.values = arrays["touching"], arrays["values"]
        self.apparent_n = arrays["uncompensated_force_n"]
        self.elements, self.plays = arrays["sheet_elements"], arrays["sheet_plays"]
        self.back_n, self.flow_s = arrays["back_n"], arrays["flow_s"]
        self.impulse_ns, self.back_waited_s = arrays["impulse_ns"], arrays["back_waited_s"]
        self.load_is_old = arrays["load_is_old"]
        self.growth = arrays["bank_growth"]
        self.force_n, self.std_n = arrays["compensated_force_n"], arrays["compensated_std_n"]
        self.relative_std, self.reliability = arrays["relative_std"], arrays["force_reliability"]
        self.last_touch_ns, self.new_contact = arrays["last_touch_ns"], arrays["new_contact"]
        self.updated_ns, self.waited_s = arrays["sheets_updated_ns"], arrays["uncertainty_waited_s"]

    def compensate_forces(self, sync_ns: int) -> None:
        """Advance all sheets to `sync_ns`, and compensate the forces of touched pads with a model.

        They are those of the contact law in the state, `uncompensated_force_n` and `uncompensated_std_n`
        [N]; untouched pads count as 0.
        """
        periods = _elapsed_periods(self, sync_ns)
        if periods != self.periods:
            self.periods = periods
            self.steps = self.make_steps(periods * self.period_ns * 1e-9)
        self.back_due = False
        for k in range(len(self.steps)):
            if _compensate_sheets(self, self.steps[k]):
                self.back_due = True
        _find_pressed(self, periods * self.period_ns * 1e-9)
        if self.began:  # its first message has an uncertainty
            self.update_began()
        self.store_forces()

    def complete_update(self) -> None:
        """Update what is due, which takes longer than all else here; once a tick, after its messages."""
        if self.back_due or self.due:
            uncertainties = self.due
            self.back_due = self.due = False
            self.update(uncertainties)

    def store_forces(self) -> None:
        """Replace the forces of touched pads in the contacts' values by compensated ones."""
        for row in range(self.sheets):
            pad = self.pads[row]
            if not self.touching[pad]:
                continue
            force, first = self.force_n[pad], pad * _VALUES
            self.std_n[pad] = force * self.relative_std[pad]
            self.values[first + _FORCE] = _NAN if self.reliability[pad] == _INVALID else force
            saturated = self.values[first + _FORCE_STATUS] == _BOUNDED
            self.values[first + _FORCE_STD] = _INFINITY if saturated else self.std_n[pad]


def _elapsed_periods(stage: SheetStage, sync_ns: int) -> int:
    """Advance the sheets' time; return the whole periods since the last tick, keeping the rest."""
    elapsed_ns: int = sync_ns - stage.updated_ns[0]
    if elapsed_ns > _MAX_PAUSE_NS or elapsed_ns < 0:
        stage.updated_ns[0] = sync_ns
        return 0
    periods = (elapsed_ns + stage.period_ns // 2) // stage.period_ns
    stage.updated_ns[0] += periods * stage.period_ns
    return periods


def _compensate_sheets(stage: SheetStage, step: SheetInterval) -> bool:
    """Compute loads of sheets of one behaviour; return True if their back forces are to be updated."""
    old = stage.load_is_old[step.number] != 0
    for row in range(step.first, step.stop):
        _compensate_sheet(stage, step, row, old)
    stage.load_is_old[step.number] = 0
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


def _compensate_sheet(stage: SheetStage, step: SheetInterval, row: int, old: bool) -> None:
    """Compute the load of one sheet; NaN where the apparent load isn't finite: the last one then goes on."""
    pad, first, last = stage.pads[row], row * stage.columns, row * stage.play_columns
    apparent = stage.apparent_n[pad] if stage.touching[pad] else 0.0
    finite = -_INFINITY < apparent < _INFINITY
    if apparent <= 0.0:  # a release is immediate, and leaves no trace
        for i in range(step.elements):
            stage.elements[first + i] = 0.0
        for i in range(step.plays):
            stage.plays[last + i] = 0.0
        _write_result(stage, row, 0.0, 0.0, 0.0, 0.0)
        stage.force_n[pad] = 0.0
        return
    if not finite:
        effective = stage.elements[first]
        apparent = effective * step.total
    elif old:
        effective = apparent / step.total
    else:
        effective = _invert_creep(stage, step, first, apparent)
    _advance_creep(stage, step, first, effective, old)
    effective /= stage.growth[row]
    before = effective + stage.back_n[row] if effective > 0.0 else 0.0
    if effective > 0.0:
        stage.impulse_ns[row] += step.dt_s * before
        stage.flow_s[row] += step.dt_s
    load = before
    if step.plays > 0:
        load = _invert_hysteresis(stage, step, last, before)
    _write_result(stage, row, load, before, effective, apparent)
    stage.force_n[pad] = load if finite else _NAN


def _invert_creep(stage: SheetStage, step: SheetInterval, first: int, reading: float) -> float:
    """Return the load of a reading: the largest solution of its straight lines."""
    n, greatest = step.elements, 0.0
    stage.elements[first] = reading
    for k in range(n):
        load = 0.0
        for i in range(n):
            load += step.lines[k * n + i] * stage.elements[first + i]
        if k == 0 or load > greatest:
            greatest = load
    return greatest


def _advance_creep(stage: SheetStage, step: SheetInterval, first: int, load: float, old: bool) -> None:
    """Advance the elements under a load; none exceeds it."""
    n = step.elements
    stage.elements[first] = load
    # an element needs only the load and itself
    for i in range(1, n):
        moved = load
        if not old:
            at = (i - 1) * n
            moved = step.transition[at] * load + step.transition[at + i] * stage.elements[first + i]
        stage.elements[first + i] = moved if moved < load else load


def _invert_hysteresis(stage: SheetStage, step: SheetInterval, last: int, before: float) -> float:
    load = step.base * before
    for i in range(step.plays):
        play = stage.plays[last + i]
        if play > before:
            play = before
        if play < before - step.widths_n[i]:
            play = before - step.widths_n[i]
        stage.plays[last + i] = play
        load += step.weights[i] * play
    return load


def _write_result(
    stage: SheetStage, row: int, load: float, before: float, effective: float, reading: float
) -> None:
    stage.results[row], stage.results[stage.rows + row] = load, before
    stage.results[2 * stage.rows + row], stage.results[3 * stage.rows + row] = effective, reading
