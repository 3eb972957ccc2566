"""What the page is told: the deployment's geometry, contacts and health as they change, and only changes."""

from __future__ import annotations

import base64
import json
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config, shipped, wire
from handtouch.field.surface import Cone, Cylinder, Plane, Sphere, Surface
from handtouch.hand.kinematics import Kinematics
from handtouch.hand.urdf import Shape, read
from handtouch.view.page.layout import describe
from handtouch.view.page.meshes import body_mesh, outline_m, pad_mesh
from handtouch.view.page.picture import Board, Picture
from handtouch.view.page.serve import PageServer

DEPLOYMENT = config.load(shipped.path("utah_mit.toml"))
FILES = {hand.urdf: Path(hand.urdf).read_bytes() for hand in DEPLOYMENT.hands if hand.urdf}
LINKS = tuple(pad.link for pad in DEPLOYMENT.hands[0].pads)
DISTAL = LINKS.index("index_distal")


def frame(contacts: dict[int, int], run: int = 1, state: dict[int, int] | None = None) -> wire.HandFrame:
    """A hand frame; `contacts`: row -> id."""
    n = len(LINKS)
    values: dict[str, NDArray[Any]] = {
        name: np.full((n, elements), np.nan if kind == "<f4" else 0, dtype=kind)
        for name, (kind, elements) in wire.COLUMNS[wire.HandFrame].items()
    }
    for row, number in contacts.items():
        values["state"][row], values["contact"][row], values["force_n"][row] = 1, number, 1.25
        values["position_m"][row], values["normal"][row] = (0.01, 0.0, 0.009), (0.0, 0.0, 1.0)
        values["covariance_m2"][row] = np.diag([4e-10, 1e-10, 0.0]).ravel()
        values["pad_m"][row] = (0.004, 0.003)
    for row, number in (state or {}).items():
        values["state"][row] = number
    told = {name: column.tobytes() for name, column in values.items()}
    for name in ("group", "palm", "base", "joints_age_s", "unestimated"):
        told |= {key: b"" for key in told if key == name or key.startswith(f"{name}_")}
    return wire.HandFrame(1, run, 1, 10**9, 1, "right", LINKS, **told, repeat=False)


def health(state: str = "clear", run: int = 1, **changed: Any) -> wire.Health:
    values: dict[str, Any] = dict.fromkeys(wire.Health.__dataclass_fields__, 0)
    values |= {"v": 1, "run": run, "hand": "right", "link": "index_distal", "bus": "can0", "state": state}
    values |= {"node": "operational", "pace": "sync", "reason": "", "serial": None, "age_s": None}
    values |= {"emergencies": (), "repeat": False, "rate_hz": 200.0, "trust": "trusted", "calibration": ""}
    return wire.Health(**{**values, "calibrating": "", "findings": (), **changed})


def deployed(deployment: config.Deployment = DEPLOYMENT, run: int = 1) -> wire.Config:
    text = deployment.model_dump_json(by_alias=True)
    return wire.Config(1, run, 1, 0, text, dict(FILES), {}, False)


def said(picture: Picture) -> list[str]:
    lines = picture.board.since(0).get("messages", ())
    return [f"{', '.join(line['links'])}: {line['text']}" for line in lines]


# geometry ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "size_m", "volume"),
    [
        ("box", (0.2, 0.3, 0.4), 0.024),
        ("sphere", (0.1,), 4 / 3 * np.pi * 1e-3),
        ("cylinder", (0.1, 0.5), np.pi * 0.005),
        ("capsule", (0.1, 0.5), np.pi * 0.005 + 4 / 3 * np.pi * 1e-3),
    ],
)
def test_bodies_are_closed_and_face_outward(kind: str, size_m: tuple[float, ...], volume: float) -> None:
    mesh = body_mesh(Shape(kind, size_m, np.eye(3), np.array([1.0, 2.0, 3.0])), Path())
    assert mesh is not None
    a, b, c = mesh.corners_m.reshape(-1, 3, 3).transpose(1, 0, 2)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.02)  # Gauss
    flat = np.cross(b - a, c - a)
    turned = np.einsum("ij,ij->i", flat, mesh.normals.reshape(-1, 3, 3).mean(axis=1))
    assert (turned[np.linalg.norm(flat, axis=1) > 1e-9] > 0).all()


@pytest.mark.parametrize(
    "surface",
    [
        Plane(0.03, 0.02),
        Cylinder(0.012, 0.03, 2.0),
        Cone(0.012, 0.009, 0.03, 2.0),
        Sphere(0.011, -0.5, 0.9, 2.0),
    ],
)
def test_an_unrolled_pad_keeps_lengths_along_and_across(surface: Surface) -> None:
    mesh, outline = pad_mesh(surface, np.eye(3), np.zeros(3)), outline_m(surface)
    a, b, c = mesh.corners_m.reshape(-1, 3, 3).transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    x, y = outline.T
    unrolled = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    assert unrolled == pytest.approx(area, rel=0.12)  # the surface is drawn a little above itself
    assert np.ptp(x) == pytest.approx(float(surface.from_rectangle(surface.a, surface.b / 2)[0]))


def test_links_stand_where_the_kinematics_put_them() -> None:
    scene = describe(DEPLOYMENT, FILES)
    robot = read(shipped.path("utah_mit.urdf"))
    kinematics = Kinematics(robot, LINKS, "palm", robot.root)
    kinematics.move(np.zeros(len(kinematics.joints)))
    for number, pad in enumerate(scene["pads"]):
        rotation, at, node = np.eye(3), np.zeros(3), pad["node"]
        while node >= 0:
            told = scene["nodes"][node]
            turn = np.reshape(told["turn"], (3, 3))
            rotation, at, node = turn @ rotation, turn @ at + told["at"], told["parent"]
        pose = kinematics.in_base(number)
        assert np.allclose(rotation, pose.rotation)
        assert np.allclose(at, pose.translation_m)
    moved = {node["joint"].split("/")[1] for node in scene["nodes"] if "joint" in node}
    assert moved == set(kinematics.joints)


def test_without_a_urdf_pads_stand_side_by_side_and_face_the_viewer() -> None:
    scene = describe(DEPLOYMENT, {})
    assert not scene["bodies"]
    boxes = []
    for pad in scene["pads"]:
        corners = np.frombuffer(base64.b64decode(pad["corners"]), "<f4").reshape(-1, 3)
        normals = np.frombuffer(base64.b64decode(pad["normals"]), "<f4").reshape(-1, 3)
        node = scene["nodes"][pad["node"]]
        turn = np.reshape(node["turn"], (3, 3))
        assert (normals @ turn.T).mean(axis=0) @ [0.0, -1.0, 0.0] > 0.7
        seen = (corners @ turn.T + node["at"])[:, [0, 2]]
        boxes.append((seen.min(axis=0), seen.max(axis=0)))
    for k, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:k]:
            assert (low > other_high).any() or (high < other_low).any()
    assert sorted(k for column in scene["columns"] for k in column) == list(range(15))


# what is told -----------------------------------------------------------------------------------------------


def test_only_changes_are_told() -> None:
    board = Board()
    board.put("a", 1)
    board.put("b", 2)
    seen = board.changes
    board.put("a", 1)
    assert board.since(seen) == {}
    board.put("b", 3)
    assert board.since(seen) == {"b": 3}
    assert board.since(0) == {"a": 1, "b": 3}


def test_a_contact_is_told_with_its_ellipse_and_then_that_it_ended() -> None:
    picture = Picture()
    picture.take(frame({DISTAL: 7}))
    picture.step(True)
    contact = picture.board.since(0)["contact/right/index_distal"]
    assert (contact["id"], contact["force_n"], contact["pad_m"]) == (7, 1.25, [0.004, 0.003])
    lengths = [np.linalg.norm(axis) for axis in contact["axes"]]
    assert lengths == pytest.approx([2.4477 * 2e-5, 2.4477 * 1e-5], rel=1e-2)
    assert abs(contact["axes"][0][0]) == pytest.approx(lengths[0])  # along the greater variance
    picture.take(frame({}))
    picture.step(True)
    assert picture.board.since(0)["contact/right/index_distal"] is None
    seen = picture.board.changes
    picture.take(frame({}))
    picture.step(True)
    assert picture.board.since(seen) == {}


def test_a_touch_between_two_updates_is_seen_once() -> None:
    picture = Picture()
    picture.take(frame({}))
    picture.step(True)
    for contacts in ({}, {DISTAL: 3}, {}):
        picture.take(frame(contacts))
    picture.step(True)
    assert picture.board.since(0)["contact/right/index_distal"]["id"] == 3
    picture.take(frame({}))
    picture.step(True)
    assert picture.board.since(0)["contact/right/index_distal"] is None


def test_health_colours_the_pad_and_is_told_in_words() -> None:
    picture = Picture()
    picture.take(frame({}, state={DISTAL: 5}))
    picture.take(health("starting"))
    picture.step(True)
    assert said(picture) == []  # a start is nothing to tell
    gum = {"kind": "gum", "cause": "chewing gum", "evidence": "pressed for 60 s", "remedy": "clean it"}
    picture.take(health(findings=(gum,)))
    picture.take(frame({}))
    picture.step(True)
    assert picture.board.since(0)["pad/right/index_distal"]["look"] == "doubted"
    assert said(picture) == ["index_distal: chewing gum (pressed for 60 s): clean it"]
    picture.take(health("lost", reason="no heartbeat: look at its plug"))
    picture.take(frame({}, state={DISTAL: int(wire.PadState.LOST)}))
    picture.step(True)
    assert picture.board.since(0)["pad/right/index_distal"]["look"] == "lost"
    picture.take(health("lost", reason="no heartbeat: look at its plug"))  # once is enough
    picture.take(health())
    assert said(picture)[1:] == [
        "index_distal: lost: no heartbeat: look at its plug",
        "index_distal: well again",
    ]


def test_what_befalls_many_pads_at_once_is_one_line() -> None:
    picture = Picture()
    for link in LINKS[:3]:
        picture.take(health("lost", link=link, reason="unplugged"))
    assert said(picture) == [f"{', '.join(LINKS[:3])}: lost: unplugged"]
    picture.take(health("lost", link=LINKS[3], reason="unplugged", t_ns=2 * 10**9))
    assert said(picture)[1:] == [f"{LINKS[3]}: lost: unplugged"]


def test_a_daemon_that_is_silent_or_another_takes_its_contacts_along() -> None:
    picture = Picture()
    for message in (deployed(), frame({DISTAL: 7})):
        picture.take(message)
    picture.step(True)
    picture.step(False)
    assert picture.board.since(0)["contact/right/index_distal"] is None
    seen = picture.board.changes
    for message in (deployed(run=2), frame({}, run=2)):
        picture.take(message)
    picture.step(True)
    assert ": the daemon was started anew" in said(picture)
    assert "scene" not in picture.board.since(seen)  # the same hand needn't be built again
    hand = DEPLOYMENT.hands[0]
    fewer = DEPLOYMENT.model_copy(update={"hands": (hand.model_copy(update={"pads": hand.pads[:4]}),)})
    picture.take(deployed(fewer, run=2))
    assert len(picture.board.since(seen)["scene"]["pads"]) == 4


def percept(kind: str, label: str, **changed: Any) -> wire.Percept:
    values: dict[str, Any] = {"v": 1, "run": 1, "seq": 1, "t_ns": 10**9, "hand": "right", "kind": kind}
    values |= {"link": "index_distal", "contact": 7, "state": "estimated", "label": label, "confidence": 0.93}
    values |= {"probabilities": {}, "values": {}, "evidence": {}, "reason": "", "repeat": False}
    return wire.Percept(**{**values, **changed})


def test_what_is_felt_is_told_in_words_beside_its_pad_as_long_as_the_contact_lasts() -> None:
    picture = Picture()
    picture.take(frame({DISTAL: 7}))
    picture.take(percept("motion", "sliding", values={"slipped_m": 4e-4}))
    picture.take(percept("hardness", "medium", values={"stiffness_n_per_m": 2100.0}))
    picture.take(percept("texture", "", state="unestimated", reason="it has to slide"))
    picture.take(percept("shape", "sphere", link="", contact=0, values={"radius_m": 0.012}))
    question = {"values": {"force_ratio": 1.5, "bits": 0.8}, "question": "hardness", "expires_ns": 2 * 10**9}
    picture.take(percept("ask", "squeeze", state="open", confidence=None, **question))
    picture.step(True)
    told = picture.board.since(0)
    assert told["felt/right/index_distal"] == {
        "short": ["sliding", "medium"],
        "lines": ["sliding 95%, slipped 0.4 mm", "medium 95%, stiffness 2.1 N/mm"],
        "asks": ["hardness? squeeze (force ratio 1.5)"],
        "missing": ["texture: it has to slide"],
    }
    assert told["felt/right/"]["lines"] == ["shape sphere 95%, radius 12 mm"]
    later = replace(frame({DISTAL: 7}), t_ns=2 * 10**9)
    picture.take(later)
    picture.step(True)
    assert picture.board.since(0)["felt/right/index_distal"]["asks"] == []  # expired
    picture.take(replace(frame({DISTAL: 8}), t_ns=2 * 10**9))
    picture.step(True)
    assert picture.board.since(0)["felt/right/index_distal"] is None  # another contact


def test_a_silent_daemon_takes_what_was_felt_along() -> None:
    picture = Picture()
    picture.take(frame({DISTAL: 7}))
    picture.take(percept("motion", "sliding"))
    picture.step(True)
    assert picture.board.since(0)["felt/right/index_distal"]
    picture.step(False)
    assert picture.board.since(0)["felt/right/index_distal"] is None


def test_a_urdf_that_cannot_be_read_is_told_and_pads_are_shown_all_the_same() -> None:
    picture = Picture()
    picture.take(wire.Config(1, 1, 1, 0, deployed().deployment, dict.fromkeys(FILES, b"<robot/>"), {}, False))
    assert len(picture.board.since(0)["scene"]["pads"]) == 15
    assert "has no link" in said(picture)[0]


# the server -------------------------------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[PageServer]:
    opened = PageServer(Board(), "127.0.0.1", 0)
    yield opened
    opened.close()


def changes(url: str) -> Iterator[dict[str, Any]]:
    with urllib.request.urlopen(f"{url}changes", timeout=30) as stream:
        for line in stream:
            if line.startswith(b"data: "):
                yield json.loads(line[6:])


def test_the_page_and_all_that_it_names_are_served_and_nothing_else(server: PageServer) -> None:
    with urllib.request.urlopen(server.url) as page:
        text = page.read().decode()
    assert "main.js" in text
    assert "//" not in text.replace("<!doctype html>", "")  # nothing from elsewhere
    for name in ("main.js", "hand.js", "style.css", "icon.svg"):
        assert urllib.request.urlopen(server.url + name).status == 200
    for name in ("picture.py", "../picture.py", "static/main.js", "nothing.js"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(server.url + name)


def test_a_page_from_elsewhere_that_was_led_here_gets_nothing(server: PageServer) -> None:
    request = urllib.request.Request(server.url, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="421"):
        urllib.request.urlopen(request)


def test_each_page_gets_what_is_there_and_then_the_changes(server: PageServer) -> None:
    server.board.put("a", 1)
    first = changes(server.url)
    assert next(first) == {"a": 1}
    with server.changed:
        server.board.put("b", 2)
    server.tell()
    assert next(first) == {"b": 2}
    late = changes(server.url)
    assert next(late) == {"a": 1, "b": 2}
    assert server.seen == 2
    first.close()  # type: ignore[attr-defined]
    late.close()  # type: ignore[attr-defined]


def test_a_page_that_does_not_read_holds_up_nobody(server: PageServer) -> None:
    with socket.create_connection(("127.0.0.1", int(server.url.split(":")[2].rstrip("/")))) as lazy:
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host = server.url.removeprefix("http://").rstrip("/")
        lazy.sendall(f"GET /changes HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        other = changes(server.url)
        for number in range(60):
            with server.changed:
                server.board.put("much", str(number) * 50_000)
            server.tell()
            while next(other)["much"] != str(number) * 50_000:
                pass
        other.close()  # type: ignore[attr-defined]


def test_a_taken_port_is_told_with_a_remedy(server: PageServer) -> None:
    port = server.url.split(":")[2].rstrip("/")
    command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", port]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"127.0.0.1:{port}" in done.stderr
    assert "--port 0" in done.stderr


def test_threads_of_pages_end_with_the_server() -> None:
    opened = PageServer(Board(), "127.0.0.1", 0)
    opened.board.put("a", 1)
    stream = changes(opened.url)
    next(stream)
    opened.close()
    assert list(stream) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "handtouch-page"]
