"""Two nodes with one id are detected, without false alarms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.device import LineFaults

MS = 1_000_000
Make = Callable[..., Any]
OPERATIONAL, FAULTED = NodeState.OPERATIONAL, NodeState.FAULTED


@pytest.mark.parametrize("heartbeat_ms", [0, 100, 200], ids=lambda ms: f"{ms} ms from the factory")
@pytest.mark.parametrize("gone", ["the first", "the second"])
def test_two_nodes_with_one_id_are_faulted_until_one_is_unplugged(
    rig: Any, heartbeat_ms: int, gone: str
) -> None:
    rig.boot()
    twin = rig.devices.add_twin(2, serial=999)
    twin.write_object(0x1017, 0, heartbeat_ms, keep=True)
    twin.plug()
    rig.run(6000)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL, FAULTED, OPERATIONAL]
    assert "duplicate node id" in rig.status(2).reason
    expected = [e for e in rig.run(5000) if e.slot == 1]
    assert expected == []  # once
    (rig.node(2) if gone == "the first" else twin).unplug()
    rig.run(4000)
    assert rig.state(2) is OPERATIONAL


def test_two_nodes_with_one_id_from_the_start_are_detected(rig: Any) -> None:
    rig.devices.add_twin(2, serial=999).plug()
    rig.plug_all()
    rig.start()
    rig.run(6000)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL, FAULTED, OPERATIONAL]


def test_running_nodes_with_one_id_are_detected_after_a_restart(rig: Any) -> None:
    rig.boot()
    rig.devices.add_twin(2, serial=999).plug()
    rig.run(1000)
    rig.restart()
    rig.start()
    rig.run(6000)
    assert rig.state(2) is FAULTED


@pytest.mark.parametrize("late_ms", [1, 50, 300])
def test_late_heartbeats_are_not_taken_for_twins(rig: Any, late_ms: int) -> None:
    rig.boot()
    for round_ in range(12):
        rig.node(1).line = LineFaults(late_ns=late_ms * MS if round_ % 2 else 0, data_only=False)
        events = rig.run(700)
        assert not [e for e in events if "duplicate node id" in e.reason]


@pytest.mark.parametrize("held_ms", [500, 1500, 4000])
def test_heartbeats_in_a_burst_are_not_taken_for_twins(make_rig: Make, held_ms: int) -> None:
    """Heartbeats in a burst, as after a pause of a bridge or a process."""
    rig = make_rig(1, heartbeat_timeout_ms=5000)
    rig.boot()
    for _ in range(4):
        rig.node(1).send_heartbeat = False
        rig.run(held_ms)
        rig.node(1).send_heartbeat = True
        for _ in range(held_ms // 100):
            rig.inject(0x701, b"\x05")
        events = rig.run(3000)
        assert [e.new_state for e in events] == []


@pytest.mark.parametrize("every_ms", [60, 230, 700, 1100, 2300])
def test_repeatedly_rebooting_node_is_not_taken_for_twins(rig: Any, every_ms: int) -> None:
    """Its heartbeat time after power-on is much shorter than what it is set to."""
    rig.node(1).write_object(0x1017, 0, 10, keep=True)
    rig.boot()
    rig.node(1).brown_out(10 * MS, times=10, every_ns=every_ms * MS)
    events = rig.run(10 * every_ms + 1000)
    assert not [e for e in events if "duplicate node id" in e.reason]
    rig.run(5300)  # a boot loop is waited out
    assert rig.state(1) is OPERATIONAL
    assert rig.status(1).reboots == 10


def test_frames_duplicated_by_a_bad_line_are_reported_as_twins_while_they_last(rig: Any) -> None:
    rig.boot()
    rig.node(1).line = LineFaults(duplicate=1.0, data_only=False)
    rig.run(4000)
    rig.node(1).line = None
    rig.run(4000)
    assert rig.state(1) is OPERATIONAL
