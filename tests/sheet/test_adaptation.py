"""Adaptation: additive steps, recovery, reset by weak presses, exact inverse."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.sheet import Adaptation

ON, OFF = np.array([True]), np.array([False])
adaptations = st.builds(
    Adaptation,
    st.floats(0.0, 1.0),
    st.floats(100.0, 1e4),
    st.floats(100.0, 1e4),
    st.just(0.02),
    st.one_of(st.just(np.inf), st.floats(100.0, 1e5)),
)


@given(adaptations, st.floats(1.0, 10.0), st.integers(2, 40))
def test_steps_add_up(adaptation: Adaptation, load: float, steps: int) -> None:
    many, once = adaptation.initial_state(1), adaptation.initial_state(1)
    stride, whole = adaptation.discretise(100.0 / steps), adaptation.discretise(100.0)
    for _ in range(steps):
        effective = stride.forward(many, np.array([load]), ON)
    np.testing.assert_allclose(effective, whole.forward(once, np.array([load]), ON), rtol=1e-10)
    np.testing.assert_allclose(many.back_n, once.back_n, rtol=1e-10, atol=1e-300)
    np.testing.assert_allclose(many.current_flow_s, once.current_flow_s, rtol=1e-10)


@given(adaptations, st.integers(0, 2**32))
def test_the_inverse_is_exact_where_there_is_a_response(adaptation: Adaptation, seed: int) -> None:
    draws = np.random.default_rng(seed)
    there, back = adaptation.initial_state(4), adaptation.initial_state(4)
    step, on = adaptation.discretise(5.0), np.ones(4, np.bool_)
    for _ in range(100):
        load = (there.back_n + 0.1 + draws.uniform(0, 5, 4)) * (draws.random(4) < 0.7)
        effective = step.forward(there, load, on)
        assert ((effective > 0) == (load > 0)).all()
        np.testing.assert_allclose(
            step.inverse(back, effective, step.remaining_fraction(back)), load, atol=1e-9
        )
        np.testing.assert_allclose(back.back_n, there.back_n, atol=1e-9)


def test_a_pure_exponential_without_fatigue() -> None:
    adaptation = Adaptation(0.8, 1000.0, 1000.0, 0.0)
    state = adaptation.initial_state(1)
    effective = adaptation.discretise(500.0).forward(state, np.array([3.0]), ON)
    assert effective[0] == pytest.approx(3 * (1 - 0.8 * (1 - np.exp(-0.5))), rel=1e-12)


def test_without_potential_there_is_no_response_and_the_back_force_decays() -> None:
    adaptation = Adaptation(1.0, 1000.0, 3600.0, 0.02)
    state = adaptation.initial_state(1)
    adaptation.discretise(2000.0).forward(state, np.array([3.0]), ON)
    before = state.back_n.copy()
    assert adaptation.discretise(3600.0).forward(state, np.array([3.0]), OFF)[0] == 0
    np.testing.assert_allclose(state.back_n, before * np.exp(-1), rtol=1e-12)


def press(adaptation: Adaptation, peak: float, back: float) -> float:
    """Return the back force after a press under potential."""
    state = adaptation.initial_state(1)
    state.back_n[:] = back
    step = adaptation.discretise(1e-6)
    for load in (0.3 * peak, peak, 0.5 * peak, 0.0):
        step.forward(state, np.array([load]), ON)
    return float(state.back_n[0])


def test_only_a_press_well_below_the_back_force_wipes_it() -> None:
    """Neither small loads at the begin of a larger press nor a touch below the threshold wipe it."""
    adaptation = Adaptation(1.0, 3000.0, 3600.0, 0.02)
    assert press(adaptation, 1.0, 2.0) == 0
    assert press(adaptation, 1.9, 2.0) == 2.0
    assert press(adaptation, 4.0, 2.0) == pytest.approx(2.0, rel=1e-6)
    assert press(adaptation, 0.01, 2.0) == 2.0


@pytest.mark.parametrize(
    "changed",
    [{"share": 1.1}, {"time_s": 0.0}, {"threshold_n": -1.0}, {"wipe_fraction": 2.0}, {"recovery_s": np.nan}],
)
def test_parameters_out_of_range_are_rejected(changed: dict[str, npt.ArrayLike]) -> None:
    good: dict[str, npt.ArrayLike] = {"share": 1.0, "time_s": 1.0, "recovery_s": 1.0, "threshold_n": 0.0}
    with pytest.raises(ValueError, match=next(iter(changed))):
        Adaptation(**(good | changed))
