"""Differences of two contacts in the palm, with the errors of the joints that both depend on counted once.

Public names: `PalmDifferences`, `Difference`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from handtouch import wire
from handtouch.arrays import FloatArray
from handtouch.config import Deployment

_STEP = 1e-6  # rad, or m: error of a central difference below 1e-9 of the derivative on a hand


class Difference(NamedTuple):
    """Position of one contact less that of another, in the palm's frame."""

    vector_m: FloatArray
    """(3,)"""
    covariance_m2: FloatArray
    """(3, 3)"""


class PalmDifferences:
    """Differences of the contacts of one hand of a deployment with a URDF.

        differences = PalmDifferences(config.load("hand.toml"), "right")
        difference = differences.of(tip, middle, joints)

    A contact's `palm_covariance_m2` includes errors of the joints. Contacts on one finger share joints, so
    their errors are nearly the same, and the covariance of the difference is less than the sum by C + C^T,
    with C = sum over the joints of s^2 (d p1 / d q) (d p2 / d q)^T, where s is the joint's standard
    deviation. Mounts are each pad's own. Raises LookupError for a hand without URDF, OSError and UrdfError
    as `config.load`.
    """

    def __init__(self, deployment: Deployment, hand: str) -> None:
        from handtouch.core.stages.kinematics import LinkPoses
        from handtouch.hand.robot_models import RobotModels

        robots = RobotModels(deployment)
        if hand not in robots.hands:
            known = ", ".join(robots.hands) or "none"
            raise LookupError(f"hand {hand!r} has no URDF in the deployment; those with one: {known}")
        number = robots.hands.index(hand)
        self.joints = robots.joint_names[number]
        """names, as in joint states"""
        self._poses = LinkPoses(robots.kinematics[number])
        self._errors = robots.joint_errors[number]
        pads = next(table.pads for table in deployment.hands if table.name == hand)
        self._row_of_link = {pad.link: row for row, pad in enumerate(pads)}

    def of(
        self,
        first: wire.Contact,
        second: wire.Contact,
        position_rad: Mapping[str, float],
        std_rad: Mapping[str, float] | None = None,
    ) -> Difference:
        """Return the difference of two contacts at joint positions by name [rad, m if prismatic].

        std_rad: standard deviations that were sent with them, of the joints that have one; the others have
        the deployment's. Raises ValueError for a contact without a position in the palm, LookupError for a
        link or joint that is missing.
        """
        if None in (first.palm_position_m, second.palm_position_m):
            raise ValueError(
                f"palm_status of {first.link} and {second.link} is {first.palm_status} and "
                f"{second.palm_status}: both must be valid"
            )
        positions = np.array([position_rad[name] for name in self.joints])
        sent = np.array([(std_rad or {}).get(name, 0.0) for name in self.joints])
        std = self._errors.of(sent)
        one, other = (self._derivative(contact, positions) * std for contact in (first, second))
        common = one @ other.T
        apart = np.array(first.palm_covariance_m2) + np.array(second.palm_covariance_m2)
        vector_m = np.array(first.palm_position_m) - np.array(second.palm_position_m)
        return Difference(vector_m, apart.reshape(3, 3) - common - common.T)

    def _derivative(self, contact: wire.Contact, positions: FloatArray) -> FloatArray:
        """Return the derivative (3, joints) of a contact's position in the palm by the joint positions."""
        row, point = self._row_of_link[contact.link], np.asarray(contact.position_m)
        columns = []
        for joint in range(len(positions)):
            at = []
            for step in (_STEP, -_STEP):
                moved = positions.copy()
                moved[joint] += step
                self._poses.set_joint_positions(moved)
                pose = self._poses.pose_in_palm(row)
                at.append(pose.rotation @ point + pose.translation_m)
            columns.append((at[0] - at[1]) / (2 * _STEP))
        return np.array(columns).reshape(-1, 3).T
