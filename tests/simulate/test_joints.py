"""Joints of a simulated hand follow the scenario smoothly."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from handtouch.config import shipped
from handtouch.hand import urdf
from handtouch.simulate.joints import JointMotion, ReportedJoints, ScenarioJoints
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.worlds import WORLDS, Fixed, MountSpread, Normal, World


def test_joints_pass_way_points_at_even_times_and_hold_before_and_after() -> None:
    motion = JointMotion(joints=("*",), from_s=1.0, duration_s=4.0, position_deg=(0.0, 40.0, 10.0))
    assert [motion.position_at(t_s) for t_s in (0.0, 1.0, 3.0, 5.0, 9.0)] == [0.0, 0.0, 40.0, 10.0, 10.0]
    path = [motion.position_at(t_s) for t_s in np.linspace(0, 6, 6001).tolist()]
    assert max(abs(b - a) for a, b in itertools.pairwise(path)) < 0.04
    assert JointMotion(joints=("*",), duration_s=1.0, position_deg=(5.0,)).position_at(0.5) == 5.0


def test_patterns_select_joints_and_latest_motion_counts() -> None:
    robot = urdf.read_urdf(shipped.path("utah_mit.urdf"))
    motions = [
        JointMotion(joints=("*_mcp",), duration_s=1.0, position_deg=(0.0, 90.0)),
        JointMotion(joints=("ring_*",), from_s=2.0, duration_s=1.0, position_deg=(90.0, 0.0)),
    ]
    moved = ScenarioJoints(robot.joints.values(), motions)
    assert len(moved.positions_at(0.0)) == 16
    assert (
        moved.positions_at(1.5)["ring_mcp"]
        == moved.positions_at(1.5)["index_mcp"]
        == pytest.approx(math.pi / 2)
    )
    assert moved.positions_at(3.0)["ring_mcp"] == 0.0
    assert moved.positions_at(3.0)["index_pip"] == 0.0


def test_shipped_session_moves_joints_within_limits() -> None:
    robot = urdf.read_urdf(shipped.path("utah_mit.urdf"))
    moved = ScenarioJoints(
        robot.joints.values(), Scenario.load(shipped.path("utah_mit_session.toml")).motions
    )
    for t_s in np.linspace(0, 30, 100).tolist():
        for name, angle in moved.positions_at(t_s).items():
            low, high = robot.joints[name].limits
            assert low <= angle <= high
    assert moved.positions_at(10.0)["index_mcp"] != moved.positions_at(0.0)["index_mcp"]


def test_encoders_report_their_offset_noise_and_delay() -> None:
    robot = urdf.read_urdf(shipped.path("utah_mit.urdf"))
    motion = JointMotion(joints=("*",), duration_s=10.0, position_deg=(0.0, 50.0))
    true = ScenarioJoints(robot.joints.values(), [motion])
    mounts = MountSpread(
        joint_offset_deg=Normal(0.0, 0.3), joint_noise_deg=Fixed(0.05), joint_delay_s=Fixed(0.02)
    )
    world = World("encoders", mounts=mounts).draw(5)
    reported = ReportedJoints(true, robot, world, "right")
    names = sorted(true.positions_at(0.0))
    times = [5.0 + 0.01 * k for k in range(300)]
    errors = np.degrees(
        [
            [reported.positions_at(t)[name] - true.positions_at(t - 0.02)[name] for name in names]
            for t in times
        ]
    )
    offsets = world.joints("right", len(names)).offset_deg
    np.testing.assert_allclose(errors.mean(0), offsets, atol=5 * 0.05 / math.sqrt(300))
    np.testing.assert_allclose(errors.std(0), 0.05, rtol=0.2)
    assert reported.positions_at(6.0) == reported.positions_at(6.0)
    exact = ReportedJoints(true, robot, WORLDS["ideal"].draw(5), "right")
    assert exact.positions_at(4.0) == true.positions_at(4.0)
