"""Laws of what fluctuates: a press keeps its factor, flicker has its size and its time, seeds repeat."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.sheet import Fluctuation


def test_a_press_keeps_its_factor_and_the_next_has_another() -> None:
    fluctuation = Fluctuation(press_std=0.1)
    state = fluctuation.start(1, seed=1)
    readings = [float(fluctuation.step(state, np.array([load]), 0.1)[0]) for load in (1.0, 2.0, 0.0, 1.0)]
    assert readings[1] == 2 * readings[0]
    assert readings[2] == 0
    assert readings[3] != readings[0]


def test_pads_and_presses_differ_by_press_std() -> None:
    fluctuation = Fluctuation(press_std=0.05)
    readings = fluctuation.step(fluctuation.start(20_000, seed=2), np.ones(20_000), 0.1)
    assert np.log(readings).std() == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize("force", [0.25, 4.0])
@pytest.mark.parametrize("steps", [1, 7])
def test_flicker_goes_as_force_to_the_minus_half_and_forgets_in_its_time(force: float, steps: int) -> None:
    """Whatever the interval: after one correlation time 1/e of it is left."""
    fluctuation, pads = Fluctuation(noise_std=0.01, noise_time_s=0.05), 20_000
    state, load = fluctuation.start(pads, seed=3), np.full(20_000, force)
    early = np.log(fluctuation.step(state, load, 10.0) / load)
    for _ in range(steps):
        late = np.log(fluctuation.step(state, load, 0.05 / steps) / load)
    assert late.std() == pytest.approx(0.01 / np.sqrt(force), rel=0.03)
    assert np.corrcoef(early, late)[0, 1] == pytest.approx(np.exp(-1), abs=0.03)


def test_the_same_seed_gives_the_same_sheet_and_a_copy_goes_its_own_way() -> None:
    fluctuation, load = Fluctuation(0.05, 0.01), np.ones(3)
    one, two = fluctuation.start(3, seed=4), fluctuation.start(3, seed=4)
    copy = one.copy()
    expected = fluctuation.step(two, load, 0.1).tolist()
    assert fluctuation.step(copy, load, 0.1).tolist() == expected
    assert fluctuation.step(one, load, 0.1).tolist() == expected
    assert fluctuation.start(3, seed=5).draws.random() != fluctuation.start(3, seed=4).draws.random()


def test_a_negative_standard_deviation_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 0"):
        Fluctuation(press_std=-0.1)
