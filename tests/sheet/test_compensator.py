"""Compensation: exact for a known sheet, with standard deviations for fluctuations and undetected presses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.host.units import GRAM_FORCE_N
from handtouch.sheet import (
    S1,
    S2,
    Fluctuation,
    ParameterUncertainty,
    PrandtlIshlinskii,
    SheetCompensator,
    SheetModel,
    TemperatureResponse,
)
from tests.sheets import power_law

PADS = 6
WHOLE = replace(
    S1,
    creep=power_law(0.06, modes=5),
    hysteresis=PrandtlIshlinskii.from_width(0.12, 5.0),
    temperature=TemperatureResponse(gain_per_k=0.01),
    fluctuation=Fluctuation(),
)
SWELLING = replace(S2, temperature=TemperatureResponse(0.01, 0.002), fluctuation=Fluctuation())
models = st.sampled_from([replace(S1, fluctuation=Fluctuation()), SWELLING, WHOLE])


@given(models, st.integers(0, 2**32))
def test_the_load_on_a_known_sheet_is_recovered(model: SheetModel, seed: int) -> None:
    """To 1e-9, for presses, changes, releases and pauses, at any intervals."""
    draws = np.random.default_rng(seed)
    state, compensator = (
        model.initial_state(PADS),
        SheetCompensator(model, PADS, ParameterUncertainty.exact()),
    )
    for _ in range(80):
        dt = float(10 ** draws.uniform(-3, 0.5))
        load = draws.uniform(0.5, 5, PADS) * (draws.random(PADS) < 0.7)
        apparent = model.discretise(dt).forward(state, load)
        np.testing.assert_allclose(compensator.compensate(apparent, dt), load, atol=1e-9)
        assert (compensator.std_n()[load > 0] < 1e-9).all()
    np.testing.assert_allclose(compensator.back_n, state.adaptation.back_n, atol=1e-9)


@settings(max_examples=25)
@given(models, st.integers(0, 2**32))
def test_the_error_of_a_held_back_force_is_bounded(model: SheetModel, seed: int) -> None:
    """By update period over time constant, of the greatest load; after hours too."""
    draws = np.random.default_rng(seed)
    state, compensator = (
        model.initial_state(PADS),
        SheetCompensator(model, PADS, ParameterUncertainty.exact(), update_period_s=1.0),
    )
    for _ in range(120):
        load = draws.uniform(0.8, 5, PADS) * (draws.random(PADS) < 0.7)
        for _ in range(4):
            apparent = model.discretise(0.25).forward(state, load)
            found = compensator.compensate(apparent, 0.25)
        np.testing.assert_allclose(found, load, atol=2 * 5 * 1.0 / 3000)


def test_recovery_without_potential_is_tracked() -> None:
    model = replace(S1, fluctuation=Fluctuation())
    state = model.initial_state(2)
    exact, held = SheetCompensator(model, 2), SheetCompensator(model, 2, update_period_s=60.0)
    on = np.array([True, False])
    for powered, load in ((True, 3.0), (on, 0.0), (True, 4.0)):
        for compensator in (exact, held):
            compensator.set_powered(powered)
        for _ in range(60):
            apparent = model.discretise(30.0).forward(state, load, powered)
            loads = [compensator.compensate(apparent, 30.0) for compensator in (exact, held)]
    np.testing.assert_allclose(loads[0], 4.0, atol=1e-9)
    np.testing.assert_allclose(loads[1], 4.0, rtol=0.03)
    np.testing.assert_allclose(exact.back_n, state.adaptation.back_n, atol=1e-9)


@pytest.mark.parametrize("model", [S1, S2], ids=["S1", "S2"])
def test_the_standard_deviation_is_that_of_fluctuations(model: SheetModel) -> None:
    """Errors over stated standard deviations have the standard deviation 1, for a known sheet."""
    pads = 3000
    state, compensator = (
        model.initial_state(pads, seed=5),
        SheetCompensator(model, pads, ParameterUncertainty.exact()),
    )
    load = np.random.default_rng(6).uniform(0.5, 5.0, pads)
    for dt in (0.5, 0.5, 1.0):
        found = compensator.compensate(model.discretise(dt).forward(state, load), dt)
    ratio = (found - load) / compensator.std_n()
    assert ratio.std() == pytest.approx(1, abs=0.15)
    assert compensator.std_n(np.array([7, 2])).tolist() == compensator.std_n()[[7, 2]].tolist()


def test_uncertainty_grows_with_the_back_force() -> None:
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.initial_state(1), SheetCompensator(model, 1)
    stated, step = [], model.discretise(10.0)
    for _ in range(300):
        compensator.compensate(step.forward(state, 3.0), 10.0)
        stated.append(compensator.std_n()[0])
    assert (np.diff(stated[1:]) > 0).all()
    assert stated[-1] == pytest.approx(0.2 * compensator.back_n[0], rel=0.01)


def test_the_uncertainty_of_the_back_force_covers_undetected_presses() -> None:
    """A press below the threshold wipes the back force; the standard deviation covers the error."""
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.initial_state(1), SheetCompensator(model, 1)

    def press(gf: float, seconds: int) -> float:
        for _ in range(seconds):
            apparent = model.discretise(1.0).forward(state, gf * GRAM_FORCE_N)
            load = compensator.compensate(apparent, 1.0)
        return float(load[0])

    press(500, 6000)
    press(0, 100)
    assert press(300, 100) == 0  # below the threshold
    press(0, 100)
    assert state.adaptation.back_n[0] == 0
    error = press(300, 2) - 300 * GRAM_FORCE_N
    assert error == pytest.approx(float(compensator.back_n[0]), rel=0.01)
    assert error < 1.1 * compensator.std_n()[0]


def test_a_pad_without_response_may_carry_a_load_below_the_threshold() -> None:
    compensator = SheetCompensator(S1, 2)
    assert compensator.compensate(np.zeros(2), 1e-3).tolist() == [0, 0]
    np.testing.assert_allclose(compensator.std_n(), 2 * GRAM_FORCE_N / np.sqrt(3))


def test_a_reading_that_is_not_finite_affects_its_own_load_only() -> None:
    compensator, twin = SheetCompensator(S2, 3), SheetCompensator(S2, 3)
    for reading in (1.0, np.nan, np.inf, 1.0):
        load = compensator.compensate(np.array([1.0, reading, -1.0]), 0.1)
        good = twin.compensate(np.array([1.0, reading if np.isfinite(reading) else 0.0, 0.0]), 0.1)
        assert np.isnan(load[1]) == (not np.isfinite(reading))
        assert load[[0, 2]].tolist() == good[[0, 2]].tolist()
    assert load[1] == good[1] > 0


@pytest.mark.parametrize("update_period_s", [0.0, 5.0])
def test_a_known_back_force_can_be_set(update_period_s: float) -> None:
    """After a restart the load is right at once, with the given standard deviation."""
    model = replace(S1, fluctuation=Fluctuation())
    state, compensator = model.initial_state(2), SheetCompensator(model, 2, update_period_s=update_period_s)
    for _ in range(200):
        apparent = model.discretise(10.0).forward(state, 3.0)
    compensator.set_back_force(state.adaptation.back_n, 0.1)
    apparent = model.discretise(0.01).forward(state, 3.0)
    np.testing.assert_allclose(compensator.compensate(apparent, 0.01), 3.0, rtol=1e-4)
    np.testing.assert_allclose(compensator.std_n(), 0.1, rtol=0.01)
    with pytest.raises(ValueError, match="back_n"):
        compensator.set_back_force(-1.0, 0.0)


def test_a_reset_pad_is_a_fresh_sheet_and_others_continue() -> None:
    reset, kept, fresh = (SheetCompensator(WHOLE, 3, update_period_s=0.5) for _ in range(3))
    for compensator in (reset, kept):
        for _ in range(50):
            compensator.compensate(np.array([1.0, 2.0, 3.0]), 1.0)
    reset.reset_pads(np.array([1]))
    reading = np.array([2.0, 1.0, 2.5])
    loads = [compensator.compensate(reading, 1.0) for compensator in (reset, kept, fresh)]
    stated = [compensator.std_n() for compensator in (reset, kept, fresh)]
    for values in (loads, stated):
        assert values[0][1] == values[2][1] != values[1][1]
        assert values[0][[0, 2]].tolist() == values[1][[0, 2]].tolist()


def test_a_negative_interval_is_rejected() -> None:
    with pytest.raises(ValueError, match="dt_s"):
        SheetCompensator(S1, 1).compensate(np.ones(1), -1.0)
    with pytest.raises(ValueError, match="dt_s"):
        S1.discretise(float("nan"))


def test_a_negative_load_is_rejected() -> None:
    with pytest.raises(ValueError, match="loads"):
        S1.discretise(0.1).forward(S1.initial_state(2), [1.0, -1.0])
