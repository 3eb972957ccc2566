"""Joints of a simulated hand go where the scenario says, smoothly."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from handtouch import shipped
from handtouch.hand import urdf
from handtouch.simulate.joints import Motion, Moved
from handtouch.simulate.scenario import Scenario


def test_joints_pass_their_way_points_at_even_times_and_stand_still_before_and_after() -> None:
    motion = Motion(joints=("*",), from_s=1.0, duration_s=4.0, position_deg=(0.0, 40.0, 10.0))
    assert [motion.position(t_s) for t_s in (0.0, 1.0, 3.0, 5.0, 9.0)] == [0.0, 0.0, 40.0, 10.0, 10.0]
    path = [motion.position(t_s) for t_s in np.linspace(0, 6, 6001).tolist()]
    assert max(abs(b - a) for a, b in itertools.pairwise(path)) < 0.04
    assert Motion(joints=("*",), duration_s=1.0, position_deg=(5.0,)).position(0.5) == 5.0


def test_patterns_choose_joints_and_the_latest_motion_counts() -> None:
    robot = urdf.read(shipped.path("utah_mit.urdf"))
    motions = [
        Motion(joints=("*_mcp",), duration_s=1.0, position_deg=(0.0, 90.0)),
        Motion(joints=("ring_*",), from_s=2.0, duration_s=1.0, position_deg=(90.0, 0.0)),
    ]
    moved = Moved(robot.joints.values(), motions)
    assert len(moved.at(0.0)) == 16
    assert moved.at(1.5)["ring_mcp"] == moved.at(1.5)["index_mcp"] == pytest.approx(math.pi / 2)
    assert moved.at(3.0)["ring_mcp"] == 0.0
    assert moved.at(3.0)["index_pip"] == 0.0


def test_the_shipped_session_moves_the_shipped_hand_within_its_limits() -> None:
    robot = urdf.read(shipped.path("utah_mit.urdf"))
    moved = Moved(robot.joints.values(), Scenario.load(shipped.path("utah_mit_session.toml")).motions)
    for t_s in np.linspace(0, 30, 100).tolist():
        for name, angle in moved.at(t_s).items():
            low, high = robot.joints[name].limits
            assert low <= angle <= high
    assert moved.at(10.0)["index_mcp"] != moved.at(0.0)["index_mcp"]
