"""Forward kinematics of a hand from its URDF, by Pinocchio: poses of its links in the palm and base
frames.

Public names: `HandKinematics`, `LinkPose`, `pinocchio_available`. Needs the extra `handtouch[urdf]`;
Pinocchio is imported by the first `HandKinematics`, and takes 0.2 s and some 50 MB.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.urdf import MOVABLE_JOINT_TYPES, RobotDescription

FloatArray = NDArray[np.float64]


def pinocchio_available() -> bool:
    """Return whether Pinocchio is installed."""
    return find_spec("pinocchio") is not None


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
        import pinocchio

        self._pin = pinocchio
        self._model = pinocchio.buildModelFromXML(robot.path.read_text(encoding="utf-8"))
        self._data = self._model.createData()
        self._frames = [self._frame_id(robot, link) for link in links]
        self._palm, self._base = self._frame_id(robot, palm), self._frame_id(robot, base)
        chains = [[robot.joints_between(link, other) for link in links] for other in (palm, base)]
        moving = {
            j.mimic[0] if j.mimic else j.name
            for of in chains
            for c in of
            for j in c
            if j.kind in MOVABLE_JOINT_TYPES
        }
        self.joints = tuple(name for name in robot.joints if name in moving)
        self.continuous = np.array(
            [robot.joints[n].kind == "continuous" for n in self.joints], dtype=np.bool_
        )
        self.limits = np.array([robot.joints[n].limits for n in self.joints]).reshape(-1, 2)
        self.palm_joint_mask, self.base_joint_mask = (
            np.array(
                [
                    [any(name in (j.name, j.mimic and j.mimic[0]) for j in chain) for name in self.joints]
                    for chain in of
                ],
                dtype=np.bool_,
            ).reshape(len(links), len(self.joints))
            for of in chains
        )
        self._build_joint_map(robot)

    def set_joint_positions(self, position_rad: FloatArray) -> None:
        """Set the joint positions (m,): radians, metres for prismatic joints. NaN counts as 0."""
        if np.isnan(position_rad).any():
            position_rad = np.nan_to_num(position_rad)
        turned = self._matrix @ position_rad + self._offset
        q = self._neutral_q.copy()
        q[self._plain_q] = turned[self._plain_v]
        if len(self._turning_q):
            angle = turned[self._turning_v]
            q[self._turning_q], q[self._turning_q + 1] = np.cos(angle), np.sin(angle)
        self._pin.forwardKinematics(self._model, self._data, q)
        self._q = q
        self._jacobians: dict[int, Any] = {}
        self._frame_placements: dict[int, Any] = {}

    def pose_in_palm(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the palm frame."""
        return self._relative_pose(self._palm, self._frames[link])

    def pose_in_base(self, link: int) -> LinkPose:
        """Return the pose of link number `link` in the base frame."""
        return self._relative_pose(self._base, self._frames[link])

    def direction_in_links(self, in_base: FloatArray) -> FloatArray:
        """Return a direction (3,) of the base frame in the frame of each link, (n, 3)."""
        reference = self._frame_placement(self._base).rotation @ in_base
        return np.array([reference @ self._frame_placement(frame).rotation for frame in self._frames])

    def point_jacobian(self, link: int, position_m: FloatArray, in_base: bool = False) -> FloatArray:
        """Return the derivative (3, m) [m/rad] of a point (3,) of the link by the joints, in palm or base
        frame.
        """
        frame, other = self._frames[link], self._base if in_base else self._palm
        reference = self._frame_placement(other)
        x, y, z = self._frame_placement(frame).act(position_m)
        twist = self._frame_jacobian(frame) - self._frame_jacobian(other)
        lever = np.array(
            [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        )  # cross product of a rotation with the position
        moved = twist[:3] + lever @ twist[3:]
        return np.asarray(reference.rotation.T @ moved @ self._matrix, np.float64)

    def _frame_jacobian(self, frame: int) -> Any:
        """Return the Jacobian (6, nv) of a frame by Pinocchio's coordinates, about the world's origin."""
        found = self._jacobians.get(frame)
        if found is None:
            if not self._jacobians:
                self._pin.computeJointJacobians(self._model, self._data, self._q)
            found = self._pin.getFrameJacobian(self._model, self._data, frame, self._pin.WORLD)
            self._jacobians[frame] = found
        return found

    def _relative_pose(self, seen_from: int, frame: int) -> LinkPose:
        pose = self._frame_placement(seen_from).actInv(self._frame_placement(frame))
        return LinkPose(pose.rotation, pose.translation)

    def _frame_placement(self, frame: int) -> Any:
        placement = self._frame_placements.get(frame)
        if placement is None:
            placement = self._frame_placements[frame] = self._pin.updateFramePlacement(
                self._model, self._data, frame
            )
        return placement

    def _frame_id(self, robot: RobotDescription, link: str) -> int:
        robot.bodies[link]
        return int(self._model.getFrameId(link, self._pin.FrameType.BODY))

    def _build_joint_map(self, robot: RobotDescription) -> None:
        """Map `joints` linearly to Pinocchio's coordinates: order, mimicking joints, continuous joints."""
        model = self._model
        self._matrix = np.zeros((model.nv, len(self.joints)))
        self._offset = np.zeros(model.nv)
        self._neutral_q = self._pin.neutral(model)
        plain: list[tuple[int, int]] = []
        turning: list[tuple[int, int]] = []
        for number in range(1, model.njoints):
            joint, kind = robot.joints[model.names[number]], model.joints[number]
            name, factor, self._offset[kind.idx_v] = joint.mimic or (joint.name, 1.0, 0.0)
            if name in self.joints:
                self._matrix[kind.idx_v, self.joints.index(name)] = factor
            (plain if kind.nq == 1 else turning).append((kind.idx_q, kind.idx_v))
        self._plain_q, self._plain_v = np.array(plain, dtype=np.intp).reshape(-1, 2).T
        self._turning_q, self._turning_v = np.array(turning, dtype=np.intp).reshape(-1, 2).T
        self.set_joint_positions(np.zeros(len(self.joints)))
