"""Creep: lag under load but not on release, additive steps, exact inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.sheet import Creep
from tests.sheets import power_law

creeps = st.one_of(
    st.builds(Creep.first_order, st.floats(0.05, 0.95), st.floats(0.01, 10.0)),
    st.builds(power_law, st.floats(0.02, 0.1), modes=st.integers(4, 8)),
)
seeds = st.integers(0, 2**32)


@given(creeps, st.floats(0.1, 10.0), st.floats(1e-3, 100.0), st.integers(2, 50))
def test_steps_add_up(creep: Creep, load: float, time_s: float, steps: int) -> None:
    """n steps of dt under one load equal one step of n dt, from any state."""
    many, once = creep.initial_state(1), creep.initial_state(1)
    for state in (many, once):
        creep.discretise(0.3).forward(state, np.array([0.5]))
    stride, whole = creep.discretise(time_s / steps), creep.discretise(time_s)
    for _ in range(steps):
        reading = stride.forward(many, np.array([load]))
    np.testing.assert_allclose(reading, whole.forward(once, np.array([load])), rtol=1e-12)
    np.testing.assert_allclose(many, once, rtol=1e-12)


@given(creeps, seeds)
def test_the_inverse_is_exact(creep: Creep, seed: int) -> None:
    """Load and state are recovered to 1e-9 for loading, partial unloading and release at any intervals."""
    draws = np.random.default_rng(seed)
    there, back = creep.initial_state(5), creep.initial_state(5)
    for _ in range(60):
        load = draws.uniform(0, 10, 5) * (draws.random(5) < 0.8)
        step = creep.discretise(10 ** draws.uniform(-4, 2))
        found = step.inverse(back, step.forward(there, load))
        np.testing.assert_allclose(found, load, atol=1e-9)
    np.testing.assert_allclose(back, there, atol=1e-9)


@given(creeps, st.floats(0.1, 10.0))
def test_a_step_of_load_is_the_response(creep: Creep, time_s: float) -> None:
    reading = creep.discretise(time_s).forward(creep.initial_state(1), np.array([2.0]))
    np.testing.assert_allclose(reading, 2 * creep.response(time_s), rtol=1e-12)


@given(creeps, st.floats(0.0, 0.9))
def test_release_is_abrupt(creep: Creep, rest: float) -> None:
    """After a partial release the reading is at once that of the final state under the remaining load."""
    state = creep.initial_state(1)
    creep.discretise(1e9).forward(state, np.array([1.0]))
    reading = creep.discretise(1e-9).forward(state, np.array([rest]))
    np.testing.assert_allclose(reading, creep.total * rest, rtol=1e-9, atol=1e-15)


def test_seven_elements_creep_by_a_power_law() -> None:
    """From 1 ms to 1 h, within the error stated in docs/theory.md."""
    t_s = np.geomspace(1e-3, 3600, 2000)
    assert np.abs(power_law(0.05).response(t_s) / t_s**0.05 - 1).max() < 0.0034


@pytest.mark.parametrize(
    "parameters",
    [(0.0, (1.0,), (1.0,)), (1.0, (1.0,), ()), (1.0, (-1.0,), (1.0,)), (1.0, (1.0, 1.0), (2.0, 1.0))],
)
def test_invalid_parameters_are_rejected(
    parameters: tuple[float, tuple[float, ...], tuple[float, ...]],
) -> None:
    with pytest.raises(ValueError, match=r"must|weights"):
        Creep(*parameters)
