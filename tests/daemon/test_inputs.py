"""What robots tell is taken in, or counted and dropped with its cause; nothing that arrives is fatal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from handtouch import keys
from handtouch.daemon.inputs import Inputs
from handtouch.daemon.security import Gate
from handtouch.hand.joints import JointStates
from handtouch.inputs import InputError, JointCommand, JointState, LinkForces, decode, encode
from handtouch.robot import Robot
from handtouch.supervise.strength import ForceReference

NOW = 10**12
PADS = [("left", "tip"), ("right", "tip"), ("right", "palm")]
finite = st.floats(-1e6, 1e6)


@st.composite
def _inputs(draw: st.DrawFn) -> JointState | LinkForces:
    names = tuple(draw(st.lists(st.text(max_size=9), min_size=1, max_size=5, unique=True)))
    column = st.lists(finite, min_size=len(names), max_size=len(names)).map(np.array)
    positive = column.map(np.abs)
    t_ns = draw(st.none() | st.integers(0, 2**62))
    if draw(st.booleans()):
        return LinkForces("right", t_ns, names, draw(column), draw(positive))
    others = (draw(st.none() | column), draw(st.none() | column), draw(st.none() | positive))
    down = draw(st.none() | st.sampled_from([np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])]))
    return JointState("right", t_ns, names, draw(column), *others, down)


def _same(one: Any, two: Any) -> bool:
    return type(one) is type(two) and all(
        np.array_equal(getattr(one, name), getattr(two, name)) for name in type(one).__slots__
    )


@given(_inputs())
def test_every_input_survives_the_wire(message: JointState | LinkForces) -> None:
    assert _same(decode(encode(message)), message)


@given(_inputs(), st.data())
def test_a_missing_or_wrong_key_is_refused_by_name(
    message: JointState | LinkForces, data: st.DataObject
) -> None:
    topic, payload = encode(message)
    content = msgpack.unpackb(payload)
    key = data.draw(st.sampled_from(sorted(content)))
    wrong: Any
    for wrong in ("x", [["x"]], [float("nan")] * 5, {}):
        with pytest.raises(InputError, match=key):
            decode([topic, msgpack.packb({**content, key: wrong})])
    if key in ("v", "names", "links", "position_rad", "force_n", "std_n"):
        del content[key]
        with pytest.raises(InputError, match=key):
            decode([topic, msgpack.packb(content)])


@pytest.mark.parametrize("given", [[0.0, 0.0, 0.0], [1.0, 0.0], [1e400, 0.0, 1.0], "down"])
def test_gravity_that_points_nowhere_is_refused_by_name(given: object) -> None:
    payload = {"v": 1, "t_ns": None, "names": ["a"], "position_rad": [0.1], "gravity": given}
    with pytest.raises(InputError, match="gravity"):
        decode([b"joints/right", msgpack.packb(payload)])


def test_gravity_of_any_length_is_a_direction_and_the_last_that_was_told_holds(inputs: Inputs) -> None:
    assert inputs.down_at("right") is None
    for number, gravity in enumerate([[0.0, 0.0, -9.81], None, [1e300, 0.0, 0.0], None]):
        payload = {"v": 1, "t_ns": NOW + number, "names": ["a"], "position_rad": [0.1], "gravity": gravity}
        inputs.take([b"joints/right", msgpack.packb(payload)], NOW + number)
        down = inputs.down_at("right")
        assert down is not None
        assert down.tolist() == ([0.0, 0.0, -1.0] if number < 2 else [1.0, 0.0, 0.0])


@given(st.sampled_from([b"joints/right", b"force/right", b"joints", b"x/y", b"\xff"]), st.binary(max_size=50))
def test_any_bytes_are_refused_but_never_fatal(topic: bytes, payload: bytes) -> None:
    with pytest.raises(InputError):
        decode([topic, payload])


@pytest.fixture
def inputs() -> Any:
    with zmq.Context() as context:
        states = {"right": JointStates(("a", "b"))}
        made = Inputs(context, "tcp://127.0.0.1:*", Gate(context), states, PADS)
        yield made
        made.close()


def joints(hand: str = "right", t_ns: int | None = NOW, names: tuple[str, ...] = ("a", "b")) -> list[bytes]:
    return encode(JointState(hand, t_ns, names, np.full(len(names), 0.5)))


@pytest.mark.parametrize(
    ("parts", "cause", "said"),
    [
        ([b"joints/right", b"\xc1"], "malformed", "msgpack"),
        ([b"joints/right"], "malformed", "1 parts"),
        (joints("nobody"), "unknown_hand", "joints/nobody; there are left, right"),
        (joints("left"), "no_urdf", "joints/left"),
        (joints(names=("x", "y")), "unknown_joints", "tells x, y; the URDF has a, b"),
        (joints(t_ns=NOW + 10**15), "clock", "s off; leave it nil"),
        (joints(t_ns=5), "clock", "s off"),
        (encode(JointCommand("right", NOW, ("x",), np.ones(1))), "unknown_joints", "command/right tells x"),
        (encode(LinkForces("right", NOW, ("toe",), np.ones(1), np.ones(1))), "unknown_link", "'toe'"),
    ],
)
def test_what_can_not_be_used_is_counted_and_named(
    inputs: Any, parts: list[bytes], cause: str, said: str
) -> None:
    inputs.take(parts, NOW)
    figures = inputs.figures(NOW)
    assert figures["dropped"] == {cause: 1}
    assert said in figures["problem"]
    assert not figures["received"]


def test_states_of_the_same_time_are_late_and_those_without_a_time_are_of_now(inputs: Any) -> None:
    inputs.take(joints(), NOW)
    inputs.take(joints(), NOW)
    inputs.take(joints(t_ns=None), NOW + 5)
    assert inputs.dropped == {"late": 1}
    assert inputs.joints_at("right", NOW + 5).age_s.tolist() == [0.0, 0.0]
    assert inputs.joints_at("left", NOW) is None
    assert inputs.figures(NOW + 10**9)["age_s"]["joints/right"] == pytest.approx(1.0)


def test_commands_are_kept_apart_from_joint_states_and_hold(inputs: Any) -> None:
    assert inputs.commands_at("right", NOW) is None
    inputs.take(encode(JointCommand("right", NOW, ("b",), np.array([0.7]))), NOW)
    told = inputs.commands_at("right", NOW + 10**9)
    assert told.position_rad.tolist() == pytest.approx([np.nan, 0.7], nan_ok=True)
    assert np.isnan(inputs.joints_at("right", NOW).position_rad).all()
    assert inputs.received == {"command/right": 1}
    inputs.take(encode(JointCommand("left", NOW, ("b",), np.array([0.7]))), NOW)
    assert inputs.dropped == {"no_urdf": 1}


def test_forces_are_handed_over_by_pad(inputs: Any) -> None:
    told: list[ForceReference] = []
    inputs.refer = told.append
    message = LinkForces("right", NOW, ("toe", "palm"), np.array([1.0, 2.0]), np.array([0.3, 0.1]))
    inputs.take(encode(message), NOW)
    (reference,) = told
    assert (reference.pads.tolist(), reference.force_n.tolist()) == ([2], [2.0])
    assert (reference.std_n.tolist(), reference.t_ns) == ([0.1], NOW)
    assert inputs.dropped == {"unknown_link": 1}


def test_a_flood_costs_a_bounded_number_of_messages_a_period(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        while not robot.connected(0.05):  # the daemon polls in every period
            inputs.poll(NOW)
        for number in range(60):
            robot.send_joints("right", {"a": 0.1}, t_ns=NOW + number)
        before = -1
        while sum(inputs.received.values()) < 16:  # the sender's own queue holds 16 while the wire is slow
            inputs.poll(NOW)
            assert sum(inputs.received.values()) - max(before, 0) <= 32
            before = sum(inputs.received.values())


def test_the_robots_side_refuses_numbers_that_are_none(inputs: Any) -> None:
    with Robot(inputs.endpoint, key="") as robot:
        with pytest.raises(ValueError, match="not finite: a"):
            robot.send_joints("right", {"a": float("nan")})
        with pytest.raises(ValueError, match=r"same names.*b"):
            robot.send_joints("right", {"a": 1.0}, velocity_rad_s={"b": 1.0})
        with pytest.raises(ValueError, match="there are none"):
            robot.send_forces("right", {}, 0.1)


def test_with_keys_only_those_who_may_control_may_tell(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    keys.make(folder, "daemon")
    for name, rights in (("viewer", "read"), ("arm", "control")):
        keys.add_client(folder, name, rights, tmp_path / name)
    with zmq.Context() as context:
        gate = Gate(context, folder)
        made = Inputs(context, "tcp://127.0.0.1:*", gate, {"right": JointStates(("a",))}, PADS)
        try:
            for name in ("arm", "viewer", ""):
                key = str(tmp_path / name) if name else ""
                with Robot(made.endpoint, key) as robot:
                    let_in = _knock(robot, gate, made)
                    assert let_in == (name == "arm")
            gate.poll(10**12)
        finally:
            made.close()
            gate.close()
    assert gate.refused["no_right"] >= 1
    assert sum(gate.refused.values()) >= 2  # without a key it may also look like garbage


def _knock(robot: Robot, gate: Gate, inputs: Inputs) -> bool:
    for number in range(1000):
        gate.poll(number * 20_000_000)
        inputs.poll(NOW)
        try:
            if robot.connected(0.01):
                return True
        except PermissionError:
            return False
    raise AssertionError("neither let in nor refused")
