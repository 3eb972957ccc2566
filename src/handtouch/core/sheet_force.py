"""Compensation of sheet behaviour (creep, adaptation, hysteresis) in forces, with their uncertainty.
Positions need none: they follow from ratios of currents.

Public names: `SheetForceCompensation`, `SheetBehaviour`, `sheet_behaviour_of`, `ForceReliability`,
`ForceReference`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch import sheet
from handtouch.arrays import BoolArray, FloatArray, IntArray
from handtouch.config import Behaviour
from handtouch.core.memory import RowArray, view_memory
from handtouch.core.stages.loads import SheetInterval, SheetLoads
from handtouch.core.stages.sheets import SHEET_LOAD_ROW, UPDATE_PERIOD_S, SheetStage
from handtouch.core.state import SHEET_ELEMENTS, SHEET_PLAYS, TickState

# Constants without an origin beside them were chosen; docs/benchmarks/supervise.md and soak_sheets.md
# measure what they yield.
_MIN_CONTACTS, _MIN_TOUCHED_S = 3, 5.0  # evidence before forces are reliable
_MIN_FORCE_N = 1e-6
_MIN_UNTOUCHED_PROBABILITY = 0.3  # that no undetected press occurred in a pause, however long
_MAX_FORCE_STD_FRACTION = 1.0  # deviation over the force: above it, the force is unreliable
_UNKNOWN_GAIN_STD = 0.15
"""Relative error of a sheet that wasn't measured: its loops, too"""
_HOUR_S = 3600.0
_LOG_GAIN_STD_PER_HOUR = 0.05  # random walk of a pad's gain
_MAX_LOG_GAIN_RATE_PER_S = 0.02  # so that no reference makes forces jump
_OUTLIER_SIGMA = 4.0  # references farther off don't count
_MAX_REFERENCE_OFFSET_NS = 50_000_000  # between a reference and the sample it is compared with
_MIN_CONTACT_AGE_S = 1.0  # age of a contact that is compared with a reference
_OF_PAD = (
    "compensated_force_n",
    "compensated_std_n",
    "relative_std",
    "force_reliability",
    "evidence_contacts",
    "touched_s",
    "touched_at_begin_s",
    "last_touch_ns",
    "new_contact",
    "force_confirmed",
    "log_gain",
    "log_gain_std",
    "compared_ns",
)
"""Arrays of the state with a row for each pad."""
_OF_COMPENSATOR = (
    "back_n",
    "back_std_n",
    "press_n",
    "current_flow_s",
    "flow_s",
    "impulse_ns",
    "powered",
)
"""Arrays of the same names as in `sheet.CompensatorState`"""
_OF_BANK = {field.name: f"bank_{field.name}" for field in fields(sheet.BankState)}
_OF_SHEET = ("sheet_elements", "sheet_plays", *_OF_COMPENSATOR, *_OF_BANK.values())
"""Arrays with a row for each modelled sheet, those of one behaviour in consecutive rows."""
_ZERO_AT_FIRST = (
    "evidence_contacts",
    "touched_s",
    "log_gain",
    "last_touch_ns",
    "compared_ns",
    "force_confirmed",
    "touched_at_begin_s",
    "sheets_updated_ns",
    "uncertainty_waited_s",
    "new_contact",
)
_OF_BEHAVIOUR = ("back_waited_s", "load_is_old")
_OF_ALL = ("sheets_updated_ns", "uncertainty_waited_s")
_MIN_REFERENCE_INTERVAL_S = 1.0  # references in quicker succession aren't independent


class ForceReliability(IntEnum):
    """Reliability of a pad's force."""

    UNRELIABLE = 0  # too little evidence since the calibration, baseline unknown, or the force within its std
    RELIABLE = 1


class ForceReference(NamedTuple):
    """Forces on pads (k,) rows, measured by another sensor (k,) [N], and their time."""

    pads: IntArray
    force_n: FloatArray
    std_n: FloatArray
    measured_ns: int


@dataclass(frozen=True)
class SheetBehaviour:
    """Models of a `[sheet.NAME.behaviour]`, and the uncertainty of their parameters.

    material: name of the sheet; what pads with it show is evidence for one another. max_force_n: greatest
    force of a contact, infinite where it is unknown.
    """

    model: sheet.SheetModel
    uncertainty: sheet.ParameterUncertainty
    gain_std: float
    back_force_std_n: float
    forget_time_s: float
    prior: sheet.BankPrior
    material: str = ""
    max_force_n: float = math.inf


class SheetForceCompensation:
    """Compensated forces of n pads; `behaviours`: sheet behaviour of each, None where it isn't modelled.

    Public state: `force_n`, `std_n` (n,) compensated, of touched pads; `state` (n,) of `ForceReliability`;
    evidence since the last calibration, `contacts` (n,) and `touched_s` (n,); `log_gain`, `log_gain_std`
    (n,): log of the factor applied to compensated forces, from reference forces.
    """

    def __init__(
        self,
        behaviours: Sequence[SheetBehaviour | None],
        period_ns: int,
        state: TickState | None = None,
    ) -> None:
        n = len(behaviours)
        held = TickState.empty(n) if state is None else state
        self._held = held
        self.modelled = np.array([behaviour is not None for behaviour in behaviours], np.bool_)
        self.any_modelled = bool(self.modelled.any())
        self.force_n, self.std_n = held.compensated_force_n, held.compensated_std_n
        self.state, self.contacts, self.touched_s = (
            held.force_reliability,
            held.evidence_contacts,
            held.touched_s,
        )
        self.log_gain, self.log_gain_std = held.log_gain, held.log_gain_std
        self.refused_contacts, self._refused_in = np.zeros((2, len(behaviours)), np.int64)
        """(n,) contacts in succession whose force references were all refused"""
        self.refused_log_ratio = np.zeros(len(behaviours))
        """(n,) ln of the last such reference over the force"""
        self._first_gain_std = np.array([0.0 if b is None else b.gain_std for b in behaviours])
        self._last_touch_ns, self._compared_ns = held.last_touch_ns, held.compared_ns
        self._confirmed, self._begin_s = held.force_confirmed, held.touched_at_begin_s
        self._updated_ns = held.sheets_updated_ns  # time of the sheets' state
        self._waited_s = held.uncertainty_waited_s  # since the last update of uncertainties
        self._new_contacts = held.new_contact  # since then
        self._relative_std = held.relative_std  # standard deviation over force
        self._period_ns = period_ns
        self._gain = np.ones(n)
        self._results = np.zeros(n, SHEET_LOAD_ROW).view(np.recarray)
        self._reset()
        self.groups = _make_groups(behaviours, held, self._results)
        self.loads = SheetLoads(held.memory, view_memory(self._sheet_rows()), SHEET_ELEMENTS, SHEET_PLAYS)
        """histories of the sheets, for loads by readings that aren't decided yet"""
        stage = self._make_stage()
        self.compensate_forces, self.store_forces = stage.compensate_forces, stage.store_forces
        self.complete_update, self.find_intervals = stage.complete_update, stage.find_intervals

    def with_behaviours(
        self, before: Sequence[SheetBehaviour | None], behaviours: Sequence[SheetBehaviour | None]
    ) -> SheetForceCompensation:
        """Return self, or an object that replaces it if behaviours changed; state of unchanged pads is
        kept."""
        if behaviours == before:
            return self
        kept = np.array([old == new for old, new in zip(before, behaviours, strict=True)])
        held, rows, numbers = self._held, self._sheet_rows(), self._behaviour_numbers()
        names = (*_OF_PAD, *_OF_SHEET, *_OF_BEHAVIOUR, *_OF_ALL)
        old_state = {name: getattr(held, name).copy() for name in names}
        fresh = SheetForceCompensation(behaviours, self._period_ns, held)
        for name in _OF_PAD:
            getattr(held, name)[kept] = old_state[name][kept]
        for name in _OF_ALL:
            getattr(held, name)[:] = old_state[name]
        held.last_touch_ns[:] = old_state["last_touch_ns"]  # whatever sheet was touched
        new_rows, new_numbers = fresh._sheet_rows(), fresh._behaviour_numbers()
        modelled = self.modelled & fresh.modelled
        held.powered[new_rows[modelled]] = old_state["powered"][rows[modelled]]
        for name in _OF_SHEET:
            getattr(held, name)[new_rows[modelled & kept]] = old_state[name][rows[modelled & kept]]
        for name in _OF_BEHAVIOUR:
            getattr(held, name)[new_numbers[modelled & kept]] = old_state[name][numbers[modelled & kept]]
        fresh.refresh()
        return fresh

    def _sheet_rows(self) -> IntArray:
        """Return the row (n,) of each pad's sheet in the state; -1 without a model."""
        rows = np.full(len(self.modelled), -1, np.intp)
        for group in self.groups:
            rows[group.pads] = group.first + np.arange(len(group.pads))
        return rows

    def _behaviour_numbers(self) -> IntArray:
        """Return the number (n,) of each pad's behaviour in the state; -1 without a model."""
        numbers = np.full(len(self.modelled), -1, np.intp)
        for group in self.groups:
            numbers[group.pads] = group.number
        return numbers

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        np.exp(self.log_gain, out=self._gain)
        for group in self.groups:
            group.bank.update_weights()

    def set_law_ages(self, age_s: FloatArray) -> None:
        """Set the ages (n,) [s] of contacts at which the pads' contact laws hold."""
        for group in self.groups:
            group.bank.set_law_ages(age_s[group.pads])

    def _reset(self) -> None:
        """Begin with fresh sheets, without evidence."""
        unreliable, reliable = ForceReliability.UNRELIABLE, ForceReliability.RELIABLE
        self.state[:] = np.where(self.modelled, unreliable, reliable)
        self.force_n[:] = self.std_n[:] = self._relative_std[:] = np.nan
        for name in _ZERO_AT_FIRST:
            getattr(self._held, name)[:] = 0
        self.log_gain_std[:] = self._first_gain_std

    def set_back_force(
        self, pad: int, back_n: float, std_n: float, learned: Sequence[float] = (), *, confirmed: bool = True
    ) -> None:
        """Set the back force of a pad's sheet [N], e.g. from a store, and what was learned of its behaviour
        (`learned_of`; empty: unchanged); `confirmed`: its forces are reliable without further evidence.
        Ignored for a pad without sheet model. Raises ValueError as `sheet.ModelBank.set_learned`."""
        if not self.modelled[pad]:
            return
        group, row = self._find_group(pad)
        if len(learned):
            group.bank.set_learned(row, np.asarray(learned, np.float64))
        back, spread = group.compensator.back_n.copy(), group.compensator.back_std_n.copy()
        back[row], spread[row] = back_n, std_n
        group.compensator.set_back_force(back, spread)
        self._confirmed[pad] |= confirmed

    def reset_evidence(self, pad: int, *, new_sheet: bool = False) -> None:
        """Restart the evidence: the pad has another calibration, and perhaps another sheet."""
        self.contacts[pad], self.touched_s[pad], self._begin_s[pad] = 0, 0.0, 0.0
        self.refused_contacts[pad] = self._refused_in[pad] = 0
        self._confirmed[pad] = False
        self.log_gain[pad], self._gain[pad] = 0.0, 1.0
        self.log_gain_std[pad] = self._first_gain_std[pad]
        if self.modelled[pad]:
            self.state[pad] = ForceReliability.UNRELIABLE
            if new_sheet:
                group, row = self._find_group(pad)
                group.compensator.reset_pads(np.array([row]))

    def set_excitation(self, on: BoolArray) -> None:
        """Set the pads (n,) whose sheet has its potential."""
        for group in self.groups:
            group.compensator.set_powered(on[group.pads])

    @property
    def back_force(self) -> tuple[FloatArray, FloatArray]:
        """Back force of each sheet and its standard deviation (n,) [N]; NaN where not modelled."""
        back, std = np.full(len(self.force_n), np.nan), np.full(len(self.force_n), np.nan)
        for group in self.groups:
            back[group.rows], std[group.rows] = group.compensator.back_n, group.compensator.back_std_n
        return back, std

    def learned_of(self, pad: int) -> FloatArray:
        """Return the learned behaviour of a sheet (`sheet.BANK_LEARNED`,); NaN if not modelled."""
        if not self.modelled[pad]:
            return np.full(sheet.BANK_LEARNED, np.nan)
        group, row = self._find_group(pad)
        return np.asarray(group.bank.learned[row])

    @property
    def adaptation_rejected(self) -> BoolArray:
        """Sheets (n,) whose adaptation isn't compensated, as their holds are steadier without."""
        rejected = np.zeros(len(self.force_n), np.bool_)
        for group in self.groups:
            rejected[group.rows] = group.bank.rejected
        return rejected

    def _find_group(self, pad: int) -> tuple[_BehaviourGroup, int]:
        """Return the group of a pad, and its row there."""
        return next((g, int(g.pads.searchsorted(pad))) for g in self.groups if pad in g.pads)

    def begin_contacts(self, began: IntArray) -> None:
        """Note contacts that began on these pads. In the pause before, a press below the threshold may have
        wiped the back force: take the mean of both possibilities, and their difference as uncertainty."""
        pause_s = np.maximum(self._updated_ns[0] - self._last_touch_ns[began], 0) * 1e-9
        for group in self.groups:
            rows = np.searchsorted(group.pads, began)
            here = np.flatnonzero(group.pads[np.minimum(rows, len(group.pads) - 1)] == began)
            group.decay_back_force(rows[here], pause_s[here])
        self.contacts[began] += 1
        self._begin_s[began] = self.touched_s[began]
        self._new_contacts[began] = True

    def update_gains(
        self, reference: ForceReference, sample_ns: npt.NDArray[np.int64], touching: BoolArray
    ) -> int:
        """Compare forces with a reference: a scalar Kalman filter on each pad's log gain, limited to 2 % a
        second. `sample_ns` (n,): times of the pads' samples. Return the number of pads updated; references
        that are late, unsteady, not positive or outliers are ignored."""
        pads = np.asarray(reference.pads)
        force, estimated = np.asarray(reference.force_n, np.float64), self.force_n[pads]
        since_s = (reference.measured_ns - self._compared_ns[pads]) * 1e-9
        with np.errstate(all="ignore"):
            usable = self.modelled[pads] & touching[pads] & (force > 0) & (estimated > 0)
            usable &= np.abs(sample_ns[pads] - reference.measured_ns) <= _MAX_REFERENCE_OFFSET_NS
            usable &= self.touched_s[pads] - self._begin_s[pads] >= _MIN_CONTACT_AGE_S
            usable &= since_s >= _MIN_REFERENCE_INTERVAL_S
            pads, force, estimated = pads[usable], force[usable], estimated[usable]
            since_s = since_s[usable]
            excess = np.log(force / estimated)
            spread = np.square(self.log_gain_std[pads])
            sheets = np.maximum(np.square(self.std_n[pads] / estimated) - spread, 0.0)
            noise = np.square(np.asarray(reference.std_n, np.float64)[usable] / force) + sheets
        since_s = np.minimum(since_s, _HOUR_S)
        spread = spread + np.square(_LOG_GAIN_STD_PER_HOUR) * since_s / _HOUR_S
        used = np.isfinite(excess) & (np.square(excess) <= _OUTLIER_SIGMA**2 * (spread + noise))
        refused = np.isfinite(excess) & ~used
        self._count_refused(pads[used], pads[refused], excess[refused])
        pads, excess, since_s = pads[used], excess[used], since_s[used]
        spread, noise = spread[used], noise[used]
        gain = spread / (spread + noise)
        most = _MAX_LOG_GAIN_RATE_PER_S * np.minimum(since_s, 60.0)
        move = np.clip(gain * excess, -most, most)
        self.log_gain[pads] += move
        clipped = np.abs(gain * excess - move)
        self.log_gain_std[pads] = np.sqrt((1 - gain) * spread + np.square(clipped))
        self._gain[pads] = np.exp(self.log_gain[pads])
        self._compared_ns[pads] = reference.measured_ns
        self._confirmed[pads] = True
        return len(pads)

    def _count_refused(self, used: IntArray, refused: IntArray, log_ratio: FloatArray) -> None:
        """Count contacts whose references are refused, and note the last of their ratios to the force."""
        self.refused_contacts[used] = 0
        new = refused[self._refused_in[refused] != self.contacts[refused]]
        self.refused_contacts[new] += 1
        self._refused_in[new] = self.contacts[new]
        self.refused_log_ratio[refused] = log_ratio

    def _make_stage(self) -> SheetStage:
        pads = np.array([pad for group in self.groups for pad in group.pads.tolist()], np.int64)
        limits = [group.max_force_n for group in self.groups for _ in group.pads]
        return SheetStage(
            self._held,
            self.loads,
            view_memory(pads),
            view_memory(np.array(limits, np.float64)),
            view_memory(self._gain),
            self._results,
            self._period_ns,
            self,
        )

    def make_steps(self, dt_s: float) -> list[SheetInterval]:
        """Return the intervals of all behaviours of a duration."""
        return [group.interval(dt_s) for group in self.groups]

    def update(self, uncertainties: bool) -> None:
        """Update back forces that are due, and with `uncertainties` those of the forces of touched pads."""
        for number, group in enumerate(self.groups):
            if self._held.back_waited_s[number] >= UPDATE_PERIOD_S:
                group.compensator.update_back_force()
        if uncertainties:
            touching = self._held.touching.astype(np.bool_)
            self.touched_s += self._waited_s[0] * touching
            self._waited_s[0] = 0.0
            self._update_uncertainty(touching)

    def update_began(self) -> None:
        """Compute standard deviations and reliability of pads whose contact began in this tick."""
        began = (self._held.touching & self._new_contacts).astype(np.bool_)
        # the end of the interval counts all of it
        self.touched_s[began] -= self._waited_s[0]
        self._begin_s[began] -= self._waited_s[0]
        self._new_contacts[:] = False
        self._update_uncertainty(began)

    def _update_uncertainty(self, pads: BoolArray) -> None:
        """Update standard deviations and reliability of touched pads."""
        pressed, apparent_n = np.flatnonzero(pads & self.modelled), self._held.uncompensated_force_n
        force = self.force_n[pressed]
        for group in self.groups:
            self.std_n[group.rows] = group.compensator.std_n()
        law_n = self._held.uncompensated_std_n[pressed]
        law_n = np.where(law_n < np.inf, law_n, 0.0)  # a lower bound of the law has its margin
        with np.errstate(all="ignore"):
            relative = law_n / apparent_n[pressed]
            # either includes the error of the contact law
            common = np.maximum(relative, self.log_gain_std[pressed])
            variance = np.square(self.std_n[pressed]) + np.square(force * common)
        self.std_n[pressed] = std = np.sqrt(variance)
        self._relative_std[pressed] = std / np.maximum(force, _MIN_FORCE_N)
        enough = (self.contacts[pressed] >= _MIN_CONTACTS) & (self.touched_s[pressed] >= _MIN_TOUCHED_S)
        known = enough | self._confirmed[pressed]
        sane = std < _MAX_FORCE_STD_FRACTION * force  # False for what isn't finite
        self.state[pressed] = sane & known


class _BehaviourGroup:
    """Pads of equal sheet behaviour, the group `number`; `state`: of their sheets, from row `first` on."""

    def __init__(
        self,
        number: int,
        first: int,
        behaviour: SheetBehaviour,
        pads: IntArray,
        state: sheet.CompensatorState,
        bank: sheet.BankState,
        results: RowArray,
    ) -> None:
        self.pads, self.number, self.first = pads, number, first
        whole = len(pads) == pads[-1] - pads[0] + 1
        self.rows: slice | IntArray = slice(int(pads[0]), int(pads[-1]) + 1) if whole else pads
        self._forget_time_s, self.max_force_n = behaviour.forget_time_s, behaviour.max_force_n
        self.bank = sheet.ModelBank(behaviour.model.adaptation, behaviour.prior, bank)
        self.compensator = sheet.SheetCompensator(
            behaviour.model,
            len(pads),
            behaviour.uncertainty,
            update_period_s=UPDATE_PERIOD_S,
            state=state,
            bank=self.bank,
        )
        steps = results.view(np.float64).reshape(len(results), -1)
        self.compensator.last_step = steps[first : first + len(pads)].T
        if behaviour.back_force_std_n and np.any(behaviour.model.adaptation.share):
            self.compensator.set_back_force(0.0, behaviour.back_force_std_n)

    def interval(self, dt_s: float) -> SheetInterval:
        """Return an interval of this duration."""
        model = self.compensator.model
        creep, hysteresis = model.creep.discretise(dt_s), model.hysteresis.inverse
        arrays = {
            "lines": creep.inverse_lines,
            "transition": creep.transition,
            "widths_n": hysteresis.widths_n,
            "weights": hysteresis.weights,
        }
        return SheetInterval(
            self.number,
            slice(self.first, self.first + len(self.pads)),
            dt_s,
            float(model.creep.total),
            float(hysteresis.base),
            {name: view_memory(np.array(values, np.float64)) for name, values in arrays.items()},
        )

    def decay_back_force(self, rows: IntArray, pause_s: FloatArray) -> None:
        """Update back forces of rows after a pause. An undetected press may have wiped them, more probably
        the longer the pause and the larger the back force; else they are unchanged. Set mean and variance
        over both. The rate of such presses is unknown (exponential prior), and without activity it is 0: the
        probability never reaches 1, and both possibilities stay within 1.96 standard deviations."""
        back, std = self.compensator.back_n, self.compensator.back_std_n
        kept = _MIN_UNTOUCHED_PROBABILITY + (1 - _MIN_UNTOUCHED_PROBABILITY) / (
            1 + pause_s / self._forget_time_s * back[rows]
        )
        std[rows] = np.sqrt(kept * (np.square(std[rows]) + (1 - kept) * np.square(back[rows])))
        back[rows] *= kept
        self.bank.begin_contacts(rows, pause_s / self._forget_time_s, _MIN_UNTOUCHED_PROBABILITY)


def _make_groups(
    behaviours: Sequence[SheetBehaviour | None], held: TickState, results: RowArray
) -> list[_BehaviourGroup]:
    """Return the pads by sheet behaviour, with fresh sheets in consecutive rows of the state."""
    groups, first = [], 0
    for number, kind in enumerate(dict.fromkeys(b for b in behaviours if b is not None)):
        pads = np.flatnonzero([b == kind for b in behaviours])
        rows = slice(first, first + len(pads))
        first += len(pads)
        elements, plays = 1 + len(kind.model.creep.times_s), len(kind.model.hysteresis.widths_n)
        if elements > SHEET_ELEMENTS or plays > SHEET_PLAYS:
            raise ValueError(f"a sheet model of {elements} elements and {plays} plays is too large")
        state = sheet.CompensatorState(
            elements=held.sheet_elements[rows].T[:elements],
            plays=held.sheet_plays[rows].T[:plays],
            waited_s=held.back_waited_s[number : number + 1],
            load_is_old=held.load_is_old[number : number + 1],
            **{name: getattr(held, name)[rows] for name in _OF_COMPENSATOR},
        )
        for part in vars(state).values():
            part[:] = 0
        state.powered[:] = True
        bank = sheet.BankState(**{name: getattr(held, array)[rows] for name, array in _OF_BANK.items()})
        groups.append(_BehaviourGroup(number, rows.start, kind, pads, state, bank, results))
    return groups


def sheet_behaviour_of(behaviour: Behaviour, material: str = "") -> SheetBehaviour:
    """Build the preset with the deployment's changes, and the uncertainty of its parameters, of the sheet of
    that name."""
    preset = {"S1": sheet.S1, "S2": sheet.S2, "unknown": sheet.UNKNOWN}[behaviour.preset]
    adaptation, creep, noise = preset.adaptation, preset.creep, preset.fluctuation
    share, time_s = 1 - creep.instant, creep.times_s[0]
    share = share if behaviour.creep_share is None else behaviour.creep_share
    time_s = time_s if behaviour.creep_time_s is None else behaviour.creep_time_s
    changed = {
        "share": behaviour.adaptation_share,
        "time_s": behaviour.adaptation_time_s,
        "recovery_s": behaviour.recovery_time_s,
        "fatigue_s": behaviour.fatigue_s,
        "threshold_n": behaviour.threshold_n,
    }
    model = replace(
        preset,
        adaptation=replace(adaptation, **{key: value for key, value in changed.items() if value is not None}),
        creep=sheet.Creep.first_order(1 - share, time_s) if share else sheet.Creep(1.0, (), ()),
        fluctuation=noise if behaviour.press_std is None else replace(noise, press_std=behaviour.press_std),
    )
    if behaviour.hysteresis_width:
        loop = sheet.PrandtlIshlinskii.from_width(
            behaviour.hysteresis_width, behaviour.hysteresis_full_scale_n
        )
        model = replace(model, hysteresis=loop)
    uncertainty = sheet.ParameterUncertainty(
        behaviour.parameter_std_fraction,
        behaviour.parameter_std_fraction,
        behaviour.parameter_std_fraction,
        math.inf,
        late_creep=behaviour.parameter_std_fraction * (behaviour.creep_share or 0.0),
    )
    return SheetBehaviour(
        model,
        uncertainty,
        _gain_std_of(behaviour),
        behaviour.back_force_std_n * float(np.max(model.adaptation.share)),
        behaviour.forget_time_s,
        _prior_of(behaviour),
        material,
    )


def _gain_std_of(behaviour: Behaviour) -> float:
    """Return the relative error of forces on a fresh sheet beyond the law's, common to all presses."""
    if behaviour.gain_std is not None:
        return behaviour.gain_std
    return _UNKNOWN_GAIN_STD if behaviour.preset == "unknown" else 0.0


def _prior_of(behaviour: Behaviour) -> sheet.BankPrior:
    """Return how far a sheet may be from its description."""
    if behaviour.preset == "unknown":
        return sheet.BankPrior(log_time_std=1.5, not_adapting=0.5, exponent_std=0.1)
    measured = behaviour.adaptation_share is not None
    return sheet.BankPrior(
        log_time_std=0.25 if measured else 0.5,
        not_adapting=0.01 if measured else 0.15,
        exponent_std=behaviour.slow_creep,
    )
