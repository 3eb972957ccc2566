"""Poses of a hand's links at joint positions.

Public names: `LinkPoses`, `LinkPose`. The arithmetic is `core.stages.kinematics`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.core.memory import view_memory
from handtouch.core.stages.kinematics import JointTree
from handtouch.hand.kinematics import HandKinematics

FloatArray = NDArray[np.float64]


class LinkPose(NamedTuple):
    """Pose of a link in another frame."""

    rotation: FloatArray
    """(3, 3)"""
    translation_m: FloatArray
    """(3,)"""


class LinkPoses:
    """Poses of the n links of a hand in its palm and base frames, at the positions of its `joints` joints
    that were set last, at first 0. `stage` computes them.
    """

    def __init__(self, hand: HandKinematics) -> None:
        self.joints, self._links = len(hand.joints), len(hand.link_frames)
        self.stage = _joint_tree(hand)
        self.set_joint_positions(np.zeros(self.joints))

    def set_joint_positions(self, position_rad: FloatArray) -> None:
        """Set the joint positions (m,): radians, metres for prismatic joints. NaN counts as 0."""
        self.stage.set_joint_positions(view_memory(position_rad))

    def pose_in_palm(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the palm frame."""
        return self._pose(link, in_base=False)

    def pose_in_base(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the base frame."""
        return self._pose(link, in_base=True)

    def direction_in_links(self, in_base: FloatArray) -> FloatArray:
        """Return a direction (3,) of the base frame in the frame of each link, (n, 3)."""
        rotations = [self.pose_in_base(link).rotation for link in range(self._links)]
        return np.asarray(in_base @ np.array(rotations).reshape(-1, 3, 3))

    def joint_covariance_m2(
        self, link: int, position_m: ArrayLike, std_rad: FloatArray, in_base: bool = False
    ) -> FloatArray:
        """Return the covariance (3, 3) of a point (3,) of a link from the standard deviations (m,) of the
        joints, in palm or base frame."""
        covariance, point = np.zeros(9), np.array(position_m, dtype=np.float64)
        self.stage.add_joint_covariance(
            *(link, in_base, view_memory(point), 0, view_memory(std_rad), view_memory(covariance))
        )
        return covariance.reshape(3, 3)

    def _pose(self, link: int, in_base: bool) -> LinkPose:
        pose = np.empty(12)
        self.stage.write_pose(link, in_base, view_memory(pose))
        return LinkPose(pose[:9].reshape(3, 3), pose[9:])


def _joint_tree(hand: HandKinematics) -> JointTree:
    t, m = len(hand.tree), len(hand.joints)
    kinds = np.array([_KINDS.get(joint.kind, 0) for joint in hand.tree], dtype=np.intp)
    motions = np.zeros((t, 33))
    for motion, joint in zip(motions, hand.tree, strict=True):
        cross = np.cross(joint.axis, np.eye(3)).T  # cross product of the axis with a vector, as a matrix
        turned = joint.rotation, joint.rotation @ cross, joint.rotation @ cross @ cross
        motion[:] = np.concatenate([*map(np.ravel, turned), joint.translation_m, joint.axis])
    return JointTree(
        *(view_memory(hand.parents), view_memory(kinds), view_memory(motions)),
        *(view_memory(hand.movers), view_memory(hand.factors), view_memory(hand.offsets)),
        view_memory(np.array([*hand.link_frames, hand.palm_frame, hand.base_frame], dtype=np.intp)),
        view_memory(np.stack([hand.palm_signs, hand.base_signs])),
        *(view_memory(np.zeros(12 * (t + 1))), view_memory(np.zeros(3 * m))),
    )


_KINDS = {"revolute": 1, "continuous": 1, "prismatic": 2}
