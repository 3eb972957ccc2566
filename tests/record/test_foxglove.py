"""Foxglove scenes: frames and bodies of the hand from URDF and joint states, and contacts on them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import shipped
from handtouch.hand.urdf import read_urdf
from handtouch.record.foxglove import (
    FRAMES_TOPIC,
    HAND_TOPIC,
    SCENE_TOPIC,
    FoxgloveConverter,
)
from handtouch.record.link_frames import quaternion

DEPLOYMENT = config.load(shipped.path("utah_mit.toml"))
LINKS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
SECOND_NS = 1_000_000_000


def configured(urdf: bytes | None = None) -> FoxgloveConverter:
    """Return a converter after the daemon's configuration."""
    hand = DEPLOYMENT.hands[0]
    data = Path(hand.urdf or "").read_bytes() if urdf is None else urdf
    made = FoxgloveConverter()
    files = {hand.urdf: data} if data else {}
    made.convert("config", {"deployment": DEPLOYMENT.model_dump_json(by_alias=True), "files": files}, 1)
    return made


def frames(made: list[Any]) -> dict[str, dict[str, Any]]:
    return {
        one["child_frame_id"]: one
        for message in made
        if message.topic == FRAMES_TOPIC
        for one in json.loads(message.data)["transforms"]
    }


def matrix(frame: dict[str, Any]) -> NDArray[np.float64]:
    """Return the homogeneous matrix (4, 4) of a frame."""
    x, y, z, w = (frame["rotation"][key] for key in "xyzw")
    made = np.eye(4)
    made[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made[:3, 3] = [frame["translation"][key] for key in "xyz"]
    return made


def test_frames_of_links_equal_the_kinematics() -> None:
    pytest.importorskip("pinocchio")
    from handtouch.hand.kinematics import HandKinematics

    foxglove = configured()
    at = frames(foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS))
    angles = {"index_mcp": 0.5, "index_pip": 0.3, "thumb_cmc": -0.2}
    joints = {"hand": "right", "names": [*angles, "ring_mcp"], "position_rad": [*angles.values(), None]}
    at |= frames(foxglove.convert("joints/right", joints, 10 * SECOND_NS))
    robot = read_urdf(shipped.path("utah_mit.urdf"))
    kinematics = HandKinematics(robot, LINKS, "palm", robot.root)
    kinematics.set_joint_positions(np.array([angles.get(name, 0.0) for name in kinematics.joints]))
    for number, link in enumerate(LINKS):
        pose, frame = np.eye(4), link
        while frame != robot.root:
            pose, frame = matrix(at[frame]) @ pose, at[frame]["parent_frame_id"]
        expected = kinematics.pose_in_base(number)
        assert np.allclose(pose[:3, :3], expected.rotation)
        assert np.allclose(pose[:3, 3], expected.translation_m)


def test_bodies_and_contacts_are_in_frames_of_links() -> None:
    foxglove = configured()
    made = foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    at = frames(made)
    (body,) = [json.loads(message.data) for message in made if message.topic == HAND_TOPIC]
    assert {entity["frame_id"] for entity in body["entities"]} <= set(at)
    assert any(entity[kind] for entity in body["entities"] for kind in ("cubes", "cylinders"))
    contact = {"event": "begin", "id": 1, "hand": "right", "link": "index_distal", "frame": "index_distal"}
    contact |= {"position_m": [0.01, 0, 0.01], "normal": [0, 0, 1], "force_n": 1.0, "force_status": "valid"}
    scene = foxglove.convert("contact/right/index_distal", contact, 10 * SECOND_NS)
    (entity,) = next(json.loads(m.data) for m in scene if m.topic == SCENE_TOPIC)["entities"]
    assert entity["frame_id"] in at


@pytest.mark.parametrize("urdf", [b"", b"<robot/>"])
def test_without_a_urdf_links_are_in_a_row(urdf: bytes) -> None:
    made = configured(urdf).convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    at = frames(made)
    assert list(at) == LINKS
    assert len({frame["translation"]["x"] for frame in at.values()}) == len(LINKS)
    assert not [message for message in made if message.topic == HAND_TOPIC]


def test_links_of_two_hands_have_distinct_frames() -> None:
    made = configured(b"").convert("service", {"hands": {"right": LINKS, "left": LINKS}}, 10 * SECOND_NS)
    assert {name.split("/")[0] for name in frames(made)} == {"right", "left"}
    assert len(frames(made)) == 2 * len(LINKS)


def test_a_quaternion_equals_its_matrix() -> None:
    random = np.random.default_rng(1)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(50)]
    half = [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)]
    for turn in [*(one * np.linalg.det(one) for one in turns), *half]:
        frame = {"rotation": dict(zip("xyzw", quaternion(turn), strict=True))}
        frame["translation"] = dict.fromkeys("xyz", 0.0)
        assert np.allclose(matrix(frame)[:3, :3], turn)
