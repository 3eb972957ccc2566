"""Gravity on every link: from joints and base, at a limited rate, unknown without joints."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import (
    ConfigError,
    load,
    parse,
    shipped,
)
from handtouch.core.gravity import GravityTracker
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels, check_urdfs
from tests.core.conftest import DEPLOYMENT as PLAIN

FloatArray = NDArray[np.float64]
MS = 1_000_000
DEPLOYMENT = load(shipped.path("utah_mit.toml"))
ROBOTS = RobotModels(DEPLOYMENT)
KINEMATICS, NAMES = ROBOTS.kinematics[0], ROBOTS.joint_names[0]
PADS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
POSES = LinkPoses(KINEMATICS)
MOVED = KINEMATICS.base_joint_mask.any(axis=1)


class JointRig:
    """Joint states of the shipped hand and their gravity tracker."""

    def __init__(self) -> None:
        self.states, self.t_ns = JointStateBuffer(NAMES), 100 * MS
        self.down: FloatArray | None = None
        self.gravity = GravityTracker(
            ROBOTS, len(PADS), lambda _, t_ns: self.states.interpolate(t_ns), lambda _: self.down
        )

    def joints(self, position_rad: float | FloatArray) -> None:
        self.t_ns += 100 * MS
        self.states.add_state(self.t_ns, NAMES, np.zeros(len(NAMES)) + position_rad)

    def step(self) -> FloatArray | None:
        return self.gravity.update_directions(self.t_ns)


def test_gravity_on_a_link_is_that_of_the_base_rotated_by_the_joints() -> None:
    rig, position = JointRig(), np.random.default_rng(1).uniform(-0.5, 1.5, len(NAMES))
    rig.joints(position)
    found = rig.step()
    assert found is not None
    POSES.set_joint_positions(position)
    for link in range(len(PADS)):
        expected = POSES.pose_in_base(link).rotation.T @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(found[link], expected, atol=1e-12)
    rig.down = np.array([1.0, 0.0, 0.0])
    rig.joints(position)
    rotated = rig.step()
    assert rotated is not None
    np.testing.assert_allclose(rotated[0], POSES.pose_in_base(0).rotation.T @ rig.down, atol=1e-12)


def test_gravity_is_updated_after_a_rotation_and_every_20_ms() -> None:
    rig = JointRig()
    rig.joints(0.3)
    assert rig.step() is not None
    rig.states.add_state(rig.t_ns + 50 * MS, NAMES, np.full(len(NAMES), 0.6))
    assert rig.gravity.update_directions(rig.t_ns + 19 * MS) is None
    assert rig.gravity.update_directions(rig.t_ns + 20 * MS) is not None
    rig.joints(0.3)
    assert rig.step() is not None
    rig.joints(0.3)
    assert rig.step() is None
    rig.joints(0.32)
    assert rig.step() is not None


def test_gravity_is_unknown_on_links_with_unknown_or_stale_joints() -> None:
    rig = JointRig()
    found = rig.step()
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found[:, 0]), MOVED)
    rig.joints(0.3)
    found = rig.step()
    assert found is not None
    assert not np.isnan(found).any()
    rig.t_ns += 1000 * MS
    found = rig.step()
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found[:, 0]), MOVED)


def test_a_zero_vector_of_gravity_is_an_error_of_the_deployment() -> None:
    broken = parse(PLAIN.replace('name = "h"', 'name = "h"\ngravity = [0.0, 0.0, 0.0]'))
    with pytest.raises(ConfigError, match="must not be zero"):
        check_urdfs(broken, "a.toml")
