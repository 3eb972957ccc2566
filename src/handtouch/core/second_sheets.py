"""Second sheets of pads with two: their channel, baseline and behaviour; force and radius are by both.

Public name: `SecondSheets`. The estimate is in `stages.two_sheets`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.arrays import IntArray
from handtouch.core.baseline import Baseline, BaselineSettings
from handtouch.core.memory import rows_at, view_memory, view_rows
from handtouch.core.pad_model import PadModel
from handtouch.core.sheet_force import SheetForceCompensation
from handtouch.core.slab import Slab
from handtouch.core.stages.force import PadLaw
from handtouch.core.stages.rows import VALUE_ROW, VALUE_SLICES
from handtouch.core.stages.two_sheets import (
    MAX_EQUAL_SAMPLES,
    TwoSheets,
    read_totals,
    store_both,
)
from handtouch.core.state import TickState
from handtouch.wire import ContactRadiusStatus, SecondSheetStatusName

_RADIUS_STATUS = VALUE_SLICES["contact_radius_status"].start
_MAX_DEAD_SIGMA = 4.0
"""Deviations of noise and zero that a touched second sheet at least exceeds: the weakest contacts give
hundreds of counts"""
_MIN_DEAD_NS = 150_000_000
"""Time since a contact began: before, its frame may be that of an earlier SYNC, as of a host that is late"""
_MIN_DEAD_FORCE = 0.5
"""Force over the contact's greatest: where it ends, the current may be within what the zero is known to"""


class SecondSheets:
    """Second sheets of a model's pads in a tick's state, 0 to n of them.

    `both`: what the solver estimates with, None without any.
    """

    def __init__(self, model: PadModel, state: TickState, period_ns: int) -> None:
        self.any_configured = len(model.second_pads) > 0
        """a pad has two sheets"""
        self.both: TwoSheets | None = None
        self._pads, self._state, self._period_ns = model.second_pads, state, period_ns
        self._number_of_pad = np.full(model.size, -1, np.int64)
        self._number_of_pad[self._pads] = np.arange(len(self._pads))
        if not self.any_configured:
            return
        assert state.second is not None
        self._held = held = state.second
        rows = [
            slice(*np.searchsorted(self._pads, (rows.start, rows.stop)))
            for rows in model.rows_of_hand.values()
        ]
        self._baseline = Baseline(
            self._baseline_settings(model), rows, held, np.ones(len(self._pads), np.intp)
        )
        self._behaviours = model.second_behaviours
        self._compensation = SheetForceCompensation(self._behaviours, period_ns, held)
        self._columns, self._noise_counts = model.second_columns, model.noise_counts[self._pads]

    def has_second(self, pad: int) -> bool:
        """Return True if a pad has two sheets."""
        return pad in self._pads

    def column(self, pad: int) -> int:
        """Return the column of a pad's second sheet in the slab."""
        return int(self._columns[self._pads.searchsorted(pad)])

    def counts(self, rows: slice, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the counts of the second sheets of a hand's pads, 0 of those without; empty without any.

        counts: (n, channels) of the slab.
        """
        pads = self._pads[(self._pads >= rows.start) & (self._pads < rows.stop)]
        if not len(pads):
            return np.zeros(0, np.int64)
        found = np.zeros(rows.stop - rows.start, np.int64)
        found[pads - rows.start] = counts[pads, self._columns[self._pads.searchsorted(pads)]]
        return found

    def make_stage(self, model: PadModel, sheet_force: SheetForceCompensation) -> None:
        """Make what the solver estimates with, of this model; sheet_force: of the first sheets."""
        if not self.any_configured:
            return
        if model.second_behaviours != self._behaviours:
            self._compensation = self._compensation.with_behaviours(self._behaviours, model.second_behaviours)
            self._behaviours = model.second_behaviours
        self._compensations = sheet_force, self._compensation
        sheets = {
            "numbers": self._number_of_pad,
            "pads": self._pads,
            "columns": model.second_columns,
            "expected_counts": self._baseline.expected_counts,
            "ampere_per_count": model.second_ampere_per_count,
            "noise_counts": np.ascontiguousarray(model.noise_counts[self._pads]),
        }
        laws, none = model.second_law_parameters, view_memory(np.zeros(0))
        self.both = TwoSheets(
            state=self._state.memory,
            second_state=self._held.memory,
            sheets={name: view_memory(array) for name, array in sheets.items()},
            laws=[PadLaw(rows_at(laws, k), none, has_series=False) for k in range(len(laws))],
            first=sheet_force.loads,
            second=self._compensation.loads,
        )

    def refresh(self, model: PadModel) -> None:
        """Compute what follows from the state, after that was loaded, and the model."""
        if self.any_configured:
            self._baseline.set_settings(self._baseline_settings(model))
            self._compensation.set_law_ages(model.second_law_ages_s)
            self._compensation.refresh()

    def _baseline_settings(self, model: PadModel) -> BaselineSettings:
        begin_counts, end_counts = model.second_threshold_counts()
        rise_s = model.touch.max_rise_time_s[self._pads]
        return BaselineSettings(model.noise_counts[self._pads], begin_counts, end_counts, rise_s)

    def read_totals(self, slab: Slab, sync_ns: int) -> None:
        """Compute the currents of a tick; contacts are solved after it."""
        assert self.both is not None
        read_totals(self.both, slab.memory)
        for compensation in self._compensations:
            if compensation.any_modelled:
                compensation.find_intervals(sync_ns)

    def begin_contacts(self, began: IntArray) -> None:
        """Note contacts that began on these pads."""
        if self.any_configured and len(numbers := self._numbers(began)):
            self._state.joint_force_n[numbers] = np.nan
            self._held.uncompensated_force_n[numbers] = np.nan
            self._compensation.begin_contacts(numbers)

    def store_forces(self, sync_ns: int) -> None:
        """Let the second sheets' behaviour go on, and replace the forces of touched pads by those of both."""
        assert self.both is not None
        if self._compensation.any_modelled:
            self._compensation.compensate_forces(sync_ns)
        self.store_both()

    def store_both(self) -> None:
        """Replace the forces of touched pads by those of both sheets."""
        assert self.both is not None
        store_both(self.both, view_rows(self._state.values, VALUE_ROW))

    def prepare_next_tick(self, sync_ns: int) -> None:
        """Update baselines and uncertainties of behaviour, between two ticks."""
        if self._compensation.any_modelled:
            self._compensation.complete_update()
        if sync_ns:
            self._baseline.update_baseline(sync_ns, self._held.touching.astype(np.bool_))

    def set_offset(self, pad: int, offset_counts: ArrayLike, std_counts: ArrayLike = 0.0) -> None:
        """Set the untouched count of a pad's second sheet (1,), and its standard deviation: a tare."""
        for number in self._numbers(np.array([pad])).tolist():
            self._baseline.set_offset(number, offset_counts, std_counts)

    def discard(self, pads: IntArray) -> None:
        """Discard the forces of pads, because what they are computed from changed."""
        numbers = self._numbers(pads)
        self._state.joint_force_n[numbers] = np.nan

    def reset_evidence(self, pad: int, *, new_sheet: bool = False) -> None:
        """Restart the evidence of a pad, as `SheetForceCompensation`; with a new sheet it has a new second
        one."""
        for number in self._numbers(np.array([pad])).tolist():
            self._compensation.reset_evidence(number, new_sheet=new_sheet)
            if new_sheet:
                self._baseline.reset_pad(number)

    def find_status(
        self, pad: int, counts: NDArray[np.int64], limits_reached: NDArray[np.bool_]
    ) -> SecondSheetStatusName:
        """Return the status of the channel of a pad's second sheet in the last tick, as `second_sheet_status`
        names it; empty without one.

        counts, limits_reached: (n, channels) of the slab.
        """
        for number in self._numbers(np.array([pad])).tolist():
            column = int(self._columns[number])
            if limits_reached[pad, column]:
                return "saturated"
            if self._state.equal_samples[number] >= MAX_EQUAL_SAMPLES:
                return "stuck"
            if not self._held.known[number]:
                return "no_zero"
            noise = math.hypot(self._noise_counts[number], self._held.offset_std[number])
            excess = counts[pad, column] - self._baseline.expected_counts[number, 0]
            lasted_ns = self._state.sample_ns[pad] - self._state.begin_ns[pad]
            force_n = self._state.values[pad, VALUE_SLICES["force_n"]][0]
            is_firm = force_n >= _MIN_DEAD_FORCE * self._state.peak_force_n[pad]
            lasts = self._held.touching[number] and lasted_ns >= _MIN_DEAD_NS
            if lasts and is_firm and excess < _MAX_DEAD_SIGMA * noise:
                return "dead"
            if self._state.values[pad, _RADIUS_STATUS] == float(ContactRadiusStatus.CONTRADICTORY):
                return "contradictory"
            return "operational"
        return ""

    def set_excitation(self, on: NDArray[np.bool_]) -> None:
        """Set the pads (n,) whose sheets have their potential."""
        if self.any_configured:
            self._compensation.set_excitation(on[self._pads])

    def _numbers(self, pads: IntArray) -> IntArray:
        """Return the numbers of the second sheets that these pads have."""
        numbers = self._number_of_pad[pads]
        return numbers[numbers >= 0]
