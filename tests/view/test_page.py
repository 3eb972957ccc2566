"""The page in the browser: geometry of the deployment, contacts, health and percepts, and its HTTP server."""

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

from handtouch import config, wire
from handtouch.config import shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.field import (
    ConeSurface,
    CylinderSurface,
    PlaneSurface,
    SphereSurface,
    Surface,
)
from handtouch.field.triangulation import parse_stl
from handtouch.hand import mount_transform, pad_surface
from handtouch.hand.kinematics import HandKinematics
from handtouch.hand.urdf import BodyShape, read_urdf
from handtouch.view.page.model import PageModel, VersionedValues
from handtouch.view.page.scene_graph import body_mesh, outline_m, pad_mesh, scene_of
from handtouch.view.page.server import PageServer
from tests.view.test_terminal import SERVICE

DEPLOYMENT = config.load(shipped.path("utah_mit.toml"))
FILES = {hand.urdf: Path(hand.urdf).read_bytes() for hand in DEPLOYMENT.hands if hand.urdf}
LINKS = tuple(pad.link for pad in DEPLOYMENT.hands[0].pads)
DISTAL = LINKS.index("index_distal")


def frame(contacts: dict[int, int], run: int = 1, state: dict[int, int] | None = None) -> wire.HandFrame:
    """A hand frame; `contacts`: row -> id."""
    n = len(LINKS)
    values: dict[str, NDArray[Any]] = {
        name: np.full((n, column.elements), np.nan if column.dtype == "<f4" else 0, dtype=column.dtype)
        for name, column in wire.COLUMNS[wire.HandFrame].items()
    }
    for row, number in contacts.items():
        values["state"][row], values["contact_id"][row], values["force_n"][row] = 1, number, 1.25
        values["position_m"][row], values["normal"][row] = (0.01, 0.0, 0.009), (0.0, 0.0, 1.0)
        values["covariance_m2"][row] = np.diag([4e-10, 1e-10, 0.0]).ravel()
        values["pad_m"][row] = (0.004, 0.003)
        values["position_status"][row], values["force_status"][row] = 1, 1
    for row, number in (state or {}).items():
        values["state"][row] = number
    data = {name: column.tobytes() for name, column in values.items()}
    data |= {key: b"" for key in data if key.startswith(("group", "palm_", "base_", "joints_age_s"))}
    return wire.HandFrame(1, run, 1, 10**9, 1, "right", LINKS, **data, retained=False)


def health(state: str = "clear", run: int = 1, **changed: Any) -> wire.Health:
    values: dict[str, Any] = dict.fromkeys(wire.Health.__dataclass_fields__, 0)
    values |= {"v": 1, "session": run, "hand": "right", "link": "index_distal", "bus": "can0", "state": state}
    values |= {"node_state": "operational", "sampling": "sync", "reason": "", "serial": None, "age_s": None}
    values |= {
        "emergencies": (),
        "retained": False,
        "rate_hz": 200.0,
        "calibration_state": "calibrated",
        "calibration_id": "",
    }
    return wire.Health(**{**values, "calibration_progress": "", "diagnoses": (), **changed})


def deployed(deployment: config.Deployment = DEPLOYMENT, run: int = 1) -> wire.Config:
    text = deployment.model_dump_json(by_alias=True)
    return wire.Config(1, run, 1, 0, text, dict(FILES), {}, False)


def message_lines(model: PageModel) -> list[str]:
    lines = model.values.changes_since(0).get("messages", ())
    return [f"{', '.join(line['links'])}: {line['text']}" for line in lines]


def test_a_pad_of_an_stl_file_is_drawn_where_its_triangles_are() -> None:
    """Also on a machine without the file: the deployment holds it."""
    deployment = config.load(shipped.path("fingertip.toml"))
    pad = deployment.pads[0].pad
    drawn = pad_mesh(pad_surface(pad), *mount_transform(pad)).corners_m
    vertices = 1e-3 * parse_stl(shipped.path("fingertip.stl").read_bytes()).points
    away_m = np.linalg.norm(vertices[:, None] - drawn, axis=2)
    assert away_m.min(axis=0).max() < 1.2e-3  # every corner is near a vertex; these are 1 to 2 mm apart
    assert away_m.min(axis=1).max() < 1.8e-3
    assert len(scene_of(deployment, {})["pads"]) == 1


def test_a_daemon_that_is_late_is_shown_with_the_rate_that_it_should_have() -> None:
    for rate_hz, overruns, text in ((200.0, 500, "200"), (17.0, 500, "17 of 200"), (74.0, 0, "74")):
        model = PageModel()
        model.add_message(replace(SERVICE, rate_hz=rate_hz, overruns=overruns))
        assert model.values.changes_since(0)["service"]["tick_rate"] == text


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
def test_body_meshes_are_closed_with_outward_normals(
    kind: str, size_m: tuple[float, ...], volume: float
) -> None:
    mesh = body_mesh(BodyShape(kind, size_m, np.eye(3), np.array([1.0, 2.0, 3.0])), Path())
    assert mesh is not None
    a, b, c = mesh.corners_m.reshape(-1, 3, 3).transpose(1, 0, 2)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.02)  # Gauss
    flat = np.cross(b - a, c - a)
    turned = np.einsum("ij,ij->i", flat, mesh.normals.reshape(-1, 3, 3).mean(axis=1))
    assert (turned[np.linalg.norm(flat, axis=1) > 1e-9] > 0).all()


@pytest.mark.parametrize(
    "surface",
    [
        PlaneSurface(0.03, 0.02),
        CylinderSurface(0.012, 0.03, 2.0),
        ConeSurface(0.012, 0.009, 0.03, 2.0),
        SphereSurface(0.011, -0.5, 0.9, 2.0),
    ],
)
def test_an_unrolled_pad_preserves_length_and_area(surface: Surface) -> None:
    mesh, outline = pad_mesh(surface, np.eye(3), np.zeros(3)), outline_m(surface)
    a, b, c = mesh.corners_m.reshape(-1, 3, 3).transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    x, y = outline.T
    unrolled = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    assert unrolled == pytest.approx(area, rel=0.12)  # the surface is drawn a little above itself
    assert np.ptp(x) == pytest.approx(float(surface.from_rectangle(surface.a, surface.b / 2)[0]))


def test_an_l_shaped_pad_is_drawn_with_its_re_entrant_corner() -> None:
    (entry,) = config.load(shipped.path("l_palm.toml")).pads
    x, y = 1e3 * outline_m(pad_surface(entry.pad)).T
    assert abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2 == pytest.approx(52 * 18 + 24 * 22, rel=0.01)
    middle = np.array([(x.min() + x.max()) / 2 - 2, (y.min() + y.max()) / 2 - 2])  # of the vertex (24, 18)
    assert np.hypot(x - middle[0], y - middle[1]).min() < 1.0


def test_pads_of_several_hands_carry_the_hand_s_name() -> None:
    (hand,) = DEPLOYMENT.hands
    left = hand.model_copy(update={"name": "left"})
    both = scene_of(DEPLOYMENT.model_copy(update={"hands": (hand, left)}), {})
    assert {pad["name"] for pad in both["pads"]} == {
        f"{name}/{link}" for name in ("right", "left") for link in LINKS
    }
    assert {pad["name"] for pad in scene_of(DEPLOYMENT, {})["pads"]} == set(LINKS)


def test_link_poses_agree_with_the_kinematics() -> None:
    scene = scene_of(DEPLOYMENT, FILES)
    robot = read_urdf(shipped.path("utah_mit.urdf"))
    kinematics = HandKinematics(robot, LINKS, "palm", robot.root)
    poses = LinkPoses(kinematics)
    for number, pad in enumerate(scene["pads"]):
        rotation, at, node = np.eye(3), np.zeros(3), pad["node"]
        while node >= 0:
            graph_node = scene["nodes"][node]
            turn = np.reshape(graph_node["rotation"], (3, 3))
            rotation, at, node = turn @ rotation, turn @ at + graph_node["translation"], graph_node["parent"]
        pose = poses.pose_in_base(number)
        assert np.allclose(rotation, pose.rotation)
        assert np.allclose(at, pose.translation_m)
    moved = {node["joint"].split("/")[1] for node in scene["nodes"] if "joint" in node}
    assert moved == set(kinematics.joints)


def test_without_a_urdf_pads_are_side_by_side_and_face_the_viewer() -> None:
    scene = scene_of(DEPLOYMENT, {})
    assert not scene["bodies"]
    boxes = []
    for pad in scene["pads"]:
        corners = np.frombuffer(base64.b64decode(pad["corners"]), "<f4").reshape(-1, 3)
        normals = np.frombuffer(base64.b64decode(pad["normals"]), "<f4").reshape(-1, 3)
        node = scene["nodes"][pad["node"]]
        turn = np.reshape(node["rotation"], (3, 3))
        assert (normals @ turn.T).mean(axis=0) @ [0.0, -1.0, 0.0] > 0.7
        seen = (corners @ turn.T + node["translation"])[:, [0, 2]]
        boxes.append((seen.min(axis=0), seen.max(axis=0)))
    for k, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:k]:
            assert (low > other_high).any() or (high < other_low).any()
    assert sorted(k for column in scene["columns"] for k in column) == list(range(15))


# the model --------------------------------------------------------------------------------------------------


def test_only_changed_values_are_returned() -> None:
    values = VersionedValues()
    values.set_value("a", 1)
    values.set_value("b", 2)
    seen = values.version
    values.set_value("a", 1)
    assert values.changes_since(seen) == {}
    values.set_value("b", 3)
    assert values.changes_since(seen) == {"b": 3}
    assert values.changes_since(0) == {"a": 1, "b": 3}


def test_a_contact_has_its_ellipse_until_it_ends() -> None:
    model = PageModel()
    model.add_message(frame({DISTAL: 7}))
    model.update_values(True)
    contact = model.values.changes_since(0)["contact/right/index_distal"]
    assert (contact["id"], contact["force_n"], contact["pad_m"]) == (7, 1.25, [0.004, 0.003])
    lengths = [np.linalg.norm(axis) for axis in contact["axes_m"]]
    assert lengths == pytest.approx([2.4477 * 2e-5, 2.4477 * 1e-5], rel=1e-2)
    assert abs(contact["axes_m"][0][0]) == pytest.approx(lengths[0])  # along the greater variance
    model.add_message(frame({}))
    model.update_values(True)
    assert model.values.changes_since(0)["contact/right/index_distal"] is None
    seen = model.values.version
    model.add_message(frame({}))
    model.update_values(True)
    assert model.values.changes_since(seen) == {}


def test_a_contact_between_two_updates_is_shown_once() -> None:
    model = PageModel()
    model.add_message(frame({}))
    model.update_values(True)
    for contacts in ({}, {DISTAL: 3}, {}):
        model.add_message(frame(contacts))
    model.update_values(True)
    assert model.values.changes_since(0)["contact/right/index_distal"]["id"] == 3
    model.add_message(frame({}))
    model.update_values(True)
    assert model.values.changes_since(0)["contact/right/index_distal"] is None


def test_health_sets_the_status_of_a_pad_and_appends_messages() -> None:
    model = PageModel()
    model.add_message(frame({}, state={DISTAL: 5}))
    model.add_message(health("starting"))
    model.update_values(True)
    assert message_lines(model) == []  # no message for a node that starts
    gum = {"kind": "gum", "cause": "chewing gum", "evidence": "pressed for 60 s", "remedy": "clean it"}
    model.add_message(health(diagnoses=(gum,)))
    model.add_message(frame({}))
    model.update_values(True)
    assert model.values.changes_since(0)["pad/right/index_distal"]["status"] == "unreliable"
    assert message_lines(model) == ["index_distal: chewing gum (pressed for 60 s): clean it"]
    model.add_message(health("lost", reason="no heartbeat; check its plug"))
    model.add_message(frame({}, state={DISTAL: int(wire.PadState.LOST)}))
    model.update_values(True)
    assert model.values.changes_since(0)["pad/right/index_distal"]["status"] == "lost"
    model.add_message(health("lost", reason="no heartbeat; check its plug"))  # reported once
    model.add_message(health())
    assert message_lines(model)[1:] == [
        "index_distal: lost: no heartbeat; check its plug",
        "index_distal: recovered",
    ]


def test_errors_that_a_node_reports_are_shown_until_they_are_cleared() -> None:
    model, error = PageModel(), {"code": 0x5000, "text": "0x5000 device hardware", "cleared_ns": None}
    shown = []
    for cleared_ns in (None, 7):
        model.add_message(health(emergencies=({**error, "cleared_ns": cleared_ns},)))
        model.add_message(frame({}))
        model.update_values(True)
        shown.append(model.values.changes_since(0)["pad/right/index_distal"]["reason"])
    assert shown == ["EMCY 0x5000 device hardware", ""]


def test_the_same_fault_of_several_pads_is_one_message() -> None:
    model = PageModel()
    for link in LINKS[:3]:
        model.add_message(health("lost", link=link, reason="unplugged"))
    assert message_lines(model) == [f"{', '.join(LINKS[:3])}: lost: unplugged"]
    model.add_message(health("lost", link=LINKS[3], reason="unplugged", t_ns=2 * 10**9))
    assert message_lines(model)[1:] == [f"{LINKS[3]}: lost: unplugged"]


def test_an_event_that_repeats_is_one_message_with_its_number_of_times() -> None:
    model = PageModel()
    for second in range(50):
        for link in LINKS[:3]:
            late = f"no sample for {20 + second} ms"
            model.add_message(health("stale", link=link, reason=late, t_ns=second * 10**9))
        for link in LINKS[:3]:
            model.add_message(health(link=link, t_ns=second * 10**9 + 10**8))
    links = ", ".join(LINKS[:3])
    assert message_lines(model) == [f"{links}: stale: no sample for 69 ms", f"{links}: recovered"]
    assert [line["count"] for line in model.values.changes_since(0)["messages"]] == [50, 50]
    model.add_message(health("stale", link=LINKS[0], reason="no sample for 9 ms", t_ns=200 * 10**9))
    assert message_lines(model)[2:] == [f"{LINKS[0]}: stale: no sample for 9 ms"]  # after two minutes


def test_contacts_are_cleared_when_the_daemon_disconnects_or_restarts() -> None:
    model = PageModel()
    for message in (deployed(), frame({DISTAL: 7})):
        model.add_message(message)
    model.update_values(True)
    model.update_values(False)
    assert model.values.changes_since(0)["contact/right/index_distal"] is None
    seen = model.values.version
    for message in (deployed(run=2), frame({}, run=2)):
        model.add_message(message)
    model.update_values(True)
    assert ": daemon restarted" in message_lines(model)
    assert "scene" not in model.values.changes_since(seen)  # the same hand is not sent again
    hand = DEPLOYMENT.hands[0]
    fewer = DEPLOYMENT.model_copy(update={"hands": (hand.model_copy(update={"pads": hand.pads[:4]}),)})
    model.add_message(deployed(fewer, run=2))
    assert len(model.values.changes_since(seen)["scene"]["pads"]) == 4


def percept(kind: str, label: str, **changed: Any) -> wire.Percept:
    values: dict[str, Any] = {"v": 1, "session": 1, "seq": 1, "t_ns": 10**9, "hand": "right", "kind": kind}
    values |= {
        "link": "index_distal",
        "contact_id": 7,
        "state": "estimated",
        "label": label,
        "confidence": 0.93,
    }
    values |= {"probabilities": {}, "values": {}, "evidence": {}, "reason": "", "retained": False}
    return wire.Percept(**{**values, **changed})


def test_percepts_are_shown_at_their_pad_while_the_contact_lasts() -> None:
    model = PageModel()
    model.add_message(frame({DISTAL: 7}))
    model.add_message(percept("motion", "sliding", values={"slip_distance_m": 4e-4}))
    model.add_message(percept("friction", "incipient", values={"ratio": 0.6}))
    model.add_message(percept("shape", "", state="undetermined", reason="2 of 3 contacts"))
    model.add_message(percept("shape", "sphere", link="", contact_id=0, values={"radius_m": 0.012}))
    question = {
        "values": {"force_ratio": 1.5, "expected_information_bits": 0.8},
        "question": "radius",
        "expires_ns": 2 * 10**9,
    }
    model.add_message(percept("action_request", "squeeze", state="open", confidence=None, **question))
    model.update_values(True)
    values = model.values.changes_since(0)
    assert values["percepts/right/index_distal"] == {
        "labels": ["sliding", "incipient"],
        "lines": ["sliding 95%, slip distance 0.4 mm", "friction incipient 95%, ratio 0.6"],
        "requests": ["radius? squeeze (force ratio 1.5)"],
        "missing": ["shape: 2 of 3 contacts"],
    }
    assert values["percepts/right/"]["lines"] == ["shape sphere 95%, radius 12 mm"]
    later = replace(frame({DISTAL: 7}), t_ns=2 * 10**9)
    model.add_message(later)
    model.update_values(True)
    assert model.values.changes_since(0)["percepts/right/index_distal"]["requests"] == []  # expired
    model.add_message(replace(frame({DISTAL: 8}), t_ns=2 * 10**9))
    model.update_values(True)
    assert model.values.changes_since(0)["percepts/right/index_distal"] is None  # another contact


def test_hypotheses_about_an_object_are_drawn_by_weight_ellipsoid_and_axis() -> None:
    covariance = np.diag([4e-6, 1e-6, 1e-6, 1e-2, 1e-2, 1e-2]).ravel().tolist()
    pose = wire.ObjectPose(
        weight=0.9,
        palm_position_m=[0.07, 0.0, 0.03],
        palm_quaternion=[0.0, 0.0, 0.0, 1.0],
        palm_covariance=covariance,
    )
    model = PageModel()
    model.add_message(frame({DISTAL: 7}))
    model.add_message(percept("object", "bolt", link="", contact_id=0, poses=(pose,)))
    model.update_values(True)
    (drawn,) = model.values.changes_since(0)["percepts/right/"]["poses"]
    assert (drawn["weight"], drawn["position_m"], drawn["z"]) == (0.9, [0.07, 0.0, 0.03], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        np.abs(drawn["axes_m"]).max(axis=0), np.sqrt(7.815) * np.array([2e-3, 1e-3, 1e-3])
    )


def test_percepts_are_cleared_when_the_daemon_disconnects() -> None:
    model = PageModel()
    model.add_message(frame({DISTAL: 7}))
    model.add_message(percept("motion", "sliding"))
    model.update_values(True)
    assert model.values.changes_since(0)["percepts/right/index_distal"]
    model.update_values(False)
    assert model.values.changes_since(0)["percepts/right/index_distal"] is None


def test_an_unreadable_urdf_is_reported_and_pads_are_still_shown() -> None:
    model = PageModel()
    model.add_message(
        wire.Config(1, 1, 1, 0, deployed().deployment, dict.fromkeys(FILES, b"<robot/>"), {}, False)
    )
    assert len(model.values.changes_since(0)["scene"]["pads"]) == 15
    assert "has no link" in message_lines(model)[0]


# the server -------------------------------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[PageServer]:
    opened = PageServer(VersionedValues(), "127.0.0.1", 0).start()
    yield opened
    opened.close()


def changes(url: str) -> Iterator[dict[str, Any]]:
    with urllib.request.urlopen(f"{url}changes", timeout=30) as stream:
        for line in stream:
            if line.startswith(b"data: "):
                yield json.loads(line[6:])


def test_only_the_files_of_the_page_are_served(server: PageServer) -> None:
    with urllib.request.urlopen(server.url) as page:
        text = page.read().decode()
    assert "main.js" in text
    assert "//" not in text.replace("<!doctype html>", "")  # nothing from other hosts
    for name in ("main.js", "hand.js", "style.css", "icon.svg"):
        assert urllib.request.urlopen(server.url + name).status == 200
    for name in ("model.py", "../model.py", "static/main.js", "nothing.js"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(server.url + name)


def test_requests_with_another_host_header_are_rejected(server: PageServer) -> None:
    request = urllib.request.Request(server.url, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="421"):
        urllib.request.urlopen(request)


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors"},
    ],
)
def test_pages_of_other_websites_read_nothing(server: PageServer, headers: dict[str, str]) -> None:
    """Nor do they hold connections, which a browser opens for them as often as they like."""
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(server.url + "changes", headers=headers))


def test_a_link_of_another_website_opens_the_page(server: PageServer) -> None:
    headers = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert urllib.request.urlopen(urllib.request.Request(server.url, headers=headers)).status == 200
    own = {"Origin": server.url.rstrip("/"), "Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors"}
    with urllib.request.urlopen(urllib.request.Request(server.url + "changes", headers=own)) as changes:
        assert changes.status == 200


def test_each_page_receives_the_current_values_and_then_changes(server: PageServer) -> None:
    server.values.set_value("a", 1)
    first = changes(server.url)
    assert next(first) == {"a": 1}
    with server.condition:
        server.values.set_value("b", 2)
    server.notify_pages()
    assert next(first) == {"b": 2}
    late = changes(server.url)
    assert next(late) == {"a": 1, "b": 2}
    assert server.pages_opened == 2
    first.close()  # type: ignore[attr-defined]
    late.close()  # type: ignore[attr-defined]


def test_a_page_that_does_not_read_delays_no_other(server: PageServer) -> None:
    with socket.create_connection(("127.0.0.1", int(server.url.split(":")[2].rstrip("/")))) as stalled:
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host = server.url.removeprefix("http://").rstrip("/")
        stalled.sendall(f"GET /changes HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        other = changes(server.url)
        for number in range(60):
            with server.condition:
                server.values.set_value("much", str(number) * 50_000)
            server.notify_pages()
            while next(other)["much"] != str(number) * 50_000:
                pass
        other.close()  # type: ignore[attr-defined]


def test_a_port_in_use_is_reported_with_a_remedy(server: PageServer) -> None:
    port = server.url.split(":")[2].rstrip("/")
    command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", port]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"127.0.0.1:{port}" in done.stderr
    assert "--port 0" in done.stderr


def test_page_threads_end_with_the_server() -> None:
    opened = PageServer(VersionedValues(), "127.0.0.1", 0).start()
    opened.values.set_value("a", 1)
    stream = changes(opened.url)
    next(stream)
    opened.close()
    assert list(stream) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "handtouch-page"]
