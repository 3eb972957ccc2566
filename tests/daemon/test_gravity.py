"""Gravity on every link: by joints and base, told seldom, and not where joints aren't known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.config import ConfigError, load, parse
from handtouch.daemon.gravity import Gravity
from handtouch.hand.joints import JointStates
from handtouch.hand.robot import Robots, check
from tests.daemon.conftest import DEPLOYMENT as PLAIN

FloatArray = NDArray[np.float64]
MS = 1_000_000
DEPLOYMENT = load(shipped.path("utah_mit.toml"))
ROBOTS = Robots(DEPLOYMENT)
KINEMATICS, NAMES = ROBOTS.kinematics[0], ROBOTS.joint_names[0]
PADS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
MOVED = KINEMATICS.base_needs.any(axis=1)


class Told:
    def __init__(self) -> None:
        self.states, self.t_ns = JointStates(NAMES), 100 * MS
        self.down: FloatArray | None = None
        self.gravity = Gravity(ROBOTS, len(PADS), lambda _, t_ns: self.states.at(t_ns), lambda _: self.down)

    def joints(self, position_rad: float | FloatArray) -> None:
        self.t_ns += 100 * MS
        self.states.take(self.t_ns, NAMES, np.zeros(len(NAMES)) + position_rad)

    def step(self) -> FloatArray | None:
        return self.gravity.step(self.t_ns)


def test_gravity_on_a_link_is_that_of_the_base_turned_by_the_joints() -> None:
    told, position = Told(), np.random.default_rng(1).uniform(-0.5, 1.5, len(NAMES))
    told.joints(position)
    found = told.step()
    assert found is not None
    KINEMATICS.move(position)
    for link in range(len(PADS)):
        expected = KINEMATICS.in_base(link).rotation.T @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(found[link], expected, atol=1e-12)
    told.down = np.array([1.0, 0.0, 0.0])
    told.joints(position)
    turned = told.step()
    assert turned is not None
    np.testing.assert_allclose(turned[0], KINEMATICS.in_base(0).rotation.T @ told.down, atol=1e-12)


def test_it_is_told_only_when_a_link_has_turned_and_not_more_often_than_baselines_move() -> None:
    told = Told()
    told.joints(0.3)
    assert told.step() is not None
    told.states.take(told.t_ns + 50 * MS, NAMES, np.full(len(NAMES), 0.6))
    assert told.gravity.step(told.t_ns + 50 * MS) is None
    told.joints(0.3)
    assert told.step() is None
    told.joints(0.32)
    assert told.step() is not None


def test_where_joints_are_unknown_or_old_so_is_gravity_but_for_links_that_none_moves() -> None:
    told = Told()
    found = told.step()
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found[:, 0]), MOVED)
    told.joints(0.3)
    found = told.step()
    assert found is not None
    assert not np.isnan(found).any()
    told.t_ns += 1000 * MS
    found = told.step()
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found[:, 0]), MOVED)


def test_gravity_that_points_nowhere_is_a_mistake_in_the_deployment() -> None:
    broken = parse(PLAIN.replace('name = "h"', 'name = "h"\ngravity = [0.0, 0.0, 0.0]'))
    with pytest.raises(ConfigError, match="must point somewhere"):
        check(broken, "a.toml")
