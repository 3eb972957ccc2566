"""Forces on sheets that creep and adapt: compensated, with an honest deviation, or told to be worth none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import sheet
from handtouch.config import Behaviour
from handtouch.supervise.strength import (
    ForceReference,
    SheetStrength,
    StrengthState,
    behaviour_of,
)

FloatArray = NDArray[np.float64]
PERIOD_NS, DT_S = 100_000_000, 0.1
LIKE_S1 = behaviour_of(Behaviour(gain_std=0.0, history_std_n=0.0))


class Rig:
    """Sheets of a model under loads, and what becomes of them; the estimator is told `behaviour` alone."""

    def __init__(
        self, pads: int, model: sheet.SheetModel, behaviour: object = LIKE_S1, seed: int = 1
    ) -> None:
        self.strength = SheetStrength([behaviour] * pads, PERIOD_NS)  # type: ignore[list-item]
        self._state, self._step = model.start(pads, seed), model.at(DT_S)
        self.t_ns, self.touching = 10**9, np.zeros(pads, np.bool_)
        self.strength.step(np.zeros(pads), np.zeros(pads), self.touching, self.t_ns)

    def run(self, seconds: float, load_n: FloatArray) -> None:
        for _ in range(round(seconds / DT_S)):
            self.t_ns += PERIOD_NS
            apparent = self._step.forward(self._state, load_n)
            touching = apparent > 0.05
            self.strength.begin(np.flatnonzero(touching & ~self.touching))
            self.touching = touching
            self.apparent = apparent
            self.strength.step(apparent, 0.0 * apparent, touching, self.t_ns)

    def cycle(self, times: int, load_n: FloatArray) -> None:
        for _ in range(times):
            self.run(2.0, load_n)
            self.run(0.5, 0 * load_n)


def calm(model: sheet.SheetModel) -> sheet.SheetModel:
    return replace(model, fluctuation=sheet.Fluctuation())


QUICK = replace(calm(sheet.S1), adaptation=replace(sheet.S1.adaptation, time_s=300.0, fatigue_s=1000.0))
LIKE_QUICK = behaviour_of(
    Behaviour(gain_std=0.0, history_std_n=0.0, adaptation_time_s=300.0, fatigue_s=1000.0)
)


def test_a_sheet_that_is_known_tells_the_load_it_has_got_used_to() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(90.0, load)
    assert rig.apparent[0] < 0.8 * load[0]
    assert rig.strength.force_n[0] == pytest.approx(load[0], rel=0.02)


def test_a_force_counts_after_evidence_and_again_after_a_new_calibration() -> None:
    rig, load = Rig(2, calm(sheet.S1)), np.array([2.0, 2.0])
    rig.cycle(2, load)
    assert rig.strength.state.tolist() == [StrengthState.UNESTIMATED] * 2
    rig.cycle(2, load)
    rig.run(0.5, load)
    assert rig.strength.state.tolist() == [StrengthState.ESTIMATED] * 2
    assert rig.strength.contacts[0] == 5
    assert rig.strength.touched_s[0] == pytest.approx(8.4, abs=0.5)
    rig.strength.recalibrated(0, new_sheet=True)
    rig.run(0.5, load)
    assert rig.strength.state.tolist() == [StrengthState.UNESTIMATED, StrengthState.ESTIMATED]
    assert rig.strength.back[0][0] < rig.strength.back[0][1]


def test_what_a_store_vouches_for_counts_at_once() -> None:
    rig = Rig(1, calm(sheet.S1))
    rig.strength.assume(0, 0.0, 0.05)
    rig.run(0.5, np.array([2.0]))
    assert rig.strength.state[0] == StrengthState.ESTIMATED


def test_a_force_about_which_nothing_is_known_is_invalid() -> None:
    rig = Rig(1, calm(sheet.S1))
    rig.strength.assume(0, 1.0, 3.0)
    rig.run(0.5, np.array([2.0]))
    assert rig.strength.state[0] == StrengthState.INVALID


def test_silence_makes_what_a_sheet_had_got_used_to_uncertain() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(60.0, load)
    back, before = (float(value[0]) for value in rig.strength.back)
    rig.run(60.0, 0 * load)
    rig.run(0.1, load)
    fell = back - rig.strength.back[0][0]
    assert 0.2 * back < fell < 0.7 * back
    assert rig.strength.back[1][0] > max(0.4 * back, 1.2 * before)


def test_doubt_of_what_a_sheet_had_got_used_to_never_exceeds_it_however_many_silences() -> None:
    rig, load = Rig(1, QUICK, LIKE_QUICK), np.array([3.0])
    rig.run(60.0, load)
    for _ in range(10):
        rig.run(5.0, 0 * load)
        rig.run(0.5, load)
        back, std = (float(value[0]) for value in rig.strength.back)
    assert std < load[0] - back < load[0]


def test_deviations_cover_sheets_that_are_off_by_what_is_doubted() -> None:
    """200 sheets whose numbers are spread about the preset's; uses of many kinds."""
    pads, rng = 200, np.random.default_rng(5)
    spread = np.exp(rng.normal(0, 0.2, (2, pads)))
    adaptation = replace(sheet.S1.adaptation, time_s=3000.0 * spread[0], fatigue_s=1e4 * spread[1])
    rig = Rig(
        pads,
        replace(sheet.S1, adaptation=adaptation),
        behaviour_of(Behaviour(gain_std=0.0, history_std_n=0.0)),
    )
    inside, counted = 0, 0
    for _ in range(25):
        load = rng.uniform(0.3, 5.0, pads)
        rig.run(rng.uniform(1.5, 20.0), load)
        valid = rig.touching & (rig.strength.state == StrengthState.ESTIMATED)
        off = np.abs(rig.strength.force_n - load) < 1.96 * rig.strength.std_n
        inside, counted = inside + int(off[valid].sum()), counted + int(valid.sum())
        rig.run(rng.uniform(0.3, 3.0), 0 * load)
    assert counted > 0.8 * 25 * pads
    assert 0.9 < inside / counted < 0.99


def test_deviations_cover_a_long_hold_whose_end_the_preset_does_not_know() -> None:
    """What an S2 keeps at last, off by a fifth: its error goes into the load, and so into what is learned."""
    pads, rng = 100, np.random.default_rng(8)
    left = (1 - np.asarray(sheet.S2.adaptation.share)) * np.exp(rng.normal(0, 0.2, pads))
    model = replace(sheet.S2, adaptation=replace(sheet.S2.adaptation, share=1 - left, time_s=60.0))
    told = Behaviour(
        preset="S2", adaptation_time_s=60.0, gain_std=0.0, history_std_n=0.0, slow_creep=0.0, press_std=0.05
    )
    rig = Rig(pads, replace(model, fluctuation=sheet.Fluctuation(press_std=0.05)), behaviour_of(told))
    load = rng.uniform(1.0, 4.0, pads)
    rig.cycle(4, load)
    rig.run(240.0, load)
    off = np.abs(rig.strength.force_n - load)
    assert 0.9 < (off < 1.96 * rig.strength.std_n).mean() <= 1
    assert np.sqrt(np.mean(off**2)) > 0.33 * np.sqrt(np.mean(rig.strength.std_n**2))


def test_doubt_of_slow_creep_grows_with_the_logarithm_of_how_long_a_touch_lasts() -> None:
    stds = []
    for slow_creep in (0.0, 0.03):
        behaviour = behaviour_of(Behaviour(gain_std=0.0, history_std_n=0.0, doubt=0.0, slow_creep=slow_creep))
        rig, load = Rig(1, calm(sheet.S1), behaviour), np.array([2.0])
        std = []
        for seconds in (5.0, 95.0):
            rig.run(seconds, load)
            std.append(rig.strength.std_n[0] / rig.strength.force_n[0])
        stds.append(np.array(std))
    added = np.sqrt(stds[1] ** 2 - stds[0] ** 2)
    np.testing.assert_allclose(added, 0.03 * np.log1p([5.0, 100.0]), rtol=0.05)


def test_a_reference_finds_the_gain_while_working_and_no_faster_than_is_sane() -> None:
    behaviour = behaviour_of(Behaviour(gain_std=0.2, history_std_n=0.0))
    rig, rng, load = Rig(2, calm(sheet.S1), behaviour), np.random.default_rng(6), np.array([2.0, 2.0])
    true = 1.25
    for _ in range(40):
        rig.run(2.0, load)
        measured = true * load * (1 + rng.normal(0, 0.05, 2))
        reference = ForceReference(np.array([0]), measured[:1], np.array([0.05 * 2.5]), rig.t_ns)
        before = rig.strength.log_gain[0]
        rig.strength.refer(reference, np.full(2, rig.t_ns), rig.touching)
        assert abs(rig.strength.log_gain[0] - before) <= 0.02 * 60
        rig.run(0.3, 0 * load)
    rig.run(2.0, load)
    assert rig.strength.force_n[0] == pytest.approx(true * 2.0, rel=0.05)
    assert rig.strength.force_n[1] == pytest.approx(2.0, rel=0.05)
    assert rig.strength.log_gain_std[0] < 0.05 < rig.strength.log_gain_std[1]


@pytest.mark.parametrize(
    ("force", "late_ns"), [(np.nan, 0), (0.0, 0), (-1.0, 0), (200.0, 0), (2.0, 80_000_000)]
)
def test_a_reference_that_is_late_or_absurd_changes_nothing(force: float, late_ns: int) -> None:
    rig = Rig(1, calm(sheet.S1), behaviour_of(Behaviour()))
    rig.run(3.0, np.array([2.0]))
    reference = ForceReference(np.array([0]), np.array([force]), np.array([0.1]), rig.t_ns + late_ns)
    assert rig.strength.refer(reference, np.full(1, rig.t_ns), rig.touching) == 0
    assert rig.strength.log_gain[0] == 0.0


def test_sheets_of_two_kinds_and_none_go_side_by_side() -> None:
    s2 = behaviour_of(Behaviour(preset="S2", loop=0.1))
    strength = SheetStrength([LIKE_S1, None, s2, LIKE_S1], PERIOD_NS)
    raw, touching = np.array([1.0, 1.0, 1.0, 0.0]), np.array([True, True, True, False])
    for t_ns in range(10**9, 2 * 10**9, PERIOD_NS):
        pressed = strength.step(raw, 0.1 * raw, touching, t_ns)
    assert pressed.tolist() == [0, 2]
    assert np.isfinite(strength.std_n[pressed]).all()
    assert strength.state[1] == StrengthState.ESTIMATED
    again = strength.adopt([LIKE_S1, None, s2, LIKE_S1], [LIKE_S1, None, LIKE_S1, LIKE_S1])
    assert again.touched_s[0] == strength.touched_s[0] > 0
    assert again.state[2] == StrengthState.UNESTIMATED


def test_the_keys_of_a_behaviour_change_its_preset() -> None:
    made = behaviour_of(
        Behaviour(
            preset="S2", adaptation_share=0.5, adaptation_time_s=100.0, creep_share=0.0, loop=0.1, doubt=0.1
        )
    )
    assert (made.model.adaptation.share, made.model.adaptation.time_s) == (0.5, 100.0)
    assert made.model.adaptation.recovery_s == sheet.S2.adaptation.recovery_s
    assert made.model.creep.times_s == ()
    assert made.model.hysteresis.widths_n
    assert made.doubt.creep == 0.1
