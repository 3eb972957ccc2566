"""Standby of pads outside the scene; event-driven transmission of untouched pads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import IdleSettings
from handtouch.config import shipped
from handtouch.config.channels import WritableObject, parse_writable_object, resolve_channels

MS = 1_000_000
Make = Callable[..., Any]
EDS = str(shipped.path("handtouch-node.eds"))
OPERATIONAL, STOPPED, ABSENT, STALE = (
    NodeState.OPERATIONAL,
    NodeState.STOPPED,
    NodeState.ABSENT,
    NodeState.STALE,
)
EXCITATION = (0x2100, 0)
IDLE = IdleSettings(
    delta_counts=50,
    period_ms=100,
    inhibit_100us=50,
    delta_objects=tuple(WritableObject(0x6426, sub, 4) for sub in (1, 2, 3, 4)),
    enable_object=WritableObject(0x6423, 0, 1),
)
SHIPPED = {"eds": EDS, "idle": IDLE, "excitation": parse_writable_object("0x2100:0:u8")}


@pytest.fixture(params=[False, True], ids=["lax", "strict"])
def rig(make_rig: Make, request: pytest.FixtureRequest) -> Any:
    """Two operational nodes of the shipped kind, that change a PDO anytime or only while it is off."""
    rig = make_rig(2, device={"strict_pdo": request.param}, **SHIPPED)
    rig.boot()
    return rig


def rest(rig: Any, number: int, resting: bool) -> None:
    rig.master.set_standby(number - 1, resting, rig.t_ns)


def pace(rig: Any, number: int, idle: bool) -> None:
    rig.master.set_transmission(number - 1, idle, rig.t_ns)


def samples(rig: Any, ms: int) -> int:
    """Samples of node 1 that come in a while, at most one a millisecond."""
    arrived = 0
    for _ in range(ms):
        stamp = rig.slab.arrival_ns[0]
        rig.run(1)
        arrived += int(rig.slab.arrival_ns[0] != stamp)
    return arrived


def test_node_in_standby_is_switched_off_and_stopped_and_still_supervised(rig: Any) -> None:
    rest(rig, 1, True)
    rig.run(50)
    assert (rig.state(1), rig.state(2)) == (STOPPED, OPERATIONAL)
    assert rig.node(1).state == "STOPPED"
    assert rig.node(1).read_object(*EXCITATION) == 0
    assert rig.node(2).read_object(*EXCITATION) == 1
    assert samples(rig, 3000) == 0
    assert rig.state(1) is STOPPED
    rig.node(1).unplug()
    rig.run(600)
    assert rig.state(1) is ABSENT


def test_event_driven_node_may_send_different_samples_in_a_sync_period(rig: Any) -> None:
    pace(rig, 1, True)
    rig.run(50)
    for _ in range(600):
        rig.inject(0x281, b"\x20\x03" * 4)
        rig.inject(0x281, b"\x10\x03" * 4)
        assert rig.run(5) == []


def test_node_that_reboots_in_standby_stays_in_standby(rig: Any) -> None:
    rest(rig, 1, True)
    rig.run(50)
    rig.node(1).reboot()
    rig.run(300)
    assert rig.state(1) is STOPPED
    assert rig.node(1).state == "STOPPED"
    assert rig.node(1).read_object(*EXCITATION) == 0
    assert (1, 1) not in [tuple(data) for can_id, data in rig.wire.sent if can_id == 0]


def test_node_whose_stop_was_lost_is_stopped_again(rig: Any) -> None:
    rest(rig, 1, True)
    rig.run(50)
    rig.node(1).handle_nmt(1)
    rig.run(500)
    assert rig.node(1).state == "STOPPED"
    assert rig.state(1) is STOPPED


def test_node_that_is_needed_again_is_excited_and_its_first_samples_are_discarded(rig: Any) -> None:
    """The simulated node's first three samples after its excitation came on are wrong."""
    rest(rig, 1, True)
    rig.run(1000)
    rest(rig, 1, False)
    for _ in range(300):
        rig.run(1)
        if rig.state(1) is OPERATIONAL:
            assert rig.slab.unpack_counts()[0].tolist() == [10, 20, 30, 40]
    assert rig.state(1) is OPERATIONAL
    assert rig.node(1).read_object(*EXCITATION) == 1


@pytest.mark.parametrize("when_ms", [0, 1, 2, 3, 5, 10])
def test_standby_and_back_at_any_moment_ends_operational(rig: Any, when_ms: int) -> None:
    rest(rig, 1, True)
    rig.run(when_ms)
    rest(rig, 1, False)
    rig.run(1500)
    assert rig.state(1) is OPERATIONAL
    assert rig.node(1).read_object(*EXCITATION) == 1


@pytest.mark.parametrize("when_ms", [0, 1, 2, 3, 5, 10, 20])
def test_standby_requested_while_booting_ends_in_standby(make_rig: Make, when_ms: int) -> None:
    rig = make_rig(1, **SHIPPED)
    rig.plug_all()
    rig.start()
    rig.run(when_ms)
    rest(rig, 1, True)
    rig.run(500)
    assert rig.state(1) is STOPPED
    assert rig.node(1).state == "STOPPED"
    assert rig.node(1).read_object(*EXCITATION) == 0


def test_excitation_that_cannot_be_switched_off_is_reported_and_the_node_stopped(rig: Any) -> None:
    rig.node(1).sdo.fail_write[EXCITATION] = 0x08000022
    rest(rig, 1, True)
    rig.run(50)
    assert rig.node(1).state == "STOPPED"
    assert "in standby until needed, but writing excitation, 0x2100:00: refused" in rig.status(1).reason


def test_node_without_excitation_switch_is_just_stopped(make_rig: Make) -> None:
    rig = make_rig(1)
    rig.boot()
    rest(rig, 1, True)
    rig.run(50)
    assert rig.node(1).state == "STOPPED"
    rest(rig, 1, False)
    rig.run(100)
    assert rig.state(1) is OPERATIONAL


def test_idle_settings_are_written_at_boot(rig: Any) -> None:
    node = rig.node(1)
    assert [node.read_object(0x6426, sub) for sub in (1, 2, 3, 4)] == [50] * 4
    assert [node.read_object(*where) for where in ((0x6423, 0), (0x1801, 3), (0x1801, 5))] == [1, 50, 100]
    assert node.read_object(0x1801, 2) == 1
    assert node.read_object(0x1801, 1) == 0x281


def test_idle_node_sends_by_event_timer_and_at_once_when_touched(rig: Any) -> None:
    assert 199 <= samples(rig, 1000) <= 201
    pace(rig, 1, True)
    rig.run(20)
    assert rig.status(1).idle
    assert rig.node(1).read_object(0x1801, 2) == 255
    assert 9 <= samples(rig, 1000) <= 11
    assert rig.state(1) is OPERATIONAL
    rig.counts[0] += 51
    assert samples(rig, 3) == 1
    assert rig.slab.unpack_counts()[0].tolist() == [61, 71, 81, 91]
    rig.counts[0] += 50
    assert samples(rig, 20) == 0
    pace(rig, 1, False)
    rig.run(10)
    assert not rig.status(1).idle
    assert rig.node(1).read_object(0x1801, 2) == 1
    assert 199 <= samples(rig, 1000) <= 201


def test_full_rate_is_back_with_the_next_sync(rig: Any) -> None:
    pace(rig, 1, True)
    rig.run(200)
    pace(rig, 1, False)
    assert samples(rig, 10) == 2


def test_stale_timeout_follows_the_sample_period(rig: Any) -> None:
    pace(rig, 1, True)
    rig.run(20)
    assert rig.master.sample_period_ns.tolist() == [100 * MS, 5 * MS]
    rig.node(1).send_data = rig.node(2).send_data = False
    rig.run(25)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL, STALE]
    rig.run(300)
    assert rig.state(1) is STALE
    rig.node(1).send_data = True
    rig.run(110)
    assert rig.state(1) is OPERATIONAL


def test_stale_idle_node_can_be_made_synchronous(rig: Any) -> None:
    """Its event timer may have died; SYNC hasn't."""
    pace(rig, 1, True)
    rig.run(20)
    rig.node(1).write_object(0x1801, 5, 0)
    rig.run(1000)
    assert rig.state(1) is STALE
    pace(rig, 1, False)
    rig.run(100)
    pace(rig, 1, False)
    rig.run(100)
    assert rig.state(1) is OPERATIONAL


def test_idle_node_that_reboots_is_synchronous_again(rig: Any) -> None:
    pace(rig, 1, True)
    rig.run(50)
    rig.node(1).reboot()
    rig.run(300)
    assert rig.state(1) is OPERATIONAL
    assert not rig.status(1).idle
    assert rig.master.sample_period_ns[0] == 5 * MS
    pace(rig, 1, True)
    rig.run(50)
    assert rig.status(1).idle


def test_idle_node_of_a_master_that_restarts_is_synchronous_again(rig: Any) -> None:
    pace(rig, 1, True)
    rig.run(50)
    rig.restart()
    rig.start()
    rig.run(300)
    assert [rig.state(n) for n in (1, 2)] == [OPERATIONAL] * 2
    assert rig.node(1).read_object(0x1801, 2) == 1
    assert rig.node(1).state == "OPERATIONAL"


def test_refusal_to_be_event_driven_is_reported_once_and_remembered(rig: Any) -> None:
    rig.node(1).sdo.fail_write[0x1801, 2] = 0x06010002
    pace(rig, 1, True)
    (expected,) = rig.run(50)
    assert expected.old_state is expected.new_state is OPERATIONAL
    assert expected.reason.startswith(
        "stays synchronous: writing transmission type of TPDO2, 0x1801:02: refused"
    )
    assert not rig.master.can_idle(0)
    for _ in range(10):
        pace(rig, 1, True)
        assert rig.run(50) == []
    assert rig.node(1).read_object(0x1801, 1) == 0x281  # its PDO was switched on again
    assert samples(rig, 100) == 20


def test_refused_deltas_only_prevent_idling(make_rig: Make) -> None:
    rig = make_rig(1, **SHIPPED)
    rig.node(1).sdo.fail[0x6426, 2] = 0x06090011
    rig.plug_all()
    rig.start()
    events = rig.run(200)
    assert rig.state(1) is OPERATIONAL
    expected = [e.reason for e in events if "synchronous while idle" in e.reason]
    assert len(expected) == 1
    assert "0x6426:02" in expected[0]
    assert not rig.master.can_idle(0)


def test_refused_timers_leave_the_pdo_enabled(make_rig: Make) -> None:
    rig = make_rig(1, device={"strict_pdo": True}, **SHIPPED)
    rig.node(1).sdo.fail_write[0x1801, 5] = 0x06010002
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is OPERATIONAL
    assert rig.node(1).read_object(0x1801, 1) == 0x281


def test_node_that_stops_responding_during_a_transmission_change_is_configured_again(rig: Any) -> None:
    """Its PDO may be off."""
    rig.node(1).sdo.fail[0x1801, 2] = None
    pace(rig, 1, True)
    rig.run(100)
    rig.node(1).sdo.fail.clear()
    rig.run(1000)
    assert rig.state(1) is OPERATIONAL
    assert samples(rig, 100) == 20


def test_node_with_several_pdos_stays_synchronous(make_rig: Make) -> None:
    eds = str(Path(__file__).parent.parent / "data" / "eds" / "norsens-quad404.eds")
    channels = resolve_channels([f"0x9130:{n}" for n in (1, 2, 3, 4)], eds)
    device = {"eds": eds, "channels": tuple((c.index, c.sub) for c in channels)}
    rig = make_rig(1, device=device, eds=eds, channels=channels, idle=IDLE)
    rig.boot()
    assert not rig.master.can_idle(0)
    pace(rig, 1, True)
    rig.run(100)
    assert not rig.status(1).idle
    assert np.array_equal(rig.slab.unpack_counts()[0], [10, 20, 30, 40])
