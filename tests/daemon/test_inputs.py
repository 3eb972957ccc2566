"""Robot inputs are processed, or counted and dropped by cause; no message is fatal."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from handtouch.client import key_maker
from handtouch.client.robot import Robot
from handtouch.core.sheet_force import ForceReference
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.inputs import DROP_CAUSES, InputReceiver
from handtouch.hand.joints import JointStateBuffer
from handtouch.wire.inputs import (
    JointState,
    LinkForces,
    encode,
)

NOW = 10**12
PADS = [("left", "tip"), ("right", "tip"), ("right", "palm")]


def test_gravity_is_normalised_and_the_newest_value_holds(inputs: InputReceiver) -> None:
    assert inputs.base_pose("right", "gravity") is None
    for number, gravity in enumerate([[0.0, 0.0, -9.81], None, [1e300, 0.0, 0.0], None]):
        payload = {"v": 1, "t_ns": NOW + number, "names": ["a"], "position_rad": [0.1], "gravity": gravity}
        inputs.process_message([b"joints/right", msgpack.packb(payload)], NOW + number)
        down = inputs.base_pose("right", "gravity")
        assert down is not None
        assert down.tolist() == ([0.0, 0.0, -1.0] if number < 2 else [1.0, 0.0, 0.0])


@pytest.fixture
def references() -> list[ForceReference]:
    """Force references that the receiver forwarded."""
    return []


@pytest.fixture
def inputs(references: list[ForceReference]) -> Any:
    with zmq.Context() as context, Authenticator(context) as authenticator:
        limits = np.array([[-0.5, 1.5], [-np.inf, np.inf]])
        states = {"right": JointStateBuffer(("a", "b"), limits=limits)}
        made = InputReceiver.open(
            context, "tcp://127.0.0.1:*", authenticator, states, PADS, references.append
        )
        yield made
        made.close()


def joints(hand: str = "right", t_ns: int | None = NOW, names: tuple[str, ...] = ("a", "b")) -> list[bytes]:
    return encode(JointState(hand, t_ns, names, np.full(len(names), 0.5)))


@pytest.mark.parametrize(
    ("parts", "cause", "detail"),
    [
        ([b"joints/right", b"\xc1"], "malformed", "msgpack"),
        ([b"joints/right"], "malformed", "1 parts"),
        (
            [b"joint/right", b""],
            "unknown_topic",
            "'joint/right'; the topics are joints/*, force/*",
        ),
        ([b"joints", b""], "unknown_topic", "'joints'; the topics are"),
        (joints("third"), "unknown_hand", "joints/third; the hands are left, right"),
        (joints("left"), "no_urdf", "joints/left"),
        (joints(names=("x", "y")), "unknown_joints", "joints/right has x, y; the URDF has a, b"),
        (joints(t_ns=NOW + 10**15), "clock", "s off; send nil"),
        (joints(t_ns=5), "clock", "s off"),
        ([b"command/right", b""], "unknown_topic", "'command/right'; the topics are joints/*, force/*"),
        (encode(JointState("right", NOW, ("a",), np.array([45.0]))), "joint_limits", "joints/right: a = 45"),
        (encode(LinkForces("right", NOW, ("toe",), np.ones(1), np.ones(1))), "unknown_link", "'toe'"),
    ],
)
def test_unusable_message_is_counted_and_described(
    inputs: Any, parts: list[bytes], cause: str, detail: str
) -> None:
    inputs.process_message(parts, NOW)
    statistics = inputs.statistics(NOW)
    assert statistics["dropped"] == {cause: 1}
    assert detail in statistics["problem"]
    assert not statistics["received"]


def test_the_problem_is_the_latest_one(inputs: Any) -> None:
    inputs.process_message(joints(names=("x",)), NOW)
    inputs.process_message([b"joints/right", b""], NOW)
    inputs.process_message(joints(names=("y",)), NOW)
    assert "joints/right has y" in inputs.problem


def test_repeated_time_is_late_and_missing_time_means_now(inputs: Any) -> None:
    inputs.process_message(joints(), NOW)
    inputs.process_message(joints(), NOW)
    inputs.process_message(joints(t_ns=None), NOW + 5)
    assert inputs.dropped == {"late": 1}
    assert inputs.joints_at("right", NOW + 5).age_s.tolist() == [0.0, 0.0]
    assert inputs.joints_at("left", NOW) is None
    assert inputs.statistics(NOW + 10**9)["age_s"]["joints/right"] == pytest.approx(1.0)


def test_forces_are_forwarded_by_pad(inputs: Any, references: list[ForceReference]) -> None:
    message = LinkForces("right", NOW, ("toe", "palm"), np.array([1.0, 2.0]), np.array([0.3, 0.1]))
    inputs.process_message(encode(message), NOW)
    (reference,) = references
    assert (reference.pads.tolist(), reference.force_n.tolist()) == ([2], [2.0])
    assert (reference.std_n.tolist(), reference.measured_ns) == ([0.1], NOW)
    assert inputs.dropped == {"unknown_link": 1}


def test_messages_read_per_period_are_bounded(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        while not robot.wait_connected(0.05):  # the daemon polls in every period
            inputs.poll(NOW)
        for number in range(60):
            robot.send_joints("right", {"a": 0.1}, t_ns=NOW + number)
        while sum(inputs.received.values()) < 16:  # the sender's own queue holds 16 while the wire is slow
            before = sum(inputs.received.values())
            inputs.poll(NOW)
            assert sum(inputs.received.values()) - before <= 128


def test_the_newest_of_many_waiting_messages_is_used_at_once(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        while not robot.wait_connected(0.05):
            inputs.poll(NOW)
        for number in range(1, 11):  # the sender queues 16
            robot.send_joints("right", {"a": 0.01 * number}, t_ns=NOW + number * 1_000_000)
        end_s = time.monotonic() + 30
        while time.monotonic() < end_s:
            inputs.poll(NOW + 10_000_000)
            at = inputs.joints_at("right", NOW + 10_000_000)
            if at.age_s[0] == 0.0:  # of earlier states, 0.1 rad may be extrapolated
                break
    assert at.age_s[0] == 0.0
    assert at.position_rad[0] == 0.1


def test_of_states_without_stamp_in_one_read_the_last_is_kept(inputs: Any) -> None:
    for position in (0.1, 0.2, 0.3):
        inputs.process_message(encode(JointState("right", None, ("a", "b"), np.full(2, position))), NOW)
    assert inputs.joints_at("right", NOW).position_rad.tolist() == [0.3, 0.3]
    assert inputs.dropped == {}


def test_misspelt_topic_is_counted_by_the_endpoint(inputs: Any) -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as robot:
        robot.connect(inputs.endpoint)
        while not inputs.dropped:
            robot.send_multipart([b"joint/right", b""])
            inputs.poll(NOW)
    assert "unknown_topic" in inputs.dropped


def test_robot_client_refuses_an_unknown_hand(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        while not robot.wait_connected(0.05):
            inputs.poll(NOW)
        with pytest.raises(ValueError, match=r"'rihgt' is unknown; the hands of the daemon are left, right"):
            robot.send_joints("rihgt", {"a": 0.1})
        with pytest.raises(ValueError, match="unknown"):
            robot.send_forces("rihgt", {"tip": 1.0}, 0.1)
        robot.send_joints("right", {"a": 0.1})


def test_robot_client_knows_the_hands_of_a_daemon_that_restarts(endpoints: dict[str, str]) -> None:
    def accepts_right_hand() -> bool:
        try:
            robot.send_joints("right", {"a": 0.1})
        except ValueError:
            return False
        return True

    with Robot(endpoints["inputs"], key="") as robot:
        for hand in ("left", "right", "left"):
            with zmq.Context() as context, Authenticator(context) as authenticator:
                made = InputReceiver.open(context, endpoints["inputs"], authenticator, {}, [(hand, "tip")])
                end_s = time.monotonic() + 60
                while not robot.wait_connected(0.05) or accepts_right_hand() is not (hand == "right"):
                    made.poll(NOW)
                    assert time.monotonic() < end_s
                made.close()


def test_a_sequence_of_positions_has_the_order_of_the_daemon_s_joints(endpoints: dict[str, str]) -> None:
    buffer = JointStateBuffer(("knuckle", "a/b", "tip"))
    with zmq.Context() as context, Robot(endpoints["inputs"]) as robot:
        with pytest.raises(LookupError, match="wait_connected"):
            robot.send_joints("right", [0.1, 0.2, 0.3])
        authenticator = Authenticator(context)
        made = InputReceiver.open(context, endpoints["inputs"], authenticator, {"right": buffer}, PADS)
        try:
            assert _try_to_connect(robot, authenticator, made)
            assert robot.joints("right") == buffer.names
            with pytest.raises(ValueError, match="2 values for 3 joints: knuckle, a/b, tip"):
                robot.send_joints("right", [0.1, 0.2])
            robot.send_joints("right", np.array([0.1, 0.2, 0.3]), t_ns=NOW, position_std_rad=0.01)
            for _ in range(1000):
                made.poll(NOW)
                if (found := buffer.interpolate(NOW)).position_rad[0] == 0.1:
                    break
                time.sleep(0.01)
            assert found.position_rad.tolist() == [0.1, 0.2, 0.3]
        finally:
            made.close()
            authenticator.close()


def test_robot_client_refuses_missing_values(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        with pytest.raises(ValueError, match=r"same names.*b"):
            robot.send_joints("right", {"a": 1.0}, velocity_rad_s={"b": 1.0})
        with pytest.raises(ValueError, match="none given"):
            robot.send_forces("right", {}, 0.1)


def test_with_keys_only_control_clients_may_send_inputs(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    key_maker.make_server_keys(folder, "daemon")
    for name, rights in (("viewer", "read"), ("arm", "control")):
        key_maker.add_client(folder, name, rights, tmp_path / name)
    with zmq.Context() as context:
        authenticator = Authenticator.open(context, folder)
        made = InputReceiver.open(
            context, "tcp://127.0.0.1:*", authenticator, {"right": JointStateBuffer(("a",))}, PADS
        )
        try:
            for name in ("arm", "viewer", ""):
                key = str(tmp_path / name) if name else ""
                with Robot(made.endpoint, key) as robot:
                    authorised = _try_to_connect(robot, authenticator, made)
                    assert authorised == (name == "arm")
            _poll_until_refused(authenticator, 2)
        finally:
            made.close()
            authenticator.close()
    assert authenticator.refused["no_right"] >= 1
    assert sum(authenticator.refused.values()) >= 2  # without a key it may also look like garbage


def _poll_until_refused(authenticator: Authenticator, count: int) -> None:
    """Poll until so many connections are refused: a client's greeting may arrive after it was closed."""
    for number in range(1000):
        authenticator.poll(10**12 + number * 20_000_000)
        if sum(authenticator.refused.values()) >= count:
            return
        time.sleep(0.01)


def _try_to_connect(robot: Robot, authenticator: Authenticator, inputs: InputReceiver) -> bool:
    for number in range(1000):
        authenticator.poll(number * 20_000_000)
        inputs.poll(NOW)
        try:
            if robot.wait_connected(0.01):
                return True
        except PermissionError:
            return False
    raise AssertionError("neither authorised nor refused")


def test_the_documentation_lists_every_cause() -> None:
    page = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()
    assert all(f"`{cause}`" in page for cause in DROP_CAUSES)
