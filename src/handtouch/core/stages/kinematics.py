"""Kinematics of a hand: poses of its links in its palm and base frames at joint positions, and the covariance
of points on them from those of the joints.

Public names: `LinkPoses`, `LinkPose`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handtouch.core.memory import RowArray, view_memory, view_rows

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from handtouch.arrays import FloatArray
    from handtouch.hand.kinematics import HandKinematics


JOINT_ROW = np.dtype(
    [
        ("parent", "<i8"),  # frame of its parent link; frame 0 is the root, k + 1 the child link of joint k
        ("kind", "<i8"),
        ("mover", "<i8"),  # joint at whose position it moves, -1 for none
        ("factor", "<f8"),
        ("offset", "<f8"),
        ("origin", "<f8", 9),  # rotation A of its origin
        ("crossed", "<f8", 9),  # A K, with the cross product K with its axis
        ("twice_crossed", "<f8", 9),  # A K K
        ("translation", "<f8", 3),
        ("axis", "<f8", 3),
    ]
)
"""A joint of the tree"""
POSE_ROW = np.dtype([("rotation", "<f8", 9), ("translation", "<f8", 3)])
"""Pose of a frame in the root of the tree"""
_TURNS, _SLIDES = 1, 2
_KINDS = {"revolute": _TURNS, "continuous": _TURNS, "prismatic": _SLIDES}


class LinkPose(NamedTuple):
    """Pose of a link in another frame."""

    rotation: FloatArray
    """(3, 3)"""
    translation_m: FloatArray
    """(3,)"""


class LinkPoses:
    """Poses of the n links of a hand in its palm and base frames, at the positions of its `joints` joints
    that were set last, at first 0.

    tree: (t,) joints between the links, parents first, as JOINT_ROW. frames: (n + 2,) of the links, then of
    palm and base. signs: (2 n t,) 1 for a joint that moves a link, -1 for one that moves its palm; the same
    for the base. poses: (t + 1,) of all frames, as POSE_ROW. velocities: (3 m,), working memory.
    """

    def __init__(self, hand: HandKinematics) -> None:
        self.joints, self.links, self.tree_joints = len(hand.joints), len(hand.link_frames), len(hand.tree)
        self.tree = _joint_rows(hand)
        self.frames = view_memory(
            np.array([*hand.link_frames, hand.palm_frame, hand.base_frame], dtype=np.intp)
        )
        self.signs = view_memory(np.stack([hand.palm_signs, hand.base_signs]))
        poses = view_rows(np.zeros(self.tree_joints + 1, POSE_ROW), POSE_ROW)
        poses.rotation[0] = np.eye(3).ravel()
        self.poses = poses
        self.velocities = view_memory(np.zeros(3 * self.joints))
        self.set_joint_positions(view_memory(np.zeros(self.joints)))

    def pose_in_palm(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the palm frame."""
        return _pose(self, link, False)

    def pose_in_base(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the base frame."""
        return _pose(self, link, True)

    def joint_covariance_m2(
        self, link: int, position_m: ArrayLike, std_rad: FloatArray, in_base: bool = False
    ) -> FloatArray:
        """Return the covariance (3, 3) of a point (3,) of a link from the standard deviations (m,) of the
        joints, in palm or base frame."""
        covariance = np.zeros(9)
        x, y, z = np.asarray(position_m, dtype=np.float64).tolist()
        self.add_joint_covariance(
            link, in_base, x, y, z, stds=view_memory(std_rad), out=view_memory(covariance)
        )
        return covariance.reshape(3, 3)

    def set_joint_positions(self, positions: memoryview[float] | FloatArray) -> None:
        """Compute all poses at joint positions (m,) [rad, m if prismatic]; NaN counts as 0."""
        for k in range(self.tree_joints):
            moved, mover = self.tree[k].offset, self.tree[k].mover
            if mover >= 0 and positions[mover] - positions[mover] == 0.0:
                moved += self.tree[k].factor * positions[mover]
            _place_child(self, k, moved)

    def write_pose(self, link: int, in_base: bool, out: RowArray) -> None:
        """Write the pose of a link in the palm or base frame to the first POSE_ROW of `out`."""
        at, seen_from = self.frames[link], self.frames[self.links + (1 if in_base else 0)]
        x = self.poses[at].translation[0] - self.poses[seen_from].translation[0]
        y = self.poses[at].translation[1] - self.poses[seen_from].translation[1]
        z = self.poses[at].translation[2] - self.poses[seen_from].translation[2]
        for i in range(3):
            a = self.poses[seen_from].rotation[i]
            b = self.poses[seen_from].rotation[3 + i]
            c = self.poses[seen_from].rotation[6 + i]
            for j in range(3):
                out[0].rotation[3 * i + j] = (
                    a * self.poses[at].rotation[j]
                    + b * self.poses[at].rotation[3 + j]
                    + c * self.poses[at].rotation[6 + j]
                )
            out[0].translation[i] = a * x + b * y + c * z

    def add_joint_covariance(
        self,
        link: int,
        in_base: bool,
        px: float,
        py: float,
        pz: float,
        stds: memoryview[float],
        out: memoryview[float],
    ) -> None:
        """Add the covariance (9,) of a point (px, py, pz) of a link that the joints' deviations (m,) cause.

        The covariance is in palm or base frame.
        """
        velocities = self.velocities
        at, seen_from = self.frames[link], self.frames[self.links + (1 if in_base else 0)]
        x = _turned(self, at, 0, px, py, pz) + self.poses[at].translation[0]
        y = _turned(self, at, 1, px, py, pz) + self.poses[at].translation[1]
        z = _turned(self, at, 2, px, py, pz) + self.poses[at].translation[2]
        for i in range(3 * self.joints):
            velocities[i] = 0.0
        row = (self.links + link if in_base else link) * self.tree_joints
        for k in range(self.tree_joints):
            if self.signs[row + k] != 0.0 and self.tree[k].mover >= 0 and self.tree[k].kind != 0:
                _add_velocity(self, k, self.signs[row + k] * self.tree[k].factor, x, y, z)
        for k in range(self.joints):
            x, y, z = velocities[3 * k], velocities[3 * k + 1], velocities[3 * k + 2]
            if stds[k] > 0.0 and (x != 0.0 or y != 0.0 or z != 0.0):
                for i in range(3):
                    turned = self.poses[seen_from].rotation[i] * x + self.poses[seen_from].rotation[3 + i] * y
                    velocities[3 * k + i] = stds[k] * (turned + self.poses[seen_from].rotation[6 + i] * z)
                for i in range(3):
                    for j in range(3):
                        out[3 * i + j] += velocities[3 * k + i] * velocities[3 * k + j]


def _joint_rows(hand: HandKinematics) -> RowArray:
    rows = np.zeros(len(hand.tree), JOINT_ROW)
    rows["parent"], rows["mover"] = hand.parents, hand.movers
    rows["factor"], rows["offset"] = hand.factors, hand.offsets
    for row, joint in zip(rows, hand.tree, strict=True):
        cross = np.cross(joint.axis, np.eye(3)).T  # cross product of the axis with a vector, as a matrix
        row["kind"] = _KINDS.get(joint.kind, 0)
        row["origin"] = joint.rotation.ravel()
        row["crossed"] = (joint.rotation @ cross).ravel()
        row["twice_crossed"] = (joint.rotation @ cross @ cross).ravel()
        row["translation"], row["axis"] = joint.translation_m, joint.axis
    return rows.view(np.recarray)


def _pose(poses: LinkPoses, link: int, in_base: bool) -> LinkPose:
    pose = view_rows(np.zeros(1, POSE_ROW), POSE_ROW)
    poses.write_pose(link, in_base, pose)
    return LinkPose(pose.rotation.reshape(3, 3), pose.translation[0])


def _turned(tree: LinkPoses, frame: int, i: int, x: float, y: float, z: float) -> float:
    """Return component i of a vector of a frame, turned to the root."""
    turned: float = (
        tree.poses[frame].rotation[3 * i] * x
        + tree.poses[frame].rotation[3 * i + 1] * y
        + tree.poses[frame].rotation[3 * i + 2] * z
    )
    return turned


def _place_child(tree: LinkPoses, k: int, moved: float) -> None:
    """Compute the pose of joint k's child link from that of its parent, by Rodrigues' formula."""
    parent, kind = tree.tree[k].parent, tree.tree[k].kind
    sine = versine = 0.0
    if kind == _TURNS:
        half = math.sin(0.5 * moved)
        sine, versine = math.sin(moved), 2.0 * half * half
    for j in range(3):
        a = _column(tree, k, j, sine, versine)
        b = _column(tree, k, 3 + j, sine, versine)
        c = _column(tree, k, 6 + j, sine, versine)
        for i in range(3):
            tree.poses[k + 1].rotation[3 * i + j] = _turned(tree, parent, i, a, b, c)
    x, y, z = tree.tree[k].translation[0], tree.tree[k].translation[1], tree.tree[k].translation[2]
    for i in range(3):
        origin = _turned(tree, parent, i, x, y, z)
        tree.poses[k + 1].translation[i] = origin + tree.poses[parent].translation[i]
    if kind == _SLIDES:
        x, y, z = tree.tree[k].axis[0], tree.tree[k].axis[1], tree.tree[k].axis[2]
        for i in range(3):
            tree.poses[k + 1].translation[i] += moved * _turned(tree, k + 1, i, x, y, z)


def _column(tree: LinkPoses, k: int, i: int, sine: float, versine: float) -> float:
    """Return element i of joint k's rotation."""
    element: float = (
        tree.tree[k].origin[i] + sine * tree.tree[k].crossed[i] + versine * tree.tree[k].twice_crossed[i]
    )
    return element


def _add_velocity(tree: LinkPoses, k: int, rate: float, x: float, y: float, z: float) -> None:
    """Add the velocity of a point (x, y, z) of the root that joint k causes at a rate to its mover's."""
    a, b, c = tree.tree[k].axis[0], tree.tree[k].axis[1], tree.tree[k].axis[2]
    ax, ay = _turned(tree, k + 1, 0, a, b, c), _turned(tree, k + 1, 1, a, b, c)
    az = _turned(tree, k + 1, 2, a, b, c)
    if tree.tree[k].kind == _TURNS:
        x = x - tree.poses[k + 1].translation[0]
        y = y - tree.poses[k + 1].translation[1]
        z = z - tree.poses[k + 1].translation[2]
        ax, ay, az = ay * z - az * y, az * x - ax * z, ax * y - ay * x
    first = 3 * tree.tree[k].mover
    tree.velocities[first] += rate * ax
    tree.velocities[first + 1] += rate * ay
    tree.velocities[first + 2] += rate * az
