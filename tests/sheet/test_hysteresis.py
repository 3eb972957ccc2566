"""Hysteresis: wiping-out, congruency, rate independence, zero without load, exact inverse."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.sheet import PrandtlIshlinskii

FloatArray = npt.NDArray[np.float64]

sheets = st.builds(
    PrandtlIshlinskii.from_width, st.floats(0.01, 0.3), st.floats(1.0, 20.0), st.integers(1, 12)
)
seeds = st.integers(0, 2**32)


def readings(sheet: PrandtlIshlinskii, loads: npt.ArrayLike, state: FloatArray | None = None) -> FloatArray:
    """Return the readings of one pad."""
    state = sheet.initial_state(1) if state is None else state
    return np.array([sheet.apply_to(state, np.array([load]))[0] for load in np.asarray(loads, np.float64)])


@given(sheets, seeds)
def test_the_inverse_is_exact_for_any_history(sheet: PrandtlIshlinskii, seed: int) -> None:
    loads = np.random.default_rng(seed).uniform(0, 20, 200)
    loads[::7] = 0
    np.testing.assert_allclose(readings(sheet.inverse, readings(sheet, loads)), loads, atol=1e-9)


@given(sheets, seeds)
def test_a_larger_loop_wipes_out_a_smaller(sheet: PrandtlIshlinskii, seed: int) -> None:
    """After 0 - low - high, loops between low and high have no effect."""
    draws = np.random.default_rng(seed)
    low, high = np.sort(draws.uniform(0, 20, 2))
    plain, looped = sheet.initial_state(1), sheet.initial_state(1)
    readings(sheet, [high, low, high], plain)
    readings(sheet, [high, low, *draws.uniform(low, high, 20), low, high], looped)
    np.testing.assert_allclose(plain, looped, atol=1e-12)


@given(sheets, seeds)
def test_loops_between_the_same_loads_are_congruent(sheet: PrandtlIshlinskii, seed: int) -> None:
    """Minor loops differ by a constant only, for any history."""
    draws = np.random.default_rng(seed)
    low, high = np.sort(draws.uniform(0, 20, 2))
    path = [*np.linspace(low, high, 9), *np.linspace(high, low, 9)]
    loops = []
    for _ in range(2):
        state = sheet.initial_state(1)
        readings(sheet, [*draws.uniform(0, 20, 15), low], state)
        readings(sheet, path, state)
        loops.append(readings(sheet, path, state))
    first, second = (loop - loop[0] for loop in loops)
    np.testing.assert_allclose(first, second, atol=1e-9)


@given(sheets, seeds)
def test_a_released_sheet_reads_nothing(sheet: PrandtlIshlinskii, seed: int) -> None:
    assert readings(sheet, [*np.random.default_rng(seed).uniform(0, 20, 20), 0.0])[-1] == 0


@given(sheets, seeds)
def test_sampling_of_a_path_does_not_matter(sheet: PrandtlIshlinskii, seed: int) -> None:
    turns = np.random.default_rng(seed).uniform(0, 20, 10)
    fine = np.interp(np.linspace(0, 9, 9 * 16 + 1), np.arange(10), turns)
    np.testing.assert_allclose(readings(sheet, fine)[::16], readings(sheet, turns), atol=1e-9)


@given(st.floats(0.01, 0.3), st.floats(1.0, 20.0), st.integers(1, 12))
def test_the_loop_has_the_given_width_and_unit_gain(width: float, full: float, plays: int) -> None:
    sheet = PrandtlIshlinskii.from_width(width, full, plays)
    loading, top, unloading = readings(sheet, [full / 2, full, full / 2])
    assert top == pytest.approx(full, rel=1e-12)
    assert unloading - loading == pytest.approx(width * full, rel=1e-9)


@pytest.mark.parametrize(
    ("base", "widths", "weights"),
    [(0.0, (1.0,), (1.0,)), (1.0, (2.0, 1.0), (0.1, 0.1)), (1.0, (1.0,), (-1.5,)), (1.0, (1.0,), ())],
)
def test_an_operator_that_does_not_rise_is_rejected(
    base: float, widths: tuple[float, ...], weights: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match=r"rise|weights"):
        PrandtlIshlinskii(base, widths, weights)
