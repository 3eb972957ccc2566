"""A touch is told where it is in the palm, while the finger moves: real daemon, nodes and robot's program."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch import Robot, columns, shipped, wire
from handtouch.hand import urdf

LINK, MOUNT_M = "index_distal", (0.01716, 0.0, 0.00976)
ROBOT = urdf.read(shipped.path("utah_mit.urdf"))
JOINTS = [joint.name for joint in ROBOT.joints.values() if joint.kind == "revolute"]
JOINTS_EVERY_S = 0.01
IN_TIME_S = 0.75 * JOINTS_EVERY_S
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
    """Where the joints are at a time: fingers close and open."""
    closed = 0.5 + 0.4 * math.sin(t_ns * 1e-9)
    return {name: 0.1 if name.endswith("abduction") else closed for name in JOINTS}


def palm_of(point_m: tuple[float, ...], t_ns: int) -> NDArray[np.float64]:
    """A point of the index finger's last link in the palm, by the product of its joints' transforms."""
    point, at = np.array(point_m), angles(t_ns)
    for joint in reversed(ROBOT.between(LINK, "palm")):
        turn = Rotation.from_rotvec(joint.axis * at[joint.name]).as_matrix()
        point = joint.rotation @ turn @ point + joint.translation_m
    return np.asarray(point)


@pytest.fixture
def robot(rig: Any) -> Iterator[threading.Event]:
    """A robot that tells its joints a hundred times a second; set the event to silence it."""
    rig.scenario.write_text(SCENARIO)
    text = rig.config.read_text()
    rig.config.write_text(
        text.replace("[touch]", '[scene]\noutputs = ["location", "palm", "base"]\n\n[touch]', 1)
    )
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    silent, stop = threading.Event(), threading.Event()

    def tell() -> None:
        with Robot(rig.endpoints["inputs"], key="") as robot:
            while not stop.wait(JOINTS_EVERY_S):
                t_ns = time.monotonic_ns()
                if not silent.is_set():
                    robot.send_joints("right", {**angles(t_ns), "an_arm": 0.0}, t_ns=t_ns)

    teller = threading.Thread(target=tell)
    teller.start()
    yield silent
    stop.set()
    teller.join()


def test_a_touch_on_a_moving_finger_is_told_in_the_palm_and_old_joints_spoil_that_alone(
    rig: Any, robot: threading.Event
) -> None:
    with rig.subscribe("contact/*/*", "hand/*", "service") as messages:
        seen, excess, frames = 0, [], 0
        while seen < 40 or frames < 10:
            message = messages.recv(60)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.Contact) and message.palm == "valid" and message.event == "update":
                assert message.group == message.id
                assert message.base == "valid"
                assert message.joints_age_s is not None
                assert message.joints_age_s < 0.1
                if message.joints_age_s < IN_TIME_S:  # else the teller was held up, and the place is as old
                    seen += 1
                    excess.append(_excess(message))
            elif isinstance(message, wire.HandFrame) and message.palm:
                told = columns(message)
                row = message.links.index(LINK)
                if told["palm"][row] == wire.Placing.VALID:
                    frames += 1
                    expected = palm_of(MOUNT_M, int(told["sample_ns"][row]))
                    assert np.linalg.norm(told["palm_position_m"][row] - expected) < 1e-3
        assert np.sqrt(np.mean(excess)) < 1.5  # in standard deviations, of two dimensions
        robot.set()
        while True:
            message = messages.recv(60)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.Contact) and message.palm == "stale":
                break
        assert message.palm_position_m is None
        assert message.joints_age_s is not None
        assert message.joints_age_s > 0.1
        assert message.location == "valid"  # on the link all goes on
        while not isinstance(message, wire.Service):
            message = messages.recv(60)
        assert message.inputs is not None
        assert message.inputs["received"]["joints/right"] > 40


def _excess(contact: wire.Contact) -> float:
    """Squared error in the surface, in standard deviations, a dimension."""
    assert contact.palm_position_m is not None
    error = np.array(contact.palm_position_m) - palm_of(MOUNT_M, contact.t_ns)
    covariance = np.reshape(contact.palm_covariance_m2 or (), (3, 3))
    assert abs(error @ np.array(contact.palm_normal)) < 2e-4
    return float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error) / 2
