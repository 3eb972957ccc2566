"""Ports, master, worker threads and nodes together in real time: a hand boots, reboots and stops."""

from __future__ import annotations

import select
import time
from collections.abc import Callable

import can
import numpy as np
import pytest

from handtouch.canbus.bus.port import Port
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import NodeSpec
from handtouch.canbus.objects import sdo
from handtouch.config import Bus
from handtouch.core.slab import Slab
from handtouch.device import DeviceBus

NODES = 15


def eventually(what: Callable[[], bool], seconds: float = 5.0) -> bool:
    deadline = time.monotonic() + seconds
    while not what() and time.monotonic() < deadline:
        time.sleep(0.005)
    return what()


@pytest.mark.parametrize(
    ("interface", "channel"),
    [("virtual", "hand"), pytest.param("socketcan", "vcan0", marks=pytest.mark.socketcan)],
)
def test_a_hand_boots_in_two_seconds_of_work_and_survives_a_reboot(interface: str, channel: str) -> None:
    slab = Slab(NODES)
    port = Port.open(Bus(name="palm", interface=interface, channel=channel), slab)
    counts = np.arange(4 * NODES, dtype=np.int16).reshape(NODES, 4)
    with can.Bus(interface=interface, channel=channel) as bus:
        devices = DeviceBus(bus, lambda _: counts)
        for number in range(1, NODES + 1):
            devices.add(number, serial=number)
        devices.start()
        specs = [NodeSpec(slot, "palm", slot + 1, f"pad{slot}", serial=slot + 1) for slot in range(NODES)]
        master = Master({"palm": port}, specs, 20_000_000)
        started = time.process_time()  # of master and nodes: a pause of the machine is none of theirs
        master.start(time.monotonic_ns())
        assert _cycle(port, master, lambda: bool((master.states == NodeState.OPERATIONAL).all()), 60)
        assert time.process_time() - started < 2
        devices.devices[3].reboot()
        assert _cycle(port, master, lambda: master.status()[2].reboots == 1, 30)
        assert _cycle(port, master, lambda: master.states[2] == NodeState.OPERATIONAL, 30)
        np.testing.assert_array_equal(slab.unpack_counts(), counts)
        master.stop(time.monotonic_ns())
        assert eventually(lambda: {d.state for d in devices.devices.values()} == {"PRE-OPERATIONAL"})
        devices.stop()
    assert port.counters.unknown_frames == port.counters.send_failures == port.counters.overflow == 0
    port.close()


def _cycle(port: Port, master: Master, what: Callable[[], bool], seconds: float) -> bool:
    """The hot loop in small, with a SYNC every 10 ms; as there, missed ones aren't sent later."""
    deadline = time.monotonic() + seconds
    next_sync = time.monotonic()
    while time.monotonic() < deadline:
        if time.monotonic() >= next_sync:
            port.send(0x80, b"")
            next_sync = max(next_sync + 0.01, time.monotonic())
        select.select([port.fileno()], [], [], max(next_sync - time.monotonic(), 0))
        for frame in port.drain():
            master.handle_frame("palm", *frame)
        master.poll(time.monotonic_ns())
        if what():
            return True
    return False


def test_missing_nodes_do_not_delay_other_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five of fifteen answer nothing: while the first transfer to them still waits, all others are up."""
    monkeypatch.setattr(sdo, "SDO_TIMEOUT_S", 1.5)
    slab = Slab(NODES)
    port = Port.open(Bus(name="palm", interface="virtual", channel="dead"), slab)
    dead = {1, 4, 7, 10, 15}
    with can.Bus(interface="virtual", channel="dead") as bus:
        devices = DeviceBus(bus, lambda _: np.zeros((NODES, 4), dtype=np.int16))
        for number in range(1, NODES + 1):
            devices.add(number).sdo.frozen = number in dead
        devices.start()
        specs = [NodeSpec(slot, "palm", slot + 1, f"pad{slot}") for slot in range(NODES)]
        master = Master({"palm": port}, specs, 20_000_000)
        master.start(time.monotonic_ns())
        living = [number - 1 for number in range(1, NODES + 1) if number not in dead]
        assert _cycle(port, master, lambda: bool((master.states[living] == NodeState.OPERATIONAL).all()), 60)
        waiting = [NodeState(int(master.states[number - 1])) for number in dead]
        assert waiting == [NodeState.BOOTING] * len(dead)
        assert not [e for e in master.drain_events() if "no answer" in str(e)]
        for number in dead:
            devices.devices[number].sdo.frozen = False
        assert _cycle(port, master, lambda: bool((master.states == NodeState.OPERATIONAL).all()), 60)
        master.stop(time.monotonic_ns())
        devices.stop()
    port.close()
