"""Kinematics of a hand: poses of its links in its palm and base frames at joint positions, and the covariance
of points on them from those of the joints."""

from __future__ import annotations

import math

_POSE, _MOTION = 12, 33
_AXIS = 30
_TURNS, _SLIDES = 1, 2


class JointTree:
    """Joints (t) between n links of a hand, parents first, and the poses of frames in the root of their tree.

    Frame 0 is the root, frame k + 1 the child link of joint k; a pose is a rotation by rows and a
    translation. parents: (t,) frame of each joint's parent link. kinds: (t,) 1 for a joint that turns, 2 for
    one that slides, else 0. motions: (t 33,) matrices A, A K and A K K for the rotation A of its origin and
    the cross product K with its axis, the translation of its origin, and the axis. Joint k is at
    factors[k] times the position of joint movers[k] of m plus offsets[k]; its mover is -1 for none.
    frames: (n,) of the links, then of palm and base. signs: (2 n t,) 1 for a joint that moves a link, -1
    for one that moves its palm; the same for the base. poses: (12 (t + 1),). velocities: (3 m,), working
    memory.
    """

    def __init__(
        self,
        parents: memoryview[int],
        kinds: memoryview[int],
        motions: memoryview[float],
        movers: memoryview[int],
        factors: memoryview[float],
        offsets: memoryview[float],
        frames: memoryview[int],
        signs: memoryview[float],
        poses: memoryview[float],
        velocities: memoryview[float],
    ) -> None:
        self.parents, self.kinds, self.motions = parents, kinds, motions
        self.movers, self.factors, self.offsets = movers, factors, offsets
        self.frames, self.signs, self.poses, self.velocities = frames, signs, poses, velocities
        self.tree_joints, self.links, self.joints = len(parents), len(frames) - 2, len(velocities) // 3
        for i in range(_POSE):
            poses[i] = 1.0 if i in (0, 4, 8) else 0.0

    def set_joint_positions(self, positions: memoryview[float]) -> None:
        """Compute all poses at joint positions (m,) [rad, m if prismatic]; NaN counts as 0."""
        for k in range(self.tree_joints):
            moved, mover = self.offsets[k], self.movers[k]
            if mover >= 0 and positions[mover] - positions[mover] == 0.0:
                moved += self.factors[k] * positions[mover]
            _place_child(self, k, moved)

    def write_pose(self, link: int, in_base: bool, out: memoryview[float]) -> None:
        """Write rotation and translation (12,) of a link in the palm or base frame."""
        poses = self.poses
        at, seen_from = _POSE * self.frames[link], _POSE * self.frames[self.links + (1 if in_base else 0)]
        x, y, z = (
            poses[at + 9] - poses[seen_from + 9],
            poses[at + 10] - poses[seen_from + 10],
            poses[at + 11] - poses[seen_from + 11],
        )
        for i in range(3):
            a, b, c = poses[seen_from + i], poses[seen_from + 3 + i], poses[seen_from + 6 + i]
            for j in range(3):
                out[3 * i + j] = a * poses[at + j] + b * poses[at + 3 + j] + c * poses[at + 6 + j]
            out[9 + i] = a * x + b * y + c * z

    def add_joint_covariance(
        self,
        link: int,
        in_base: bool,
        point: memoryview[float],
        first: int,
        stds: memoryview[float],
        out: memoryview[float],
    ) -> None:
        """Add the covariance (9,) of a point on a link that the joints' deviations (m,) cause.

        point: in the link's frame, from index `first` on. The covariance is in palm or base frame.
        """
        poses, velocities = self.poses, self.velocities
        at, seen_from = _POSE * self.frames[link], _POSE * self.frames[self.links + (1 if in_base else 0)]
        px, py, pz = point[first], point[first + 1], point[first + 2]
        x = poses[at] * px + poses[at + 1] * py + poses[at + 2] * pz + poses[at + 9]
        y = poses[at + 3] * px + poses[at + 4] * py + poses[at + 5] * pz + poses[at + 10]
        z = poses[at + 6] * px + poses[at + 7] * py + poses[at + 8] * pz + poses[at + 11]
        for i in range(3 * self.joints):
            velocities[i] = 0.0
        row = (self.links + link if in_base else link) * self.tree_joints
        for k in range(self.tree_joints):
            if self.signs[row + k] != 0.0 and self.movers[k] >= 0 and self.kinds[k] != 0:
                _add_velocity(self, k, self.signs[row + k] * self.factors[k], x, y, z)
        for k in range(self.joints):
            x, y, z = velocities[3 * k], velocities[3 * k + 1], velocities[3 * k + 2]
            if stds[k] > 0.0 and (x != 0.0 or y != 0.0 or z != 0.0):
                for i in range(3):
                    turned = poses[seen_from + i] * x + poses[seen_from + 3 + i] * y
                    velocities[3 * k + i] = stds[k] * (turned + poses[seen_from + 6 + i] * z)
                for i in range(3):
                    for j in range(3):
                        out[3 * i + j] += velocities[3 * k + i] * velocities[3 * k + j]


def _place_child(tree: JointTree, k: int, moved: float) -> None:
    """Compute the pose of joint k's child link from that of its parent, by Rodrigues' formula."""
    poses, motions, kind = tree.poses, tree.motions, tree.kinds[k]
    parent, child, of = _POSE * tree.parents[k], _POSE * (k + 1), _MOTION * k
    sine = versine = 0.0
    if kind == _TURNS:
        half = math.sin(0.5 * moved)
        sine, versine = math.sin(moved), 2.0 * half * half
    for j in range(3):
        a = motions[of + j] + sine * motions[of + 9 + j] + versine * motions[of + 18 + j]
        b = motions[of + 3 + j] + sine * motions[of + 12 + j] + versine * motions[of + 21 + j]
        c = motions[of + 6 + j] + sine * motions[of + 15 + j] + versine * motions[of + 24 + j]
        for i in range(3):
            row = parent + 3 * i
            poses[child + 3 * i + j] = poses[row] * a + poses[row + 1] * b + poses[row + 2] * c
    x, y, z = motions[of + 27], motions[of + 28], motions[of + 29]
    for i in range(3):
        row = parent + 3 * i
        moved_origin = poses[row] * x + poses[row + 1] * y + poses[row + 2] * z
        poses[child + 9 + i] = moved_origin + poses[parent + 9 + i]
    if kind == _SLIDES:
        x, y, z = motions[of + _AXIS], motions[of + _AXIS + 1], motions[of + _AXIS + 2]
        for i in range(3):
            row = child + 3 * i
            poses[child + 9 + i] += moved * (poses[row] * x + poses[row + 1] * y + poses[row + 2] * z)


def _add_velocity(tree: JointTree, k: int, rate: float, x: float, y: float, z: float) -> None:
    """Add the velocity of a point (x, y, z) of the root that joint k causes at a rate to its mover's."""
    poses, velocities, row, axis = tree.poses, tree.velocities, _POSE * (k + 1), _MOTION * k + _AXIS
    a, b, c = tree.motions[axis], tree.motions[axis + 1], tree.motions[axis + 2]
    ax = poses[row] * a + poses[row + 1] * b + poses[row + 2] * c
    ay = poses[row + 3] * a + poses[row + 4] * b + poses[row + 5] * c
    az = poses[row + 6] * a + poses[row + 7] * b + poses[row + 8] * c
    if tree.kinds[k] == _TURNS:
        x, y, z = x - poses[row + 9], y - poses[row + 10], z - poses[row + 11]
        ax, ay, az = ay * z - az * y, az * x - ax * z, ax * y - ay * x
    first = 3 * tree.movers[k]
    velocities[first] += rate * ax
    velocities[first + 1] += rate * ay
    velocities[first + 2] += rate * az
