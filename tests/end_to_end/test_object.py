"""The pose of a known object that one pad touches: real daemon, nodes, percept process and robot client."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from handtouch import DaemonControl, Robot, wire

RADIUS_M = 20e-3
WRIST_M = (0.0, 0.0, 0.03)  # origin of the palm in the base, of the URDF
LONGEST_S = 300.0
SCENARIO = """
repeat = true
pause_s = 0.1

[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 3.0
path = [[0.5, 0.5]]
force_n = [1.5]
"""
JOINTS = {"index_abduction": 0.1, "index_mcp": 0.5, "index_pip": 0.4, "index_dip": 0.3}


def test_a_ball_stated_over_control_is_placed_where_the_touched_pad_says(rig: Any) -> None:
    rig.scenario.write_text(SCENARIO)
    text = rig.config.read_text()
    ball = f'[object.ball]\nshape = {{ kind = "sphere", diameter_mm = {2e3 * RADIUS_M} }}\n\n[touch]'
    rig.config.write_text(text.replace("[touch]", ball, 1))
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    control = DaemonControl(rig.endpoints["control"])
    assert control.object("right")["name"] is None
    assert control.object("right", "ball")["table"] == {
        "shape": {"kind": "sphere", "diameter_mm": 2e3 * RADIUS_M}
    }
    end_s = time.monotonic() + LONGEST_S
    reasons: set[str] = set()
    contact = None
    with (
        Robot(rig.endpoints["inputs"], key="") as robot,
        rig.subscribe("percept/right/object", "contact/right/index_distal") as messages,
    ):
        send_joints = joints_at_100_hz(robot)
        while True:
            assert time.monotonic() < end_s, f"{reasons} {rig.all_printed()}"
            send_joints()
            message = messages.recv(0.02)
            if isinstance(message, wire.Contact):
                contact = message if message.palm_position_m is not None else contact
            elif isinstance(message, wire.Percept):
                reasons.add(message.reason)
                if message.state == "estimated" and contact is not None:
                    break
    assert (message.kind, message.link, message.label) == ("object", "", "ball")
    assert message.evidence["contacts"] == 1
    pose = message.poses[0]
    expected = np.array(contact.palm_position_m) + RADIUS_M * np.array(contact.palm_normal)
    assert np.linalg.norm(pose["palm_position_m"] - expected) < 5e-3
    covariance = np.array(pose["palm_covariance"]).reshape(6, 6)
    np.testing.assert_allclose(np.diag(covariance)[3:], np.pi**2 / 3, rtol=0.05)
    turned = Rotation.from_quat(pose["base_quaternion"]) * Rotation.from_quat(pose["palm_quaternion"]).inv()
    from_palm = np.array(pose["base_position_m"]) - turned.apply(pose["palm_position_m"])
    np.testing.assert_allclose(from_palm, WRIST_M, atol=1e-9)


def joints_at_100_hz(robot: Robot) -> Callable[[], None]:
    """Return a function that sends joint states, at most 100 a second."""
    sent = [0.0]

    def send() -> None:
        if time.monotonic() - sent[0] > 0.01:
            sent[0] = time.monotonic()
            robot.send_joints("right", JOINTS, t_ns=time.monotonic_ns())

    return send
