"""Joint states are matched to the time of a sample, and say how far from it they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.hand.joints import JointStates

MS = 1_000_000
NAMES = ("a", "b", "c")


def told(*states: tuple[int, float], names: tuple[str, ...] = NAMES) -> JointStates:
    made = JointStates(NAMES)
    for t_ms, value in states:
        assert made.take(t_ms * MS, names, np.full(len(names), value))
    return made


@given(st.floats(0, 1))
def test_between_two_states_joints_are_on_the_line(part: float) -> None:
    at = told((100, 1.0), (110, 3.0)).at(round((100 + 10 * part) * MS))
    np.testing.assert_allclose(at.position_rad, 1.0 + 2.0 * part, atol=1e-6)
    np.testing.assert_allclose(at.age_s, min(part, 1 - part) * 0.01, atol=1e-8)


def test_beyond_the_newest_they_go_on_for_20_ms_and_no_further() -> None:
    states = told((100, 1.0), (110, 2.0))
    assert states.at(115 * MS).position_rad == pytest.approx(2.5)
    assert states.at(130 * MS).position_rad == pytest.approx(4.0)
    assert states.at(900 * MS).position_rad == pytest.approx(4.0)
    assert states.at(900 * MS).age_s == pytest.approx(0.79)


def test_a_told_velocity_goes_before_the_difference_of_two_states() -> None:
    states = told((100, 1.0))
    states.take(110 * MS, NAMES, np.full(3, 2.0), np.full(3, -10.0))
    assert states.at(120 * MS).position_rad == pytest.approx(1.9)


def test_before_all_that_is_kept_the_oldest_holds_with_its_age() -> None:
    at = told((100, 1.0), (110, 2.0)).at(90 * MS)
    assert at.position_rad == pytest.approx(1.0)
    assert at.age_s == pytest.approx(0.01)


def test_several_sources_each_tell_their_joints() -> None:
    states = told((100, 1.0), names=("arm", "b", "a"))
    assert states.take(105 * MS, ("c",), np.array([5.0]), None, np.array([0.1]))
    at = states.at(105 * MS)
    np.testing.assert_allclose(at.position_rad, [1.0, 1.0, 5.0])
    np.testing.assert_allclose(at.age_s, [0.005, 0.005, 0.0])
    np.testing.assert_allclose(at.std_rad, [0.0, 0.0, 0.1])


def test_what_nobody_told_is_unknown() -> None:
    at = told((100, 1.0), names=("a",)).at(100 * MS)
    assert np.isnan(at.position_rad[1:]).all()
    assert np.isinf(at.age_s[1:]).all()


def test_states_that_are_not_newer_or_of_other_joints_are_of_no_use() -> None:
    states = told((100, 1.0))
    assert not states.take(100 * MS, NAMES, np.zeros(3))
    assert not states.take(200 * MS, ("x",), np.zeros(1))
    assert states.late == 1


def test_a_joint_without_end_takes_the_short_way_round() -> None:
    states = JointStates(("a",), np.array([True]))
    states.take(100 * MS, ("a",), np.array([math.pi - 0.1]))
    states.take(110 * MS, ("a",), np.array([-math.pi + 0.1]))
    assert states.at(105 * MS).position_rad[0] == pytest.approx(math.pi)


def test_memory_is_bounded_however_many_states_and_sources_come() -> None:
    states = JointStates(("a",))
    for number in range(200):
        states.take((100 + number) * MS, ("a", f"x{number}"), np.zeros(2))
    for number in range(500):
        states.take((1000 + number) * MS, ("a",), np.zeros(1))
    assert len(states._sources) <= 16
    assert max(len(kept) for _, _, kept in states._sources.values()) <= 64
