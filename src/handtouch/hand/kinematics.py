"""Forward kinematics of a hand from its URDF: poses of its links in the palm and base frames.

Public names: `HandKinematics`, `LinkPose`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.urdf import MOVABLE_JOINT_TYPES, RobotDescription, UrdfJoint

FloatArray = NDArray[np.float64]
_IDENTITY = np.eye(3)


class LinkPose(NamedTuple):
    """Pose of a link in another frame."""

    rotation: FloatArray
    """(3, 3)"""
    translation_m: FloatArray
    """(3,)"""


class HandKinematics:
    """Poses of `links` (n names of the URDF) in the frames of the links `palm` and `base`.

    Call `set_joint_positions` before querying poses. `joints` (m names of the URDF) are those that move some
    link against palm or base; mimicking joints aren't among them. `continuous` (m,) have no limits,
    `limits` (m, 2) are the lower and upper limits of all [rad, m if prismatic], infinite where there is none.
    `palm_joint_mask`, `base_joint_mask` (n, m): which joints a link's pose in the palm or base frame depends
    on. Raises KeyError for a link that the URDF lacks.
    """

    def __init__(self, robot: RobotDescription, links: Sequence[str], palm: str, base: str) -> None:
        chains = [robot.joint_chain(link) for link in (*links, palm, base)]
        depths = {joint.name: depth for chain in chains for depth, joint in enumerate(chain)}
        tree = [robot.joints[name] for name in sorted(depths, key=lambda name: depths[name])]
        number = {robot.root: 0} | {joint.child: row for row, joint in enumerate(tree, 1)}  # of each frame
        *frames, self._palm, self._base = (number[link] for link in (*links, palm, base))
        self._frames = np.array(frames, dtype=np.intp)
        self._set_tree(tree, [number[joint.parent] for joint in tree], list(depths.values()))
        above = np.array([[joint in chain for joint in tree] for chain in chains], np.float64)
        above = above.reshape(len(chains), len(tree))
        self._signs = above[:-2] - above[-2], above[:-2] - above[-1]
        """(n, t) in palm and base: 1 for a joint that moves the link, -1 for one that moves palm or base"""
        movers = [joint.mimic[0] if joint.mimic else joint.name for joint in tree]
        relative = np.abs(above[:-2, None] - above[None, -2:]).any(axis=(0, 1))
        moving = {movers[row] for row in np.flatnonzero(relative) if tree[row].kind in MOVABLE_JOINT_TYPES}
        self.joints = tuple(name for name in robot.joints if name in moving)
        m = len(self.joints)
        self.continuous = np.array(
            [robot.joints[n].kind == "continuous" for n in self.joints], dtype=np.bool_
        )
        self.limits = np.array([robot.joints[n].limits for n in self.joints]).reshape(-1, 2)
        moved_by = np.array([[mover == name for name in self.joints] for mover in movers], np.float64)
        moved_by = moved_by.reshape(len(tree), m)  # each joint of the tree, by the joints
        self._matrix = (
            moved_by * np.array([joint.mimic[1] if joint.mimic else 1.0 for joint in tree])[:, None]
        )
        self._offset = np.array([joint.mimic[2] if joint.mimic else 0.0 for joint in tree])
        self.palm_joint_mask, self.base_joint_mask = (np.abs(signs) @ moved_by > 0 for signs in self._signs)
        self._poses = np.tile(np.eye(4), (1 + len(tree), 1, 1))  # of the root and the joints' child links
        self._twists: tuple[FloatArray, FloatArray] | None = None  # at the present positions, if needed
        self.set_joint_positions(np.zeros(m))

    def set_joint_positions(self, position_rad: FloatArray) -> None:
        """Set the joint positions (m,): radians, metres for prismatic joints. NaN counts as 0."""
        if np.isnan(position_rad).any():
            position_rad = np.nan_to_num(position_rad)
        moved = self._matrix @ position_rad + self._offset
        angle = moved * self._turns
        sine, versine = np.sin(angle)[:, None, None], (2.0 * np.sin(0.5 * angle) ** 2)[:, None, None]
        motion = self._motion
        motion[:, :3, :3] = sine * self._cross + versine * self._cross_squared + _IDENTITY  # Rodrigues
        motion[:, :3, 3] = self._slides * moved[:, None]
        local = self._origins @ motion
        for children, parents in self._levels:
            self._poses[children] = self._poses[parents] @ local[children - 1]
        self._twists = None

    def pose_in_palm(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the palm frame."""
        return self._relative_pose(self._palm, link)

    def pose_in_base(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the base frame."""
        return self._relative_pose(self._base, link)

    def direction_in_links(self, in_base: FloatArray) -> FloatArray:
        """Return a direction (3,) of the base frame in the frame of each link, (n, 3)."""
        in_root = self._poses[self._base, :3, :3] @ in_base
        return np.asarray(in_root @ self._poses[self._frames, :3, :3])

    def point_jacobian(self, link: int, position_m: FloatArray, in_base: bool = False) -> FloatArray:
        """Return the derivative (3, m) [m/rad] of a point (3,) of the link by the joints, in palm or base
        frame.
        """
        pose = self._poses[self._frames[link]]
        x, y, z = pose[:3, :3] @ position_m + pose[:3, 3]
        lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # cross products of rows with the point
        turning, moving = self._joint_twists()
        moved = (turning @ lever + moving) * self._signs[in_base][link][:, None]
        reference = self._poses[self._base if in_base else self._palm]
        return np.asarray((moved @ reference[:3, :3]).T @ self._matrix)

    def _joint_twists(self) -> tuple[FloatArray, FloatArray]:
        """Return the angular velocities (t, 3) that the tree's joints cause, each at a rate of 1, and the
        velocities of the root's origin."""
        if self._twists is None:
            rotation, origin = self._poses[1:, :3, :3], self._poses[1:, :3, 3]
            turning = (rotation @ self._axes[:, :, None])[:, :, 0] * self._turns[:, None]
            sliding = (rotation @ self._slides[:, :, None])[:, :, 0]
            self._twists = turning, np.cross(origin, turning) + sliding
        return self._twists

    def _relative_pose(self, seen_from: int, link: int) -> LinkPose:
        reference, pose = self._poses[seen_from], self._poses[self._frames[link]]
        back = reference[:3, :3].T
        return LinkPose(back @ pose[:3, :3], back @ (pose[:3, 3] - reference[:3, 3]))

    def _set_tree(self, tree: Sequence[UrdfJoint], parents: Sequence[int], depths: Sequence[int]) -> None:
        """Set what is constant of the joints (t) of a tree, in the order of their depths."""
        t, parent = len(tree), np.array(parents, dtype=np.intp)
        depth = np.sort(np.array(depths, dtype=np.intp))
        self._levels = [
            (np.flatnonzero(depth == level) + 1, parent[depth == level]) for level in range(len(set(depths)))
        ]
        """frames at one depth, and their parents"""
        self._origins = np.tile(np.eye(4), (t, 1, 1))
        for origin, joint in zip(self._origins, tree, strict=True):
            origin[:3, :3], origin[:3, 3] = joint.rotation, joint.translation_m
        self._motion = np.tile(np.eye(4), (t, 1, 1))
        self._axes = np.array([joint.axis for joint in tree]).reshape(t, 3)
        self._turns = np.array([joint.kind in ("revolute", "continuous") for joint in tree], np.float64)
        self._slides = self._axes * np.array([[joint.kind == "prismatic"] for joint in tree]).reshape(t, 1)
        self._cross = np.cross(self._axes[:, None], np.eye(3)).transpose(0, 2, 1)  # as matrices (t, 3, 3)
        self._cross_squared = self._cross @ self._cross
