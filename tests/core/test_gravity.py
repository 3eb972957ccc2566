"""Gravity and acceleration of every link: from joints and base, at a limited rate, unknown without joints."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.config import (
    ConfigError,
    load,
    parse,
    shipped,
)
from handtouch.config.responses import ResponseTable
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
            ROBOTS,
            len(PADS),
            lambda _, t_ns: self.states.interpolate(t_ns),
            lambda _, key: self.down if key == "gravity" else None,
        )

    def direction(self, _: str, key: str) -> FloatArray | None:
        return self.down if key == "gravity" else None

    def joints(self, position_rad: float | FloatArray) -> None:
        self.t_ns += 100 * MS
        self.states.add_state(self.t_ns, NAMES, np.zeros(len(NAMES)) + position_rad)

    def step(self) -> FloatArray | None:
        return self.gravity.update_felt(self.t_ns)


def test_a_magnetic_pad_has_the_orientation_of_its_link_instead_of_gravity() -> None:
    (hand,) = DEPLOYMENT.hands
    taxels = load(shipped.path("taxels.toml")).pads[0].pad.response
    assert isinstance(taxels, ResponseTable)
    response = taxels.model_copy(update={"magnetic": True})
    magnetic = hand.pads[0].model_copy(update={"response": response, "sheet": None})
    hand = hand.model_copy(update={"pads": (magnetic, *hand.pads[1:])})
    robots, states = RobotModels(DEPLOYMENT.model_copy(update={"hands": (hand,)})), JointStateBuffer(NAMES)
    states.add_state(100 * MS, NAMES, np.zeros(len(NAMES)))
    base = Rotation.from_euler("xyz", [0.5, -1.0, 3.0])
    orientation = {"orientation": base.as_quat()}
    tracker = GravityTracker(
        robots, len(PADS), lambda _, t_ns: states.interpolate(t_ns), lambda _, key: orientation.get(key)
    )
    found = tracker.update_felt(100 * MS)
    assert found is not None
    POSES.set_joint_positions(np.zeros(len(NAMES)))
    link = Rotation.from_matrix(base.as_matrix() @ POSES.pose_in_base(0).rotation)
    np.testing.assert_allclose(found[0], link.as_quat(canonical=True)[:3], atol=1e-12)
    np.testing.assert_allclose(found[1], POSES.pose_in_base(1).rotation.T @ [0.0, 0.0, -1.0], atol=1e-12)


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
    assert rig.gravity.update_felt(rig.t_ns + 19 * MS) is None
    assert rig.gravity.update_felt(rig.t_ns + 20 * MS) is not None
    rig.joints(0.3)
    assert rig.step() is not None
    for _ in range(5):  # poses of which the acceleration is
        rig.joints(0.3)
        last = rig.step()
    assert last is None
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


@pytest.mark.parametrize("acceleration_rad_s2", [0.0, 40.0])
def test_the_acceleration_of_a_link_is_subtracted_from_gravity(acceleration_rad_s2: float) -> None:
    rig, finger = JointRig(), NAMES.index("index_mcp")
    speed_rad_s, link = 6.0, PADS.index("index_proximal")
    at_m = ROBOTS.pad_centres_m[0][link]
    felt = None
    for step in range(8):
        t_s = 0.02 * (step - 5)  # the acceleration is that in the middle of five poses
        position = np.zeros(len(NAMES))
        position[finger] = 0.7 + speed_rad_s * t_s + 0.5 * acceleration_rad_s2 * t_s**2
        rig.t_ns += 20 * MS
        rig.states.add_state(rig.t_ns, NAMES, position)
        felt = rig.step()
    assert felt is not None
    POSES.set_joint_positions(position)
    weight = POSES.pose_in_base(link).rotation.T @ [0.0, 0.0, -1.0]
    # the joint's axis is the link's -y, through its origin
    centripetal = -(speed_rad_s**2) * at_m * [1.0, 0.0, 1.0]
    tangential = acceleration_rad_s2 * np.cross([0.0, -1.0, 0.0], at_m)
    expected = weight - (centripetal + tangential) / 9.80665
    np.testing.assert_allclose(felt[link], expected, atol=0.03)
    assert np.linalg.norm(expected - weight) > 0.08


def test_a_zero_vector_of_gravity_is_an_error_of_the_deployment() -> None:
    broken = parse(PLAIN.replace('name = "h"', 'name = "h"\ngravity = [0.0, 0.0, 0.0]'))
    with pytest.raises(ConfigError, match="must not be zero"):
        check_urdfs(broken, "a.toml")
