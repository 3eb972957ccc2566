"""Compensation of creep and adaptation in forces: standard deviation and reliability."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import sheet
from handtouch.config import Behaviour
from handtouch.core.sheet_force import (
    ForceReference,
    ForceReliability,
    SheetForceCompensation,
    sheet_behaviour_of,
)
from handtouch.core.state import TickState
from handtouch.daemon.pad_reports import LawReport

FloatArray = NDArray[np.float64]
PERIOD_NS, DT_S = 100_000_000, 0.1
LIKE_S1 = sheet_behaviour_of(Behaviour(gain_std=0.0, back_force_std_n=0.0))


class Rig:
    """Sheets of a model under loads; the compensation knows `behaviour` only."""

    def __init__(
        self, pads: int, model: sheet.SheetModel, behaviour: object = LIKE_S1, seed: int = 1
    ) -> None:
        self.tick_state = TickState.empty(pads)
        self.compensation = SheetForceCompensation([behaviour] * pads, PERIOD_NS, self.tick_state)  # type: ignore[list-item]
        self._state, self._step = model.initial_state(pads, seed), model.discretise(DT_S)
        self.t_ns, self.touching = 10**9, np.zeros(pads, np.bool_)
        self.compensate(np.zeros(pads))

    def compensate(self, apparent: FloatArray) -> None:
        self.tick_state.touching[:] = self.touching
        self.tick_state.uncompensated_force_n[:], self.tick_state.uncompensated_std_n[:] = apparent, 0.0
        self.compensation.compensate_forces(self.t_ns)
        self.compensation.complete_update()

    def run(self, seconds: float, load_n: FloatArray) -> None:
        for _ in range(round(seconds / DT_S)):
            self.t_ns += PERIOD_NS
            apparent = self._step.forward(self._state, load_n)
            touching = apparent > 0.05
            self.compensation.begin_contacts(np.flatnonzero(touching & ~self.touching))
            self.touching = touching
            self.apparent = apparent
            self.compensate(apparent)

    def cycle(self, times: int, load_n: FloatArray) -> None:
        for _ in range(times):
            self.run(2.0, load_n)
            self.run(0.5, 0 * load_n)


def calm(model: sheet.SheetModel) -> sheet.SheetModel:
    return replace(model, fluctuation=sheet.Fluctuation())


QUICK = replace(calm(sheet.S1), adaptation=replace(sheet.S1.adaptation, time_s=300.0, fatigue_s=1000.0))
LIKE_QUICK = sheet_behaviour_of(
    Behaviour(gain_std=0.0, back_force_std_n=0.0, adaptation_time_s=300.0, fatigue_s=1000.0)
)


def test_the_load_on_a_known_sheet_is_recovered() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(90.0, load)
    assert rig.apparent[0] < 0.8 * load[0]
    assert rig.compensation.force_n[0] == pytest.approx(load[0], rel=0.02)


def test_a_force_is_reliable_after_evidence_and_again_after_a_new_calibration() -> None:
    rig, load = Rig(2, calm(sheet.S1)), np.array([2.0, 2.0])
    rig.cycle(2, load)
    assert rig.compensation.state.tolist() == [ForceReliability.UNRELIABLE] * 2
    rig.cycle(2, load)
    rig.run(0.5, load)
    assert rig.compensation.state.tolist() == [ForceReliability.RELIABLE] * 2
    assert rig.compensation.contacts[0] == 5
    assert rig.compensation.touched_s[0] == pytest.approx(8.4, abs=0.5)
    rig.compensation.reset_evidence(0, new_sheet=True)
    rig.run(0.5, load)
    assert rig.compensation.state.tolist() == [ForceReliability.UNRELIABLE, ForceReliability.RELIABLE]
    assert rig.compensation.back_force[0][0] < rig.compensation.back_force[0][1]


def test_a_stored_back_force_is_reliable_at_once() -> None:
    rig = Rig(1, calm(sheet.S1))
    rig.compensation.set_back_force(0, 0.0, 0.05)
    rig.run(0.5, np.array([2.0]))
    assert rig.compensation.state[0] == ForceReliability.RELIABLE


def test_a_force_with_unknown_back_force_is_unreliable() -> None:
    rig = Rig(1, calm(sheet.S1))
    rig.compensation.set_back_force(0, 1.0, 3.0)
    rig.run(0.5, np.array([2.0]))
    assert rig.compensation.state[0] == ForceReliability.UNRELIABLE
    assert rig.compensation.std_n[0] > rig.compensation.force_n[0] > 0.0


def test_a_pause_makes_the_back_force_uncertain() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(60.0, load)
    back, before = (float(value[0]) for value in rig.compensation.back_force)
    rig.run(60.0, 0 * load)
    rig.run(0.1, load)
    fell = back - rig.compensation.back_force[0][0]
    assert 0.2 * back < fell < 0.7 * back
    assert rig.compensation.back_force[1][0] > max(0.4 * back, 1.2 * before)


def test_the_std_of_the_back_force_never_exceeds_it_after_any_number_of_pauses() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(60.0, load)
    for _ in range(10):
        rig.run(5.0, 0 * load)
        rig.run(0.5, load)
        back, std = (float(value[0]) for value in rig.compensation.back_force)
    assert std < load[0] - back < load[0]


def test_standard_deviations_cover_sheets_with_varied_parameters() -> None:
    """200 sheets with parameters spread about the preset's, under many loads."""
    pads, rng = 200, np.random.default_rng(5)
    spread = np.exp(rng.normal(0, 0.2, (2, pads)))
    adaptation = replace(sheet.S1.adaptation, time_s=3000.0 * spread[0], fatigue_s=1e4 * spread[1])
    rig = Rig(
        pads,
        replace(sheet.S1, adaptation=adaptation),
        sheet_behaviour_of(Behaviour(gain_std=0.0, back_force_std_n=0.0)),
    )
    inside, counted = 0, 0
    for _ in range(12):
        load = rng.uniform(0.3, 5.0, pads)
        rig.run(rng.uniform(1.5, 20.0), load)
        valid = rig.touching & (rig.compensation.state == ForceReliability.RELIABLE)
        off = np.abs(rig.compensation.force_n - load) < 1.96 * rig.compensation.std_n
        inside, counted = inside + int(off[valid].sum()), counted + int(valid.sum())
        rig.run(rng.uniform(0.3, 3.0), 0 * load)
    assert counted > 0.8 * 12 * pads
    assert 0.9 < inside / counted < 0.99


def test_standard_deviations_cover_a_long_hold_with_another_final_value() -> None:
    """The final response of an S2 is off by a fifth: the error enters load and back force."""
    pads, rng = 100, np.random.default_rng(8)
    final = (1 - np.asarray(sheet.S2.adaptation.share)) * np.exp(rng.normal(0, 0.2, pads))
    model = replace(sheet.S2, adaptation=replace(sheet.S2.adaptation, share=1 - final, time_s=60.0))
    behaviour = Behaviour(
        preset="S2",
        adaptation_time_s=60.0,
        gain_std=0.0,
        back_force_std_n=0.0,
        slow_creep=0.0,
        press_std=0.05,
    )
    rig = Rig(
        pads, replace(model, fluctuation=sheet.Fluctuation(press_std=0.05)), sheet_behaviour_of(behaviour)
    )
    load = rng.uniform(1.0, 4.0, pads)
    rig.cycle(4, load)
    rig.run(240.0, load)
    off = np.abs(rig.compensation.force_n - load)
    assert 0.9 < (off < 1.96 * rig.compensation.std_n).mean() <= 1
    assert np.sqrt(np.mean(off**2)) > 0.33 * np.sqrt(np.mean(rig.compensation.std_n**2))


def test_a_creep_that_was_described_may_end_later_than_described() -> None:
    film = replace(
        calm(sheet.S2),
        adaptation=replace(sheet.S2.adaptation, share=0.0),
        creep=sheet.Creep(0.7, (0.2, 0.1), (0.4, 30.0)),
    )
    described = Behaviour(
        preset="S2", adaptation_share=0.0, creep_share=0.3, creep_time_s=0.6, press_std=0.0, gain_std=0.0
    )
    rig = Rig(1, film, sheet_behaviour_of(described))
    rig.run(3.0, np.array([2.0]))
    assert rig.compensation.force_n[0] < 2.0 - 0.1
    assert rig.compensation.force_n[0] + 1.96 * rig.compensation.std_n[0] > 2.0


def stds_by_law(rig: Rig, law_std: float) -> tuple[float, float]:
    """Return deviations of a force of 3 N without, and with, a relative error of the contact law."""
    rig.run(2.0, np.full(2, 3.0))
    rig.tick_state.uncompensated_std_n[:] = rig.apparent * [0.0, law_std]
    for _ in range(2):
        rig.t_ns += PERIOD_NS
        rig.compensation.compensate_forces(rig.t_ns)
        rig.compensation.complete_update()
    without, with_law = rig.compensation.std_n.tolist()
    return without, with_law


def test_the_error_of_the_contact_law_counts_once() -> None:
    rig = Rig(2, calm(sheet.S1), sheet_behaviour_of(Behaviour(gain_std=0.1, press_std=0.0)))
    without, with_law = stds_by_law(rig, 0.1)
    assert without == pytest.approx(with_law, rel=1e-6)


def test_forces_by_a_law_of_small_error_are_as_certain_as_that_law() -> None:
    behaviour = Behaviour(preset="S1", press_std=0.0, slow_creep=0.0, back_force_std_n=0.0)
    rig = Rig(2, calm(sheet.S1), sheet_behaviour_of(behaviour))
    without, with_law = stds_by_law(rig, 0.02)
    assert with_law == pytest.approx(np.hypot(without, 0.02 * 3.0), rel=0.02)
    assert without < 0.03 * 3.0


def test_slow_creep_that_is_not_learned_yet_is_as_uncertain_as_stated() -> None:
    variances = []
    for slow_creep in (0.0, 0.02, 0.04):
        behaviour = Behaviour(preset="S1", press_std=0.0, slow_creep=slow_creep, back_force_std_n=0.0)
        rig = Rig(1, calm(sheet.S1), sheet_behaviour_of(behaviour))
        rig.run(1.9, np.full(1, 3.0))
        variances.append(rig.compensation.std_n[0] ** 2)
    none, some, twice = variances
    assert some > none
    assert twice - none == pytest.approx(4 * (some - none), rel=1e-3)


def test_a_sheet_that_does_not_adapt_has_no_adapted_force_from_earlier_loads() -> None:
    behaviour = sheet_behaviour_of(Behaviour(adaptation_share=0.0, back_force_std_n=0.3))
    assert Rig(1, QUICK, behaviour).compensation.back_force[1][0] == 0
    half = sheet_behaviour_of(Behaviour(adaptation_share=0.5, back_force_std_n=0.3))
    assert Rig(1, QUICK, half).compensation.back_force[1][0] == pytest.approx(0.15)


def test_reference_forces_estimate_the_gain_at_a_limited_rate() -> None:
    behaviour = sheet_behaviour_of(Behaviour(gain_std=0.2, back_force_std_n=0.0))
    rig, rng, load = Rig(2, calm(sheet.S1), behaviour), np.random.default_rng(6), np.array([2.0, 2.0])
    true = 1.25
    for _ in range(40):
        rig.run(2.0, load)
        measured = true * load * (1 + rng.normal(0, 0.05, 2))
        reference = ForceReference(np.array([0]), measured[:1], np.array([0.05 * 2.5]), rig.t_ns)
        before = rig.compensation.log_gain[0]
        rig.compensation.update_gains(reference, np.full(2, rig.t_ns), rig.touching)
        assert abs(rig.compensation.log_gain[0] - before) <= 0.02 * 60
        rig.run(0.3, 0 * load)
    rig.run(2.0, load)
    assert rig.compensation.force_n[0] == pytest.approx(true * 2.0, rel=0.05)
    assert rig.compensation.force_n[1] == pytest.approx(2.0, rel=0.05)
    assert rig.compensation.log_gain_std[0] < 0.05 < rig.compensation.log_gain_std[1]


@pytest.mark.parametrize(
    ("force", "late_ns"), [(np.nan, 0), (0.0, 0), (-1.0, 0), (200.0, 0), (2.0, 80_000_000)]
)
def test_a_late_or_implausible_reference_is_ignored(force: float, late_ns: int) -> None:
    rig = Rig(1, calm(sheet.S1), sheet_behaviour_of(Behaviour()))
    rig.run(3.0, np.array([2.0]))
    reference = ForceReference(np.array([0]), np.array([force]), np.array([0.1]), rig.t_ns + late_ns)
    assert rig.compensation.update_gains(reference, np.full(1, rig.t_ns), rig.touching) == 0
    assert rig.compensation.log_gain[0] == 0.0


@pytest.mark.parametrize(("ratio", "reported"), [(4.0, True), (1.3, False)])
def test_contacts_whose_references_are_refused_report_another_law(ratio: float, reported: bool) -> None:
    rig, load, report = Rig(1, calm(sheet.S1), sheet_behaviour_of(Behaviour())), np.array([2.0]), LawReport(1)
    found = []
    for _ in range(3):
        for _ in range(4):  # several references of one contact count once
            rig.run(1.5, load)
            reference = ForceReference(np.array([0]), ratio * load, np.array([0.1]), rig.t_ns)
            rig.compensation.update_gains(reference, np.full(1, rig.t_ns), rig.touching)
        found.append(report.update(rig.compensation, 0, rig.t_ns))
        rig.run(0.5, 0 * load)
    assert found[:2] == [None, None]
    assert (found[2] is not None) is reported
    if found[2] is None:
        return
    assert found[2].kind == "sheet_replaced"
    assert "of 3 contacts in succession" in found[2].evidence
    rig.compensation.reset_evidence(0)
    assert report.update(rig.compensation, 0, rig.t_ns) is None


def test_sheets_of_two_behaviours_and_none_are_independent() -> None:
    s2 = sheet_behaviour_of(Behaviour(preset="S2", hysteresis_width=0.1))
    state = TickState.empty(4)
    compensation = SheetForceCompensation([LIKE_S1, None, s2, LIKE_S1], PERIOD_NS, state)
    state.uncompensated_force_n[:3], state.uncompensated_std_n[:], state.touching[:3] = 1.0, 0.1, True
    for t_ns in range(10**9, 2 * 10**9, PERIOD_NS):
        compensation.compensate_forces(t_ns)
        compensation.complete_update()
    assert np.isfinite(compensation.std_n).tolist() == [True, False, True, True]
    assert (compensation.force_n[[0, 2]] > 0).all()
    assert compensation.state[1] == ForceReliability.RELIABLE
    again = compensation.with_behaviours([LIKE_S1, None, s2, LIKE_S1], [LIKE_S1, None, LIKE_S1, LIKE_S1])
    assert again.touched_s[0] == compensation.touched_s[0] > 0
    assert again.state[2] == ForceReliability.UNRELIABLE


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(-500, 8000).map(lambda mn: mn / 1000), st.booleans(), st.integers(1, 3)),
        min_size=1,
        max_size=40,
    ),
    st.sampled_from(["S1", "S2"]),
    st.sampled_from([0.0, 0.1]),
)
def test_loads_are_those_of_the_inverse_model(
    steps: list[tuple[float, bool, int]], preset: Literal["S1", "S2"], hysteresis_width: float
) -> None:
    behaviour = sheet_behaviour_of(
        Behaviour(preset=preset, hysteresis_width=hysteresis_width, gain_std=0.0, back_force_std_n=0.0)
    )
    certain = sheet.BankPrior(log_time_std=1e-12, not_adapting=1e-18, exponent_std=0.0)
    behaviour = replace(behaviour, prior=certain)
    inverse = sheet.SheetCompensator(behaviour.model, 1, behaviour.uncertainty, update_period_s=DT_S)
    rig = Rig(1, calm(sheet.S1), behaviour)
    for apparent, touching, periods in steps:
        rig.t_ns += periods * PERIOD_NS
        rig.touching[:] = touching
        rig.compensate(np.array([apparent]))
        expected = inverse.compensate(np.array([apparent * touching]), periods * DT_S)
        np.testing.assert_allclose(rig.compensation.force_n, expected, rtol=1e-9, atol=1e-9)


def test_the_keys_of_a_behaviour_change_its_preset() -> None:
    made = sheet_behaviour_of(
        Behaviour(
            preset="S2",
            adaptation_share=0.5,
            adaptation_time_s=100.0,
            creep_share=0.0,
            hysteresis_width=0.1,
            parameter_std_fraction=0.1,
        )
    )
    assert (made.model.adaptation.share, made.model.adaptation.time_s) == (0.5, 100.0)
    assert made.model.adaptation.recovery_s == sheet.S2.adaptation.recovery_s
    assert made.model.creep.times_s == ()
    assert made.model.hysteresis.widths_n
    assert made.uncertainty.creep == 0.1


def test_intervals_of_an_unknown_sheet_are_wide_and_narrow_with_holds_and_force_references() -> None:
    """On a sheet that neither adapts nor creeps, and reads 15 % too high."""
    settled = sheet.SheetModel(replace(sheet.UNKNOWN.adaptation, share=0.0))
    unknown = Rig(1, settled, sheet_behaviour_of(Behaviour(preset="unknown")))
    measured = Rig(1, settled, sheet_behaviour_of(Behaviour(preset="S1")))
    true, read = 2.0, np.array([2.3])

    def hold(rig: Rig, seconds: float) -> float:
        """Return the standard deviation during a hold, and release."""
        rig.run(seconds, read)
        std = float(rig.compensation.std_n[0])
        assert rig is measured or abs(rig.compensation.force_n[0] - true) < 1.96 * std
        rig.run(2.0, 0 * read)
        return std

    first = hold(unknown, 4.0)
    assert first > 1.7 * hold(measured, 4.0)
    for _ in range(3):
        hold(unknown, 400.0)
    assert unknown.compensation.adaptation_rejected[0]
    used = hold(unknown, 4.0)
    assert used < first
    for _ in range(30):
        unknown.run(2.0, read)
        reference = ForceReference(np.array([0]), np.array([true]), np.array([0.02]), unknown.t_ns)
        unknown.compensation.update_gains(reference, np.array([unknown.t_ns]), unknown.touching)
    assert hold(unknown, 4.0) < 0.8 * used


CREEPING = sheet_behaviour_of(
    Behaviour(gain_std=0.0, back_force_std_n=0.0, creep_share=0.3, creep_time_s=20.0)
)
CREEPS = replace(QUICK, creep=sheet.Creep.first_order(0.7, 20.0))


@pytest.mark.parametrize("unknown_s", [0.1, 1.0])
def test_unknown_force_of_a_held_contact_is_no_release(unknown_s: float) -> None:
    held, disturbed = (Rig(1, CREEPS, CREEPING) for _ in range(2))
    for rig in (held, disturbed):
        rig.run(60.0, np.array([1.5]))
    for _ in range(round(unknown_s / DT_S)):
        disturbed.t_ns += PERIOD_NS
        disturbed.compensate(np.array([np.nan]))
        assert np.isnan(disturbed.compensation.force_n[0])
    held.run(unknown_s, np.array([1.5]))
    for rig in (held, disturbed):
        rig.run(0.1, np.array([1.5]))
    assert disturbed.compensation.force_n[0] == pytest.approx(held.compensation.force_n[0], rel=0.01)


OTHER = sheet_behaviour_of(Behaviour(gain_std=0.1, back_force_std_n=0.0, adaptation_share=0.2))


@settings(max_examples=15, deadline=None)
@given(
    kept=st.lists(st.sampled_from([LIKE_S1, LIKE_QUICK]), min_size=2, max_size=2),
    before=st.lists(st.sampled_from([CREEPING, OTHER]), min_size=2, max_size=2),
    after=st.lists(st.sampled_from([CREEPING, OTHER]), min_size=2, max_size=2),
    order=st.permutations(range(4)),
    ticks=st.integers(0, 20),
    excited=st.lists(st.booleans(), min_size=4, max_size=4),
)
def test_pads_whose_sheet_is_unchanged_are_not_disturbed_by_a_reload(
    kept: list[object],
    before: list[object],
    after: list[object],
    order: list[int],
    ticks: int,
    excited: list[bool],
) -> None:
    """Sheets of one behaviour are evidence for each other, so those of kept pads are a kind of their own."""
    old, new = ([[*kept, *others][pad] for pad in order] for others in (before, after))
    loads = np.array([0.5, 3.0, 0.0, 1.5])
    rigs = [Rig(4, QUICK, LIKE_S1) for _ in range(2)]
    for rig in rigs:
        rig.compensation = SheetForceCompensation(old, PERIOD_NS, rig.tick_state)  # type: ignore[arg-type]
        rig.compensation.set_excitation(np.array(excited))
        rig.run(2.0 + ticks * DT_S, loads)
    rigs[0].compensation = rigs[0].compensation.with_behaviours(old, new)  # type: ignore[arg-type]
    unchanged = np.array(order) < 2
    for seconds, load in ((0.0, loads), (0.7, loads), (0.7, 0 * loads), (0.7, loads)):
        results = []
        for rig in rigs:
            rig.run(seconds, load)
            made = rig.compensation
            columns = made.force_n, made.std_n, *made.back_force, made.log_gain
            results.append(np.stack(columns)[:, unchanged])
        # rounding depends on the number of sheets that are computed together
        np.testing.assert_allclose(results[0], results[1], rtol=1e-12 if seconds else 0, atol=1e-15)
