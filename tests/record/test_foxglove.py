"""Foxglove scenes: frames and bodies of the hand from URDF and joint states, and contacts on them."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as open_websocket
from websockets.typing import Subprotocol

from handtouch import config
from handtouch.client import connect
from handtouch.config import shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.kinematics import HandKinematics
from handtouch.hand.urdf import read_urdf
from handtouch.record.foxglove import (
    FRAMES_TOPIC,
    HAND_TOPIC,
    LOG_TOPIC,
    SCENE_TOPIC,
    FoxgloveConverter,
    quaternion,
)
from handtouch.record.schemas import SceneMessage
from handtouch.view import foxglove as live
from handtouch.wire import to_map
from tests.client.hand_messages import make_contact

from .conftest import WALL_NS, RecordingSession
from .foxglove_messages import decode

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


def fields(message: SceneMessage) -> dict[str, Any]:
    """Return the fields of a message."""
    return decode(message.format.schema_name, message.format.schema, message.data)


def frames(made: list[SceneMessage]) -> dict[str, dict[str, Any]]:
    return {
        one["child_frame_id"]: one
        for message in made
        if message.topic == FRAMES_TOPIC
        for one in fields(message)["transforms"]
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
    foxglove = configured()
    at = frames(foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS))
    angles = {"index_mcp": 0.5, "index_pip": 0.3, "thumb_cmc": -0.2}
    joints = {"hand": "right", "names": [*angles, "ring_mcp"], "position_rad": [*angles.values(), None]}
    at |= frames(foxglove.convert("joints/right", joints, 10 * SECOND_NS))
    robot = read_urdf(shipped.path("utah_mit.urdf"))
    kinematics = HandKinematics(robot, LINKS, "palm", robot.root)
    poses = LinkPoses(kinematics)
    poses.set_joint_positions(np.array([angles.get(name, 0.0) for name in kinematics.joints]))
    for number, link in enumerate(LINKS):
        pose, frame = np.eye(4), link
        while frame != robot.root:
            pose, frame = matrix(at[frame]) @ pose, at[frame]["parent_frame_id"]
        expected = poses.pose_in_base(number)
        assert np.allclose(pose[:3, :3], expected.rotation)
        assert np.allclose(pose[:3, 3], expected.translation_m)


def test_bodies_and_contacts_are_in_frames_of_links() -> None:
    foxglove = configured()
    made = foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    at = frames(made)
    (body,) = [fields(message) for message in made if message.topic == HAND_TOPIC]
    assert {entity["frame_id"] for entity in body["entities"]} <= set(at)
    assert any(entity[kind] for entity in body["entities"] for kind in ("cubes", "cylinders"))
    contact = {"event": "begin", "id": 1, "hand": "right", "link": "index_distal", "frame": "index_distal"}
    contact |= {"position_m": [0.01, 0, 0.01], "normal": [0, 0, 1], "force_n": 1.0, "force_status": "valid"}
    scene = foxglove.convert("contact/right/index_distal", contact, 10 * SECOND_NS)
    (entity,) = next(fields(m) for m in scene if m.topic == SCENE_TOPIC)["entities"]
    assert entity["frame_id"] in at


def test_two_contacts_of_a_pad_are_two_more_points_with_their_forces() -> None:
    contact = {"event": "update", "id": 1, "hand": "right", "link": "index_distal", "frame": "index_distal"}
    contact |= {"position_m": [0.01, 0, 0.01], "normal": [0, 0, 1], "force_n": 1.0, "force_status": "valid"}
    parts = [
        {"position_m": [x, 0, 0.01], "force_n": force_n} for x, force_n in ((0.005, 0.75), (0.015, None))
    ]
    foxglove = configured()
    foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    scene = foxglove.convert("contact/right/index_distal", contact | {"parts": parts}, 10 * SECOND_NS)
    (entity,) = next(fields(m) for m in scene if m.topic == SCENE_TOPIC)["entities"]
    drawn = [sphere["pose"]["position"]["x"] for sphere in entity["spheres"]]
    assert drawn == pytest.approx([0.005, 0.015, 0.01])
    assert [text["text"] for text in entity["texts"]] == ["0.75 N", "index_distal 1.00 N"]


def test_hypotheses_about_an_object_are_drawn_in_the_palm_and_a_determined_pose_is_published() -> None:
    covariance = np.diag([4e-6, 1e-6, 1e-6, 1e-2, 1e-2, 1e-2])
    pose: dict[str, Any] = {"palm_position_m": [0.07, 0.0, 0.03], "palm_quaternion": [0.0, 0.0, 0.0, 1.0]}
    pose |= {"weight": 0.8, "palm_covariance": covariance.ravel().tolist()}
    percept = {
        "kind": "object",
        "hand": "right",
        "state": "estimated",
        "poses": [pose, pose | {"weight": 0.2}],
    }
    foxglove = configured()
    made = foxglove.convert("percept/right/object", percept, 10 * SECOND_NS)
    placed = next(fields(message) for message in made if message.topic == "/handtouch/object/right")
    assert (placed["frame_id"], placed["pose"]["position"]["x"]) == ("palm", pytest.approx(0.07))
    (entity,) = next(fields(message) for message in made if message.topic == SCENE_TOPIC)["entities"]
    longest_m = max(max(sphere["size"][key] for key in "xyz") for sphere in entity["spheres"])
    assert longest_m == pytest.approx(2 * 2e-3 * 7.815**0.5)
    assert len(entity["spheres"]) == len(entity["arrows"]) == 2
    open_made = foxglove.convert("percept/right/object", percept | {"state": "undetermined"}, 11 * SECOND_NS)
    assert [message.topic for message in open_made] == [SCENE_TOPIC]


@pytest.mark.parametrize("reason", ["stale", "lost", "faulted", "stopped"])
def test_a_contact_of_a_pad_that_is_not_sampled_stays_without_a_force_until_it_is(reason: str) -> None:
    foxglove = configured()
    foxglove.convert("service", {"hands": {"right": LINKS}}, 10 * SECOND_NS)
    contact = to_map(replace(make_contact("index_tip", "begin", 4), position_m=(0, 0, 0), normal=(0, 0, 1)))
    name = "right/index_tip"

    def scene(topic: str, payload: dict[str, Any], at_s: int) -> dict[str, Any]:
        made = foxglove.convert(topic, payload, at_s * SECOND_NS)
        (shown,) = [fields(message) for message in made if message.topic == SCENE_TOPIC]
        return shown

    (touched,) = scene(f"contact/{name}", contact, 11)["entities"]
    assert len(touched["arrows"]) == len(touched["spheres"]) == 1
    (unknown,) = scene(f"contact/{name}", contact | {"event": "end", "end_reason": reason}, 12)["entities"]
    assert (unknown["arrows"], unknown["texts"], len(unknown["spheres"])) == ([], [], 1)
    sampled = scene(f"health/{name}", {"state": "clear", "reason": ""}, 13)
    assert sampled["entities"] == []
    assert [deletion["id"] for deletion in sampled["deletions"]] == [name]


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


class FoxgloveClient:
    """A client of Foxglove's WebSocket that subscribes to every channel."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._channels: dict[int, dict[str, Any]] = {}

    def messages(self, timeout_s: float) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """Yield topic, time [ns] and fields of the messages until there is none for `timeout_s`."""
        while True:
            try:
                received = self._socket.recv(timeout=timeout_s)
            except TimeoutError:
                return
            if isinstance(received, str):
                self._subscribe(json.loads(received))
            elif received[0] == 1:
                number, t_ns = struct.unpack_from("<IQ", received, 1)
                channel, data = self._channels[number], received[13:]
                if channel["encoding"] == "json":
                    yield channel["topic"], t_ns, json.loads(data)
                    continue
                schema = base64.b64decode(channel["schema"] + "===")
                yield channel["topic"], t_ns, decode(channel["schemaName"], schema, data)

    def _subscribe(self, message: dict[str, Any]) -> None:
        channels = message.get("channels", []) if message["op"] == "advertise" else []
        self._channels |= {channel["id"]: channel for channel in channels}
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def test_a_client_of_foxglove_receives_scene_frames_log_and_values(
    make_hand: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint, stop = f"ipc://{tmp_path}/live", threading.Event()
    session = RecordingSession(make_hand, tmp_path)
    needed = {SCENE_TOPIC, FRAMES_TOPIC, LOG_TOPIC, "contact/h/plane", "service"}
    received: dict[str, dict[str, Any]] = {}
    with ExitStack() as opened:
        publisher = opened.enter_context(opened.enter_context(zmq.Context()).socket(zmq.XPUB))
        publisher.bind(endpoint)
        messages = opened.enter_context(connect(*live.PATTERNS, endpoint=endpoint, key=""))
        for _ in live.PATTERNS:
            publisher.recv()  # is subscribed
        server = opened.enter_context(live.FoxgloveServer("127.0.0.1", 0))
        thread = threading.Thread(target=live.serve, args=(messages, server, stop, float("inf")))
        thread.start()
        opened.callback(thread.join)
        opened.callback(stop.set)
        protocol = Subprotocol("foxglove.sdk.v1")
        client = FoxgloveClient(opened.enter_context(open_websocket(server.url, subprotocols=[protocol])))
        session.send = publisher.send_multipart
        while not needed <= received.keys():  # a channel appears with its first message, which is lost
            session.start()
            session.hand.stroke(40)
            for topic, t_ns, message in client.messages(0.05):
                received[topic] = message
                assert t_ns > WALL_NS
    assert {one["child_frame_id"] for one in received[FRAMES_TOPIC]["transforms"]} == {"plane", "round"}
    assert received[LOG_TOPIC]["message"].startswith("contact ")
    assert received["contact/h/plane"]["link"] == "plane"
    assert all(entity["frame_id"] in ("plane", "round") for entity in received[SCENE_TOPIC]["entities"])


@pytest.mark.parametrize(
    ("origin", "is_allowed"),
    [
        (None, True),
        ("https://app.foxglove.dev", True),
        ("file://", True),
        ("http://localhost:8080", True),
        ("http://127.0.0.1:8080", True),
        ("http://[::1]:8080", True),
        ("http://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://app.foxglove.dev", False),
        ("http://localhost.evil.example", False),
        ("http://127.0.0.1.evil.example", False),
        ("null", False),
        ("", False),
        ("http://[", False),
    ],
)
def test_pages_of_other_websites_may_not_read_the_hand(origin: str | None, is_allowed: bool) -> None:
    with live.FoxgloveServer("127.0.0.1", 0) as server:
        host, port = server.url.removeprefix("ws://").split(":")
        lines = [
            *("GET / HTTP/1.1", f"Host: {host}:{port}", "Connection: Upgrade", "Upgrade: websocket"),
            *("Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="),
            *("Sec-WebSocket-Protocol: foxglove.sdk.v1", *([f"oRiGiN: {origin}"] * (origin is not None))),
        ]
        with socket.create_connection((host, int(port)), timeout=60) as client:
            client.sendall("\r\n".join([*lines, "", ""]).encode())
            status = client.makefile("rb").readline().split()[1]
    assert status == (b"101" if is_allowed else b"403")


def test_a_port_in_use_and_a_missing_package_are_reported_with_a_remedy(tmp_path: Path) -> None:
    def run(port: int, **environment: str) -> str:
        command = [sys.executable, "-m", "handtouch", "view", "--foxglove", "--key", "", "--port", str(port)]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60, env={**os.environ, **environment}
        )
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        return done.stderr

    with live.FoxgloveServer("127.0.0.1", 0) as server:
        port = int(server.url.split(":")[2])
        assert f"127.0.0.1:{port}" in (text := run(port))
        assert "--port 0" in text
    (tmp_path / "foxglove.py").write_text("raise ImportError('not here')")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    assert "[foxglove]" in run(0, PYTHONPATH=path)
