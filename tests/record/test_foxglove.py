"""What Foxglove is told: the hand as its URDF and joints have it, so that contacts sit on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config, shipped
from handtouch.hand.urdf import read
from handtouch.record.foxglove import FRAMES, HAND, SCENE, Foxglove
from handtouch.record.links import quaternion

DEPLOYMENT = config.load(shipped.path("utah_mit.toml"))
LINKS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
SECOND_NS = 1_000_000_000


def told(urdf: bytes | None = None) -> Foxglove:
    """As after the first messages of a daemon."""
    hand = DEPLOYMENT.hands[0]
    data = Path(hand.urdf or "").read_bytes() if urdf is None else urdf
    made = Foxglove()
    files = {hand.urdf: data} if data else {}
    made.take("config", {"deployment": DEPLOYMENT.model_dump_json(by_alias=True), "files": files}, 1)
    return made


def frames(made: list[Any]) -> dict[str, dict[str, Any]]:
    return {
        one["child_frame_id"]: one
        for message in made
        if message.topic == FRAMES
        for one in json.loads(message.data)["transforms"]
    }


def matrix(frame: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4)"""
    x, y, z, w = (frame["rotation"][key] for key in "xyzw")
    made = np.eye(4)
    made[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made[:3, 3] = [frame["translation"][key] for key in "xyz"]
    return made


def test_links_stand_where_the_kinematics_put_them() -> None:
    pytest.importorskip("pinocchio")
    from handtouch.hand.kinematics import Kinematics

    foxglove = told()
    at = frames(foxglove.take("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS))
    angles = {"index_mcp": 0.5, "index_pip": 0.3, "thumb_cmc": -0.2}
    joints = {"hand": "right", "names": [*angles, "ring_mcp"], "position_rad": [*angles.values(), None]}
    at |= frames(foxglove.take("joints/right", joints, 10 * SECOND_NS))
    robot = read(shipped.path("utah_mit.urdf"))
    kinematics = Kinematics(robot, LINKS, "palm", robot.root)
    kinematics.move(np.array([angles.get(name, 0.0) for name in kinematics.joints]))
    for number, link in enumerate(LINKS):
        pose, frame = np.eye(4), link
        while frame != robot.root:
            pose, frame = matrix(at[frame]) @ pose, at[frame]["parent_frame_id"]
        expected = kinematics.in_base(number)
        assert np.allclose(pose[:3, :3], expected.rotation)
        assert np.allclose(pose[:3, 3], expected.translation_m)


def test_the_hand_has_a_body_and_contacts_are_on_links_that_have_a_frame() -> None:
    foxglove = told()
    made = foxglove.take("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    at = frames(made)
    (body,) = [json.loads(message.data) for message in made if message.topic == HAND]
    assert {entity["frame_id"] for entity in body["entities"]} <= set(at)
    assert any(entity[kind] for entity in body["entities"] for kind in ("cubes", "cylinders"))
    contact = {"event": "begin", "id": 1, "hand": "right", "link": "index_distal", "frame": "index_distal"}
    contact |= {"position_m": [0.01, 0, 0.01], "normal": [0, 0, 1], "force_n": 1.0, "strength": "valid"}
    scene = foxglove.take("contact/right/index_distal", contact, 10 * SECOND_NS)
    (entity,) = next(json.loads(m.data) for m in scene if m.topic == SCENE)["entities"]
    assert entity["frame_id"] in at


@pytest.mark.parametrize("urdf", [b"", b"<robot/>"])
def test_without_a_urdf_links_stand_in_a_row(urdf: bytes) -> None:
    made = told(urdf).take("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    at = frames(made)
    assert list(at) == LINKS
    assert len({frame["translation"]["x"] for frame in at.values()}) == len(LINKS)
    assert not [message for message in made if message.topic == HAND]


def test_links_of_two_hands_have_frames_of_their_own() -> None:
    made = told(b"").take("service", {"hands": {"right": LINKS, "left": LINKS}}, 10 * SECOND_NS)
    assert {name.split("/")[0] for name in frames(made)} == {"right", "left"}
    assert len(frames(made)) == 2 * len(LINKS)


def test_a_quaternion_turns_as_its_matrix() -> None:
    random = np.random.default_rng(1)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(50)]
    half = [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)]
    for turn in [*(one * np.linalg.det(one) for one in turns), *half]:
        frame = {"rotation": dict(zip("xyzw", quaternion(turn), strict=True))}
        frame["translation"] = dict.fromkeys("xyz", 0.0)
        assert np.allclose(matrix(frame)[:3, :3], turn)
