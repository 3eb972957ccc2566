"""Poses of a hand's links and palm at joint states, for what works on whole hands rather than contacts.

Public name: `HandPoses`.
"""

from __future__ import annotations

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.core.memory import view_memory
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels


class HandPoses:
    """Poses of hands' links in their palms, and of their palms in their bases."""

    def __init__(self, robots: RobotModels) -> None:
        self._robots = robots
        self._poses = [LinkPoses(kinematics) for kinematics in robots.kinematics]

    def compute(self, hand: str, joints: JointSnapshot) -> tuple[FloatArray, FloatArray] | None:
        """Return poses (n, 12) of a hand's links in its palm, and (12,) of its palm in its base, each a
        rotation, row by row, and a translation in m; NaN where a joint is stale. None for a hand without
        a robot model."""
        if hand not in self._robots.hands:
            return None
        number = self._robots.hands.index(hand)
        poses, kinematics = self._poses[number], self._robots.kinematics[number]
        poses.set_joint_positions(view_memory(joints.position_rad))
        stale = ~(joints.age_s <= self._robots.joints_stale_s[number])
        in_palm = [poses.pose_in_palm(link) for link in range(len(kinematics.link_frames))]
        found = np.array([np.append(pose.rotation, pose.translation_m) for pose in in_palm])
        found[kinematics.palm_joint_mask @ stale] = np.nan
        first, in_base = in_palm[0], poses.pose_in_base(0)
        turn = in_base.rotation @ first.rotation.T
        palm = np.append(turn, in_base.translation_m - turn @ first.translation_m)
        if (kinematics.base_joint_mask[0] != kinematics.palm_joint_mask[0]) @ stale:
            palm[:] = np.nan
        return found, palm
