"""Messages of the ROS 2 bridge: definitions, encoding and content, as ROS tools decode them."""

from __future__ import annotations

import gc
import itertools
import math
import os
import threading
import time
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args
from uuid import uuid4

import numpy as np
import pytest
import zmq
from cyclonedds.idl import IdlStruct
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.bridge.options import BridgeError
from handtouch.bridge.ros2 import messages as ros
from handtouch.bridge.ros2.conflation import Conflation
from handtouch.bridge.ros2.contact_messages import ContactArray
from handtouch.bridge.ros2.conversion import (
    Stamper,
    contact_markers,
    encode_contacts,
    encode_sum,
    encode_wrench,
    inputs_status,
)
from handtouch.bridge.ros2.network import Quality, RosNetwork, ros_name
from handtouch.bridge.ros2.relay import TOPICS, RosRelay, relay_received
from handtouch.bridge.ros2.runner import RosOptions, run_ros_bridge
from handtouch.bridge.ros2.type_hash import ros_type_name, type_hash
from handtouch.client import Subscriber
from handtouch.wire import PadState
from tests.client.hand_messages import make_contact, make_frame, make_service
from tests.deployments import deployment_text, pad_text

PACKAGE = Path(__file__).parents[2] / "clients" / "ros2" / "handtouch_msgs"
WALL_OFFSET_NS = 1_700_000_000_000_000_123
NOT_ON_ROS = {"v", "session", "seq", "t_ns", "retained", "frame", "begin_ns", "parts"}
"""Fields of `contact` that are in the headers, in `begin`, or about the transport; and lists of structures"""


def typestore(release: Stores) -> Any:
    """Types of a ROS 2 release, with those of the repository's `.msg` files."""
    store = get_typestore(release)
    for path in sorted((PACKAGE / "msg").glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"handtouch_msgs/msg/{path.stem}"))
    return store


@pytest.fixture(scope="module", params=[Stores.ROS2_HUMBLE, Stores.ROS2_KILTED], ids=["humble", "kilted"])
def store(request: pytest.FixtureRequest) -> Any:
    return typestore(request.param)


def make_stamper() -> Stamper:
    stamper = Stamper("robot1/")
    stamper.wall_offset_ns = WALL_OFFSET_NS
    return stamper


LOCATED = replace(
    make_contact("index_tip", "update", 7, seq=2_000_000_000),
    position_m=(0.01, 0.02, 0.03),
    normal=(0.0, 0.6, 0.8),
    covariance_m2=(4e-8, 0.0, 0.0, 0.0, 1e-8, 0.0, 0.0, 0.0, 0.0),
    pad_m=(0.011, 0.022),
    position_status="valid",
    force_n=2.5,
    palm_status="valid",
    palm_position_m=(0.1, 0.0, 0.0),
    palm_normal=(0.0, 0.0, 1.0),
    palm_covariance_m2=(1e-6,) * 9,
    group=3,
    diagnoses=("gum", "drift"),
    force_vector_status="valid",
    force_vector_n=(0.3, -1.5, -2.0),
    force_vector_covariance_n2=(1e-2,) * 9,
    palm_force_vector_n=(1.5, 0.3, -2.0),
)


@pytest.mark.parametrize(
    "kind",
    [
        *(ros.WrenchStamped, ros.RosJointState, ros.MarkerArray, ros.DiagnosticArray, ContactArray),
        ros.PoseWithCovarianceStamped,
    ],
    ids=ros_type_name,
)
def test_definitions_hash_as_in_ros(kind: type[IdlStruct], store: Any) -> None:
    """The same RIHS01 hash means the same names, types and order of all fields."""
    assert type_hash(kind) == store.hash_rihs01(ros_type_name(kind))


def test_constants_of_the_msg_file_are_the_codes_of_the_wire(store: Any) -> None:
    constants = {name: value for name, _, value in store.fielddefs["handtouch_msgs/msg/Contact"][0]}
    for prefix, codes in (
        ("POSITION", wire.PositionStatus),
        ("FORCE", wire.ForceStatus),
        ("FRAME", wire.FrameStatus),
    ):
        assert {f"{prefix}_{code.name}": code.value for code in codes} == {
            name: value for name, value in constants.items() if name.startswith(f"{prefix}_")
        }


def test_every_field_of_a_contact_is_decoded_by_ros(store: Any) -> None:
    frame = replace(make_frame(seq=1), session=2**53 - 1, tick=9)
    unknown = make_contact("ring", "begin", 8)
    encoded = encode_contacts([unknown, LOCATED], frame, "palm", make_stamper())
    decoded = store.deserialize_cdr(encoded, "handtouch_msgs/msg/ContactArray")
    assert (decoded.session, decoded.tick, decoded.header.frame_id) == (2**53 - 1, 9, "robot1/palm")
    first, contact = decoded.contacts
    assert (first.link, first.diagnoses, first.fresh) == ("ring", [], True)
    stamp = contact.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == LOCATED.t_ns + WALL_OFFSET_NS
    assert contact.header.frame_id == "robot1/index_tip"
    assert (contact.event, contact.position_status, contact.palm_status) == (1, 1, 1)
    for field in fields(wire.Contact):
        if field.name in NOT_ON_ROS or field.name in ("event", "position_status", "force_status"):
            continue
        sent, received = getattr(LOCATED, field.name), getattr(contact, field.name)
        if field.name.endswith("_status"):
            assert received == wire.FrameStatus[sent.upper()]
        elif hasattr(received, "x"):
            expected = [math.nan] * 3 if sent is None else sent
            np.testing.assert_array_equal([received.x, received.y, received.z], expected)
        elif sent is None:
            assert np.isnan(received).all(), field.name
        else:
            assert np.array_equal(np.asarray(received), np.asarray(sent)), field.name


PARTS: tuple[wire.ContactPart, ...] = tuple(
    {
        "position_m": [x, 0.02, 0.03],
        "normal": [0.0, 0.6, 0.8],
        "covariance_m2": [1e-8 * k for k in range(9)],
        "force_n": force_n,
        "force_std_n": None,
        "palm_position_m": [x, 0.5, 0.25],
        "palm_normal": [1.0, 0.0, 0.0],
        "palm_covariance_m2": [1e-6] * 9,
    }
    for x, force_n in ((0.01, 1.5), (0.02, None))
)


def test_two_contacts_on_a_pad_are_decoded_by_ros(store: Any) -> None:
    contacts = [replace(LOCATED, parts=PARTS), LOCATED, replace(LOCATED, parts=PARTS[::-1])]
    encoded = encode_contacts(contacts, make_frame(seq=1), "palm", make_stamper())
    decoded = store.deserialize_cdr(encoded, "handtouch_msgs/msg/ContactArray")
    assert [len(contact.parts) for contact in decoded.contacts] == [2, 0, 2]
    for contact, sent in zip(decoded.contacts, contacts, strict=True):
        assert contact.calibration_id == sent.calibration_id
        for received, part in zip(contact.parts, sent.parts, strict=True):
            assert [received.position_m.x, received.position_m.y] == part["position_m"][:2]
            assert received.covariance_m2.tolist() == part["covariance_m2"]
            assert received.palm_position_m.y == 0.5
            assert math.isnan(received.base_position_m.x)
            assert np.array_equal(received.force_n, part["force_n"] or math.nan, equal_nan=True)


def test_two_contacts_on_a_pad_have_points_that_expire() -> None:
    markers = contact_markers(replace(LOCATED, parts=PARTS), 4, make_stamper())[3:]
    assert [(marker.ns, marker.id, marker.pose.position.x) for marker in markers] == [
        ("part", 8, 0.01),
        ("part", 9, 0.02),
    ]
    assert all(marker.lifetime.nanosec > 0 for marker in markers)


def test_a_wrench_is_the_force_on_the_link_about_its_origin(store: Any) -> None:
    encoded = encode_wrench(replace(LOCATED, force_vector_status="unreliable"), make_stamper())
    assert encoded is not None
    decoded = store.deserialize_cdr(encoded, "geometry_msgs/msg/WrenchStamped")
    force, torque = decoded.wrench.force, decoded.wrench.torque
    assert [force.x, force.y, force.z] == pytest.approx([0.0, -1.5, -2.0])
    expected = np.cross(LOCATED.position_m or (), [0.0, -1.5, -2.0])
    assert [torque.x, torque.y, torque.z] == pytest.approx(expected.tolist())


def test_a_wrench_above_a_shear_pad_has_the_valid_force_vector() -> None:
    encoded = encode_wrench(LOCATED, make_stamper())
    assert encoded is not None
    force = ros.WrenchStamped.deserialize(encoded).wrench.force
    assert [force.x, force.y, force.z] == pytest.approx(LOCATED.force_vector_n)


def wrench_of(encoded: bytes | None) -> list[float]:
    assert encoded is not None
    wrench = ros.WrenchStamped.deserialize(encoded).wrench
    return [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"]


@pytest.mark.parametrize("reason", get_args(wire.EndReason))
def test_a_wrench_is_zero_only_when_it_is_released(reason: wire.EndReason) -> None:
    ended = encode_wrench(replace(LOCATED, event="end", end_reason=reason), make_stamper())
    assert wrench_of(ended) == [0.0] * 6 if reason == "released" else ended is None


@pytest.mark.parametrize("unknown", [{"force_n": None}, {"position_m": None}, {"fresh": False}])
def test_a_wrench_of_which_anything_is_unknown_is_not_known(unknown: dict[str, Any]) -> None:
    assert encode_wrench(replace(LOCATED, **unknown), make_stamper()) is None


def test_a_sum_has_all_contacts_or_is_unknown() -> None:
    stamper = make_stamper()
    unknown = make_contact("thumb_tip", "update", 8)
    assert encode_sum([LOCATED, unknown], 1, "palm", stamper) is None
    assert encode_sum([LOCATED, replace(LOCATED, fresh=False)], 1, "palm", stamper) is None
    flat = replace(LOCATED, force_vector_status="not_computed")
    wrench = wrench_of(encode_sum([flat, flat], 1, "palm", stamper))
    assert [wrench[2], wrench[4]] == pytest.approx([-5.0, 0.5])
    assert wrench_of(encode_sum([], 1, "palm", stamper)) == [0.0] * 6


class RosTopics:
    """Keeps what a relay publishes, by topic: as a network whose topics all have a reader."""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = {}

    def writer(self, topic: str, *_: Any) -> Any:
        return SimpleNamespace(is_read=True, write=self.sent.setdefault(topic, []).append)

    def forces_n(self, topic: str) -> list[float]:
        """Take the forces along z that were published, NaN for unknown ones."""
        values = [wrench_of(encoded)[2] for encoded in self.sent.get(topic, [])]
        self.sent.get(topic, []).clear()
        return values


class RelayedHand:
    """A relay of a hand with a held contact; `tick` sends what a daemon does in one."""

    def __init__(self) -> None:
        self.topics, self.now_s, self.seq = RosTopics(), 0.0, 0
        network: Any = self.topics
        self.relay = RosRelay(network, make_stamper(), {"right": "palm"}, lambda: self.now_s)

    def tick(
        self,
        *contacts: wire.Contact,
        state: Any = (0, 1, 0),
        contact_id: Any = (0, 7, 0),
        sample_ns: Any = None,
    ) -> None:
        self.seq += 1
        self.now_s += 0.005
        for contact in contacts:
            self.relay.relay(replace(contact, seq=self.seq, t_ns=10**10 + 5_000_000 * self.seq))
        t_ns = 10**10 + 5_000_000 * self.seq
        codes = {"state": state, "contact_id": contact_id, "sample_ns": sample_ns or (t_ns,) * 3}
        self.relay.relay(make_frame(self.seq, t_ns=t_ns, **codes))

    def forces_n(self, name: str) -> list[float]:
        return self.topics.forces_n(f"right/{name}wrench")


def test_the_pose_of_an_object_is_published_while_it_is_determined() -> None:
    pose = wire.ObjectPose(
        weight=0.9,
        palm_position_m=[0.07, 0.0, 0.03],
        palm_quaternion=[0.0, 0.6, 0.0, 0.8],
        palm_covariance=[1e-6 * k for k in range(36)],
    )
    percept = wire.Percept(
        *(1, 1, 1, 10**10, "right", "object", "", 0, "estimated", "bolt", 0.9),
        *({"bolt": 0.9}, {}, {}, "", False),
        poses=(pose, pose | {"weight": 0.1}),
    )
    hand = RelayedHand()
    hand.relay.relay(percept)
    hand.relay.relay(replace(percept, state="undetermined"))
    (sent,) = hand.topics.sent["right/object"]
    assert sent.header.frame_id == "robot1/palm"
    placed = sent.pose.pose
    assert [placed.position.x, placed.position.y, placed.position.z] == pose["palm_position_m"]
    assert [placed.orientation.y, placed.orientation.w] == [0.6, 0.8]
    assert list(sent.pose.covariance) == pose["palm_covariance"]


HELD = replace(LOCATED, force_vector_status="not_computed")


@pytest.mark.parametrize("state", [s for s in wire.PadState if s not in (PadState.CLEAR, PadState.TOUCHED)])
def test_a_pad_that_falls_silent_while_touched_is_unknown_once_until_it_is_sampled_again(
    state: wire.PadState,
) -> None:
    hand = RelayedHand()
    hand.tick(HELD)
    assert hand.forces_n("index_tip/") == [-2.0]
    assert hand.forces_n("thumb_tip/") == [0.0]
    assert hand.forces_n("") == [-2.5]
    for _ in range(3):
        hand.tick(state=(0, state, 0))
    hand.tick(replace(HELD, event="end", end_reason="stale"), state=(0, state, 0), contact_id=(0, 0, 0))
    for _ in range(3):
        hand.tick(state=(0, state, 0), contact_id=(0, 0, 0))
    assert np.array_equal(hand.forces_n("index_tip/"), [math.nan], equal_nan=True)
    assert np.array_equal(hand.forces_n(""), [math.nan], equal_nan=True)
    assert hand.forces_n("thumb_tip/") == []
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0))
    assert hand.forces_n("index_tip/") == [0.0]
    assert hand.forces_n("") == [0.0]


def test_a_sample_that_was_unknown_never_counts_again() -> None:
    """A pad that changes between lost and sampled without a newer sample has one wrench of NaN."""
    hand = RelayedHand()
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0))
    assert hand.forces_n("index_tip/") == [0.0]
    newest_ns = (10**10 + 10_000_000,) * 3
    for state in (PadState.STALE, 0) * 3:
        hand.tick(state=(0, state, 0), contact_id=(0, 0, 0), sample_ns=newest_ns)
    assert np.array_equal(hand.forces_n("index_tip/"), [math.nan], equal_nan=True)
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0))
    assert hand.forces_n("index_tip/") == [0.0]


def test_no_sample_has_two_wrenches_of_nan() -> None:
    """The force of a touch isn't known, as of a pad in quarantine; its last sample comes twice, then none."""
    hand = RelayedHand()
    hand.relay.relay(make_service())
    for _ in range(2):
        hand.tick(replace(HELD, force_n=None))
    assert np.array_equal(hand.forces_n("index_tip/"), [math.nan] * 2, equal_nan=True)
    old_ns = 10**10 + 5_000_000 * hand.seq
    hand.relay.relay(replace(HELD, force_n=None, seq=hand.seq, t_ns=old_ns, retained=True))
    hand.tick(state=(0, PadState.STALE, 0), sample_ns=(old_ns,) * 3)
    hand.relay.end_session()
    hand.relay.relay(make_service())
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0), sample_ns=(old_ns,) * 3)
    assert hand.forces_n("index_tip/") == []
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0))
    assert hand.forces_n("index_tip/") == [0.0]


def test_the_first_missing_sample_of_a_contact_is_unknown() -> None:
    hand = RelayedHand()
    hand.tick(HELD)
    hand.tick(replace(HELD, fresh=False))
    hand.tick(HELD)
    for name, force_n in (("index_tip/", -2.0), ("", -2.5)):
        assert np.array_equal(hand.forces_n(name), [force_n, math.nan, force_n], equal_nan=True)


def test_a_sum_without_a_pad_of_the_hand_is_not_published() -> None:
    hand = RelayedHand()
    hand.tick(HELD, state=(PadState.LOST, 1, 0))
    assert hand.forces_n("") == []
    hand.tick(HELD, state=(0, 1, 1), contact_id=(0, 7, 9))  # its begin was lost
    assert hand.forces_n("") == []


def test_without_a_daemon_every_pad_is_unknown_once() -> None:
    """Whether it hangs, or is disconnected, or one after the other."""
    for first, second in itertools.product((RosRelay.expire, RosRelay.end_session), repeat=2):
        hand = RelayedHand()
        hand.relay.relay(make_service())
        for _ in range(3):
            hand.tick(HELD)
        for name in ("index_tip/", "thumb_tip/", "index_base/", ""):
            hand.forces_n(name)
        hand.relay.expire()
        assert not hand.forces_n("index_tip/")
        hand.now_s += 0.1
        first(hand.relay)
        second(hand.relay)
        for name in ("index_tip/", "thumb_tip/", "index_base/", ""):
            assert np.array_equal(hand.forces_n(name), [math.nan], equal_nan=True), name


def test_a_pad_that_was_lost_is_known_again_by_a_newer_sample_only() -> None:
    """Frames come again, of a hand whose pads haven't been sampled since they were lost."""
    hand = RelayedHand()
    hand.relay.relay(make_service())
    hand.tick(HELD)
    hand.now_s += 0.1
    hand.relay.expire()
    names = ("index_tip/", "thumb_tip/", "index_base/", "")
    for name in names:
        hand.forces_n(name)
    old_ns = 10**10 + 5_000_000 * hand.seq
    for state in ((0, 0, 0), (0, PadState.STALE, 0)):
        hand.tick(state=state, contact_id=(0, 0, 0), sample_ns=(old_ns,) * 3)
        assert [hand.forces_n(name) for name in names] == [[]] * 4
    hand.tick(state=(0, 0, 0), contact_id=(0, 0, 0))
    assert [hand.forces_n(name) for name in names] == [[0.0]] * 4


def test_a_hand_is_silent_after_three_periods_of_its_frames_as_service_states_them() -> None:
    """Not by their intervals, which grow with what a daemon is late by."""
    hand = RelayedHand()
    hand.relay.relay(make_service(frame_period_s=0.1))
    hand.tick(HELD)
    hand.now_s += 0.29
    hand.relay.expire()
    assert hand.forces_n("index_tip/") == [-2.0]
    hand.now_s += 0.02
    hand.relay.expire()
    assert np.array_equal(hand.forces_n("index_tip/"), [math.nan], equal_nan=True)


def test_markers_of_a_pad_that_falls_silent_are_a_grey_point_until_it_is_sampled() -> None:
    hand = RelayedHand()

    def markers() -> dict[str, list[float]]:
        for _ in range(8):
            hand.tick(state=(0, state, 0), contact_id=(0, contact_id, 0))
        shown: dict[str, list[float]] = {}
        for array in hand.topics.sent["right/markers"]:
            shown |= {marker.ns: [marker.action, marker.color.g] for marker in array.markers}
        return shown

    hand.tick(HELD)
    state, contact_id = int(PadState.TOUCHED), 7
    assert markers()["contact"] == pytest.approx([0, 0.8])
    state = int(PadState.STALE)
    assert markers()["contact"] == pytest.approx([0, 0.5])
    assert markers()["force"][0] == 2
    hand.tick(replace(HELD, event="end", end_reason="stale"), state=(0, state, 0))
    contact_id = 0
    assert markers()["contact"] == pytest.approx([0, 0.5])
    state = int(PadState.CLEAR)
    assert markers()["contact"][0] == 2


def test_the_ellipse_has_the_axes_of_the_covariance(store: Any) -> None:
    turned = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    covariance = turned @ np.diag([4e-8, 1e-8, 0.0]) @ turned.T
    values: Any = tuple(covariance.ravel().tolist())
    contact = replace(LOCATED, covariance_m2=values)
    array = ros.MarkerArray(contact_markers(contact, 4, make_stamper()))
    decoded = store.deserialize_cdr(array.serialize(), "visualization_msgs/msg/MarkerArray")
    assert [(marker.ns, marker.id, marker.action) for marker in decoded.markers] == [
        *(("contact", 4, 0), ("force", 4, 0), ("ellipse", 4, 0))
    ]
    ellipse = decoded.markers[2]
    pose = ellipse.pose.orientation
    axes = Rotation.from_quat([pose.x, pose.y, pose.z, pose.w]).as_matrix()
    half = np.array([ellipse.scale.x, ellipse.scale.y, ellipse.scale.z]) / 2
    long = axes[:, half.argmax()]
    assert abs(long @ turned[:, 0]) == pytest.approx(1.0)
    assert sorted(half)[1:] == pytest.approx([math.sqrt(5.991 * 1e-8), math.sqrt(5.991 * 4e-8)], rel=1e-4)


@pytest.mark.parametrize(
    ("text", "name"), [("index_tip", "index_tip"), ("3rd finger", "_3rd_finger"), ("a--b__c", "a_b_c")]
)
def test_names_fit_the_rules_of_ros(text: str, name: str) -> None:
    assert ros_name(text) == name


@pytest.mark.parametrize("pair", [("index-tip", "index_tip"), ("tip", "tip_")])
def test_pads_whose_names_fall_on_one_topic_are_refused(tmp_path: Path, pair: tuple[str, str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(deployment_text(*(pad_text(link, number) for number, link in enumerate(pair, 1))))
    with pytest.raises(BridgeError, match=f"h/{pair[0]} and h/{pair[1]} have one topic in ROS 2"):
        run_ros_bridge(RosOptions(path), threading.Event())


def test_joint_states_that_are_dropped_are_a_warning_with_the_reason_while_they_are() -> None:
    inputs = {"received": {"joints/t": 7}, "age_s": {"joints/t": 0.1}, "dropped": {"clock": 2}}
    problem = "joints/t: stamps of another clock"
    for before, level, text in ((0, 1, problem), (2, 0, f"all used; the last problem was: {problem}")):
        status = inputs_status(inputs | {"problem": problem}, before)
        assert (status.name, status.level, status.message) == ("handtouch: inputs", level, text)
        assert {pair.key: pair.value for pair in status.values}["dropped clock"] == "2"
    nothing = {"received": {}, "age_s": {}, "dropped": {}, "problem": ""}
    assert (inputs_status(nothing, 0).level, inputs_status(nothing, 0).message) == (0, "all used")


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> RosNetwork:
    interface = '<Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast>'
    monkeypatch.setenv(
        "CYCLONEDDS_URI", f"<CycloneDDS><Domain><General>{interface}</General></Domain></CycloneDDS>"
    )
    return RosNetwork(os.getpid() % 200)


@pytest.mark.parametrize("asked", [Quality.SENSOR_DATA, Quality.STREAM], ids=["best effort", "reliable"])
def test_a_topic_is_read_while_it_has_a_reader_of_either_reliability(
    network: RosNetwork, asked: Quality
) -> None:
    """Nothing is encoded for a topic that isn't read."""
    wrenches = network.writer("wrench", ros.WrenchStamped, Quality.STREAM)
    assert not wrenches.is_read
    reader = network.reader("wrench", ros.WrenchStamped, asked)
    end_s = time.monotonic() + 60
    received: list[Any] = []
    sent = encode_wrench(LOCATED, make_stamper())
    assert sent is not None
    while not received and time.monotonic() < end_s:
        wrenches.write(sent)
        received = reader.take(1)
    assert received[0] == ros.WrenchStamped.deserialize(sent)
    del reader
    while wrenches.is_read and time.monotonic() < end_s:
        gc.collect()
    assert not wrenches.is_read


def test_a_late_bridge_relays_the_newest_updates_and_every_begin_and_end(network: RosNetwork) -> None:
    """However long the bridge was stalled, it then sends one update a topic, and reports that it dropped."""
    stream = f"inproc://{uuid4()}"
    publisher: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
    publisher.sndhwm = 0
    publisher.bind(stream)
    relay = RosRelay(network, make_stamper(), {})
    arrays = network.reader("right/contacts", ContactArray, Quality.SENSOR_DATA)
    diagnostics = network.reader("/diagnostics", ros.DiagnosticArray, Quality.STATE)
    end_s, seq, waiting = time.monotonic() + 60, itertools.count(1), Conflation()
    with publisher, Subscriber[Any].open(TOPICS, stream, 20_000, "") as source:
        while not arrays.take(1) and time.monotonic() < end_s:  # until publisher and reader are connected
            publisher.send_multipart(wire.encode(make_frame(next(seq))))
            relay_received(source, waiting, relay, 0.0)
        assert waiting.replaced == 0
        events: list[wire.ContactEvent] = ["update"] * 400
        events[0], events[-1] = "begin", "end"
        for tick, event in enumerate(events, 1):
            for link in ("index_tip", "thumb_tip"):
                contact = replace(make_contact(link, event, 1, seq=tick), t_ns=10**10 + tick)
                publisher.send_multipart(wire.encode(contact))
            publisher.send_multipart(wire.encode(make_frame(next(seq), t_ns=10**10 + tick)))
        assert relay_received(source, waiting, relay, 60.0)
    (array,) = arrays.take(10)
    times = [contact.header.stamp.nanosec - WALL_OFFSET_NS % 10**9 for contact in array.contacts]
    assert [contact.link for contact in array.contacts] == ["index_tip", "thumb_tip"] * 3
    assert [contact.event for contact in array.contacts] == [0, 0, 1, 1, 2, 2]
    assert times == [1, 1, 399, 399, 400, 400]
    (report,) = diagnostics.take(1)
    (bridge,) = (status for status in report.status if status.name == "handtouch: bridge")
    assert bridge.level == 1
    replaced = str(2 * 397 + 399)
    assert {pair.key: pair.value for pair in bridge.values}["replaced"] == replaced


def test_a_malformed_message_costs_no_other(network: RosNetwork) -> None:
    """A name that isn't UTF-8 passes DDS, and fails in decoding."""
    writer = network.writer("/joint_states", ros.RosJointState, Quality.STATE)
    reader = network.reader("/joint_states", ros.RosJointState, Quality.SENSOR_DATA)
    state = ros.RosJointState(name=["index_mcp"], position=[0.5])
    writer.write(state.serialize().replace(b"index", b"ind\xffx"))
    writer.write(state)
    received, end_s = list[Any](), time.monotonic() + 60
    while not received and time.monotonic() < end_s:
        received = reader.take(10)
    assert received == [state]


def test_status_that_a_later_version_added_counts_as_unreliable(store: Any) -> None:
    later: dict[str, Any] = dict.fromkeys(("position_status", "force_status", "palm_status"), "guessed")
    contact = replace(make_contact("thumb_tip", "update", 7), **later)
    data = encode_contacts([contact], make_frame(), "palm", make_stamper())
    (received,) = store.deserialize_cdr(data, "handtouch_msgs/msg/ContactArray").contacts
    assert received.position_status == int(wire.PositionStatus.UNRELIABLE)
    assert received.force_status == int(wire.ForceStatus.UNRELIABLE)
    assert received.palm_status == int(wire.FrameStatus.NOT_COMPUTED)
