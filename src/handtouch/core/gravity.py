"""Gravity less acceleration in link frames from joint states, for the compensation of baselines; of magnetic
pads, whose zeros the Earth's field shifts, the link's orientation.

Public names: `GravityTracker`, `quaternion_vectors`. Free of I/O and clocks; joint states come from
`joints_at`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import islice

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels
from handtouch.hand.rotations import rotation_matrices
from handtouch.host.units import GRAVITY_M_S2

_INTERVAL_NS = 20_000_000
"""Least time between two updates: a hand that turns over once a second turns by 7 degrees meanwhile."""
_MIN_CHANGE = 0.01
"""Least change of a joint [rad, m] or of gravity in the base frame that is processed."""
_FITTED_POSES, _MAX_SPAN_S = 5, 0.2
"""Poses to which a parabola is fitted for the acceleration, 40 ms old in its middle. Joints with deviations
of 1 mrad, 0.1 m from a link's pad, give it one of 0.014 g."""
_UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
_MAX_ACCELERATION_G = 4.0
"""More is a joint's jump: fingers that close in a tenth of a second have less"""


class GravityTracker:
    """Gravity less the acceleration of the base's frame at the centres of n pads, of magnetic ones the vector
    part of their link's quaternion. joints_at: a hand's joints at a time; base_pose: "gravity" (3,), a unit
    direction, or "orientation" (4,) of a hand's base as published by the robot, None if it isn't."""

    def __init__(
        self,
        robots: RobotModels,
        pads: int,
        joints_at: Callable[[str, int], JointSnapshot | None],
        base_pose: Callable[[str, str], FloatArray | None],
    ) -> None:
        self._robots, self._joints_at, self._base_pose = robots, joints_at, base_pose
        self._poses = [LinkPoses(kinematics) for kinematics in robots.kinematics]
        self._felt = np.full((pads, 3), np.nan)
        self._next_ns = 0
        self._last_inputs: list[FloatArray | None] = [None] * len(robots.hands)
        self._motions = [_PadMotion(centres) for centres in robots.pad_centres_m]

    def update_felt(self, now_ns: int) -> FloatArray | None:
        """Return gravity less acceleration in each link's frame (n, 3), in units of gravity, or orientation,
        NaN where unknown; None if no link moved, or it was checked less than 20 ms ago."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + _INTERVAL_NS
        moved = [self._update_hand(number, now_ns) for number in range(len(self._robots.hands))]
        return self._felt.copy() if any(moved) else None

    def _update_hand(self, number: int, now_ns: int) -> bool:
        """Update a hand's links; return True if one has moved since the last update."""
        robots, motion = self._robots, self._motions[number]
        hand, poses, rows = robots.hands[number], self._poses[number], robots.pad_rows[number]
        joints = self._joints_at(hand, now_ns)
        if joints is None:
            return False
        gravity, base = (
            stated if (published := self._base_pose(hand, key)) is None else published
            for key, stated in (("gravity", robots.gravity[number]), ("orientation", _UPRIGHT))
        )
        known = joints.age_s <= robots.joints_stale_s[number]
        inputs = np.concatenate([gravity, base, np.where(known, joints.position_rad, np.nan)])
        unchanged = _is_unchanged(inputs, self._last_inputs[number])
        if unchanged and motion.resting:
            motion.rest(now_ns)
            return False
        if not unchanged:
            self._last_inputs[number] = inputs
        poses.set_joint_positions(joints.position_rad)
        unknown = robots.kinematics[number].base_joint_mask @ ~known
        pose = [poses.pose_in_base(link) for link in range(len(rows))]
        rotation = np.array([one.rotation for one in pose]).reshape(-1, 3, 3)
        motion.add(now_ns, rotation, np.array([one.translation_m for one in pose]), unchanged)
        felt = gravity @ rotation - motion.acceleration_g()
        if (magnetic := robots.magnetic_pads[number]).any():
            felt[magnetic] = quaternion_vectors(rotation_matrices(base[None])[0] @ rotation[magnetic])
        self._felt[rows] = np.where(unknown[:, None], np.nan, felt)
        return True


class _PadMotion:
    """Last poses of a hand's k pads, to the acceleration of their centres_m (k, 3) in their links' frames."""

    def __init__(self, centres_m: FloatArray) -> None:
        self._centres_m = centres_m
        self._poses: deque[tuple[int, FloatArray, FloatArray, bool]] = deque(maxlen=_FITTED_POSES)

    @property
    def resting(self) -> bool:
        """True if none of the last poses differs from the first of them."""
        return len(self._poses) == _FITTED_POSES and all(pose[3] for pose in islice(self._poses, 1, None))

    def add(self, t_ns: int, rotation: FloatArray, translation_m: FloatArray, unchanged: bool) -> None:
        """Add poses (k, 3, 3), (k, 3) of the links in the base."""
        at_m = translation_m + np.matmul(rotation, self._centres_m[:, :, None])[:, :, 0]
        self._poses.append((t_ns, rotation, at_m, unchanged))

    def rest(self, t_ns: int) -> None:
        """Add the last pose again."""
        self._poses.append((t_ns, *self._poses[-1][1:]))

    def acceleration_g(self) -> FloatArray:
        """Return the acceleration (k, 3) of the pads in their links' frames in the middle of the last poses,
        in units of gravity; 0 while too few are known, and at rest.

        In the link's frame that of a steady turn is constant, however old.
        """
        times_s = np.array([1e-9 * (one[0] - self._poses[-1][0]) for one in self._poses])
        if len(times_s) < _FITTED_POSES or times_s[0] < -_MAX_SPAN_S or self.resting:
            return np.zeros_like(self._centres_m)
        weights = 2 * np.linalg.pinv(np.vander(times_s - times_s.mean(), 3))[0]
        in_base = np.tensordot(weights, np.array([one[2] for one in self._poses]), 1) / GRAVITY_M_S2
        in_link = np.matmul(in_base[:, None], self._poses[_FITTED_POSES // 2][1])[:, 0]
        size = np.linalg.norm(in_link, axis=1, keepdims=True)
        return np.asarray(in_link * np.minimum(1.0, _MAX_ACCELERATION_G / np.maximum(size, 1e-9)))


def quaternion_vectors(rotation: FloatArray) -> FloatArray:
    """Return the vector parts (n, 3) of the quaternions of rotations (n, 3, 3) whose scalars are >= 0."""
    r = np.moveaxis(rotation, 0, -1)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    # the outer product of a quaternion with itself is linear in its rotation
    outer = np.stack(
        [
            [1 + 2 * r[0, 0] - trace, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - trace, r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - trace, r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + trace],
        ]
    )
    largest = np.diagonal(outer).argmax(axis=1)
    quaternion = outer[largest, :, np.arange(len(largest))]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.asarray(np.where(quaternion[:, 3:] < 0, -1.0, 1.0) * quaternion[:, :3])


def _is_unchanged(now: FloatArray, before: FloatArray | None) -> bool:
    """Return True if the same joints are known and none has moved noticeably."""
    if before is None:
        return False
    if now.tobytes() == before.tobytes():  # at rest, and a tenth of the time of what follows
        return True
    if not np.array_equal(np.isnan(now), np.isnan(before)):
        return False
    return bool(np.nanmax(np.abs(now - before)) < _MIN_CHANGE)
