"""Difference of two contacts in the palm: joints that both depend on count once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from handtouch import wire
from handtouch.client.palm_difference import PalmDifferences
from handtouch.config import load, shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.robot_models import RobotModels
from tests.client.hand_messages import make_contact

DEPLOYMENT = load(shipped.path("utah_mit.toml"))
(HAND,) = DEPLOYMENT.hands
ROBOTS = RobotModels(DEPLOYMENT)
POSES = LinkPoses(ROBOTS.kinematics[0])
JOINTS = ROBOTS.joint_names[0]
LINKS = [pad.link for pad in HAND.pads]
OWN_STD_M = 1e-4
STD_RAD = np.radians(0.5)
BENT: dict[str, float] = dict.fromkeys(JOINTS, 0.4)
STD: dict[str, float] = dict.fromkeys(JOINTS, float(STD_RAD))


def in_palm(link: str, point_m: Any, positions: Any) -> Any:
    POSES.set_joint_positions(np.array(positions))
    pose = POSES.pose_in_palm(LINKS.index(link))
    return pose.rotation @ point_m + pose.translation_m


def contact(link: str, point_m: Any) -> wire.Contact:
    """Return a contact whose palm covariance is its own and that of the joints."""
    positions = list(BENT.values())
    std = np.full(len(positions), STD_RAD)
    point = in_palm(link, point_m, positions)
    covariance = POSES.joint_covariance_m2(LINKS.index(link), point_m, std) + OWN_STD_M**2 * np.eye(3)
    return replace(
        make_contact(link, "update", 1, hand=HAND.name),
        position_m=tuple(point_m),
        palm_status="valid",
        palm_position_m=tuple(point),
        palm_covariance_m2=cast("wire.Matrix3", tuple(covariance.ravel().tolist())),
    )


@pytest.mark.parametrize(
    ("one", "other"), [("index_distal", "index_middle"), ("index_distal", "thumb_distal")]
)
def test_a_differences_covariance_is_that_of_drawn_joint_errors(one: str, other: str) -> None:
    points = {one: np.array([0.004, 0.002, 0.008]), other: np.array([0.003, -0.002, 0.008])}
    first, second = (contact(link, point) for link, point in points.items())
    found = PalmDifferences(DEPLOYMENT, HAND.name).of(first, second, BENT, STD)
    random = np.random.default_rng(1)
    drawn = np.array(list(BENT.values())) + STD_RAD * random.standard_normal((4000, len(JOINTS)))
    ends = [np.array([in_palm(link, point, at) for at in drawn]) for link, point in points.items()]
    noise = OWN_STD_M * np.sqrt(2) * random.standard_normal((4000, 3))
    expected = np.cov((ends[0] - ends[1] + noise).T)
    expected_m = np.array(first.palm_position_m) - np.array(second.palm_position_m)
    assert found.vector_m == pytest.approx(expected_m)
    assert np.sqrt(np.trace(found.covariance_m2)) == pytest.approx(np.sqrt(np.trace(expected)), rel=0.05)
    np.testing.assert_allclose(found.covariance_m2, expected, atol=0.1 * np.trace(expected))


def test_contacts_of_one_finger_differ_by_less_than_their_covariances_say() -> None:
    point = np.array([0.004, 0.0, 0.008])
    tip, middle = contact("index_distal", point), contact("index_middle", point)
    found = PalmDifferences(DEPLOYMENT, HAND.name).of(tip, middle, BENT, STD)
    apart = np.reshape(tip.palm_covariance_m2 or (), (3, 3)) + np.reshape(
        middle.palm_covariance_m2 or (), (3, 3)
    )
    assert np.trace(found.covariance_m2) < 0.5 * np.trace(apart)
    assert np.linalg.eigvalsh(found.covariance_m2).min() > 0


def test_what_is_missing_is_named() -> None:
    differences = PalmDifferences(DEPLOYMENT, HAND.name)
    tip = contact("index_distal", np.array([0.004, 0.0, 0.008]))
    unknown = replace(tip, palm_status="stale", palm_position_m=None)
    with pytest.raises(ValueError, match="index_distal"):
        differences.of(tip, unknown, BENT)
    with pytest.raises(LookupError, match="other"):
        PalmDifferences(DEPLOYMENT, "other")
