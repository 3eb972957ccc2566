"""Habits of imperfect but real nodes: used as CiA 301 allows, or named; nothing is written on an odd read."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.objects.sdo import BootStepError, NodeSdoClient

Make = Callable[..., Any]
OPERATIONAL, FAULTED = NodeState.OPERATIONAL, NodeState.FAULTED


class Uploads:
    """Objects as a node's responses carry them: bytes, or an error."""

    def __init__(self, found: dict[tuple[int, int], bytes | BootStepError]) -> None:
        self.found, self.requests = found, list[tuple[int, int]]()

    def transfer(self, index: int, sub: int, *_: object) -> bytes | None:
        self.requests.append((index, sub))
        value = self.found[index, sub]
        if isinstance(value, BootStepError):
            raise value
        return value


def client(found: dict[tuple[int, int], bytes | BootStepError]) -> NodeSdoClient:
    return NodeSdoClient(Uploads(found))


@pytest.mark.parametrize(
    ("index", "sub", "size"),
    [
        (0x1001, 0, 1),
        (0x1017, 0, 2),
        (0x1018, 4, 4),
        (0x1805, 1, 4),
        (0x1805, 2, 1),
        (0x1A05, 0, 1),
        (0x1A05, 3, 4),
    ],
)
def test_bytes_behind_an_object_in_a_response_without_a_size_are_ignored(
    index: int, sub: int, size: int
) -> None:
    rubbish = struct.pack("<I", 0xBBAA0304)
    value = int.from_bytes(rubbish[:size], "little")
    assert client({(index, sub): rubbish}).read(index, sub, "object") == value
    assert client({(index, sub): rubbish[:size]}).read(index, sub, "object") == value


def test_object_of_the_manufacturer_has_the_size_that_the_deployment_states() -> None:
    assert client({(0x2100, 0): b"\x01\xaa\xbb\xcc"}).read(0x2100, 0, "excitation", 1) == 1


def test_object_that_isnt_required_may_stay_unanswered_twice() -> None:
    silent = BootStepError("no answer", timed_out=True)
    sdo = client({(0x1018, 3): silent})
    assert sdo.read_if_present(0x1018, 3, "revision") is None
    refused = BootStepError("refused by two nodes")
    with pytest.raises(BootStepError):
        client({(0x1018, 3): refused}).read_if_present(0x1018, 3, "revision")


def test_sample_longer_than_its_mapping_counts_by_its_first_bytes(make_rig: Make) -> None:
    rig = make_rig(1)
    rig.boot()
    port, slot = rig.port, 0
    before = port.counters.wrong_length
    port.router.route(0x281, slot, 0, 6)
    assert port.router.accept_frame(0x281, struct.pack("<4h", 1, 2, 3, 4), rig.t_ns)
    assert port.counters.wrong_length == before
    assert port.slab.unpack_counts()[slot].tolist() == [1, 2, 3, 4]
    assert port.router.accept_frame(0x281, bytes(5), rig.t_ns + 1)
    assert port.counters.wrong_length == before + 1


def test_samples_shorter_than_the_mapping_are_named(make_rig: Make) -> None:
    rig = make_rig(1)
    rig.boot()
    rig.node(1).send_data = False
    for _ in range(400):
        rig.port.router.accept_frame(0x281, bytes(5), rig.t_ns)
        rig.run(1)
    assert rig.state(1) is NodeState.STALE
    assert "its PDO has 5 bytes, its mapping 8" in rig.status(1).reason


@pytest.mark.parametrize("where", [(0x1A01, 0), (0x1801, 1), (0x1018, 1)])
def test_time_out_in_the_boot_names_its_object_where_the_node_answers_others(
    make_rig: Make, where: tuple[int, int]
) -> None:
    rig = make_rig(1)
    rig.node(1).sdo.fail[where] = None
    rig.node(1).send_heartbeat = False
    rig.plug_all()
    rig.start()
    reasons = [event.reason for event in rig.run(3000) if event.new_state is FAULTED]
    assert reasons
    assert all(f"0x{where[0]:04X}:{where[1]:02X}" in reason for reason in reasons)


def test_a_serial_number_that_is_not_answered_is_no_other_node(make_rig: Make) -> None:
    """It is asked again, and the reason names the object: the node or its bus may be busy."""
    rig = make_rig(1, serial=101)
    rig.node(1).sdo.fail[0x1018, 4] = None
    rig.plug_all()
    rig.start()
    reasons = {event.reason for event in rig.run(4000) if event.new_state is FAULTED}
    assert reasons
    assert all("0x1018:04" in reason and "mismatch" not in reason for reason in reasons)
    del rig.node(1).sdo.fail[0x1018, 4]
    rig.run(6000)
    assert rig.state(1) is OPERATIONAL


def test_slow_heartbeat_is_measured_and_its_remedy_named(make_rig: Make) -> None:
    rig = make_rig(1)
    rig.boot()
    rig.node(1).send_heartbeat = False
    for _ in range(4):
        rig.run(1000)
        rig.node(1).send_heartbeat = True
        rig.run(100)
        rig.node(1).send_heartbeat = False
    assert rig.state(1) is OPERATIONAL
    assert "instead of 100 ms" in rig.status(1).reason
    assert "raise heartbeat_timeout_ms" in rig.status(1).reason


def test_a_slow_heartbeats_reason_stays_while_its_period_jitters(make_rig: Make) -> None:
    rig = make_rig(1)
    rig.boot()
    rig.node(1).send_heartbeat = False
    events = []
    rig.inject(0x701, b"\x05")
    for late_ms in (0, 7, -9, 12, -15, 15, -4):
        events += rig.run(1000 + late_ms)
        rig.inject(0x701, b"\x05")
    measured = {event.reason for event in events if "slow heartbeat: every" in event.reason}
    assert len(measured) == 1, measured


def test_fast_heartbeat_is_measured_and_is_no_twin(make_rig: Make) -> None:
    rig = make_rig(2)
    rig.boot()
    rig.node(1).send_heartbeat = False
    events = []
    for _ in range(200):
        rig.inject(0x701, b"\x05")
        events += rig.run(50)
    assert rig.state(1) is NodeState.OPERATIONAL
    assert "fast heartbeat: every 50 ms instead of 100 ms; set heartbeat_ms = 50" in rig.status(1).reason
    assert not [event for event in events if "duplicate" in event.reason]
    for _ in range(100):
        rig.inject(0x701, b"\x05")
        rig.run(100)
    assert (rig.state(1), rig.status(1).reason) == (NodeState.OPERATIONAL, "")


def test_heartbeat_slowed_by_another_client_is_repaired_once_the_node_answers(make_rig: Make) -> None:
    """It beats every second when its settings can be read again, and the pad is used all the time."""
    rig = make_rig(2)
    rig.boot()
    rig.node(1).write_object(0x1017, 0, 1000)
    rig.node(1).sdo.frozen = True
    rig.run(2500)
    assert "slow heartbeat: every 1000 ms instead of 100 ms" in rig.status(1).reason
    rig.node(1).sdo.frozen = False
    rig.run(6000)
    assert rig.node(1).read_object(0x1017, 0) == 100
    assert [rig.state(n) for n in (1, 2)] == [NodeState.OPERATIONAL] * 2
    assert rig.status(1).reason == ""


def test_every_change_of_a_heartbeat_time_is_repaired_soon_and_no_other_cause_is_named(
    make_rig: Make,
) -> None:
    rig = make_rig(2)
    rig.boot()
    for heartbeat_ms in (1000, 0, 1000):
        rig.node(1).write_object(0x1017, 0, heartbeat_ms)
        reasons = {event.reason for event in rig.run(1400)}
        assert rig.node(1).read_object(0x1017, 0) == 100, heartbeat_ms
        expected = f"0x1017:00, heartbeat time, is {heartbeat_ms} instead of 100"
        assert any(expected in reason for reason in reasons)
        assert rig.status(1).reason == ""
        for _ in range(20):
            rig.run(50)
            assert rig.status(1).reason == "", heartbeat_ms


@pytest.mark.parametrize("silent_ms", [700, 1200, 2500])
def test_a_changed_heartbeat_time_is_reported_soon_after_checks_for_another_cause(
    make_rig: Make, silent_ms: int
) -> None:
    rig = make_rig(2)
    rig.boot()
    rig.node(1).send_data = False
    rig.run(silent_ms)  # its settings are checked, again and again
    assert rig.state(1) is NodeState.STALE
    rig.node(1).send_data = True
    rig.run(100)
    rig.node(1).write_object(0x1017, 0, 0)
    reasons = {event.reason for event in rig.run(900)}
    assert any("0x1017:00, heartbeat time, is 0 instead of 100" in reason for reason in reasons)
    rig.run(1000)
    assert rig.node(1).read_object(0x1017, 0) == 100
    assert (rig.state(1), rig.status(1).reason) == (NodeState.OPERATIONAL, "")


def test_nodes_that_boot_together_with_one_cob_id_are_both_faulted_and_neither_is_stale(
    make_rig: Make,
) -> None:
    rig = make_rig(3)
    rig.node(2).write_object(0x1801, 1, 0x281, keep=True)
    rig.plug_all()
    rig.start()
    events = rig.run(3000)
    assert NodeState.STALE not in {event.new_state for event in events}
    for number, other in ((1, 2), (2, 1)):
        assert rig.state(number) is NodeState.FAULTED
        assert f"COB-ID 0x281 of its samples is also that of pad{other}" in rig.status(number).reason
    assert rig.state(3) is NodeState.OPERATIONAL
