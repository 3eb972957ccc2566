"""Stages of a tick with what they read and write, and what changes them between two ticks.

Public name: `TickProcessor`. `pipeline.run_tick` runs the stages.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.arrays import BoolArray, IntArray
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.baseline import Baseline, BaselineSettings
from handtouch.core.columns import PadColumns, TickResult
from handtouch.core.pad_model import PadModel
from handtouch.core.second_sheets import SecondSheets
from handtouch.core.shear_pads import changed_shear_pads
from handtouch.core.sheet_force import ForceReference, SheetForceCompensation
from handtouch.core.stages.detect import ContactDetector, DetectionSettings
from handtouch.core.stages.publish import ContactColumns
from handtouch.core.stages.rows import PART_COUNT, PART_SLICES
from handtouch.core.stages.shear import ShearForces, ShearTable
from handtouch.core.stages.slip import SlipDetector
from handtouch.core.stages.solve import ContactSolver
from handtouch.core.state import TickState
from handtouch.wire import PadState

_TOUCHED = int(PadState.TOUCHED)


class TickProcessor:
    """Stages of all pads of a model; `state`: their state, of the model's size."""

    def __init__(self, model: PadModel, period_ns: int, state: TickState | None = None) -> None:
        self.model = model
        if state is None:
            sizes = model.size, len(model.rows_of_hand), model.channels, len(model.second_pads)
            state = TickState.empty(*sizes)
        self.state = held = state
        self.columns = PadColumns.of_state(held)
        self.counts: NDArray[np.int64] = np.zeros((model.size, model.channels), dtype=np.int64)
        """counts of the electrodes in the last tick"""
        self.channel_counts: NDArray[np.int64] = np.zeros((model.size, model.slab_channels), dtype=np.int64)
        """counts of all channels, electrodes first"""
        held.max_sample_period_ns[:] = period_ns
        self.baseline = Baseline(
            _baseline_settings(model), model.rows_of_hand.values(), held, model.electrode_counts
        )
        """counts of untouched pads"""
        self.contacts = ContactDetector(
            DetectionSettings.of_model(model), self.baseline.expected_counts, held
        )
        self.sheet_force = SheetForceCompensation(model.behaviours, period_ns, held)
        """compensation of creep, adaptation and hysteresis"""
        self.second = SecondSheets(model, held, period_ns)
        """second sheets of pads with two"""
        self.slip = SlipDetector(
            period_ns * 1e-9,
            self.columns.values,
            self.columns.total_current_a,
            self.columns.sample_ns,
            held.contact_id,
            held=held,
        )
        """slip and lift-off of contacts, where requested"""
        self.sync_ns = 0
        """of the last tick"""
        # requested, and the pad isn't in quarantine
        self._estimate_force = np.zeros(model.size, dtype=np.bool_)
        self._set_stages(model)
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from state and model, after either was changed as a whole."""
        model, held = self.model, self.state
        if any(now is not before for now, before in zip(model.forward_tables, self._tables, strict=True)):
            self._set_stages(model)
        self.contacts.set_settings(DetectionSettings.of_model(model))
        self.baseline.set_settings(_baseline_settings(model))
        self.sheet_force.set_law_ages(model.law_ages_s)
        self.sheet_force.refresh()
        self.second.refresh(model)
        self.slip.refresh()
        np.greater(held.force_requested, model.quarantined, out=self._estimate_force)
        self.output.publish()

    def expected_pads(self) -> NDArray[np.bool_]:
        """Return the pads whose sample a tick waits for: those alive and sampled by SYNC."""
        return np.asarray((self.columns.state <= _TOUCHED) & self.state.synchronous)

    def set_requested(self, position: BoolArray, force: BoolArray, interval_ticks: NDArray[np.int64]) -> None:
        """Restrict positions, forces and updates to the requested pads; all (n,), copied."""
        held = self.state
        if self.sheet_force.any_modelled:  # the sheet's history needs every contact
            position, force = position | self.sheet_force.modelled, force | self.sheet_force.modelled
        changed = np.flatnonzero((position != held.position_requested) | (force != held.force_requested))
        held.position_requested[:], held.force_requested[:] = position, force
        held.update_interval_ticks[:] = interval_ticks
        self.discard_solutions(changed)
        self.refresh()

    def set_baseline(self, pad: int, offset_counts: ArrayLike, std_counts: ArrayLike = 0.0) -> None:
        """Set the untouched counts (n,) of a pad and their standard deviation, from a store or a tare."""
        self.baseline.set_offset(pad, offset_counts, std_counts)
        self.discard_solutions(np.array([pad]))

    def set_calibration(self, pad: int, calibration: ActiveCalibration) -> None:
        """Apply a pad's calibration as a whole; forces by another contact law need new evidence."""
        if calibration.law != self.model.calibrations[pad].law:
            self.sheet_force.reset_evidence(pad)
        if calibration.second_law != self.model.calibrations[pad].second_law:
            self.second.reset_evidence(pad)
        self.model.set_calibration(pad, calibration)
        self.state.misfits[pad] = 0.0
        self.refresh()
        self.discard_solutions(np.array([pad]))
        self.state.peak_force_n[pad] = np.nan

    def reset_pad(self, pad: int) -> None:
        """Forget what was learned of a pad: its node and sheet were replaced."""
        self.baseline.reset_pad(pad)
        self.state.misfits[pad] = 0.0
        self.sheet_force.reset_evidence(pad, new_sheet=True)
        self.second.reset_evidence(pad, new_sheet=True)
        self.shear.forget_rest([pad])
        self.discard_solutions(np.array([pad]))

    def update_force_gains(self, reference: ForceReference) -> int:
        """Compare forces with an external measurement; return the number of pads whose gain was updated."""
        return self.sheet_force.update_gains(reference, self.state.sample_ns, self.state.touching)

    def replace_model(self, model: PadModel, changed: IntArray) -> None:
        """Continue with another model of the same pads, `changed` of which differ; contacts continue."""
        self.sheet_force = self.sheet_force.with_behaviours(self.model.behaviours, model.behaviours)
        for pad in changed.tolist():
            self.sheet_force.reset_evidence(pad)
            self.second.reset_evidence(pad)
        self.state.misfits[changed] = 0.0
        moved = changed_shear_pads(self.model.shear_pads, model.shear_pads)
        self.model = model
        self._set_stages(model)
        self.shear.forget_rest(moved)
        self.refresh()
        self.discard_solutions(changed)
        self.state.peak_force_n[changed] = np.nan

    def discard_solutions(self, pads: IntArray) -> None:
        """Discard the contact values of these pads, because what they are computed from changed."""
        held = self.state
        held.solved[pads] = False
        held.values[pads] = np.nan
        held.parts[pads, : PART_SLICES["newest_id"].start] = held.parts[pads, PART_COUNT:] = np.nan
        held.uncompensated_force_n[pads] = np.nan
        self.second.discard(pads)
        self.shear.discard(pads)
        self.slip.restart_contacts(pads)  # a position that a new calibration moves doesn't slip

    def clear_ended(self, ended: IntArray) -> None:
        """Clear the ids and published columns of ended contacts, after their last message was built."""
        self.state.contact_id[ended] = 0
        self.output.publish()
        self.shear.discard(ended)

    def _set_stages(self, model: PadModel) -> None:
        """Set the stages that read the model's arrays in place."""
        columns, self._tables = self.columns, list(model.forward_tables)
        self.second.make_stage(model, self.sheet_force)
        measured = {
            "saturated": self.contacts.saturated_channels,
            "noise_squared": self.state.noise_squared,
            "misfits": self.state.misfits,
        }
        self.solver = ContactSolver(
            model,
            currents=self.contacts.currents_a,
            offset_std_a=self.contacts.offset_std_a,
            force_requested=self._estimate_force,
            values=columns.values,
            parts=self.state.parts,
            measured=measured,
            both=self.second.both,
        )
        self.output = ContactColumns(model, self.state, columns)
        statuses = columns.position_status, columns.force_status
        self.shear = ShearForces(
            [ShearTable(*shear) for shear in model.shear_pads], self.state, *statuses, model.mounts
        )
        """force vectors of contacts above shear pads"""

    def detect_slips(self, result: TickResult) -> None:
        """Detect slip and lift-off of a tick's contacts; call it once the tick's messages are out."""
        self.slip.detect_slips(np.concatenate([result.began, result.updated]))

    def prepare_next_tick(self) -> None:
        """Update the baseline, and the uncertainty of forces of later ticks. Call between two ticks, off the
        critical path: it changes no contact."""
        if self.sheet_force.any_modelled:
            self.sheet_force.complete_update()
        if self.second.any_configured:
            self.second.prepare_next_tick(self.sync_ns)
        if self.sync_ns:
            self.baseline.update_baseline(self.sync_ns, self.state.touching)


def _baseline_settings(model: PadModel) -> BaselineSettings:
    return BaselineSettings(
        model.noise_counts,
        model.begin_threshold_counts,
        model.end_threshold_counts,
        model.touch.max_rise_time_s,
        model.magnetic,
    )
