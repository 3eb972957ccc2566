"""Fit the pose of a bolt to the places where it was touched and to those where it isn't.

Public names: `Contact`, `OnTable`, `poses_on_table`, `lying`, `touched_m`, `InGrip`, `pose_in_grip`; poses in
frames: `compose`, `inverse`, `relative`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from handtouch.config.objects import BoltShape, ObjectTable
from handtouch.percept.object_shapes import build_shape
from handtouch.simulate.tactile.bolt_workcell import Pose

FloatArray = NDArray[np.float64]

_SHAPE = BoltShape(kind="bolt", diameter_mm=10, length_mm=40, head_diameter_mm=17, head_length_mm=6.4)
BOLT = build_shape(ObjectTable(shape=_SHAPE))
HALF_M = float(BOLT.half_m[2])
SHANK_M, HEAD_M, HEAD_LENGTH_M = 5e-3, 8.5e-3, 6.4e-3
"""Radii of shank and head, as they touch the table: a hexagon is between 8 and 9.2 mm"""
AREA_M = 0.02
"""The bolt lies within so much of the middle"""
UP = np.array([0.0, 0.0, 1.0])
_GRIPPED_STD_M, _GRIPPED_STD_RAD = 2.5e-3, np.array([0.04, 0.1, 0.12])
"""Of the bolt in the grip, as it was found on the table: closing fingers turn it about the approach most"""
_TRACED = 24
"""Steps of predicting a touch"""


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


def contact_residuals(pose: Pose, contacts: list[Contact], std_m: float, std_rad: float) -> FloatArray:
    """Return how contacts (c,) deviate from a bolt's surface, in standard deviations (4 c,).

    Normals are compared 3 mm outside, where the gradient at an edge is any normal that a pad there may have.
    """
    position, rotation = pose
    points = (np.array([each.point_m for each in contacts]) - position) @ rotation
    normals = np.array([each.normal for each in contacts]) @ rotation
    distance = BOLT.distance(points)
    _, outward = BOLT.distance_and_normal(points - 3e-3 * normals)
    spread = np.hypot([each.std_m for each in contacts], std_m)
    turned = np.hypot([each.std_rad for each in contacts], std_rad)
    return np.concatenate([distance / spread, ((outward + normals) / turned[:, None]).ravel()])


class OnTable(NamedTuple):
    """A possible pose of a bolt on the table."""

    parameters: FloatArray
    """(3,) of `lying`"""
    weight: float
    """against the likeliest pose with the other end"""
    covariance: FloatArray
    """(3, 3) of the parameters"""

    @property
    def pose(self) -> Pose:
        """In the world."""
        return lying(*self.parameters)

    @property
    def direction_std_rad(self) -> float:
        """Standard deviation of its direction."""
        return float(np.sqrt(self.covariance[2, 2]))

    def spread(self) -> list[tuple[FloatArray, float]]:
        """Return points with weights that have its mean and covariance."""
        root = np.sqrt(3) * np.linalg.cholesky(self.covariance + 1e-12 * np.eye(3)).T
        return [(self.parameters + each, self.weight / 6) for each in (*root, *-root)]


def poses_on_table(contacts: list[Contact], spheres: FloatArray) -> list[OnTable]:
    """Return possible poses of a bolt on the table, outside of spheres (n, 4); the likeliest is the first.

    The second is the likeliest with the other end, if there is one.
    """
    middle = np.mean([each.point_m[:2] for each in contacts], axis=0)
    reach = np.arange(-0.024, 0.0241, 0.004)
    best: list[tuple[float, FloatArray]] = []
    for yaw in np.radians(np.arange(0, 360, 10)):
        along = np.array([np.cos(yaw), np.sin(yaw)])
        across = np.array([-along[1], along[0]])
        starts = [(middle + a * along + b * across, yaw) for a in reach for b in (-0.005, 0.0, 0.005)]
        costs = [np.square(_on_table(np.array([*at, yaw]), contacts, spheres)).sum() for at, yaw in starts]
        k = int(np.argmin(costs))
        best.append((float(costs[k]), np.array([*starts[k][0], yaw])))
    best.sort(key=lambda each: each[0])
    fits = [
        least_squares(_on_table, start, args=(contacts, spheres), x_scale=[1e-3, 1e-3, 0.1])
        for _, start in best[:8]
    ]
    fits.sort(key=lambda fit: fit.cost)
    turned = [fit for fit in fits if np.cos(fit.x[2] - fits[0].x[2]) < 0]
    ends = [fits[0], *turned[:1]]
    sure = weight_of(fits[0].cost, turned[0].cost if turned else np.inf)
    of = zip(ends, (sure, 1 - sure), strict=False)
    return [OnTable(fit.x, weight, _covariance(np.asarray(fit.jac))) for fit, weight in of]


def _covariance(jacobian: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(jacobian.T @ jacobian))


def touched_m(pose: Pose, spheres: FloatArray, lowest_m: float) -> FloatArray:
    """Return the point (3,) of a bolt that spheres (n, 4) touch first when lowered; if none, one below.

    The spheres are lowered by their least distance, again and again, as a ray is traced, at most to a height
    `lowest_m` above that of which they are given.
    """
    position, rotation = pose
    way_m = 0.05
    for _ in range(_TRACED):
        centres = spheres[:, :3] + [0.0, 0.0, way_m]
        apart = BOLT.distance((centres - position) @ rotation) - spheres[:, 3]
        k = int(np.argmin(apart))
        if apart[k] < 0.2e-3:
            _, outward = BOLT.distance_and_normal((centres[k : k + 1] - position) @ rotation)
            return np.asarray(centres[k] - spheres[k, 3] * (rotation @ outward[0]))
        way_m -= apart[k]
        if way_m < lowest_m:
            break
    return np.array([*spheres[:, :2].mean(axis=0), -0.01])


def _on_table(parameters: FloatArray, contacts: list[Contact], spheres: FloatArray) -> FloatArray:
    position, rotation = pose = lying(*parameters)
    apart_m = BOLT.distance((spheres[:, :3] - position) @ rotation) - spheres[:, 3]
    apart, beyond = (apart_m + 0.7e-3) / 1e-3, (np.abs(parameters[:2]) - AREA_M) / 5e-3
    touched = contact_residuals(pose, contacts, 0.7e-3, 0.2)
    return np.concatenate([touched, np.minimum(apart, 0.0), np.maximum(beyond, 0.0)])


def lying(x: float, y: float, yaw: float) -> Pose:
    """Return the pose of a bolt on the table, on its head's edge and its tip."""
    slope = (HEAD_M - 0.5e-3 - SHANK_M) / (2 * HALF_M - HEAD_LENGTH_M)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], UP])
    upright = np.array([[0.0, -slope, 1.0], [-np.hypot(1.0, slope), 0.0, 0.0], [0.0, -1.0, -slope]])
    place = np.array([x, y, SHANK_M + slope * HALF_M])
    return place, turn @ upright / np.hypot(1.0, slope)


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


def pose_in_grip(expected: Pose, contacts: list[Contact]) -> InGrip:
    """Return the bolt's pose by contacts, near the expected."""
    turned = expected[0], expected[1] @ np.diag([1.0, -1.0, -1.0])
    fits = [least_squares(_in_grip, np.zeros(6), args=(pose, contacts)) for pose in (expected, turned)]
    weight = weight_of(fits[0].cost, fits[1].cost)
    return InGrip(expected, fits[0].x, _covariance(np.asarray(fits[0].jac)), weight)


def _in_grip(change: FloatArray, expected: Pose, contacts: list[Contact]) -> FloatArray:
    pose = _shifted(change, expected)
    return np.concatenate([contact_residuals(pose, contacts, 0.4e-3, 0.2), change])


def _shifted(change: FloatArray, pose: Pose) -> Pose:
    """Return a pose after a change (6,), in standard deviations of what is expected."""
    turn = Rotation.from_rotvec(_GRIPPED_STD_RAD * change[3:]).as_matrix()
    return pose[0] + _GRIPPED_STD_M * change[:3], turn @ pose[1]


def weight_of(cost: float, other: float) -> float:
    """Return the weight of a hypothesis against another, by half of their squared residuals."""
    return float(1 / (1 + np.exp(np.clip(cost - other, -50, 50))))


def compose(first: Pose, second: Pose) -> Pose:
    """Return the pose of `second`, which is in the frame of `first`."""
    return first[0] + first[1] @ second[0], first[1] @ second[1]


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a pose."""
    return -pose[1].T @ pose[0], pose[1].T


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return a pose in a frame."""
    return compose(inverse(frame), pose)
