"""Fit the pose of a bolt to the places where it was touched and to those where it isn't.

Public names: `KnownBolt`, a bolt whose shape is known; `Contact`; `OnTable` and `InGrip`, poses that fit;
poses in frames: `compose`, `inverse`, `relative`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from handtouch.config.objects import BoltShape, ObjectTable
from handtouch.percept.object_shapes import build_shape
from handtouch.simulate.tactile.bolt_scene import Bolt
from handtouch.simulate.tactile.bolt_workcell import Pose

FloatArray = NDArray[np.float64]

AREA_M = 0.02
"""The bolt lies within so much of the middle"""
UP = np.array([0.0, 0.0, 1.0])
_ROUND_HEAD = 17 / 16
"""Diameter of a round head that is like a hexagon, over its width across flats: from corner to corner 1.15"""
_GRIPPED_STD_M, _GRIPPED_STD_RAD = 2.5e-3, np.array([0.04, 0.1, 0.12])
"""Of the bolt in the grip, as it was found on the table: closing fingers turn it about the approach most"""
_SAME_DIRECTION, _MIN_WEIGHT = np.cos(np.radians(20.0)), 0.01
"""Fits within this cosine are one pose, and poses less likely than this are left out"""
_LOWERED = 24
"""Steps of lowering spheres in thought"""


class Contact(NamedTuple):
    """A contact in the world, or in another frame."""

    point_m: FloatArray
    normal: FloatArray
    """from the pad into the object"""
    std_m: float
    """along the normal"""
    std_rad: float
    """of the normal: pads are round, so it is as uncertain as the place on the pad"""
    force_n: float

    def seen_from(self, pose: Pose) -> Contact:
        """Return it in the frame that has a pose."""
        position, rotation = pose
        return self._replace(point_m=(self.point_m - position) @ rotation, normal=self.normal @ rotation)


class OnTable(NamedTuple):
    """A possible pose of a bolt on the table."""

    parameters: FloatArray
    """(3,) of `KnownBolt.lying`"""
    weight: float
    """among the possible poses"""
    covariance: FloatArray
    """(3, 3) of the parameters"""

    @property
    def direction_std_rad(self) -> float:
        """Standard deviation of its direction."""
        return float(np.sqrt(self.covariance[2, 2]))

    def spread(self) -> list[tuple[FloatArray, float]]:
        """Return points with weights that have its mean and covariance."""
        root = np.sqrt(3) * np.linalg.cholesky(self.covariance + 1e-12 * np.eye(3)).T
        return [(self.parameters + each, self.weight / 6) for each in (*root, *-root)]


class InGrip(NamedTuple):
    """The pose of a bolt in the grip."""

    expected: Pose
    change: FloatArray
    """(6,), from what was expected, in standard deviations of it"""
    covariance: FloatArray
    """(6, 6) of the change"""
    weight: float
    """against the same with the other end"""

    @property
    def pose(self) -> Pose:
        """In the frame of the grip."""
        return self.at(self.change)

    def at(self, change: FloatArray) -> Pose:
        """Return the pose after another change."""
        return _shifted(change, self.expected)


class KnownBolt:
    """A bolt whose shape is known, at a pose that isn't.

    Attributes in m: `half_m` of its length, `shank_m` and `flats_m`, the least radii of shank and head, and
    `head_m`, the head's length.
    """

    def __init__(self, bolt: Bolt) -> None:
        self.half_m, self.head_m = bolt.total_m / 2, bolt.head_m
        self.shank_m, self.flats_m = bolt.diameter_m / 2, bolt.head_flats_m / 2
        shape = BoltShape(
            kind="bolt",
            diameter_mm=1e3 * bolt.diameter_m,
            length_mm=1e3 * bolt.length_m,
            head_diameter_mm=1e3 * _ROUND_HEAD * bolt.head_flats_m,
            head_length_mm=1e3 * bolt.head_m,
        )
        self._shape = build_shape(ObjectTable(shape=shape))

    def ends(self, pose: Pose) -> FloatArray:
        """Return the middles (2, 3) of head and tip."""
        return pose[0] + np.outer([-self.half_m, self.half_m], pose[1][:, 2])

    def lying(self, parameters: FloatArray) -> Pose:
        """Return the pose of a bolt on the table, on its head's edge and its tip; parameters: x, y, yaw."""
        x, y, yaw = parameters
        slope = (self.flats_m - self.shank_m) / (2 * self.half_m - self.head_m)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], UP])
        upright = np.array([[0.0, -slope, 1.0], [-np.hypot(1.0, slope), 0.0, 0.0], [0.0, -1.0, -slope]])
        place = np.array([x, y, self.shank_m + slope * self.half_m])
        return place, turn @ upright / np.hypot(1.0, slope)

    def poses_on_table(self, contacts: list[Contact], spheres: FloatArray) -> list[OnTable]:
        """Return possible poses of a bolt on the table, outside of spheres (n, 4), the likeliest first.

        Fits that point the same way are one.
        """
        middle = np.mean([each.point_m[:2] for each in contacts], axis=0)
        reach = np.arange(-0.024, 0.0241, 0.004)
        best: list[tuple[float, FloatArray]] = []
        for yaw in np.radians(np.arange(0, 360, 10)):
            along = np.array([np.cos(yaw), np.sin(yaw)])
            across = np.array([-along[1], along[0]])
            at = [middle + a * along + b * across for a in reach for b in (-0.005, 0.0, 0.005)]
            starts = [np.array([*each, yaw]) for each in at]
            costs = [np.square(self._on_table(start, contacts, spheres)).sum() for start in starts]
            k = int(np.argmin(costs))
            best.append((float(costs[k]), starts[k]))
        best.sort(key=lambda each: each[0])
        fits = [
            least_squares(self._on_table, start, args=(contacts, spheres), x_scale=[1e-3, 1e-3, 0.1])
            for _, start in best[:8]
        ]
        fits.sort(key=lambda fit: fit.cost)
        apart = fits[:1]
        for fit in fits[1:]:
            if all(np.cos(fit.x[2] - other.x[2]) < _SAME_DIRECTION for other in apart):
                apart.append(fit)
        weights = _weights(np.array([fit.cost for fit in apart]))
        found = zip(apart, weights.tolist(), strict=True)
        return [OnTable(fit.x, own, _covariance(fit.jac)) for fit, own in found if own > _MIN_WEIGHT]

    def lowered_m(self, parameters: FloatArray, spheres: FloatArray, lowest_m: float) -> float:
        """Return how far above their given height spheres (n, 4) touch a lying bolt, `lowest_m` for never.

        The spheres are lowered by their least distance, again and again, as a ray is traced.
        """
        position, rotation = self.lying(parameters)
        above_m = 0.05
        for _ in range(_LOWERED):
            centres = spheres[:, :3] + [0.0, 0.0, above_m]
            apart_m = float((self._shape.distance((centres - position) @ rotation) - spheres[:, 3]).min())
            if apart_m < 0.2e-3 or above_m - apart_m < lowest_m:
                return above_m if apart_m < 0.2e-3 else lowest_m
            above_m -= apart_m
        return above_m

    def pose_in_grip(self, expected: Pose, contacts: list[Contact]) -> InGrip:
        """Return the bolt's pose by contacts, near the expected."""
        turned = expected[0], expected[1] @ np.diag([1.0, -1.0, -1.0])
        fits = [
            least_squares(self._in_grip, np.zeros(6), args=(pose, contacts)) for pose in (expected, turned)
        ]
        weights = _weights(np.array([fit.cost for fit in fits]))
        return InGrip(expected, fits[0].x, _covariance(fits[0].jac), float(weights[0]))

    def _on_table(self, parameters: FloatArray, contacts: list[Contact], spheres: FloatArray) -> FloatArray:
        position, rotation = pose = self.lying(parameters)
        apart_m = self._shape.distance((spheres[:, :3] - position) @ rotation) - spheres[:, 3]
        apart, beyond = (apart_m + 0.7e-3) / 1e-3, (np.abs(parameters[:2]) - AREA_M) / 5e-3
        touched = self._touched(pose, contacts, 0.7e-3)
        return np.concatenate([touched, np.minimum(apart, 0.0), np.maximum(beyond, 0.0)])

    def _in_grip(self, change: FloatArray, expected: Pose, contacts: list[Contact]) -> FloatArray:
        return np.concatenate([self._touched(_shifted(change, expected), contacts, 0.4e-3), change])

    def _touched(self, pose: Pose, contacts: list[Contact], std_m: float, std_rad: float = 0.2) -> FloatArray:
        """Return how contacts (c,) deviate from the bolt's surface, in standard deviations (4 c,).

        Normals are compared 3 mm outside, where the gradient at an edge is any normal that a pad there may
        have.
        """
        position, rotation = pose
        points = (np.array([each.point_m for each in contacts]) - position) @ rotation
        normals = np.array([each.normal for each in contacts]) @ rotation
        distance = self._shape.distance(points)
        _, outward = self._shape.distance_and_normal(points - 3e-3 * normals)
        spread = np.hypot([each.std_m for each in contacts], std_m)
        turned = np.hypot([each.std_rad for each in contacts], std_rad)
        return np.concatenate([distance / spread, ((outward + normals) / turned[:, None]).ravel()])


def _covariance(jacobian: object) -> FloatArray:
    return np.asarray(np.linalg.pinv(np.asarray(jacobian).T @ np.asarray(jacobian)))


def _weights(costs: FloatArray) -> FloatArray:
    """Return the weights (n,) of poses by half of their squared residuals (n,)."""
    likelihood = np.exp(costs.min() - costs)
    return np.asarray(likelihood / likelihood.sum())


def _shifted(change: FloatArray, pose: Pose) -> Pose:
    """Return a pose after a change (6,), in standard deviations of what is expected."""
    turn = Rotation.from_rotvec(_GRIPPED_STD_RAD * change[3:]).as_matrix()
    return pose[0] + _GRIPPED_STD_M * change[:3], turn @ pose[1]


def compose(first: Pose, second: Pose) -> Pose:
    """Return the pose of `second`, which is in the frame of `first`."""
    return first[0] + first[1] @ second[0], first[1] @ second[1]


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a pose."""
    return -pose[1].T @ pose[0], pose[1].T


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return a pose in a frame."""
    return compose(inverse(frame), pose)
