"""Nodes that don't stay operational: cause and errors in the reason, growing delays, recovery."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.config import shipped

Make = Callable[..., Any]
MS = 1_000_000
OPERATIONAL, FAULTED, STALE = NodeState.OPERATIONAL, NodeState.FAULTED, NodeState.STALE
START, PREOPERATIONAL, RESET_COMMUNICATION = 1, 128, 130
REMAPPABLE = str(Path(__file__).parent.parent / "data" / "eds" / "feldmann-ai4w.eds")
EDS = {"eds": str(shipped.path("handtouch-node.eds"))}


def nmt(rig: Any) -> list[tuple[int, int]]:
    """Return the NMT commands sent: command and node id."""
    return [(data[0], data[1]) for can_id, data in rig.wire.sent if can_id == 0]


def run_noting(rig: Any, ms: int, command: int) -> list[int]:
    """Run; return the times [ms], to 10 ms, at which the master sent this NMT command to node 1."""
    times = []
    for at in range(0, ms, 10):
        rig.wire.sent.clear()
        rig.run(10)
        times += [at] * nmt(rig).count((command, 1))
    return times


def test_node_that_refuses_operational_is_faulted_with_its_errors(make_rig: Make) -> None:
    rig = make_rig(2, device=EDS)
    rig.node(1).latch_error(0x5000)
    rig.plug_all()
    rig.start()
    rig.run(5000)
    assert rig.state(1) is FAULTED
    reason = rig.status(1).reason
    assert reason.startswith(
        "refuses OPERATIONAL, error register 0x01 (generic), EMCY 0x5000 device hardware, "
        "0x1029:01 = 0 (pre-operational after a communication error); "
    )
    assert rig.state(2) is OPERATIONAL
    rig.node(1).clear_error()
    rig.run(5300)
    assert rig.state(1) is OPERATIONAL
    assert rig.status(1).reason == ""


def test_refusing_node_is_started_less_and_less_often(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS, allow_nmt_reset=False)
    rig.node(1).latch_error(0x5000)
    rig.plug_all()
    rig.start()
    starts = run_noting(rig, 30_000, START)
    pauses = [b - a for a, b in itertools.pairwise(starts)]
    assert pauses[0] < 450
    assert all(b >= a - 100 for a, b in itertools.pairwise(pauses))  # heartbeats come every 100 ms
    assert 5000 <= pauses[-1] <= 5400
    assert len(starts) < 14
    requests = rig.node(1).sdo.requests
    rig.run(10_000)
    assert rig.node(1).sdo.requests - requests <= 3 * 12  # its errors only, not a boot
    assert rig.status(1).reboots == 0  # no reset


def test_errors_before_the_start_of_the_daemon_are_read_from_the_node(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.plug_all()
    rig.node(1).latch_error(0x2310, 3)
    rig.wire.to_master.clear()
    rig.wire.lose = {0x81}  # no EMCY is received
    rig.start()
    rig.run(500)
    assert rig.status(1).emergencies == ()
    assert "error register 0x03 (generic, current)" in rig.status(1).reason
    assert "0x2310 current at the device's output" in rig.status(1).reason
    assert rig.status(1).error_register == 3
    assert rig.status(1).error_history[0] == 0x2310


def test_one_nmt_reset_communication_is_sent_where_allowed(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.node(1).latch_error(0x5000)
    rig.plug_all()
    rig.start()
    rig.run(20_000)
    assert nmt(rig).count((RESET_COMMUNICATION, 1)) == 1
    assert rig.status(1).reboots == 1
    assert rig.state(1) is FAULTED


def test_error_that_a_reset_clears_is_recovered_from(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.node(1).latch_error(0x8240, 0x11)
    rig.plug_all()
    rig.start()
    rig.run(600)
    assert rig.state(1) is FAULTED
    while (RESET_COMMUNICATION, 1) not in nmt(rig):
        rig.run(1)
    rig.node(1).clear_error()
    events = rig.run(600)
    assert rig.state(1) is OPERATIONAL
    assert any("NMT reset communication" in event.reason for event in events)


@pytest.mark.parametrize("role", ["guest", "listener"])
def test_no_nmt_command_is_sent_in_other_roles(make_rig: Make, role: str) -> None:
    rig = make_rig(1, role=role, device=EDS)
    rig.node(1).latch_error(0x5000)
    rig.plug_all()
    rig.start()
    rig.run(10_000)
    assert nmt(rig) == []
    rig.node(1).heartbeat_state = 99
    rig.node(1).write_object(0x1017, 0, 100)
    rig.run(5000)
    assert nmt(rig) == []
    if role == "listener":
        assert rig.wire.sent == [] == rig.wire.asked


def test_node_that_leaves_operational_by_itself_is_booted_with_the_errors_as_reason(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.boot()
    rig.run(500)
    rig.node(1).latch_error(0x8130, 0x11)
    events = rig.run(150)
    assert "left OPERATIONAL by itself, is pre-operational" in next(
        e.reason for e in events if e.new_state is NodeState.BOOTING
    )
    assert "EMCY 0x8130 life guard or heartbeat error" in rig.status(1).reason
    rig.run(1000)
    assert rig.state(1) is FAULTED
    assert rig.status(1).reason.startswith(
        "refuses OPERATIONAL, error register 0x11 (generic, communication)"
    )


def test_stopping_error_behaviour_is_understood(make_rig: Make) -> None:
    """0x1029:01 = 2: the node stops, and serves no SDO until it is made pre-operational."""
    rig = make_rig(1, device=EDS)
    rig.node(1).write_object(0x1029, 1, 2, keep=True)
    rig.boot()
    rig.run(500)
    rig.node(1).latch_error(0x8130, 0x11)
    rig.run(3000)
    assert rig.state(1) is FAULTED
    assert "0x1029:01 = 2 (stopped after a communication error)" in rig.status(1).reason
    rig.node(1).clear_error()
    rig.run(5300)
    assert rig.state(1) is OPERATIONAL


def test_error_that_changes_no_state_is_reported_and_the_node_stays_operational(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.node(1).write_object(0x1029, 1, 1, keep=True)
    rig.boot()
    rig.node(1).latch_error(0x4200, 9)
    assert rig.run(1000) == []
    assert rig.state(1) is OPERATIONAL
    assert [str(event) for event in rig.errors] == [
        "EMCY 0x4200 device temperature (register: temperature), manufacturer-specific 0000000000"
    ]


def test_node_that_keeps_leaving_operational_is_faulted_with_growing_delays(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.boot()
    for _ in range(100):
        rig.run(200)
        if rig.state(1) is OPERATIONAL:
            rig.node(1).handle_nmt(PREOPERATIONAL)  # by itself: no command is on the bus
        if rig.state(1) is FAULTED:
            break
    assert rig.status(1).reason.startswith("leaves OPERATIONAL by itself, reports no error; ")
    rig.run(1000)
    assert rig.state(1) is OPERATIONAL


@pytest.mark.parametrize(("command", "name"), [(2, "stopped"), (128, "pre-operational")])
def test_command_of_another_master_is_named_as_the_cause(rig: Any, command: int, name: str) -> None:
    rig.boot()
    rig.run(500)
    for _ in range(6):  # it is repaired at once, however often
        rig.nmt(command, 1)
        events = rig.run(600)
        reasons = [e.reason for e in events if e.new_state is NodeState.BOOTING]
        assert reasons == [f"made {name} by an NMT command of another master"]
        assert rig.state(1) is OPERATIONAL


def test_reset_by_another_master_is_no_reboot_by_itself(rig: Any) -> None:
    rig.boot()
    for command in (129, 130, 129, 130, 129):
        rig.nmt(command, 1)
        events = rig.run(300)
        assert events[0].reason == "reset by an NMT command of another master"
        assert rig.state(1) is OPERATIONAL


def test_boot_loop_is_faulted_without_traffic_until_it_ends(rig: Any) -> None:
    rig.boot()
    rig.node(1).start_boot_loop(200 * MS)
    rig.run(5000)
    assert rig.state(1) is FAULTED
    assert rig.status(1).reason.startswith(
        "boot loop: 25 boot-up messages in 4.8 s; check its supply voltage"
    )
    requests = rig.node(1).sdo.requests
    rig.run(10_000)
    assert rig.node(1).sdo.requests == requests
    rig.node(1).stop_boot_loop()
    rig.run(5300)
    assert rig.state(1) is OPERATIONAL
    assert [rig.state(n) for n in (2, 3)] == [OPERATIONAL] * 2


def test_refusal_after_a_boot_loop_is_named_as_such(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.boot()
    rig.run(500)
    rig.node(1).start_boot_loop(100 * MS)
    rig.run(450)
    rig.node(1).stop_boot_loop()
    rig.node(1).latch_error(0x5000)
    rig.run(1500)
    assert rig.state(1) is FAULTED
    assert rig.status(1).reason.startswith("refuses OPERATIONAL, error register 0x01")


def test_single_reboots_of_a_stable_node_are_never_a_boot_loop(rig: Any) -> None:
    rig.boot()
    for _ in range(6):
        rig.run(5100)
        rig.node(1).reboot()
        assert "boot loop" not in " ".join(event.reason for event in rig.run(200))
        assert rig.state(1) is OPERATIONAL


def test_illegal_heartbeat_state_is_the_reason_until_it_ends(rig: Any) -> None:
    rig.boot()
    rig.run(500)
    rig.node(1).heartbeat_state = 99
    requests = rig.node(1).sdo.requests
    events = rig.run(3000)
    assert rig.state(1) is FAULTED
    assert rig.status(1).reason.startswith("heartbeat with illegal NMT state 99; check its firmware")
    assert len([e for e in events if e.new_state is FAULTED]) <= 3
    assert nmt(rig).count((RESET_COMMUNICATION, 1)) == 1
    assert rig.node(1).sdo.requests - requests < 60
    rig.node(1).heartbeat_state = None
    rig.run(5300)
    assert rig.state(1) is OPERATIONAL


def test_node_with_an_illegal_state_that_vanishes_is_lost(rig: Any) -> None:
    rig.boot()
    rig.node(1).heartbeat_state = 99
    rig.run(1000)
    rig.node(1).unplug()
    rig.run(6500)
    assert rig.state(1) is NodeState.ABSENT
    assert "lost: " in rig.status(1).reason


def test_vanished_node_has_its_loss_as_reason_not_an_earlier_sdo_fault(rig: Any) -> None:
    rig.node(1).sdo.fail[0x1018, 1] = 0x08000000
    rig.plug_all()
    rig.start()
    rig.run(500)
    assert "vendor id" in rig.status(1).reason
    rig.node(1).unplug()
    rig.run(7000)
    assert rig.state(1) is NodeState.ABSENT
    assert rig.status(1).reason.startswith("lost: no message for ")


def test_node_that_was_never_identified_is_not_stopped(make_rig: Make) -> None:
    rig = make_rig(2)
    rig.node(1).sdo.fail[0x1018, 1] = 0x08000000
    rig.plug_all()
    rig.start()
    rig.run(500)
    rig.wire.sent.clear()
    rig.master.stop(rig.t_ns)
    assert nmt(rig) == [(128, 2)]


def test_events_without_a_reason_or_a_new_state_read_well(rig: Any) -> None:
    rig.plug_all()
    rig.start()
    texts = [str(event) for event in rig.run(300) if event.slot == 0]
    assert texts[-1] == "settling -> operational"
    rig.node(1).sdo.frozen = True
    rig.node(1).reboot()
    rig.pump()
    rig.node(1).reboot()
    rig.pump()
    texts = [str(event) for event in rig.master.drain_events()]
    assert texts[0] == "operational -> booting: rebooted by itself"
    assert not any("booting -> booting" in text for text in texts)


CHANGES = [
    ((0x1801, 2), 240, "0x1801:02, transmission type of TPDO2, is 240 instead of 1"),
    ((0x1801, 1), 0x80000281, "0x1801:01, COB-ID of TPDO2, is 0x80000281 instead of 0x281"),
    ((0x1801, 1), 0x2A1, "0x1801:01, COB-ID of TPDO2, is 0x2A1 instead of 0x281"),
    ((0x1801, 1), 0x282, "0x1801:01, COB-ID of TPDO2, is 0x282 instead of 0x281"),  # that of node 2
    ((0x1A01, 0), 0, "0x1A01:00, number of objects mapped in TPDO2, is 0 instead of 4"),
    ((0x1017, 0), 0, "0x1017:00, heartbeat time, is 0 instead of 100"),  # while its samples go on
]


@pytest.mark.parametrize(
    ("where", "value", "expected"), CHANGES, ids=[f"{c[2][:9]}={c[1]:X}" for c in CHANGES]
)
def test_changed_setting_is_repaired_and_named(
    make_rig: Make, where: tuple[int, int], value: int, expected: str
) -> None:
    rig = make_rig(2, device={"eds": REMAPPABLE})
    rig.boot()
    rig.node(1).write_object(*where, value)
    events = rig.run(1500)
    reasons = [e.reason for e in events if e.new_state is NodeState.BOOTING]
    assert reasons == [f"settings changed since its boot: {expected}; repaired"]
    assert rig.status(1).cob_ids == (0x281,)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL] * 2, rig.status(1).reason


def test_changes_that_are_minutes_apart_are_all_repaired(make_rig: Make) -> None:
    """Also of a node that other faults interrupt meanwhile."""
    rig = make_rig(1, device=EDS)
    rig.boot()
    for _ in range(5):
        rig.node(1).write_object(0x1801, 2, 240)
        assert any(e.new_state is NodeState.BOOTING for e in rig.run(3000))
        assert rig.state(1) is OPERATIONAL
        rig.run(30_000)
        rig.node(1).unplug()
        rig.run(1000)
        rig.node(1).plug()
        rig.run(31_000)


def test_changed_setting_is_repaired_three_times_then_reported(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.boot()
    repaired = 0
    for _ in range(6):
        rig.node(1).write_object(0x1801, 2, 240)
        repaired += any(e.new_state is NodeState.BOOTING for e in rig.run(3000))
    assert repaired == 3
    assert rig.state(1) is STALE
    assert "is 240 instead of 1, again after 3 repairs" in rig.status(1).reason
    rig.node(1).write_object(0x1801, 2, 1)
    rig.run(1000)
    assert rig.state(1) is OPERATIONAL


def test_settings_of_a_silent_but_correct_node_are_read_with_growing_delays(make_rig: Make) -> None:
    rig = make_rig(1, device=EDS)
    rig.boot()
    rig.node(1).send_data = False
    before = rig.node(1).sdo.requests
    rig.run(20_000)
    assert rig.node(1).sdo.requests - before == 6 * 9  # after 0.1, 0.5, 3.7, 8.7, 13.7 and 18.7 s
    assert rig.state(1) is STALE


def test_a_change_is_repaired_however_often_the_node_was_stale_before(make_rig: Make) -> None:
    rig = make_rig(2, device=EDS)
    rig.boot()
    for _ in range(6):  # as by a host that stalls
        rig.node(1).send_data = False
        rig.run(120)
        assert rig.state(1) is STALE
        rig.node(1).send_data = True
        rig.run(20)
        assert rig.state(1) is OPERATIONAL
    rig.node(1).send_data = False
    rig.run(4000)  # the delay until the next check has grown
    rig.node(1).send_data = True
    rig.run(20)
    rig.node(1).write_object(0x1801, 1, 0x80000281)
    events = rig.run(600)
    assert any("0x1801:01, COB-ID of TPDO2, is 0x80000281 instead of 0x281" in e.reason for e in events)
    assert rig.state(1) is OPERATIONAL


def test_listener_reads_no_settings_of_a_stale_node(make_rig: Make) -> None:
    rig = make_rig(1, role="listener", device=EDS)
    rig.plug_all()
    for device in rig.devices.devices.values():
        device.write_object(0x1017, 0, 100)
        device.write_object(0x1801, 2, 1)
        device.handle_nmt(START)
    rig.start()
    rig.run(300)
    assert rig.state(1) is OPERATIONAL
    rig.node(1).write_object(0x1801, 2, 240)
    rig.run(5000)
    assert rig.wire.sent == [] == rig.wire.asked


def test_missing_sync_stays_the_reason_after_the_settings_were_checked(rig: Any) -> None:
    rig.boot()
    rig.syncs = False
    rig.run(10_000)
    reasons = {rig.status(n).reason.partition(", ")[2] for n in (1, 2, 3)}
    assert len(reasons) == 1
    assert reasons.pop().endswith("; check its SYNC producer")


def test_settings_are_checked_too_if_a_pause_hid_the_change(make_rig: Make) -> None:
    """Its samples stayed away together with those of others, but not for their cause."""
    rig = make_rig(2, device=EDS)
    rig.boot()
    rig.syncs = False
    rig.node(1).write_object(0x1801, 2, 240)
    rig.run(100)
    assert rig.state(1) is STALE
    assert "no SYNC on bus can" in rig.status(1).reason
    rig.syncs = True
    events = rig.run(2000)
    assert any("0x1801:02, transmission type of TPDO2, is 240 instead of 1" in e.reason for e in events)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL] * 2


def test_a_repair_that_brings_no_samples_stays_named(make_rig: Make) -> None:
    """A node may take a setting over only when it boots."""
    rig = make_rig(1, device=EDS)
    rig.boot()
    rig.node(1).write_object(0x1017, 0, 0)
    rig.run(1000)
    rig.node(1).write_object(0x1801, 2, 240)
    rig.node(1).send_data = False
    rig.run(8000)
    assert rig.state(1) is NodeState.STALE
    assert "0x1801:02, transmission type of TPDO2, is 240 instead of 1" in rig.status(1).reason
    assert "without effect" in rig.status(1).reason
