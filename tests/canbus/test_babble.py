"""A node that sends far more samples than SYNC asks for is told; one SYNC too many is not its fault."""

from __future__ import annotations

import re
from typing import Any

import pytest

from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.slab import Slab
from handtouch.canbus.device import Line
from handtouch.canbus.nodes.life import Babble, Life, NodeState, Role, Timing
from handtouch.canbus.nodes.lifecycle import advance
from handtouch.canbus.nodes.master import Master, NodeEvent, NodeSpec
from handtouch.config import Bus

OPERATIONAL, FAULTED = NodeState.OPERATIONAL, NodeState.FAULTED
MS = 1_000_000


def test_babbling_node_is_told_once_and_used_again_when_it_is_quiet(rig: Any) -> None:
    rig.boot()
    rig.node(2).babble(2000)
    (event,) = rig.run(8000)
    assert (event.slot, event.new) == (1, FAULTED)
    assert re.search(r"samples come \d+ times as often as SYNC asks", event.reason)
    rig.node(2).hush()
    rig.run(1200)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL] * 3


def test_duplicate_samples_are_no_babble(rig: Any) -> None:
    rig.boot()
    rig.node(2).line = Line(duplicate=1.0)
    assert rig.run(3000) == []


def test_babble_that_goes_on_through_a_reboot_is_told_again(rig: Any) -> None:
    rig.boot()
    rig.node(2).babble(2000)
    rig.run(1000)
    rig.node(2).reboot()
    rig.node(2).babble(2000)
    rig.run(1500)
    assert rig.state(2) is FAULTED
    assert "times as often" in rig.status(2).reason


@pytest.mark.parametrize("size", [1, 2])
def test_another_sync_on_one_bus_makes_nobody_there_babble(make_rig: Any, size: int) -> None:
    """Three nodes follow ours at 200 Hz, those on a bus of somebody else's drives that one's at 1 kHz."""
    ours, theirs = rigs = [make_rig(3), make_rig(size)]
    specs: list[NodeSpec] = []
    slab, ports = Slab(3 + size), {}
    for name, rig, sync in (("ours", ours, "producer"), ("theirs", theirs, "consumer")):
        bus = Bus(name=name, interface="virtual", channel=name, sync=sync)  # type: ignore[arg-type]
        rig.slab, rig.port = slab, Port(bus, rig.wire, slab)
        ports[name] = rig.port
        for number in range(1, rig.size + 1):
            specs.append(rig.spec(number, slot=len(specs), bus=name, name=f"{name}{number}"))
        rig.plug_all()
    ours.master = theirs.master = master = Master(ports, specs, 5 * MS)
    master.start(ours.t_ns)
    for _ in range(3000):
        for rig in rigs:
            rig.t_ns += MS
        if ours.t_ns // MS % 5 == 0:
            ours.sync()
        theirs.port.send(0x80, b"")
        for rig in rigs:
            rig.devices.advance(rig.t_ns)
            for frame in rig.port.drain():
                master.handle(rig.port.name, *frame)
        master.poll(ours.t_ns)
        master._workers.work()  # type: ignore[union-attr]
    assert master.states.tolist() == [OPERATIONAL] * (3 + size)
    assert not [e for e in master.take_events() if isinstance(e, NodeEvent) and e.new is FAULTED]


@pytest.mark.parametrize("role", [Role.GUEST, Role.LISTENER])
def test_node_that_another_master_configures_may_send_as_it_likes(role: Role) -> None:
    life = Life(state=OPERATIONAL)
    assert advance(life, Babble(11), 0, Timing(100 * MS, 350 * MS, role)) == (life, ())
