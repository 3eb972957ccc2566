"""Kinematic tree of a hand from its URDF: the joints between its links, its palm and its base.

Public name: `HandKinematics`. `handtouch.core.stages.kinematics` computes poses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from handtouch.hand.joints import LIMIT_TOLERANCE_M, LIMIT_TOLERANCE_RAD, FollowerJoint
from handtouch.hand.urdf import MOVABLE_JOINT_TYPES, RobotDescription, UrdfError


class HandKinematics:
    """Joints that determine the poses of `links` (n names of the URDF) in the frames `palm` and `base`.

    `joints` (m names of the URDF) are those that move some link against palm or base; mimicking joints
    aren't among them. `continuous` (m,) have no limits, `limits` (m, 2) are the lower and upper limits of all
    [rad, m if prismatic], infinite where there is none. `palm_joint_mask`, `base_joint_mask` (n, m): which
    joints a link's pose in the palm or base frame depends on.

    `tree`: the t joints of the URDF above these links, parents first. Frame 0 is the root, frame k + 1 the
    child link of joint k. `parents` (t,): frames of their parent links; `link_frames` (n,), `palm_frame`,
    `base_frame`. Joint k is at `factors[k]` times the position of joint `movers[k]` of `joints` plus
    `offsets[k]`; `movers` is -1 where none moves it. `palm_signs`, `base_signs` (n, t): 1 for a joint
    that moves the link, -1 for one that moves palm or base, 0 for one that moves both or none.

    Raises KeyError for a link that the URDF lacks, UrdfError for a floating or planar joint in between.
    """

    def __init__(self, robot: RobotDescription, links: Sequence[str], palm: str, base: str) -> None:
        chains = [robot.joint_chain(link) for link in (*links, palm, base)]
        depths = {joint.name: depth for chain in chains for depth, joint in enumerate(chain)}
        self.tree = tree = [robot.joints[name] for name in sorted(depths, key=lambda name: depths[name])]
        frame = {robot.root: 0} | {joint.child: row for row, joint in enumerate(tree, 1)}
        self.parents = np.array([frame[joint.parent] for joint in tree], dtype=np.intp)
        self.link_frames = np.array([frame[link] for link in links], dtype=np.intp)
        self.palm_frame, self.base_frame = frame[palm], frame[base]
        above = np.array([[joint in chain for joint in tree] for chain in chains], np.float64)
        above = above.reshape(len(chains), len(tree))
        self.palm_signs, self.base_signs = above[:-2] - above[-2], above[:-2] - above[-1]
        moved_by = [joint.mimic[0] if joint.mimic else joint.name for joint in tree]
        moves = (np.abs(self.palm_signs) + np.abs(self.base_signs)).any(axis=0)
        for row in np.flatnonzero(moves):
            if tree[row].kind in ("floating", "planar"):
                raise UrdfError(
                    f'joint "{tree[row].name}" between palm, base and pads is {tree[row].kind}; it must be '
                    f"{', '.join(MOVABLE_JOINT_TYPES)} or fixed"
                )
        moving = {moved_by[row] for row in np.flatnonzero(moves) if tree[row].kind in MOVABLE_JOINT_TYPES}
        self.joints = tuple(name for name in robot.joints if name in moving)
        number = {name: column for column, name in enumerate(self.joints)}
        self.movers = np.array([number.get(name, -1) for name in moved_by], dtype=np.intp)
        self.factors = np.array([joint.mimic[1] if joint.mimic else 1.0 for joint in tree])
        self.offsets = np.array([joint.mimic[2] if joint.mimic else 0.0 for joint in tree])
        self.continuous = np.array(
            [robot.joints[n].kind == "continuous" for n in self.joints], dtype=np.bool_
        )
        self.limits = np.array([robot.joints[n].limits for n in self.joints]).reshape(-1, 2)
        self.tolerances = np.array(
            [
                LIMIT_TOLERANCE_M if robot.joints[n].kind == "prismatic" else LIMIT_TOLERANCE_RAD
                for n in self.joints
            ]
        )
        self.followers = {joint.name: FollowerJoint(*joint.mimic) for joint in tree if joint.mimic}
        by_joint = self.movers[:, None] == np.arange(len(self.joints))  # (t, m)
        self.palm_joint_mask, self.base_joint_mask = (
            np.abs(signs) @ by_joint > 0 for signs in (self.palm_signs, self.base_signs)
        )
