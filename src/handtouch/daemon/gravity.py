"""Which way gravity points on every link: from joint states, now and then, for the baselines of the pads.

Public name: `Gravity`. Pure but for what it keeps; joint states come through `joints_at`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.joints import Joints
from handtouch.hand.robot import Robots
from handtouch.supervise.baseline import BLOCK_NS

FloatArray = NDArray[np.float64]
_TURNED = 0.01
"""Least change of a joint [rad, m] or of gravity in the base that is worth a look."""


class Gravity:
    """Of n pads. joints_at: a hand's joints at a time; down_at: gravity in a hand's base as the robot told
    it, (3,) of unit length, None where it didn't."""

    def __init__(
        self,
        robots: Robots,
        pads: int,
        joints_at: Callable[[str, int], Joints | None],
        down_at: Callable[[str], FloatArray | None],
    ) -> None:
        self._robots, self._joints_at, self._down_at = robots, joints_at, down_at
        self._on_links = np.full((pads, 3), np.nan)
        self._next_ns = 0
        self._seen: list[FloatArray | None] = [None] * len(robots.hands)

    def step(self, now_ns: int) -> FloatArray | None:
        """Direction of gravity in each link's frame (n, 3), NaN where it isn't known: not more often than
        baselines are carried on, and only if a link has turned; else None."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + BLOCK_NS
        turned = [self._look(number, now_ns) for number in range(len(self._robots.hands))]
        return self._on_links.copy() if any(turned) else None

    def _look(self, number: int, now_ns: int) -> bool:
        """Whether a hand's links have turned since they were looked at."""
        robots = self._robots
        hand, kinematics, rows = robots.hands[number], robots.kinematics[number], robots.rows[number]
        joints = self._joints_at(hand, now_ns)
        if joints is None:
            return False
        told = self._down_at(hand)
        down = robots.gravity[number] if told is None else told
        known = joints.age_s <= robots.stale_s[number]
        seen = np.concatenate([down, np.where(known, joints.position_rad, np.nan)])
        if _alike(seen, self._seen[number]):
            return False
        self._seen[number] = seen
        kinematics.move(joints.position_rad)
        lost = kinematics.base_needs @ ~known
        self._on_links[rows] = np.where(lost[:, None], np.nan, kinematics.down(down))
        return True


def _alike(now: FloatArray, before: FloatArray | None) -> bool:
    """Whether the same joints are known, and none has moved to speak of."""
    if before is None or not np.array_equal(np.isnan(now), np.isnan(before)):
        return False
    return bool(np.nanmax(np.abs(now - before)) < _TURNED)
