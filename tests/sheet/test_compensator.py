"""Laws of compensation: exact for a known sheet, honest about what fluctuates and what can't be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.sheet import (
    GRAM_FORCE,
    S1,
    S2,
    Compensator,
    Creep,
    Doubt,
    Fluctuation,
    PrandtlIshlinskii,
    SheetModel,
    SheetTrack,
    Temperature,
)

PADS = 6
WHOLE = replace(
    S1,
    creep=Creep.power_law(0.06, modes=5),
    hysteresis=PrandtlIshlinskii.of_loop(0.12, 5.0),
    temperature=Temperature(gain_per_k=0.01),
    fluctuation=Fluctuation(),
)
SWELLING = replace(S2, temperature=Temperature(0.01, 0.002), fluctuation=Fluctuation())
models = st.sampled_from([replace(S1, fluctuation=Fluctuation()), SWELLING, WHOLE])


@given(models, st.integers(0, 2**32), st.floats(-8, 8))
def test_a_known_sheet_comes_back_to_1e_9(model: SheetModel, seed: int, warmer_k: float) -> None:
    """Presses, changes of load, releases and pauses, at any steps, warm or cold, as long as they are felt."""
    draws = np.random.default_rng(seed)
    state, compensator = model.start(PADS), Compensator(model, PADS, Doubt.none())
    compensator.set_warmer(warmer_k)
    for _ in range(80):
        dt = float(10 ** draws.uniform(-3, 0.5))
        load = draws.uniform(0.5, 5, PADS) * (draws.random(PADS) < 0.7)
        apparent = model.at(dt).forward(state, load, warmer_k=warmer_k)
        np.testing.assert_allclose(compensator.step(apparent, dt), load, atol=1e-9)
        assert (compensator.std_n()[load > 0] < 1e-9).all()
    np.testing.assert_allclose(compensator.back_n, state.adaptation.back_n, atol=1e-9)


@settings(max_examples=25)
@given(models, st.integers(0, 2**32))
def test_a_held_back_force_is_off_by_settle_over_time_at_most(model: SheetModel, seed: int) -> None:
    """Of the greatest load, also after hours: what is held back is made up for."""
    draws = np.random.default_rng(seed)
    state, compensator = model.start(PADS), Compensator(model, PADS, Doubt.none(), settle_s=1.0)
    for _ in range(120):
        load = draws.uniform(0.8, 5, PADS) * (draws.random(PADS) < 0.7)
        for _ in range(4):
            apparent = model.at(0.25).forward(state, load)
            found = compensator.step(apparent, 0.25)
        np.testing.assert_allclose(found, load, atol=2 * 5 * 1.0 / 3000)


def test_rest_without_potential_is_followed() -> None:
    model = replace(S1, fluctuation=Fluctuation())
    state = model.start(2)
    exact, held = Compensator(model, 2), Compensator(model, 2, settle_s=60.0)
    on = np.array([True, False])
    for powered, load in ((True, 3.0), (on, 0.0), (True, 4.0)):
        for compensator in (exact, held):
            compensator.set_powered(powered)
        for _ in range(60):
            apparent = model.at(30.0).forward(state, load, powered)
            loads = [compensator.step(apparent, 30.0) for compensator in (exact, held)]
    np.testing.assert_allclose(loads[0], 4.0, atol=1e-9)
    np.testing.assert_allclose(loads[1], 4.0, rtol=0.03)
    np.testing.assert_allclose(exact.back_n, state.adaptation.back_n, atol=1e-9)


@pytest.mark.parametrize("model", [S1, S2], ids=["S1", "S2"])
def test_the_standard_deviation_is_that_of_what_fluctuates(model: SheetModel) -> None:
    """Of a known sheet: errors over stated standard deviations have the width 1."""
    pads = 3000
    state, compensator = model.start(pads, seed=5), Compensator(model, pads, Doubt.none())
    load = np.random.default_rng(6).uniform(0.5, 5.0, pads)
    for dt in (0.5, 0.5, 1.0):
        found = compensator.step(model.at(dt).forward(state, load), dt)
    ratio = (found - load) / compensator.std_n()
    assert ratio.std() == pytest.approx(1, abs=0.15)
    assert compensator.std_n(np.array([7, 2])).tolist() == compensator.std_n()[[7, 2]].tolist()


def test_doubt_grows_with_the_back_force() -> None:
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.start(1), Compensator(model, 1)
    stated, step = [], model.at(10.0)
    for _ in range(300):
        compensator.step(step.forward(state, 3.0), 10.0)
        stated.append(compensator.std_n()[0])
    assert (np.diff(stated[1:]) > 0).all()
    assert stated[-1] == pytest.approx(0.2 * compensator.back_n[0], rel=0.01)


def test_silence_makes_the_back_force_doubtful_not_wrong() -> None:
    """A press too small to be felt wipes the back force unseen; the stated doubt then covers the error."""
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.start(1), Compensator(model, 1)

    def press(gf: float, seconds: int) -> float:
        for _ in range(seconds):
            apparent = model.at(1.0).forward(state, gf * GRAM_FORCE)
            load = compensator.step(apparent, 1.0)
        return float(load[0])

    press(500, 6000)
    press(0, 100)
    assert press(300, 100) == 0  # unfelt
    press(0, 100)
    assert state.adaptation.back_n[0] == 0
    error = press(300, 2) - 300 * GRAM_FORCE
    assert error == pytest.approx(float(compensator.back_n[0]), rel=0.01)
    assert error < 1.1 * compensator.std_n()[0]


def test_a_silent_pad_may_carry_what_would_not_be_felt() -> None:
    compensator = Compensator(S1, 2)
    assert compensator.step(np.zeros(2), 1e-3).tolist() == [0, 0]
    np.testing.assert_allclose(compensator.std_n(), 2 * GRAM_FORCE / np.sqrt(3))


def test_a_reading_that_is_no_number_spoils_only_its_own_load() -> None:
    compensator, twin = Compensator(S2, 3), Compensator(S2, 3)
    for reading in (1.0, np.nan, np.inf, 1.0):
        load = compensator.step(np.array([1.0, reading, -1.0]), 0.1)
        good = twin.step(np.array([1.0, reading if np.isfinite(reading) else 0.0, 0.0]), 0.1)
        assert np.isnan(load[1]) == (not np.isfinite(reading))
        assert load[[0, 2]].tolist() == good[[0, 2]].tolist()
    assert load[1] == good[1] > 0


@pytest.mark.parametrize("settle_s", [0.0, 5.0])
def test_a_back_force_that_is_known_can_be_given(settle_s: float) -> None:
    """As after a restart: the load is right at once, and its doubt the one that was given."""
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.start(2), Compensator(model, 2, settle_s=settle_s)
    for _ in range(200):
        apparent = model.at(10.0).forward(state, 3.0)
    compensator.assume(state.adaptation.back_n, 0.1)
    apparent = model.at(0.01).forward(state, 3.0)
    np.testing.assert_allclose(compensator.step(apparent, 0.01), 3.0, rtol=1e-4)
    np.testing.assert_allclose(compensator.std_n(), 0.1, rtol=0.01)
    with pytest.raises(ValueError, match="back_n"):
        compensator.assume(-1.0, 0.0)


def test_a_renewed_sheet_is_a_fresh_one_and_the_others_go_on() -> None:
    renewed, kept, fresh = (Compensator(WHOLE, 3, settle_s=0.5) for _ in range(3))
    for compensator in (renewed, kept):
        for _ in range(50):
            compensator.step(np.array([1.0, 2.0, 3.0]), 1.0)
    renewed.renew(np.array([1]))
    reading = np.array([2.0, 1.0, 2.5])
    loads = [compensator.step(reading, 1.0) for compensator in (renewed, kept, fresh)]
    stated = [compensator.std_n() for compensator in (renewed, kept, fresh)]
    for values in (loads, stated):
        assert values[0][1] == values[2][1] != values[1][1]
        assert values[0][[0, 2]].tolist() == values[1][[0, 2]].tolist()


def test_a_step_back_in_time_is_refused() -> None:
    with pytest.raises(ValueError, match="dt_s"):
        Compensator(S1, 1).step(np.ones(1), -1.0)
    with pytest.raises(ValueError, match="dt_s"):
        S1.at(float("nan"))


def test_a_negative_load_is_refused() -> None:
    with pytest.raises(ValueError, match="loads"):
        S1.at(0.1).forward(S1.start(2), [1.0, -1.0])


class TestTrack:
    """A history that depends on time alone."""

    @staticmethod
    def track(step_s: float = 0.01) -> SheetTrack:
        return SheetTrack(S1, 2, lambda t: [2.0 * (t % 2 > 1), 1.0 + np.sin(t)], seed=8, step_s=step_s)

    @given(st.lists(st.floats(0, 6), min_size=1, max_size=8))
    def test_the_same_time_gives_the_same_answer_whoever_asked_before(self, times: list[float]) -> None:
        asked, fresh = self.track(0.05), self.track(0.05)
        for time in times:
            answer = asked.apparent_n(time)
        assert answer.tolist() == fresh.apparent_n(times[-1]).tolist()

    def test_potential_and_temperature_are_functions_of_time_too(self) -> None:
        calm = replace(S1, fluctuation=Fluctuation())
        track = SheetTrack(
            calm, 1, lambda _: 2.0, step_s=0.01, powered=lambda t: t < 2, warmer_k=lambda t: 10 * (t > 1)
        )
        cold, warm, off = (float(track.apparent_n(t)[0]) for t in (0.995, 1.995, 2.5))
        assert warm / cold == pytest.approx(1.1, abs=0.02)
        assert off == 0

    def test_the_factor_is_what_the_layer_adds(self) -> None:
        track = self.track()
        np.testing.assert_array_equal(track.factor(0.5), [0, track.apparent_n(0.5)[1] / (1 + np.sin(0.5))])
        assert 0.3 < track.factor(1.05)[0] < track.factor(1.99)[0] < 1.3

    def test_the_grid_hardly_matters(self) -> None:
        calm = replace(S1, fluctuation=Fluctuation())
        coarse, fine = (
            SheetTrack(calm, 1, lambda t: 2 + np.sin(t), step_s=s).apparent_n(5.0) for s in (0.01, 0.001)
        )
        np.testing.assert_allclose(coarse, fine, rtol=0.01)

    def test_a_step_that_is_not_positive_is_refused(self) -> None:
        with pytest.raises(ValueError, match="step_s"):
            self.track(0.0)
