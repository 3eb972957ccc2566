"""Behaviour of simulated sheets against closed forms, relays and the models of `handtouch.sheet`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.sheet import S1, S2, Fluctuation, PrandtlIshlinskii, SheetModel
from handtouch.simulate.preisach import HomogeneousLoops, Loops, PlayLoops
from handtouch.simulate.sheet_physics import (
    CALIBRATION_S,
    BackForces,
    ElementCreep,
    PowerCreep,
    SheetLaw,
    SheetStates,
)
from handtouch.simulate.worlds import SHEET_KINDS
from handtouch.simulate.worlds.sheet_kinds import ELASTOMER

FloatArray = NDArray[np.float64]
ONE = np.zeros(1, np.intp)
LOADS = st.lists(st.floats(0.0, 10.0), min_size=1, max_size=30)


def readings(law: SheetLaw, times_s: Sequence[float], loads_n: Sequence[float]) -> FloatArray:
    """Return the apparent loads at the ends of intervals from time 0."""
    steps = np.diff(times_s, prepend=0.0)
    return SheetStates(law).advance(np.zeros(len(steps), np.intp), steps, loads_n)


class Hysteresis:
    """A sheet with hysteresis only."""

    def __init__(self, loops: Loops) -> None:
        self._sheet = SheetStates(SheetLaw(hysteresis=loops))

    def apply(self, load_n: float) -> float:
        """Return the reading under a load."""
        return float(self._sheet.advance(ONE, 0.0, load_n)[0])


@pytest.mark.parametrize("exponent", [0.02, 0.05, 0.1, 0.2])
def test_power_creep_of_a_step_is_the_power_of_time(exponent: float) -> None:
    times = np.geomspace(1e-3, 1e5, 90)
    read = readings(SheetLaw(creep=PowerCreep(exponent)), times.tolist(), [3.0] * len(times))
    np.testing.assert_allclose(read, 3.0 * times**exponent, rtol=2e-3)


def test_power_creep_of_a_ramp_is_its_integral() -> None:
    times = np.linspace(0.0, 20.0, 4001)[1:]
    middles = times - times[0] / 2  # constant loads that follow a ramp of 1 N/s
    read = readings(SheetLaw(creep=PowerCreep(0.1)), times.tolist(), middles.tolist())
    np.testing.assert_allclose(read[400:], times[400:] ** 1.1 / 1.1, rtol=2e-3)


def test_creep_is_forgotten_when_the_load_ends() -> None:
    law = SheetLaw(creep=PowerCreep(0.1))
    read = readings(law, [100.0, 101.0, 102.0], [2.0, 0.0, 2.0])
    assert read.tolist() == pytest.approx([2 * 100**0.1, 0.0, 2.0], rel=2e-3)


@given(st.floats(1.0, 1e5), st.integers(1, 20))
def test_adaptation_at_two_speeds_leaves_the_sum_of_two_exponentials(until_s: float, steps: int) -> None:
    law = SheetLaw(BackForces((0.5, 0.3), (200.0, 5000.0)))
    times = until_s * np.arange(1, steps + 1) / steps
    expected = 4.0 * (1 + 0.5 * np.expm1(-times / 200.0) + 0.3 * np.expm1(-times / 5000.0))
    np.testing.assert_allclose(readings(law, times.tolist(), [4.0] * steps), expected, rtol=1e-9)


def test_fatigue_doubles_the_speed_of_adaptation() -> None:
    law = SheetLaw(BackForces((0.5,), (200.0,), fatigue_s=1000.0))
    expected = 1 + 0.5 * math.expm1(-(400.0 + 400.0**2 / 2000.0) / 200.0)
    assert readings(law, [400.0], [1.0])[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("kind", "model"), [("S1", S1), ("S2", S2)])
def test_sheets_of_the_paper_behave_as_their_models(kind: str, model: SheetModel) -> None:
    """Two implementations of one law: that of the simulator, and the one that is compensated."""
    loops = PrandtlIshlinskii.from_width(0.1, 5.0)
    calm = dataclasses.replace(model, fluctuation=Fluctuation(), hysteresis=loops)
    law = dataclasses.replace(SHEET_KINDS[kind].law, hysteresis=PlayLoops(0.1, 5.0))
    expected, state = calm.initial_state(1), SheetStates(law)
    rng = np.random.default_rng(5)
    for _ in range(400):
        dt, load = float(np.exp(rng.uniform(-7, 5))), float(rng.choice([0.0, 0.01, 1.0])) * rng.uniform(0, 5)
        powered, warmer = bool(rng.uniform() < 0.8), rng.uniform(-5, 5)
        read = state.advance(ONE, dt, load, powered, warmer)[0]
        assert read == pytest.approx(
            calm.discretise(dt).forward(expected, [load], powered, warmer)[0], rel=1e-9, abs=1e-12
        )


@given(LOADS)
def test_plays_as_a_preisach_operator_read_the_same(loads: list[float]) -> None:
    model, points = PrandtlIshlinskii.from_width(0.12, 6.0), Hysteresis(PlayLoops(0.12, 6.0))
    state = model.initial_state(1)
    for load in loads:
        read = points.apply(load)
        assert read == pytest.approx(model.apply_to(state, np.array([load]))[0], abs=1e-9)


@pytest.mark.parametrize(("exponent", "tolerance"), [(1.35, 0.015), (1.5, 0.008), (2.0, 0.005)])
def test_homogeneous_loops_are_the_sum_of_their_relays(exponent: float, tolerance: float) -> None:
    """Relays switch on above `up` and off below `down`; their density is the one in the docstring."""
    full, count = 4.0, 400
    cell = full / count
    centres = cell * (np.arange(count) + 0.5)
    up, down = np.meshgrid(centres, centres, indexing="ij")
    is_relay = up > down
    ratio = np.where(is_relay, down / up, 0.0)
    density = (exponent - 1) * exponent * (1 - ratio) ** (exponent - 2) * down / up**2 * is_relay
    weight = density * cell**2 + np.diag(cell**exponent / centres ** (exponent - 1))  # half cells
    is_on = np.zeros_like(is_relay)
    points = Hysteresis(HomogeneousLoops(exponent))
    for load in (1.0, 3.0, 0.5, 2.0, 1.2, 3.5, 2.5, 3.0, 0.2, 3.9, 0.0, 2.0):
        is_on = np.where(load >= up, True, np.where(load <= down, False, is_on)) & (up >= down)
        assert points.apply(load) == pytest.approx(weight[is_on].sum(), abs=tolerance * full)


@given(LOADS)
def test_first_loading_reads_the_load_and_unloading_reads_more(loads: list[float]) -> None:
    points = Hysteresis(HomogeneousLoops(1.35))
    highest = 0.0
    for load in loads:
        read = points.apply(load)
        if load >= highest:
            highest = load
            assert read == pytest.approx(load, abs=1e-9)
        assert load - 1e-9 <= read <= highest + 1e-9


def test_loops_are_wide_as_stated() -> None:
    for loops, width in ((HomogeneousLoops(1.35), 0.5 - 2**-1.35), (PlayLoops(0.1, 4.0), 0.1)):
        points = Hysteresis(loops)
        loading = points.apply(2.0)
        points.apply(4.0)
        assert (points.apply(2.0) - loading) / 4.0 == pytest.approx(width, rel=1e-9)


@given(LOADS, st.floats(0.5, 2.0), st.floats(2.5, 4.0))
def test_a_swing_wipes_out_smaller_ones_and_returns_to_the_same_reading(
    loads: list[float], low: float, high: float
) -> None:
    loops: list[Loops] = [HomogeneousLoops(1.5), PlayLoops(0.1, 5.0)]
    for kind in loops:
        points = Hysteresis(kind)
        before = [points.apply(load) for load in (10.0, low, high)]
        inside = [low + (high - low) * load / 10.0 for load in loads]
        for load in inside:
            points.apply(load)
        assert [points.apply(load) for load in (low, high)] == pytest.approx(before[1:], abs=1e-9)


@given(st.lists(st.floats(3.0, 9.0), max_size=6))
def test_loops_between_the_same_loads_are_congruent(history: list[float]) -> None:
    """Whatever came before, a swing between two loads changes the reading by the same amount."""
    points = Hysteresis(HomogeneousLoops(1.4))
    for load in (10.0, *history, 1.5):
        low = points.apply(load)
    assert points.apply(3.0) - low == pytest.approx(3.0 * (1 - 1.5 / 3.0) ** 1.4, abs=1e-9)


def test_of_too_many_nested_swings_the_smallest_is_forgotten() -> None:
    """Swings that shrink from 4 N to a hundredth: what is forgotten counts less than the smallest of them."""
    loops = PlayLoops(0.1, 4.0, 40)
    nested = [2 + 2 * 0.98**k * (-1) ** k for k in range(250)]
    points = Hysteresis(loops)
    for load in nested:
        points.apply(load)
    returned, fresh = points.apply(nested[100]), Hysteresis(loops)
    for load in nested[:101]:
        expected = fresh.apply(load)
    assert returned == pytest.approx(expected, abs=1e-9)


def test_laws_out_of_range_are_rejected() -> None:
    for exponent in (0.0, 0.6):
        with pytest.raises(ValueError, match=r"exponent must lie above 0 and up to 0\.5"):
            PowerCreep(exponent)
    with pytest.raises(ValueError, match="exponent must be at least 1"):
        HomogeneousLoops(0.9)


def test_varied_sheets_keep_the_structure_of_their_kind() -> None:
    kind = SHEET_KINDS["two_speeds"]
    assert kind.varied(1.0, 1.0, 1.0, 1.0, 1.0, 1.0) == kind.law
    varied = kind.varied(2.0, 3.0, 0.5, 2.0, 0.5, 2.0)
    assert sum(varied.adaptation.shares) == pytest.approx(1 - 2 * (1 - sum(kind.law.adaptation.shares)))
    assert varied.adaptation.times_s == pytest.approx([3 * time_s for time_s in kind.law.adaptation.times_s])
    assert isinstance(varied.creep, ElementCreep)
    steep = SHEET_KINDS["steep_creep"].varied(1.0, 1.0, 1.0, 1.0, 1.5, 1.0).creep
    assert isinstance(steep, PowerCreep)
    assert steep.exponent == pytest.approx(0.15)


def test_a_cover_reads_the_weight_that_it_was_calibrated_by() -> None:
    states = SheetStates(ELASTOMER.law)
    assert 0.95 < states.advance(ONE, 0.01, 1.0) < 0.99  # it creeps
    assert states.advance(ONE, CALIBRATION_S - 0.01, 1.0) == pytest.approx(1.0)
    assert SheetStates(ELASTOMER.law).advance(ONE, CALIBRATION_S, 5.0) > 5.4  # at 1 N, plays hold a part back
