"""The tick: one vectorised pass from the slab's counts to the contacts of all hands.

counts -> currents -> touched pads -> position and force of those -> link frame -> begin, update, end.
Free of I/O and clocks: the state is in `TickState`, the time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import wire
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.baseline import Baseline
from handtouch.core.contact_solver import VALUE_SLICES, ContactSolver, make_solver
from handtouch.core.contacts import BoolArray, ContactDetector, IntArray
from handtouch.core.cycle import Cycle
from handtouch.core.pad_model import PadModel
from handtouch.core.sheet_force import ForceReference, ForceReliability, SheetForceCompensation
from handtouch.core.slab import Slab
from handtouch.core.slip import SlipDetector
from handtouch.core.state import TickState
from handtouch.field.contact_law import ForceEstimateStatus
from handtouch.wire import PadState

FloatArray = NDArray[np.float64]
_MAX_SILENT_PERIODS = 3
_MAX_NEGATIVE_SIGMA, _MAX_NEGATIVE_FRACTION = 10.0, 0.02
"""Most negative plausible current of a channel: in noise sigma, and as a fraction of all channels."""
# plain ints: looking up enum members costs a microsecond each
_CLEAR, _TOUCHED, _STALE, _FAULTED = map(
    int, (PadState.CLEAR, PadState.TOUCHED, PadState.STALE, PadState.FAULTED)
)
_UNRELIABLE, _INVALID = int(ForceReliability.UNRELIABLE), int(ForceReliability.INVALID)
_NO_LIMIT_NS = np.iinfo(np.int64).max
_CONTACT_COLUMNS = (
    *("pad_m", "residual", "position_m", "normal", "force_n", "force_std_n", "residual_std", "covariance_m2"),
)
CONTACT_DTYPE = np.dtype(
    [
        (name, column.dtype, (column.elements,) if column.elements > 1 else ())
        for name in _CONTACT_COLUMNS
        for column in (wire.COLUMNS[wire.HandFrame][name],)
    ]
)
"""Columns of the hand frame that are written per contact."""
_PUBLISHED_VALUES = slice(VALUE_SLICES["pad_m"].start, VALUE_SLICES["covariance_m2"].stop)
"""Values of a contact that CONTACT_DTYPE repeats, in its order."""
_FORCE, _FORCE_STD, _FORCE_STATUS = (
    VALUE_SLICES[name].start for name in ("force_n", "force_std_n", "force_status")
)
_LOWER_BOUND = float(ForceEstimateStatus.LOWER_BOUND)
_ALL_CHANNELS = np.ones(4)
_NO_ROWS: IntArray = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True)
class PadColumns:
    """State and contact values of n pads; a row keeps its last values until newer ones are computed."""

    state: NDArray[np.uint8]
    """PadState"""
    sample_ns: NDArray[np.int64]
    """SYNC of the newest sample, 0 before the first"""
    total_current_a: FloatArray
    """sum of the four channels"""
    values: FloatArray
    """(n, VALUE_COUNT) contact values of each pad's last sample of a contact; most below are views of it"""
    xy: FloatArray
    """(n, 2) position on the pad's rectangle"""
    position_m: FloatArray
    """(n, 3) in the link frame; NaN without a valid position"""
    normal: FloatArray
    """(n, 3)"""
    pad_m: FloatArray
    """(n, 2) arc lengths from the electrodes x0 and y0"""
    pad_noise_m2: FloatArray
    """(n, 3) covariance of pad_m that is independent in each sample: uu, uv, vv"""
    residual: FloatArray
    residual_std: FloatArray
    """of a point contact, from channel noise"""
    squared_misfit: FloatArray
    """of a point contact, in variances of noise and tolerances; above MAX_SQUARED_MISFIT it is no point"""
    covariance_m2: FloatArray
    """(n, 3, 3) of position_m"""
    force_n: FloatArray
    """NaN without a valid force; a lower bound where `force_saturated`"""
    force_std_n: FloatArray
    """infinite for a lower bound"""
    uncompensated_force_n: FloatArray
    """force of the contact law, before the sheet behaviour is compensated"""
    force_saturated: NDArray[np.bool_]
    contact_columns: NDArray[np.void]
    """published contact columns, as CONTACT_DTYPE; all NaN without contact"""

    @classmethod
    def of_state(cls, state: TickState) -> PadColumns:
        """Return views of a state's arrays."""
        values = state.values
        views = {name: values[:, columns] for name, columns in VALUE_SLICES.items()}
        return cls(
            state=state.pad_state,
            sample_ns=state.sample_ns,
            total_current_a=state.total_current_a,
            values=values,
            xy=views["xy"],
            position_m=views["position_m"],
            normal=views["normal"],
            pad_m=views["pad_m"],
            pad_noise_m2=views["pad_noise_m2"],
            residual=views["residual"][:, 0],
            residual_std=views["residual_std"][:, 0],
            squared_misfit=views["squared_misfit"][:, 0],
            covariance_m2=np.lib.stride_tricks.as_strided(
                views["covariance_m2"], (len(values), 3, 3), (values.strides[0], 24, 8)
            ),
            force_n=views["force_n"][:, 0],
            force_std_n=views["force_std_n"][:, 0],
            uncompensated_force_n=state.uncompensated_force_n,
            force_saturated=state.force_saturated,
            contact_columns=state.published.view(CONTACT_DTYPE)[:, 0],
        )


class TickResult(NamedTuple):
    """Rows of the columns that one tick changed."""

    sync_ns: int
    began: IntArray
    updated: IntArray
    """contacts with a new sample that did not begin in this tick"""
    ended: IntArray
    silent: IntArray
    """contacts whose sample is missing; their values are those of the last one"""


class TickProcessor:
    """The tick of all pads of a model; `state`: its state, of the model's size."""

    def __init__(self, model: PadModel, period_ns: int, state: TickState | None = None) -> None:
        self.model = model
        self.state = held = TickState.empty(model.size, len(model.rows_of_hand)) if state is None else state
        self.columns = PadColumns.of_state(held)
        self.contacts = ContactDetector(
            *(model.begin_threshold_a, model.end_threshold_a, model.begin_samples, model.end_samples), held
        )
        self.counts: NDArray[np.int64] = np.zeros((model.size, 4), dtype=np.int64)
        """counts of the last tick"""
        held.max_sample_period_ns[:] = period_ns
        self.baseline = Baseline(
            *(model.noise_counts, model.begin_threshold_counts, model.end_threshold_counts),
            *(model.max_rise_time_s, model.rows_of_hand.values(), held),
        )
        """counts of untouched pads"""
        self.sheet_force = SheetForceCompensation(model.behaviours, period_ns, held)
        """compensation of creep, adaptation and hysteresis"""
        self.slip = SlipDetector(
            period_ns * 1e-9,
            self.columns.values,
            self.columns.total_current_a,
            self.columns.sample_ns,
            self.contacts.id,
            held=held,
        )
        """slip and lift-off of contacts, where requested"""
        self._no_pads = np.zeros(model.size, dtype=np.bool_)
        # of the last tick, until `prepare_next_tick`
        self._sampled, self._trusted = self._no_pads.copy(), self._no_pads.copy()
        self._excess = np.zeros((model.size, 4))  # counts above the baseline
        self._baseline_samples_added = True
        self._sync_ns = 0
        self._currents = np.zeros((model.size, 4))
        self._offset_std_a = np.zeros(model.size)  # of the baseline
        self._min_counts = np.zeros((model.size, 1))
        self._some_skipped = False  # some output isn't requested in every tick
        self._estimate_force = self._no_pads.copy()  # requested, and the pad isn't in quarantine
        self._solver = self._make_solver(model)
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from state and model, after either was changed as a whole."""
        model, held = self.model, self.state
        self.contacts.set_settings(
            model.begin_threshold_a, model.end_threshold_a, model.begin_samples, model.end_samples
        )
        self.baseline.set_settings(
            *(model.noise_counts, model.begin_threshold_counts, model.end_threshold_counts),
            model.max_rise_time_s,
        )
        self.sheet_force.refresh()
        self.slip.refresh()
        self._min_counts = -_MAX_NEGATIVE_SIGMA * model.noise_counts[:, None]
        np.greater(held.force_requested, model.quarantined, out=self._estimate_force)
        self._some_skipped = not (held.position_requested.all() and (held.update_interval_ticks == 1).all())

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

    def is_force_unreliable(self, pads: slice | int) -> BoolArray:
        """Return the touched pads whose force is unreliable: baseline or sheet state is not known well
        enough yet."""
        unreliable = self.baseline.unknown_in_contact[pads] | (self.sheet_force.state[pads] == _UNRELIABLE)
        return np.asarray(unreliable & self.contacts.touching[pads])

    def position_noise_covariance(self, pads: IntArray) -> FloatArray:
        """Return the covariance (k, 2, 2) of arc lengths on pads (k,) that is independent in each sample."""
        return self.columns.pad_noise_m2[pads][:, [[0, 1], [1, 2]]]

    def solve_all(self) -> None:
        """Compute position and force of every touched pad, requested or not; the state's owner undoes it."""
        everything = ~self._no_pads
        self.set_requested(everything, everything, self.state.update_interval_ticks)
        touching = np.flatnonzero(self.contacts.touching)
        if len(touching):
            self._solve_contacts(touching)
            self._store_compensated_forces(np.flatnonzero(self.contacts.touching & self.sheet_force.modelled))

    def set_baseline(self, pad: int, offset_counts: ArrayLike, std_counts: ArrayLike = 0.0) -> None:
        """Set the untouched counts (4,) of a pad and their standard deviation, from a store or a tare."""
        self.baseline.set_offset(pad, offset_counts, std_counts)
        self.discard_solutions(np.array([pad]))

    def set_calibration(self, pad: int, calibration: ActiveCalibration) -> None:
        """Apply a pad's calibration as a whole; forces by another contact law need new evidence."""
        if calibration.law != self.model.calibrations[pad].law:
            self.sheet_force.reset_evidence(pad)
        self.model.set_calibration(pad, calibration)
        self.refresh()
        self.discard_solutions(np.array([pad]))

    def reset_pad(self, pad: int) -> None:
        """Forget what was learned of a pad: its node and sheet were replaced."""
        self.baseline.reset_pad(pad)
        self.sheet_force.reset_evidence(pad, new_sheet=True)
        self.discard_solutions(np.array([pad]))

    def update_force_gains(self, reference: ForceReference) -> int:
        """Compare forces with an external measurement; return the number of pads whose gain was updated."""
        return self.sheet_force.update_gains(reference, self.state.sample_ns, self.contacts.touching)

    def replace_model(self, model: PadModel, changed: IntArray) -> None:
        """Continue with another model of the same pads, `changed` of which differ; contacts continue."""
        self.sheet_force = self.sheet_force.with_behaviours(self.model.behaviours, model.behaviours)
        for pad in changed.tolist():
            self.sheet_force.reset_evidence(pad)
        self.model, self._solver = model, self._make_solver(model)
        self.refresh()
        self.discard_solutions(changed)

    def discard_solutions(self, pads: IntArray) -> None:
        """Discard the contact values of these pads, because what they are computed from changed."""
        held = self.state
        held.solved[pads] = False
        held.values[pads] = held.published[pads] = np.nan
        held.uncompensated_force_n[pads] = np.nan
        self.slip.restart_contacts(pads)  # a position that a new calibration moves doesn't slip

    def run_tick(
        self,
        slab: Slab,
        node_state: NDArray[np.uint8],
        cycle: Cycle,
        until_ns: int = _NO_LIMIT_NS,
    ) -> TickResult:
        """Process the samples of a cycle, and those of the previous one that arrived after its tick.

        Samples that arrived at `until_ns` or later belong to the next cycle. `node_state` (n,):
        PadState.CLEAR where the node is up, else the state to give its pad.
        """
        model, columns, contacts = self.model, self.columns, self.contacts
        self._add_baseline_samples()
        operational = np.logical_not(node_state)  # CLEAR is 0
        sampled = self._update_samples(slab, operational, cycle, until_ns)
        self.counts = counts = slab.unpack_counts()
        excess = np.subtract(counts, self.baseline.expected_counts, out=self._excess)
        implausible, (stale, silenced) = (
            self._find_implausible(counts, slab),
            self._find_silent(sampled, cycle),
        )
        trusted = operational
        if not (implausible is self._no_pads is stale):
            trusted = operational & ~(implausible | silenced)
        np.multiply(excess, model.ampere_per_count, out=self._currents)
        np.copyto(columns.total_current_a, self._currents @ _ALL_CHANNELS, where=sampled)
        began, ended, measured = contacts.detect_contacts(
            columns.total_current_a, sampled, trusted, columns.sample_ns
        )
        self._resolve_states(node_state, operational, implausible, stale)
        if len(began):
            self.state.solved[began] = False
            columns.values[began] = np.nan  # not a starting point: it is of the contact before
            self.baseline.begin_contacts(began)
            self.sheet_force.begin_contacts(began)
        self._sampled, self._trusted, self._baseline_samples_added = sampled, trusted, False
        self._sync_ns = cycle.sync_ns
        self.state.ticks[0] += 1
        solved = measured
        if self._some_skipped:
            due = self.state.ticks[0] % self.state.update_interval_ticks[measured] == 0
            measured = measured[due | np.isin(measured, began)]
            solved = measured[self.state.position_requested[measured]]
        if len(solved):
            self._solve_contacts(solved)
        if self.sheet_force.any_modelled:
            raw = self.columns.uncompensated_force_n
            self._store_compensated_forces(
                self.sheet_force.compensate_forces(
                    raw, self.state.uncompensated_std_n, contacts.touching, cycle.sync_ns
                )
            )
        if len(solved):
            np.fmax(
                contacts.peak_force_n, columns.force_n, out=contacts.peak_force_n, where=contacts.touching
            )
        if len(ended):
            self.state.published[ended] = np.nan
        updated = np.setdiff1d(measured, began) if len(began) else measured
        return TickResult(cycle.sync_ns, began, updated, ended, self._find_gaps(sampled))

    # Details of every tick. A ufunc on few elements costs its call, so rare conditions are tested first, by
    # `count_nonzero`, the fastest of numpy's calls ----------------------------------------------------------

    def _update_samples(self, slab: Slab, operational: BoolArray, cycle: Cycle, until_ns: int) -> BoolArray:
        """Set the sample times of new samples; return the pads (n,) that have one."""
        columns, size = self.columns, self.model.size
        sampled: BoolArray = (slab.arrival_ns != self.state.arrival_ns) & operational
        in_time = slab.fresh.view(np.bool_)
        if until_ns == _NO_LIMIT_NS:
            np.copyto(self.state.arrival_ns, slab.arrival_ns)
        else:
            here = slab.arrival_ns < until_ns
            sampled &= here
            in_time = in_time & here
            np.copyto(self.state.arrival_ns, slab.arrival_ns, where=here)
        np.copyto(columns.sample_ns, cycle.sync_ns, where=sampled)
        if np.count_nonzero(in_time) < size:
            missed = self.state.missed_sample_counts
            np.add(missed, self.expected_pads() & operational & ~in_time, out=missed)
            np.copyto(columns.sample_ns, cycle.previous_sync_ns, where=sampled & ~in_time)
        if np.count_nonzero(self.state.synchronous) < size:
            np.copyto(columns.sample_ns, slab.arrival_ns, where=sampled & ~self.state.synchronous)
        return sampled

    def _find_gaps(self, sampled: BoolArray) -> IntArray:
        """Return the contacts (k,) without the sample that was expected in this tick."""
        missing = self.contacts.touching > sampled
        if not np.count_nonzero(missing):
            return _NO_ROWS
        rows = np.flatnonzero(missing & self.state.synchronous)
        return np.asarray(rows[self.state.ticks[0] % self.state.update_interval_ticks[rows] == 0])

    def is_fresh(self, pad: int) -> bool:
        """Return True if the pad sent its last expected sample."""
        held = self.state
        limit_ns = 0 if held.synchronous[pad] else _MAX_SILENT_PERIODS * held.max_sample_period_ns[pad]
        return bool(held.silent_ns[pad] <= limit_ns)

    def _find_implausible(self, counts: NDArray[np.int64], slab: Slab) -> BoolArray:
        """Return the pads (n,) with a channel at the end of its range, or sourcing current.

        A sheet only sinks current. If all channels source, by no more than begins a contact, the baseline is
        wrong, not the pad: it was learned during a light touch."""
        railed, least, excess = slab.saturated(counts), self._min_counts, self._excess
        if not np.count_nonzero(railed) and not np.count_nonzero(excess < least):
            return self._no_pads
        limit = _MAX_NEGATIVE_FRACTION * np.abs(excess).sum(axis=1) - least[:, 0]
        sources = excess.min(axis=1) < -limit
        if np.count_nonzero(sources):
            amount_a = -(excess * self.model.ampere_per_count).sum(axis=1)
            sources &= (excess.max(axis=1) > -least[:, 0]) | (amount_a > self.model.begin_threshold_a)
        return np.asarray(railed.any(axis=1) | sources)

    def _find_silent(self, sampled: BoolArray, cycle: Cycle) -> tuple[BoolArray, BoolArray]:
        """Add the cycle to the silence of pads without a sample; return the pads (n,) that are stale, silent
        for three periods, and those whose contact ends for it."""
        silent_ns, period_ns = self.state.silent_ns, self.state.max_sample_period_ns
        if np.count_nonzero(sampled) == self.model.size:
            if np.count_nonzero(silent_ns):
                silent_ns.fill(0)
            return self._no_pads, self._no_pads
        np.add(
            silent_ns, np.minimum(max(cycle.sync_ns - cycle.previous_sync_ns, 0), period_ns), out=silent_ns
        )
        silent_ns[sampled] = 0
        half_ns = cycle.period_ns // 2  # times of SYNCs vary
        stale = silent_ns > _MAX_SILENT_PERIODS * period_ns - half_ns
        return np.asarray(stale), np.asarray(silent_ns > self.model.max_gap_periods * period_ns + half_ns)

    def _resolve_states(
        self,
        node_state: NDArray[np.uint8],
        operational: BoolArray,
        implausible: BoolArray,
        stale: BoolArray,
    ) -> None:
        state = self.columns.state
        np.copyto(state, node_state)
        np.copyto(state, _TOUCHED, where=operational & self.contacts.touching)
        if not (implausible is self._no_pads is stale):
            np.copyto(state, _FAULTED, where=operational & implausible)
            np.copyto(state, _STALE, where=operational & stale)

    def _solve_contacts(self, touched: IntArray) -> None:
        """Compute position and force of the contacts on the pads `touched`."""
        columns = self.columns
        np.multiply(self.baseline.std, self.model.mean_ampere_per_count, out=self._offset_std_a)
        self._solver.solve_contacts(touched.data)
        self.state.solved[touched] = True
        values = columns.values[touched]
        published = values[:, _PUBLISHED_VALUES]
        self.state.published[touched] = np.where(np.isfinite(published), published, np.nan)
        columns.force_saturated[touched] = values[:, _FORCE_STATUS] == _LOWER_BOUND
        if self.sheet_force.any_modelled:
            columns.uncompensated_force_n[touched] = values[:, _FORCE]
            self.state.uncompensated_std_n[touched] = values[:, _FORCE_STD]

    def _make_solver(self, model: PadModel) -> ContactSolver:
        return make_solver(
            model, self._currents, self._offset_std_a, self._estimate_force, self.columns.values
        )

    def _add_baseline_samples(self) -> None:
        """Count samples, and pass those of untouched pads to the baseline, unless a contact may be beginning.
        Runs after the messages of a tick are sent, off the critical path."""
        if self._baseline_samples_added:
            return
        self._baseline_samples_added = True
        np.add(self.state.sample_counts, self._sampled, out=self.state.sample_counts)
        free = self._sampled & self._trusted
        free &= self.columns.total_current_a <= self.model.begin_threshold_a
        free &= ~self.contacts.touching
        self.baseline.add_samples(self._excess, free)

    def _store_compensated_forces(self, pads: IntArray) -> None:
        """Replace forces of the contact law by compensated ones, for pads with a sheet model."""
        columns, compensated = self.columns, self.sheet_force
        force = np.where(compensated.state[pads] == _INVALID, np.nan, compensated.force_n[pads])
        std = np.where(columns.force_saturated[pads], np.inf, compensated.std_n[pads])
        columns.force_n[pads], columns.force_std_n[pads] = force, std
        columns.contact_columns["force_n"][pads] = force
        self.columns.contact_columns["force_std_n"][pads] = np.where(np.isfinite(std), std, np.nan)

    def detect_slips(self, result: TickResult) -> None:
        """Detect slip and lift-off of a tick's contacts; call it once the tick's messages are out."""
        if self.slip.any_requested:
            self.slip.detect_slips(np.concatenate([result.began, result.updated]))

    def prepare_next_tick(self) -> None:
        """Update the baseline. Call between two ticks, off the critical path: it changes no contact."""
        self._add_baseline_samples()
        if self._sync_ns:
            self.baseline.update_baseline(self._sync_ns, self.contacts.touching)
