"""A pause of the daemon or its host accuses no node: frames count from their arrival."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import can
import pytest

from handtouch.canbus.bus.bus_state import BusFault, ErrorState
from handtouch.canbus.bus.loop_pause import LoopPause
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.receivers import MAX_DRAIN_FRAMES
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.objects.sdo import BootStepError, NodeSdoClient, SdoTransport
from handtouch.config import Bus
from handtouch.core.slab import Slab

Make = Callable[..., Any]
MS = 1_000_000
PERIOD_NS = 5 * MS


@pytest.mark.parametrize("kernel_sync", [True, False])
@pytest.mark.parametrize("ms", [50, 300, 600, 2000])
def test_pause_of_the_daemon_makes_no_node_lost_or_stale(rig: Any, ms: int, kernel_sync: bool) -> None:
    rig.boot()
    for _ in range(3):
        rig.pause(ms, kernel_sync)
        assert rig.run(500) == []
    assert [status.reboots for status in rig.master.status()] == [0, 0, 0]
    assert [status.heartbeats_missed for status in rig.master.status()] == [0, 0, 0]


@pytest.mark.parametrize("ms", [300, 600, 2000])
def test_pause_of_the_whole_host_makes_no_node_lost(rig: Any, ms: int) -> None:
    """Its controller receives nothing meanwhile."""
    rig.boot()
    rig.wire.cut = {1, 2, 3}
    rig.pause(ms, False)
    rig.wire.cut = set()
    assert rig.run(500) == []


def test_node_that_was_unplugged_during_a_pause_is_lost_in_time_after_it(rig: Any) -> None:
    rig.boot()
    rig.wire.cut = {2}
    rig.pause(600, True)
    events = rig.run(500)
    assert [(event.slot, event.new_state) for event in events] == [
        (1, NodeState.STALE),
        (1, NodeState.STALE),
        (1, NodeState.ABSENT),
    ]
    assert "its settings can't be read: reading" in events[1].reason
    assert "bus can" not in events[-1].reason


def test_node_that_stopped_sending_is_found_although_the_loop_is_always_late(rig: Any) -> None:
    rig.boot()
    pause = LoopPause(PERIOD_NS)
    rig.wire.cut = {2}
    for _ in range(50):
        pause.begin_wait(rig.t_ns)
        rig.run(20)
        excused_ns = pause.end_wait(rig.t_ns - 15 * MS, rig.t_ns)
        assert excused_ns == 10 * MS
        rig.master.excuse_pause(excused_ns, rig.t_ns)
    assert rig.state(2) is NodeState.ABSENT
    assert rig.state(1) is rig.state(3) is NodeState.OPERATIONAL


def test_late_pads_of_a_late_loop_name_the_host(rig: Any) -> None:
    rig.boot()
    rig.wire.lose = {0x281, 0x282, 0x283}
    rig.pause(300, False)
    reasons = {event.reason for event in rig.run(100)}
    assert all("as from every pad of bus can: the loop was late by 300 ms" in reason for reason in reasons)
    assert len(reasons) == 1


def test_late_pads_of_a_bus_without_sync_name_the_sync(rig: Any) -> None:
    rig.boot()
    rig.syncs = False
    events = rig.run(100)
    assert [event.new_state for event in events] == [NodeState.STALE] * 3
    assert all("no SYNC on bus can for " in event.reason for event in events)


def test_pads_that_are_late_together_on_a_real_bus_name_the_host_and_then_the_cable(rig: Any) -> None:
    rig.port.bus = rig.port.bus.model_copy(update={"interface": "socketcan"})
    rig.boot()
    rig.wire.lose = {0x281, 0x282, 0x283}
    events = rig.run(100)
    assert all("check the host's load, then this bus's cable" in event.reason for event in events)
    rig.syncs = False
    rig.wire.lose = set()
    rig.run(1000)
    assert "check its SYNC producer and cable" in rig.status(1).reason


def test_pads_that_are_late_together_name_the_bus(rig: Any) -> None:
    rig.boot()
    rig.wire.lose = {0x281, 0x282, 0x283}
    events = rig.run(100)
    assert [event.new_state for event in events] == [NodeState.STALE] * 3
    assert all("as from every pad of bus can; check that the nodes'" in event.reason for event in events)


def test_one_late_pad_names_its_node(rig: Any) -> None:
    rig.boot()
    rig.wire.lose = {0x282}
    before, after = rig.run(200)
    assert before.slot == after.slot == 1
    assert "heartbeat present; its PDO and heartbeat settings are being checked" in before.reason
    assert "heartbeat present; its PDO and heartbeat settings are as configured" in after.reason


def running_rig(make_rig: Make, role: str) -> Any:
    """Return a rig of three operational nodes, which another master has started for a listener."""
    rig = make_rig(3, role=role)
    rig.plug_all()
    if role == "listener":
        for device in rig.devices.devices.values():
            device.write_object(0x1017, 0, 100)
            device.write_object(0x1801, 2, 1)
            device.handle_nmt(1)
    rig.start()
    rig.run(500)
    return rig


@pytest.mark.parametrize("role", ["master", "listener"])
def test_a_pad_that_stays_late_when_the_others_are_back_names_its_node(make_rig: Make, role: str) -> None:
    rig = running_rig(make_rig, role)
    rig.wire.lose = {0x281, 0x282, 0x283}
    rig.run(50)
    assert all("as from every pad of bus can" in rig.status(n).reason for n in (1, 2, 3))
    rig.wire.lose = {0x282}
    events = rig.run(500)
    assert "heartbeat present; " in rig.status(2).reason
    assert "bus" not in rig.status(2).reason
    assert not [e for e in events if e.slot != 1 and "heartbeat" in e.reason]


def test_nodes_lost_together_name_the_bus_and_one_lost_alone_doesnt(rig: Any) -> None:
    rig.boot()
    rig.wire.cut = {1}
    assert "check that its program runs, its node id" in rig.run(600)[-1].reason
    rig.wire.cut = {1, 2, 3}
    lost = [event for event in rig.run(600) if event.new_state is NodeState.ABSENT]
    assert {event.slot for event in lost} == {1, 2}
    assert all("as from every node of bus can; check that the nodes'" in event.reason for event in lost)


@pytest.mark.parametrize("role", ["master", "listener"])
def test_a_node_that_stays_lost_when_the_others_are_back_names_its_own_connection(
    make_rig: Make, role: str
) -> None:
    rig = running_rig(make_rig, role)
    rig.wire.cut = {1, 2, 3}
    rig.run(600)
    assert all("as from every node of bus can" in rig.status(n).reason for n in (1, 2, 3))
    rig.wire.cut = {2}
    rig.run(5000)
    assert rig.state(1) is rig.state(3) is NodeState.OPERATIONAL
    assert rig.state(2) is NodeState.ABSENT
    assert "lost: no heartbeat for" in rig.status(2).reason
    assert "check that its program runs, its node id" in rig.status(2).reason
    assert "as from" not in rig.status(2).reason


def test_a_short_pause_of_the_loop_is_not_the_cause_of_a_long_silence(rig: Any) -> None:
    rig.boot()
    rig.wire.cut = {1, 2, 3}
    rig.run(200)
    rig.master.excuse_pause(20 * MS, rig.t_ns)
    lost = [event for event in rig.run(600) if event.new_state is NodeState.ABSENT]
    assert len(lost) == 3
    assert all("check that the nodes' programs run" in event.reason for event in lost)
    assert not any("loop was late" in event.reason for event in lost)


def test_nodes_of_a_bus_that_is_down_name_its_problem(rig: Any) -> None:
    rig.boot()
    rig.wire.cut = {1, 2, 3}
    rig.wire.fault = BusFault(ErrorState.DOWN, "Network is down")
    rig.port.update_state(rig.t_ns)
    events = rig.run(600)
    assert {event.new_state for event in events} == {NodeState.STALE, NodeState.ABSENT}
    assert all("bus can: Network is down" in event.reason for event in events)


@pytest.mark.parametrize("outage_ms", range(20, 600, 20))
def test_no_node_is_lost_by_its_own_fault_after_an_outage_of_its_bus(rig: Any, outage_ms: int) -> None:
    """Its heartbeat may be due in the moment in which the bus recovers."""
    rig.boot()
    rig.wire.cut = {1, 2, 3}
    rig.wire.fault = BusFault(ErrorState.DOWN, "Network is down")
    rig.port.update_state(rig.t_ns)
    events = rig.run(outage_ms)
    rig.wire.cut, rig.wire.fault = set(), None
    rig.port.update_state(rig.t_ns)
    events += rig.run(600)
    assert all("bus can: Network is down" in e.reason for e in events if e.new_state is NodeState.ABSENT)
    assert all(rig.state(number) is NodeState.OPERATIONAL for number in (1, 2, 3))


def test_loop_pause_is_what_exceeds_wait_and_allowance() -> None:
    pause = LoopPause(PERIOD_NS)
    pause.begin_wait(0)
    assert pause.end_wait(wake_ns=5 * MS, now_ns=2 * MS) == 0  # a frame woke it
    assert pause.end_receive(3 * MS) == 0
    pause.begin_wait(4 * MS)
    assert pause.end_wait(wake_ns=5 * MS, now_ns=605 * MS) == 596 * MS  # stopped while it waited
    assert pause.end_receive(805 * MS) == 195 * MS  # while it read
    pause.begin_wait(1105 * MS)  # while it worked
    assert pause.end_wait(wake_ns=900 * MS, now_ns=1106 * MS) == 296 * MS
    pause.begin_wait(1107 * MS)
    assert pause.end_wait(wake_ns=2000 * MS, now_ns=2001 * MS) == 0  # a long wait is no pause


def test_frames_left_in_the_queue_hold_back_the_time_of_assessment() -> None:
    bus = Bus(name="can", interface="virtual", channel="backlog")
    with can.Bus(interface="virtual", channel="backlog") as other:
        port = Port.open(bus, Slab(1))
        try:
            message = can.Message(arbitration_id=0x701, data=b"\x05", is_extended_id=False)
            for _ in range(MAX_DRAIN_FRAMES + 1):
                other.send(message)
            sent_ns = time.monotonic_ns()
            first = port.drain()
            assert port.received_until_ns == first[-1][2] <= sent_ns
            assert len(port.drain()) == 1
            assert port.received_until_ns > sent_ns
        finally:
            port.close()


def test_sdo_timeout_waits_for_a_response_that_arrived_but_was_not_read() -> None:
    """The receiving thread is stopped past the timeout; one request suffices."""
    requests: queue.Queue[bytes] = queue.Queue()
    received_until_ns = time.monotonic_ns()

    def send(can_id: int, data: bytes) -> bool:  # noqa: ARG001
        requests.put(data)
        return True

    transport = SdoTransport(1, send, timeout_s=0.2, received_until_ns=lambda: received_until_ns)

    def respond() -> None:
        request = requests.get(timeout=10)
        time.sleep(0.3)
        transport.deliver_response(b"\x43" + request[1:4] + (7).to_bytes(4, "little"))

    receiver = threading.Thread(target=respond)
    receiver.start()
    assert NodeSdoClient(transport).read(0x1018, 1, "vendor id") == 7
    receiver.join()
    assert requests.empty()
    received_until_ns = 1 << 62
    with pytest.raises(BootStepError, match="no answer within 200 ms"):
        NodeSdoClient(transport).read(0x1018, 1, "vendor id")
