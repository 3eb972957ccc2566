"""The master boots, supervises and recovers the nodes of a hand."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import SerialChanged
from handtouch.config import shipped
from handtouch.config.eds import EdsError

from .conftest import Jobs

OPERATIONAL, ABSENT, FAULTED = NodeState.OPERATIONAL, NodeState.ABSENT, NodeState.FAULTED
NMT_START, NMT_STOP, NMT_PREOPERATIONAL = 1, 2, 128
Make = Callable[..., Any]


def nmt(rig: Any) -> list[tuple[int, int]]:
    """NMT commands the master has sent: (command, node id)."""
    return [(data[0], data[1]) for can_id, data in rig.wire.sent if can_id == 0]


def test_a_hand_becomes_operational_and_its_samples_are_in_the_slab(rig: Any) -> None:
    rig.boot()
    rig.counts[1] = (-1, 2, -3, 32767)
    rig.run(10)
    assert rig.slab.unpack_counts().tolist() == [[10, 20, 30, 40], [-1, 2, -3, 32767], [10, 20, 30, 40]]
    assert [s.cob_ids for s in rig.master.status()] == [(0x281,), (0x282,), (0x283,)]
    assert [s.serial for s in rig.master.status()] == [101, 102, 103]
    assert rig.port.counters.unknown_frames == 0


def test_boot_goes_through_every_state_in_order(rig: Any) -> None:
    rig.start()
    rig.node(2).plug()
    events = [e for e in rig.run(300) if e.slot == 1]
    assert [e.new_state.name for e in events] == [
        "BOOTING",
        "IDENTIFIED",
        "CONFIGURING",
        "SETTLING",
        "OPERATIONAL",
    ]
    assert all(
        e.old_state == previous
        for e, previous in zip(events[1:], [e.new_state for e in events], strict=False)
    )
    assert rig.state(1) is ABSENT


def test_first_three_samples_after_start_are_discarded(rig: Any) -> None:
    """The slab holds the fourth sample when a node becomes operational."""
    rig.plug_all()
    rig.start()
    trusted_at = None
    before = 0
    for _ in range(100):
        rig.run(1)
        if trusted_at is None and rig.state(1) is OPERATIONAL:
            trusted_at = rig.port.counters.samples - before
        if rig.state(1) in (NodeState.CONFIGURING, ABSENT, NodeState.IDENTIFIED):
            before = rig.port.counters.samples
    assert trusted_at == 4 * rig.size


def test_heartbeat_time_of_the_configuration_is_set(make_rig: Make) -> None:
    rig = make_rig(heartbeat_ms=50, heartbeat_timeout_ms=175)
    rig.boot()
    before = rig.status(1).heartbeats
    rig.run(500)
    assert rig.status(1).heartbeats - before == 10
    assert rig.status(1).heartbeats_missed == 0


def test_every_nmt_command_names_one_node(rig: Any) -> None:
    rig.plug_all()
    rig.start()
    rig.run(300)
    rig.node(1).reboot()
    rig.run(300)
    rig.master.stop(rig.t_ns)
    commands = nmt(rig)
    assert {node_id for _, node_id in commands} == {1, 2, 3}
    assert commands[-3:] == [(NMT_PREOPERATIONAL, 1), (NMT_PREOPERATIONAL, 2), (NMT_PREOPERATIONAL, 3)]
    assert rig.node(1).state == "PRE-OPERATIONAL"  # silent, and its objects can be read
    assert rig.state(1) is NodeState.STOPPED


def test_stop_leaves_a_wrong_device_alone(make_rig: Make) -> None:
    rig = make_rig()
    rig.specs[1] = rig.spec(2, serial=999)
    rig.restart()
    rig.plug_all()
    rig.start()
    rig.run(300)
    before = len(nmt(rig))
    rig.master.stop(rig.t_ns)
    assert nmt(rig)[before:] == [(NMT_PREOPERATIONAL, 1), (NMT_PREOPERATIONAL, 3)]


def test_nothing_is_sent_before_start(rig: Any) -> None:
    rig.plug_all()
    assert rig.wire.sent == []


def test_after_a_restart_running_nodes_continue_unchanged(rig: Any) -> None:
    rig.boot()
    rig.restart()
    rig.start()
    rig.run(300)
    assert (rig.master.states == OPERATIONAL).all()
    assert [c for c in nmt(rig) if c[0] != NMT_START] == []
    writes = [data for can_id, data in rig.wire.sent if can_id > 0x600 and data[0] & 0xE0 == 0x20]
    assert writes == []


def test_running_node_becomes_pre_operational_only_for_a_pdo_change(rig: Any) -> None:
    rig.boot()
    rig.node(1).write_object(0x1801, 2, 10)
    rig.restart()
    rig.start()
    rig.run(100)
    assert (rig.master.states == OPERATIONAL).all()
    assert rig.node(1).read_object(0x1801, 2) == 1
    assert (NMT_PREOPERATIONAL, 1) in nmt(rig)
    assert {node_id for command, node_id in nmt(rig) if command == NMT_PREOPERATIONAL} == {1}


def test_nodes_found_stopped_are_started(rig: Any) -> None:
    rig.boot()
    rig.master.stop(rig.t_ns)
    rig.restart()
    rig.start()
    rig.run(300)
    assert (rig.master.states == OPERATIONAL).all()


def test_missing_node_is_reported_and_probed_while_the_others_work(rig: Any) -> None:
    rig.start()
    rig.node(1).plug()
    rig.node(3).plug()
    rig.run(2000)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL, ABSENT, OPERATIONAL]
    assert rig.status(2).reason.startswith(
        "no message received yet; check that its program runs, its node id"
    )
    probes = [can_id for can_id, _ in rig.wire.sent if can_id == 0x602]
    assert 3 <= len(probes) <= 10  # again and again, but ever less often
    rig.node(2).plug()
    rig.run(300)
    assert rig.state(2) is OPERATIONAL


@pytest.mark.parametrize("lost", [1, 2], ids=["one lost answer", "two lost answers"])
def test_node_absent_for_long_is_up_within_half_a_second_of_its_boot_up(rig: Any, lost: int) -> None:
    rig.start()
    rig.run(20_000)  # probes are 5 s apart by now
    server = rig.node(1).sdo
    server.fail_nth = {server.requests + n: None for n in range(1, lost + 1)}
    rig.node(1).plug()
    rig.run(500)
    assert server.requests > lost
    assert rig.state(1) is OPERATIONAL


def test_node_that_sends_neither_boot_up_nor_heartbeat_is_found(rig: Any) -> None:
    device = rig.node(1)
    device.write_object(0x1017, 0, 0, keep=True)
    device.plug()
    rig.wire.to_master.clear()
    rig.start()
    rig.run(300)
    assert rig.state(1) is OPERATIONAL


@pytest.mark.parametrize("found_by", ["power", "cable"])
def test_unplugged_node_is_stale_then_lost_then_operational_again(rig: Any, found_by: str) -> None:
    rig.boot()
    device = rig.node(2)
    if found_by == "power":
        device.unplug()
    else:
        rig.wire.cut.add(2)
    events = rig.run(600)
    assert [e.new_state for e in events] == [NodeState.STALE, NodeState.STALE, ABSENT]
    assert "are being checked" in events[0].reason
    assert "can't be read" in events[1].reason
    assert "no heartbeat for 35" in events[2].reason
    stale, _, lost = ((e.event_ns - (rig.t_ns - 600_000_000)) // 1_000_000 for e in events)
    assert 15 <= stale <= 21
    assert 250 <= lost <= 352
    assert [rig.state(n) for n in (1, 3)] == [OPERATIONAL] * 2
    device.plug()
    rig.wire.cut.clear()
    rig.run(300)
    assert rig.state(2) is OPERATIONAL
    assert rig.node(2).state == "OPERATIONAL"


def test_node_without_heartbeat_is_present_while_its_samples_arrive(rig: Any) -> None:
    rig.boot()
    rig.node(1).send_heartbeat = False
    events = rig.run(10_000)
    assert {e.new_state for e in events} == {OPERATIONAL}
    assert "slow heartbeat: none for 350 ms" in rig.status(1).reason
    rig.node(1).send_heartbeat = True
    rig.run(500)
    assert (rig.state(1), rig.status(1).reason) == (OPERATIONAL, "")


def test_node_without_heartbeat_and_samples_is_lost_and_tried_less_and_less_often(rig: Any) -> None:
    rig.boot()
    rig.node(1).send_heartbeat = rig.node(1).send_data = False
    events = rig.run(10_000)
    assert ABSENT in [e.new_state for e in events]
    assert OPERATIONAL not in [e.new_state for e in events]
    assert events[-1].new_state is FAULTED
    assert "answers over SDO, but sends no heartbeat" in events[-1].reason
    starts = [e.event_ns for e in events if e.new_state is NodeState.SETTLING]
    pauses = [b - a for a, b in itertools.pairwise(starts)]
    assert pauses == sorted(pauses)
    assert len(starts) < 10
    rig.node(1).send_heartbeat = rig.node(1).send_data = True
    rig.run(5300)
    assert rig.state(1) is OPERATIONAL


def test_heartbeat_without_data_is_stale_until_data_come(rig: Any) -> None:
    rig.boot()
    rig.node(1).send_data = False
    rig.run(1000)
    assert rig.state(1) is NodeState.STALE
    rig.node(1).send_data = True
    rig.run(6)
    assert rig.state(1) is OPERATIONAL


def test_without_sync_all_are_stale_and_come_back_with_it(rig: Any) -> None:
    rig.boot()
    rig.syncs = False
    rig.run(1000)
    assert (rig.master.states == NodeState.STALE).all()
    rig.syncs = True
    rig.run(6)
    assert (rig.master.states == OPERATIONAL).all()


def test_missing_sync_at_the_start_is_reported(rig: Any) -> None:
    rig.syncs = False
    rig.plug_all()
    rig.start()
    rig.run(1200)
    assert rig.state(1) is NodeState.STALE
    assert "SYNC" in rig.status(1).reason
    rig.syncs = True
    rig.run(30)
    assert rig.state(1) is OPERATIONAL


def test_node_that_reboots_by_itself_is_configured_again(rig: Any) -> None:
    rig.boot()
    rig.node(1).reboot()
    events = rig.run(300)
    assert (events[0].new_state, events[0].reason) == (NodeState.BOOTING, "rebooted by itself")
    assert events[-1].new_state is OPERATIONAL
    assert rig.status(1).reboots == 1
    assert nmt(rig) == [(NMT_START, 1)]


def test_reboot_with_a_lost_boot_up_message_is_detected(rig: Any) -> None:
    rig.boot()
    rig.run(300)  # so that the start is long past
    rig.node(1).reboot()
    rig.wire.to_master.clear()
    rig.run(500)
    assert rig.state(1) is OPERATIONAL
    assert rig.node(1).state == "OPERATIONAL"


def test_lost_start_command_is_repeated(rig: Any) -> None:
    rig.plug_all()
    rig.start()
    rig.run(2)
    while rig.state(1) is not NodeState.SETTLING:
        rig.run(1)
    rig.node(1).handle_nmt(NMT_PREOPERATIONAL)  # as if the command was lost
    rig.run(600)
    assert rig.state(1) is OPERATIONAL


def test_bus_that_is_down_is_survived(rig: Any) -> None:
    rig.boot()
    rig.wire.down = True
    rig.wire.cut = {1, 2, 3}
    rig.run(3000)
    assert (rig.master.states == ABSENT).all()
    assert rig.port.counters.send_failures > 3
    rig.wire.down = False
    rig.wire.cut = set()
    rig.run(300)
    assert (rig.master.states == OPERATIONAL).all()


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({"vendor_id": 0x123}, "vendor id is 0 (0x0), configured is 291 (0x123)"),
        ({"product_code": 7}, "product code is 1025 (0x401), configured is 7 (0x7)"),
        ({"serial": 5}, "serial number is 101 (0x65), configured is 5 (0x5)"),
    ],
)
def test_wrong_identity_is_a_fault_with_both_numbers(
    make_rig: Make, spec: dict[str, int], expected: str
) -> None:
    rig = make_rig(1, **spec)
    rig.plug_all()
    rig.start()
    rig.run(1000)
    assert rig.state(1) is FAULTED
    assert expected in rig.status(1).reason
    assert f"connect the configured node, or correct {next(iter(spec))} in the deploy" in rig.status(1).reason
    assert "\n" not in rig.status(1).reason
    assert nmt(rig) == []  # it is not ours: neither started nor stopped


def test_replaced_node_is_faulted_until_the_right_one_is_back(make_rig: Make) -> None:
    rig = make_rig(1, serial=101)
    rig.boot()
    rig.node(1).replace_device(7)
    expected = rig.run(500)
    assert rig.state(1) is FAULTED
    assert [(e.old_serial, e.new_serial) for e in expected if isinstance(e, SerialChanged)] == [(101, 7)]
    rig.node(1).replace_device(101)
    rig.run(500)
    assert rig.state(1) is OPERATIONAL


def test_changed_serial_number_is_reported_if_none_is_configured(rig: Any) -> None:
    rig.boot()
    rig.node(1).replace_device(7)
    expected = [e for e in rig.run(500) if isinstance(e, SerialChanged)]
    assert [(e.slot, e.old_serial, e.new_serial) for e in expected] == [(0, 101, 7)]
    assert str(expected[0]).startswith("node replaced: serial number 101 -> 7")
    assert rig.status(1).serial == 7
    assert rig.state(1) is OPERATIONAL


STEPS = {
    "vendor id": (0x1018, 1),
    "mapping count": (0x1A01, 0),
    "mapping entry": (0x1A01, 3),
    "identifier": (0x1801, 1),
    "transmission type": (0x1801, 2),
    "heartbeat time": (0x1017, 0),
}


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(
    ("code", "expected"), [(0x08000000, "General error"), (None, "no answer")], ids=["abort", "silence"]
)
def test_failing_sdo_at_any_step_is_a_fault_with_its_object_and_is_retried(
    rig: Any, step: str, code: int | None, expected: str
) -> None:
    rig.node(1).sdo.fail[STEPS[step]] = code
    rig.plug_all()
    rig.start()
    rig.run(100)
    assert rig.state(1) is FAULTED
    index, sub = STEPS[step]
    assert f"0x{index:04X}:{sub:02X}" in rig.status(1).reason
    assert expected in rig.status(1).reason
    assert [rig.state(n) for n in (2, 3)] == [OPERATIONAL] * 2
    rig.node(1).sdo.fail.clear()
    rig.run(6000)
    assert rig.state(1) is OPERATIONAL


def test_refused_write_is_a_fault_with_its_abort_text(rig: Any) -> None:
    rig.node(1).sdo.fail_write[0x1017, 0] = 0x06010002
    rig.plug_all()
    rig.start()
    rig.run(100)
    assert rig.status(1).reason == (
        "writing heartbeat time, 0x1017:00: refused by the node "
        "(Code 0x06010002, Attempt to write a read only object)"
    )


def test_clash_of_sample_identifiers_is_a_fault_of_both_until_it_ends(rig: Any) -> None:
    rig.node(1).plug()
    rig.start()
    rig.run(100)
    rig.node(2).plug()
    rig.node(2).write_object(0x1801, 1, 0x281)
    rig.run(100)
    for number, other in ((1, "pad2"), (2, "pad1")):
        assert rig.state(number) is FAULTED
        assert f"COB-ID 0x281 of its samples is also that of {other}" in rig.status(number).reason
        assert rig.node(number).state == "PRE-OPERATIONAL"
    before = rig.port.counters.samples
    for number in (1, 2):
        rig.node(number).handle_nmt(1)  # another master starts them: their samples belong to no pad
    rig.run(1000)
    assert rig.port.counters.samples == before
    rig.node(2).write_object(0x1801, 1, 0x282)
    rig.run(12_000)
    assert [rig.state(number) for number in (1, 2)] == [OPERATIONAL] * 2


def test_moved_identifier_is_followed(rig: Any) -> None:
    rig.node(1).write_object(0x1801, 1, 0x80000000 | 0x3F0, keep=True)  # another identifier, and switched off
    rig.plug_all()
    rig.start()
    rig.run(300)
    assert rig.status(1).cob_ids == (0x3F0,)
    assert rig.state(1) is OPERATIONAL


def test_emergencies_are_kept_as_text_and_bounded(rig: Any) -> None:
    rig.boot()
    for code in range(0x2310, 0x2310 + 40):
        rig.node(1).send_emergency(code, 2)
        rig.pump()
    rig.node(1).send_emergency(0x8120, 0x11)
    rig.pump()
    kept = rig.status(1).emergencies
    assert len(kept) == 16
    assert kept[-1].text == "0x8120 CAN in error passive mode (register: communication)"
    assert rig.state(1) is OPERATIONAL


@pytest.mark.parametrize("can_id", [0x7F, 0x181 + 40, 0x701 + 40, 0x7FF, 0x6A0])
def test_frames_of_unknown_nodes_are_counted_and_dropped(rig: Any, can_id: int) -> None:
    rig.boot()
    rig.inject(can_id, b"\x05")
    assert rig.port.counters.unknown_frames == 1
    assert (rig.master.states == OPERATIONAL).all()


@pytest.mark.parametrize("can_id", [0x080, 0x000, 0x100, 0x601, 0x182])
def test_the_masters_own_frames_and_known_ones_are_not_foreign(rig: Any, can_id: int) -> None:
    rig.boot()
    rig.inject(can_id, b"")
    assert rig.port.counters.unknown_frames == 0


@pytest.mark.parametrize("can_id", [0x281, 0x701, 0x581, 0x081])
@pytest.mark.parametrize("data", [b"", b"\x00" * 7, b"\x00" * 2])
def test_wrong_length_is_counted_and_changes_nothing(rig: Any, can_id: int, data: bytes) -> None:
    rig.boot()
    before = rig.slab.unpack_counts().copy()
    rig.inject(can_id, data)
    assert rig.port.counters.wrong_length == 1
    assert (rig.master.states == OPERATIONAL).all()
    np.testing.assert_array_equal(rig.slab.unpack_counts(), before)
    assert rig.status(1).emergencies == ()


def test_unsolicited_sdo_responses_are_ignored(rig: Any) -> None:
    rig.boot()
    for _ in range(100):
        rig.inject(0x581, bytes(8))
    assert rig.run(50) == []
    assert rig.master._nodes[0].sdo._client.responses.qsize() == 0


def test_events_that_are_not_drained_are_bounded(rig: Any) -> None:
    rig.boot()
    for _ in range(400):
        rig.node(1).reboot()
        rig.pump()
        rig.master.poll(rig.t_ns)
    assert len(rig.master.drain_events()) <= 1024
    assert rig.master.drain_events() == []


def test_shipped_eds_is_understood(make_rig: Make) -> None:
    rig = make_rig(1, eds=str(shipped.path("handtouch-node.eds")))
    rig.boot()
    assert rig.state(1) is OPERATIONAL


def test_unusable_eds_is_named(make_rig: Make, tmp_path: Any) -> None:
    (tmp_path / "broken.eds").write_text("[1000]\nParameterName\n")
    with pytest.raises(EdsError, match=r"broken\.eds"):
        make_rig(1, eds=str(tmp_path / "broken.eds"))
    with pytest.raises(EdsError, match="No such file"):
        make_rig(1, eds=str(tmp_path / "absent.eds"))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"bus": "other"}, "not open"),
        ({"node_id": 0}, "outside 1 to 127"),
        ({"slot": 9}, "outside the slab"),
        ({"node_id": 1}, "given twice"),
        ({"slot": 0}, "given twice"),
    ],
)
def test_contradictory_nodes_are_refused(rig: Any, change: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        Master({"can": rig.port}, [rig.specs[0], rig.spec(2, **change)])


def test_host_that_cannot_start_a_thread_is_the_reason_until_it_can(
    make_rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(1)

    def fail(*_: Any) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as limited:
        limited.setattr(Jobs, "submit", fail)
        rig.plug_all()
        rig.start()
        rig.run(2000)
        assert rig.state(1) is FAULTED
        assert "can't start new thread: raise this host's limit" in rig.status(1).reason
    rig.run(15_000)
    assert rig.state(1) is OPERATIONAL
