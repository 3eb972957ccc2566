"""Fluctuations: constant factor per press, size and correlation time of flicker, reproducible seeds."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.sheet import Fluctuation


def test_a_press_keeps_its_factor_and_the_next_has_another() -> None:
    fluctuation = Fluctuation(press_std=0.1)
    state = fluctuation.initial_state(1, seed=1)
    readings = [float(fluctuation.apply_to(state, np.array([load]), 0.1)[0]) for load in (1.0, 2.0, 0.0, 1.0)]
    assert readings[1] == 2 * readings[0]
    assert readings[2] == 0
    assert readings[3] != readings[0]


def test_pads_and_presses_differ_by_press_std() -> None:
    fluctuation = Fluctuation(press_std=0.05)
    readings = fluctuation.apply_to(fluctuation.initial_state(20_000, seed=2), np.ones(20_000), 0.1)
    assert np.log(readings).std() == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize("force", [0.25, 4.0])
@pytest.mark.parametrize("steps", [1, 7])
def test_flicker_scales_with_force_and_correlation_time(force: float, steps: int) -> None:
    """For any interval, 1/e remains after one correlation time."""
    fluctuation, pads = Fluctuation(noise_std=0.01, noise_time_s=0.05), 20_000
    state, load = fluctuation.initial_state(pads, seed=3), np.full(20_000, force)
    early = np.log(fluctuation.apply_to(state, load, 10.0) / load)
    for _ in range(steps):
        late = np.log(fluctuation.apply_to(state, load, 0.05 / steps) / load)
    assert late.std() == pytest.approx(0.01 / np.sqrt(force), rel=0.03)
    assert np.corrcoef(early, late)[0, 1] == pytest.approx(np.exp(-1), abs=0.03)


def test_the_same_seed_gives_the_same_sheet_and_a_copy_is_independent() -> None:
    fluctuation, load = Fluctuation(0.05, 0.01), np.ones(3)
    one, two = fluctuation.initial_state(3, seed=4), fluctuation.initial_state(3, seed=4)
    copy = one.copy()
    expected = fluctuation.apply_to(two, load, 0.1).tolist()
    assert fluctuation.apply_to(copy, load, 0.1).tolist() == expected
    assert fluctuation.apply_to(one, load, 0.1).tolist() == expected
    assert (
        fluctuation.initial_state(3, seed=5).generator.random()
        != fluctuation.initial_state(3, seed=4).generator.random()
    )


def test_a_negative_standard_deviation_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least 0"):
        Fluctuation(press_std=-0.1)
