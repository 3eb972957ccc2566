"""Any fault at any time is reported, affects no other node, and ends with its cause."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import IdleSettings
from handtouch.config import shipped
from handtouch.config.channels import WritableObject, parse_writable_object

MS = 1_000_000
Make = Callable[..., Any]
OPERATIONAL, FAULTED, ABSENT = NodeState.OPERATIONAL, NodeState.FAULTED, NodeState.ABSENT
DELTAS = tuple(WritableObject(0x6426, sub, 4) for sub in (1, 2, 3, 4))
KIND = {
    "eds": str(shipped.path("handtouch-node.eds")),
    "idle": IdleSettings(50, 100, 50, DELTAS, WritableObject(0x6423, 0, 1)),
    "excitation": parse_writable_object("0x2100:0:u8"),
}
OBJECTS = [  # all that are read or written when a node boots, and whether it can do without
    ((0x1018, 1), False),
    ((0x1018, 2), False),
    ((0x1018, 3), False),
    ((0x1018, 4), False),
    ((0x1001, 0), True),
    ((0x1003, 0), True),
    ((0x1A01, 0), False),
    ((0x1A01, 1), False),
    ((0x1A01, 4), False),
    ((0x1801, 1), False),
    ((0x1801, 2), False),
    ((0x1801, 3), True),
    ((0x1801, 5), True),
    ((0x6426, 1), True),
    ((0x6426, 4), True),
    ((0x6423, 0), True),
    ((0x2100, 0), False),
    ((0x1017, 0), False),
]
DISPENSABLE = {(0x1001, 0), (0x1003, 0), (0x1018, 2), (0x1018, 3), (0x1018, 4)}
REQUESTS = range(1, 45)


def booted(rig: Any, ms: int) -> None:
    rig.plug_all()
    rig.start()
    rig.run(ms)


def test_boot_uses_these_objects(make_rig: Make) -> None:
    """The list above is all that a boot touches."""
    rig = make_rig(1, **KIND)
    booted(rig, 200)
    requests = [data for can_id, data in rig.wire.sent if can_id == 0x601]
    touched = {(int.from_bytes(data[1:3], "little"), data[3]) for data in requests}
    between = {(0x1A01, 2), (0x1A01, 3), (0x6426, 2), (0x6426, 3)}
    probed = {(0x1000, 0)}
    assert touched - between - probed == {where for where, _ in OBJECTS}
    assert rig.node(1).sdo.requests == REQUESTS[-1]


@pytest.mark.parametrize("code", [0x08000000, 0x06010000, None], ids=["general", "access", "silence"])
@pytest.mark.parametrize(("where", "optional"), OBJECTS, ids=[f"{i:04X}:{s}" for (i, s), _ in OBJECTS])
def test_failing_object_is_named_and_retried(
    make_rig: Make, where: tuple[int, int], optional: bool, code: int | None
) -> None:
    rig = make_rig(2, **KIND)
    rig.node(1).sdo.fail[where] = code
    booted(rig, 300)
    assert rig.state(2) is OPERATIONAL
    if where in DISPENSABLE and code is None:
        rig.run(3000)  # asked for twice
    if where in DISPENSABLE or (optional and code is not None):
        assert rig.state(1) is OPERATIONAL
        assert rig.master.can_idle(0) == (where in DISPENSABLE)
        return
    assert rig.state(1) is FAULTED
    assert f"0x{where[0]:04X}:{where[1]:02X}" in rig.status(1).reason
    assert ("no answer" in rig.status(1).reason) == (code is None)
    rig.run(1000)
    rig.node(1).sdo.fail.clear()
    for _ in range(52):
        if rig.state(1) is not OPERATIONAL:
            rig.run(100)
    assert rig.state(1) is OPERATIONAL
    assert rig.master.can_idle(0)


@pytest.mark.parametrize("code", [0x08000000, None], ids=["abort", "silence"])
@pytest.mark.parametrize("nth", REQUESTS)
def test_one_failure_at_any_step_costs_one_attempt_at_most(
    make_rig: Make, nth: int, code: int | None
) -> None:
    rig = make_rig(1, **KIND)
    rig.node(1).sdo.fail_nth = {nth: code}
    booted(rig, 500)
    assert rig.state(1) is OPERATIONAL
    assert rig.node(1).state == "OPERATIONAL"


@pytest.mark.parametrize("garble", ["toggle", "object", "noise"])
def test_garbled_responses_are_a_fault_while_they_last(make_rig: Make, garble: str) -> None:
    rig = make_rig(2, **KIND)
    rig.node(1).sdo.garble = garble
    booted(rig, 3000)
    assert rig.state(2) is OPERATIONAL
    if garble == "toggle":  # of segments, of which none is needed
        assert rig.state(1) is OPERATIONAL
        return
    assert rig.state(1) is FAULTED
    assert "0x1018:01" in rig.status(1).reason
    assert "unexpected" not in rig.status(1).reason
    rig.node(1).sdo.garble = None
    rig.run(5200)
    assert rig.state(1) is OPERATIONAL


def test_frozen_sdo_server_of_a_running_node_has_no_effect(make_rig: Make) -> None:
    rig = make_rig(1, **KIND)
    rig.boot()
    rig.node(1).sdo.frozen = True
    assert rig.run(5000) == []
    rig.node(1).reboot()
    rig.run(500)
    assert rig.state(1) is FAULTED
    assert "no answer within 5 ms in 2 attempts; is its SDO server running" in rig.status(1).reason


@settings(
    max_examples=20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(
    st.lists(st.tuples(st.integers(0, 400), st.integers(1, 2), st.integers(0, 600)), min_size=1, max_size=8)
)
def test_brown_outs_at_any_time_end_operational(make_rig: Make, faults: list[tuple[int, int, int]]) -> None:
    """(pause, node, away for) [ms]; from power-on, so that they hit every step of the boot."""
    rig = make_rig(2, **KIND)
    rig.plug_all()
    rig.start()
    for pause_ms, number, away_ms in faults:
        rig.run(pause_ms)
        rig.node(number).brown_out(away_ms * MS)
    rig.run(600 + 1000)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL] * 2
    assert [rig.node(n).state for n in (1, 2)] == ["OPERATIONAL"] * 2
    assert rig.run(1000) == []


@settings(
    max_examples=20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["power", "data", "beat", "sdo", "noise", "bus-off", "nmt", "cable", "sync"]),
            st.integers(1, 700),
        ),
        min_size=1,
        max_size=10,
    )
)
def test_any_faults_one_after_another_end_operational(make_rig: Make, faults: list[tuple[str, int]]) -> None:
    """Within the longest pause and the time to boot after the last one."""
    rig = make_rig(2)
    rig.plug_all()
    rig.start()
    for fault, lasts_ms in faults:
        cause(rig, fault, lasts_ms)
    rig.run(6000)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL] * 2, rig.status(1).reason
    assert rig.node(1).state == "OPERATIONAL"
    assert rig.run(1000) == []


def cause(rig: Any, fault: str, lasts_ms: int) -> None:
    """One fault of node 1, then none."""
    node = rig.node(1)
    match fault:
        case "power":
            node.unplug()
        case "data":
            node.send_data = False
        case "beat":
            node.send_heartbeat = False
        case "sdo":
            node.sdo.frozen = True
        case "noise":
            node.sdo.garble = "noise"
        case "bus-off":
            node.bus_off(lasts_ms * MS)
        case "nmt":
            node.handle_nmt(2)
        case "cable":
            rig.wire.cut = {1}
        case "sync":
            rig.syncs = False
    rig.run(lasts_ms)
    node.send_data = node.send_heartbeat = rig.syncs = True
    node.sdo.frozen, node.sdo.garble, rig.wire.cut = False, None, set()
    node.plug()


def test_heartbeat_without_data_is_reported_once(rig: Any) -> None:
    rig.boot()
    rig.node(1).send_data = False
    events = rig.run(10_000)
    assert [e.new_state for e in events] == [NodeState.STALE] * 2
    assert "heartbeat present" in events[0].reason
    assert "; its PDO and heartbeat settings are as configured" in events[1].reason


def test_node_whose_samples_are_too_short_is_stale_and_they_are_counted(rig: Any) -> None:
    rig.boot()
    rig.node(1).frame_bytes = 7
    events = rig.run(1000)
    assert {e.new_state for e in events} == {NodeState.STALE}
    assert rig.port.counters.wrong_length >= 199
    rig.node(1).frame_bytes = None
    rig.run(10)
    assert rig.state(1) is OPERATIONAL


def test_node_that_answers_one_probe_and_nothing_else_does_not_flap(rig: Any) -> None:
    """No heartbeat, and silent but for its device type: every try later than the one before."""
    rig.node(1).write_object(0x1017, 0, 0, keep=True)
    rig.node(1).sdo.fail[0x1018, 1] = None
    rig.plug_all()
    rig.start()
    events = [e for e in rig.run(20_000) if e.slot == 0]
    assert len(events) < 20
    assert rig.state(1) is FAULTED
    assert "0x1018:01" in rig.status(1).reason
