"""Direction of gravity in link frames from joint states, for the gravity compensation of baselines.

Public name: `GravityTracker`. Free of I/O and clocks; joint states come from `joints_at`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels

FloatArray = NDArray[np.float64]
_INTERVAL_NS = 20_000_000
"""Least time between two updates: a hand that turns over once a second turns by 7 degrees meanwhile."""
_MIN_CHANGE = 0.01
"""Least change of a joint [rad, m] or of gravity in the base frame that is processed."""


class GravityTracker:
    """Direction of gravity on the links of n pads. joints_at: a hand's joints at a time; gravity_at: unit
    direction (3,) of gravity in a hand's base as published by the robot, None if it isn't."""

    def __init__(
        self,
        robots: RobotModels,
        pads: int,
        joints_at: Callable[[str, int], JointSnapshot | None],
        gravity_at: Callable[[str], FloatArray | None],
    ) -> None:
        self._robots, self._joints_at, self._gravity_at = robots, joints_at, gravity_at
        self._poses = [LinkPoses(kinematics) for kinematics in robots.kinematics]
        self._link_directions = np.full((pads, 3), np.nan)
        self._next_ns = 0
        self._last_inputs: list[FloatArray | None] = [None] * len(robots.hands)

    def update_directions(self, now_ns: int) -> FloatArray | None:
        """Return the direction of gravity in each link's frame (n, 3), NaN where unknown; None if no link
        turned, or it was checked less than 20 ms ago."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + _INTERVAL_NS
        turned = [self._update_hand(number, now_ns) for number in range(len(self._robots.hands))]
        return self._link_directions.copy() if any(turned) else None

    def _update_hand(self, number: int, now_ns: int) -> bool:
        """Update a hand's links; return True if one has turned since the last update."""
        robots = self._robots
        hand, poses, rows = robots.hands[number], self._poses[number], robots.pad_rows[number]
        joints = self._joints_at(hand, now_ns)
        if joints is None:
            return False
        published = self._gravity_at(hand)
        gravity = robots.gravity[number] if published is None else published
        known = joints.age_s <= robots.joints_stale_s[number]
        inputs = np.concatenate([gravity, np.where(known, joints.position_rad, np.nan)])
        if _is_unchanged(inputs, self._last_inputs[number]):
            return False
        self._last_inputs[number] = inputs
        poses.set_joint_positions(joints.position_rad)
        unknown = robots.kinematics[number].base_joint_mask @ ~known
        in_links = poses.direction_in_links(gravity)
        self._link_directions[rows] = np.where(unknown[:, None], np.nan, in_links)
        return True


def _is_unchanged(now: FloatArray, before: FloatArray | None) -> bool:
    """Return True if the same joints are known and none has moved noticeably."""
    if before is None or not np.array_equal(np.isnan(now), np.isnan(before)):
        return False
    return bool(np.nanmax(np.abs(now - before)) < _MIN_CHANGE)
