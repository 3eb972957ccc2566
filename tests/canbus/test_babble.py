"""Nodes that send far more samples than SYNC requests; an extra SYNC is not their fault."""

from __future__ import annotations

import re
from typing import Any

import can
import pytest

from handtouch.canbus.bus.port import Port
from handtouch.canbus.nodes.lifecycle import advance
from handtouch.canbus.nodes.lifecycle_types import (
    BusRole,
    Lifecycle,
    NodeState,
    NodeTiming,
    SampleRate,
)
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import NodeEvent, NodeSpec
from handtouch.config import Bus
from handtouch.core.slab import Slab
from handtouch.device import LineFaults

OPERATIONAL, FAULTED = NodeState.OPERATIONAL, NodeState.FAULTED
MS = 1_000_000


def test_babbling_node_is_reported_once_and_used_again_when_it_is_quiet(rig: Any) -> None:
    rig.boot()
    rig.node(2).start_babbling(2000)
    (event,) = rig.run(8000)
    assert (event.slot, event.new_state) == (1, FAULTED)
    assert re.search(r"babbling: it sends \d+ samples per SYNC", event.reason)
    rig.node(2).stop_babbling()
    rig.run(1200)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL] * 3


def test_duplicate_samples_do_not_count_as_babbling(rig: Any) -> None:
    rig.boot()
    rig.node(2).line = LineFaults(duplicate=1.0)
    assert rig.run(3000) == []


def test_babbling_that_continues_after_a_reboot_is_reported_again(rig: Any) -> None:
    rig.boot()
    rig.node(2).start_babbling(2000)
    rig.run(1000)
    rig.node(2).reboot()
    rig.node(2).start_babbling(2000)
    rig.run(1500)
    assert rig.state(2) is FAULTED
    assert "samples per SYNC" in rig.status(2).reason


@pytest.mark.parametrize("size", [1, 2])
def test_extra_sync_producer_does_not_make_nodes_babbling(make_rig: Any, size: int) -> None:
    """Three nodes follow the master's SYNC at 200 Hz, those on a shared bus another one at 1 kHz."""
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
                master.handle_frame(rig.port.name, *frame)
        master.poll(ours.t_ns)
        master._workers.work()  # type: ignore[union-attr]
    assert master.states.tolist() == [OPERATIONAL] * (3 + size)
    assert not [e for e in master.drain_events() if isinstance(e, NodeEvent) and e.new_state is FAULTED]


@pytest.mark.parametrize("role", [BusRole.GUEST, BusRole.LISTENER])
def test_node_configured_by_another_master_may_send_at_any_rate(role: BusRole) -> None:
    life = Lifecycle(state=OPERATIONAL)
    assert advance(life, SampleRate(11), 0, NodeTiming(100 * MS, 350 * MS, role)) == (life, ())


OTHERS = b"\x20\x03" * 4


def with_another_device(rig: Any, cycles: int, data: bytes = OTHERS) -> list[Any]:
    """Run SYNC periods in each of which another device, too, sends with the COB-ID of node 1."""
    events = []
    for _ in range(cycles):
        rig.inject(0x281, data)
        events += rig.run(5)
    return events


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("role", ["master", "guest"])
def test_node_whose_cob_id_another_device_has_is_faulted_until_that_is_gone(
    make_rig: Any, size: int, role: str
) -> None:
    rig = make_rig(size, role=role)
    rig.plug_all()
    rig.start()
    for _ in range(3):
        rig.run(100)
        rig.nmt(1, 0)
    rig.run(200)
    assert rig.state(1) is OPERATIONAL
    with_another_device(rig, 600)
    assert [rig.state(n) for n in range(1, size + 1)] == [FAULTED, *[OPERATIONAL] * (size - 1)]
    assert "two different samples per SYNC: another device sends with its COB-ID" in rig.status(1).reason
    events = with_another_device(rig, 1000)
    for _ in range(200):
        rig.run(20)  # a busy host delays its frames
        events += with_another_device(rig, 1)
    assert [e for e in events if e.slot == 0] == []  # once
    rig.run(7000)
    assert rig.state(1) is OPERATIONAL


def test_what_two_devices_send_alike_contradicts_nothing(make_rig: Any) -> None:
    rig = make_rig(1)
    rig.boot()
    assert with_another_device(rig, 600, rig.counts[0].astype("<i2").tobytes()) == []


def test_samples_on_syncs_of_another_producer_are_not_those_of_another_device(make_rig: Any) -> None:
    rig = make_rig(1)
    rig.boot()
    events = []
    for cycle in range(1200):
        events += rig.run(2)
        rig.counts[:] += 1
        rig.devices.handle_frame(can.Message(arbitration_id=0x80, is_extended_id=False), rig.t_ns)
        events += rig.run(3)
        rig.counts[:] -= 1
        rig.port.other_syncs += 200 * (cycle % 200 == 199)
    assert events == []
