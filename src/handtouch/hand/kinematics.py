"""Forward kinematics of a hand from its URDF, by Pinocchio: where its links are in the palm and in the base.

Public names: `Kinematics`, `available`. Needs the extra `handtouch[urdf]`; it is imported when the first
`Kinematics` is made, and takes 0.2 s and some 50 MB.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.urdf import MOVABLE, Description

FloatArray = NDArray[np.float64]


def available() -> bool:
    """Whether Pinocchio is installed."""
    return find_spec("pinocchio") is not None


class Pose(NamedTuple):
    """Of a link in another frame."""

    rotation: FloatArray
    """(3, 3)"""
    translation_m: FloatArray
    """(3,)"""


class Kinematics:
    """Poses of `links` (n names, of the URDF) in the links `palm` and `base`: `move` the joints, then ask.

    `joints` (m names, of the URDF) move some of the links against palm or base; those that mimic others
    aren't among them. `continuous` (m,) turn without end. `palm_needs`, `base_needs` (n, m): which joints a
    link's pose in palm or base depends on. Raises KeyError for a link that the URDF lacks.
    """

    def __init__(self, robot: Description, links: Sequence[str], palm: str, base: str) -> None:
        import pinocchio

        self._pin = pinocchio
        self._model = pinocchio.buildModelFromXML(robot.path.read_text(encoding="utf-8"))
        self._data = self._model.createData()
        self._frames = [self._frame(robot, link) for link in links]
        self._palm, self._base = self._frame(robot, palm), self._frame(robot, base)
        chains = [[robot.between(link, other) for link in links] for other in (palm, base)]
        moving = {
            j.mimic[0] if j.mimic else j.name for of in chains for c in of for j in c if j.kind in MOVABLE
        }
        self.joints = tuple(name for name in robot.joints if name in moving)
        self.continuous = np.array(
            [robot.joints[n].kind == "continuous" for n in self.joints], dtype=np.bool_
        )
        self.palm_needs, self.base_needs = (
            np.array(
                [
                    [any(name in (j.name, j.mimic and j.mimic[0]) for j in chain) for name in self.joints]
                    for chain in of
                ],
                dtype=np.bool_,
            ).reshape(len(links), len(self.joints))
            for of in chains
        )
        self._map_joints(robot)

    def move(self, position_rad: FloatArray) -> None:
        """Put the joints at these positions (m,): radians, metres where they slide. NaN counts as 0."""
        if np.isnan(position_rad).any():
            position_rad = np.nan_to_num(position_rad)
        turned = self._matrix @ position_rad + self._offset
        q = self._rest.copy()
        q[self._plain_q] = turned[self._plain_v]
        if len(self._turning_q):
            angle = turned[self._turning_v]
            q[self._turning_q], q[self._turning_q + 1] = np.cos(angle), np.sin(angle)
        self._pin.forwardKinematics(self._model, self._data, q)
        self._q = q
        self._jacobians: dict[int, Any] = {}
        self._here: dict[int, Any] = {}

    def in_palm(self, link: int) -> Pose:
        """Where the link of that number is in the frame of the palm."""
        return self._pose(self._palm, self._frames[link])

    def in_base(self, link: int) -> Pose:
        """Where the link of that number is in the frame of the base."""
        return self._pose(self._base, self._frames[link])

    def down(self, in_base: FloatArray) -> FloatArray:
        """A direction (3,) of the base's frame in the frame of each link, (n, 3)."""
        seen = self._at(self._base).rotation @ in_base
        return np.array([seen @ self._at(frame).rotation for frame in self._frames])

    def slope(self, link: int, position_m: FloatArray, in_base: bool = False) -> FloatArray:
        """How a point (3,) of the link moves with each joint, (3, m) [m/rad] in palm or base frame."""
        frame, other = self._frames[link], self._base if in_base else self._palm
        seen = self._at(other)
        x, y, z = self._at(frame).act(position_m)
        twist = self._jacobian(frame) - self._jacobian(other)
        lever = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # a turn's cross product with the place
        moved = twist[:3] + lever @ twist[3:]
        return np.asarray(seen.rotation.T @ moved @ self._matrix, np.float64)

    def _jacobian(self, frame: int) -> Any:
        """How a frame moves with Pinocchio's coordinates, (6, nv), about the world's origin."""
        found = self._jacobians.get(frame)
        if found is None:
            if not self._jacobians:
                self._pin.computeJointJacobians(self._model, self._data, self._q)
            found = self._pin.getFrameJacobian(self._model, self._data, frame, self._pin.WORLD)
            self._jacobians[frame] = found
        return found

    def _pose(self, seen_from: int, frame: int) -> Pose:
        pose = self._at(seen_from).actInv(self._at(frame))
        return Pose(pose.rotation, pose.translation)

    def _at(self, frame: int) -> Any:
        here = self._here.get(frame)
        if here is None:
            here = self._here[frame] = self._pin.updateFramePlacement(self._model, self._data, frame)
        return here

    def _frame(self, robot: Description, link: str) -> int:
        robot.bodies[link]
        return int(self._model.getFrameId(link, self._pin.FrameType.BODY))

    def _map_joints(self, robot: Description) -> None:
        """Pinocchio's coordinates as a linear map of ours: order, joints that mimic, joints without end."""
        model = self._model
        self._matrix = np.zeros((model.nv, len(self.joints)))
        self._offset = np.zeros(model.nv)
        self._rest = self._pin.neutral(model)
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
        self.move(np.zeros(len(self.joints)))
