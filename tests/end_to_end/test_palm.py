"""A touch on a moving finger is reported in the palm: real daemon, nodes and robot client."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch import Robot, columns, wire
from handtouch.config import shipped
from handtouch.hand import urdf
from tests.wire.schema_check import SchemaCheck

LINK, MOUNT_M = "index_distal", (0.01716, 0.0, 0.00976)
ROBOT = urdf.read_urdf(shipped.path("utah_mit.urdf"))
JOINTS = [joint.name for joint in ROBOT.joints.values() if joint.kind == "revolute"]
JOINTS_PERIOD_S = 0.01
MAX_JOINTS_AGE_S = 0.75 * JOINTS_PERIOD_S
SCENARIO = """
repeat = true
pause_s = 0.2

[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 3.0
path = [[0.5, 0.5]]
force_n = [1.5]
"""


def angles(t_ns: int) -> dict[str, float]:
    """Return the joint positions at a time: fingers close and open."""
    closed = 0.5 + 0.4 * math.sin(t_ns * 1e-9)
    return {name: 0.1 if name.endswith("abduction") else closed for name in JOINTS}


def palm_of(point_m: tuple[float, ...], t_ns: int) -> NDArray[np.float64]:
    """Transform a point of the index finger's last link to the palm by its joints' transforms."""
    point, positions = np.array(point_m), angles(t_ns)
    for joint in reversed(ROBOT.joint_chain(LINK)[len(ROBOT.joint_chain("palm")) :]):
        rotation = Rotation.from_rotvec(joint.axis * positions[joint.name]).as_matrix()
        point = joint.rotation @ rotation @ point + joint.translation_m
    return np.asarray(point)


@pytest.fixture
def robot(rig: Any) -> Iterator[threading.Event]:
    """A robot client that sends joint states at 100 Hz; set the event to silence it."""
    rig.scenario.write_text(SCENARIO)
    text = rig.config.read_text()
    rig.config.write_text(
        text.replace("[touch]", '[scene]\noutputs = ["position", "palm", "base"]\n\n[touch]', 1)
    )
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    silent, stop = threading.Event(), threading.Event()

    def send_joints() -> None:
        with Robot(rig.endpoints["inputs"], key="") as robot:
            while not stop.wait(JOINTS_PERIOD_S):
                t_ns = time.monotonic_ns()
                if not silent.is_set():
                    robot.send_joints("right", {**angles(t_ns), "an_arm": 0.0}, t_ns=t_ns)

    sender = threading.Thread(target=send_joints)
    sender.start()
    yield silent
    stop.set()
    sender.join()


def test_touch_on_moving_finger_is_reported_in_palm_until_joints_are_stale(
    rig: Any, robot: threading.Event
) -> None:
    with rig.subscribe("contact/*/*", "hand/*", "service") as messages:
        seen, excess, frames = 0, [], 0
        while seen < 40 or frames < 10:
            message = messages.recv(60)
            assert message is not None, rig.all_printed()
            if (
                isinstance(message, wire.Contact)
                and message.palm_status == "valid"
                and message.event == "update"
            ):
                assert message.group == message.id
                assert message.base_status == "valid"
                assert message.joints_age_s is not None
                assert message.joints_age_s < 0.1
                if (
                    message.joints_age_s < MAX_JOINTS_AGE_S
                ):  # else the sender was delayed, and the position is as old
                    seen += 1
                    excess.append(_excess(message))
            elif isinstance(message, wire.HandFrame) and message.palm_status:
                frame = columns(message)
                row = message.links.index(LINK)
                current = frame["joints_age_s"][row] < MAX_JOINTS_AGE_S
                if current and frame["palm_status"][row] == wire.FrameStatus.VALID:
                    frames += 1
                    expected = palm_of(MOUNT_M, int(frame["sample_ns"][row]))
                    assert np.linalg.norm(frame["palm_position_m"][row] - expected) < 1e-3
        assert np.sqrt(np.mean(excess)) < 1.5  # in standard deviations, of two dimensions
        robot.set()
        while True:
            message = messages.recv(60)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.Contact) and message.palm_status == "stale":
                break
        assert message.palm_position_m is None
        assert message.joints_age_s is not None
        assert message.joints_age_s > 0.1
        assert message.position_status == "valid"  # the position on the link is unaffected
        while not isinstance(message, wire.Service):
            message = messages.recv(60)
        assert message.inputs is not None
        assert message.inputs["received"]["joints/right"] > 40
    robot.clear()
    _check_messages_of_all_topics(rig)


def _check_messages_of_all_topics(rig: Any) -> None:
    """Compare messages of every topic with the schema."""
    check, topics = SchemaCheck("published"), {topic.prefix for topic in wire.TOPICS}
    events: set[str] = set()
    end_s = time.monotonic() + 60
    with zmq.Context() as context, context.socket(zmq.SUB) as messages:
        messages.subscribe("")
        messages.connect(rig.endpoints["complete"])
        while topics or events < {"begin", "update", "end"}:
            assert messages.poll(round(1000 * (end_s - time.monotonic()))), (
                topics,
                events,
                rig.all_printed(),
            )
            parts = messages.recv_multipart()
            assert check.errors(parts) == []
            topics.discard(parts[0].decode().split("/")[0])
            events.add(msgpack.unpackb(parts[1]).get("event", ""))


def _excess(contact: wire.Contact) -> float:
    """Return the squared error in the surface per dimension, in standard deviations."""
    assert contact.palm_position_m is not None
    error = np.array(contact.palm_position_m) - palm_of(MOUNT_M, contact.t_ns)
    covariance = np.reshape(contact.palm_covariance_m2 or (), (3, 3))
    assert abs(error @ np.array(contact.palm_normal)) < 2e-4
    return float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error) / 2
