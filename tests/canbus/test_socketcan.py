"""A port on a real SocketCAN bus, with can-utils as the stranger; runs where there is a vcan0."""

from __future__ import annotations

import select
import subprocess
import time
from collections.abc import Callable, Iterator

import pytest

from handtouch.canbus import receivers
from handtouch.canbus.port import Port
from handtouch.canbus.slab import Slab
from handtouch.config import Bus

pytestmark = pytest.mark.socketcan


def run(command: str) -> None:
    subprocess.run(["sh", "-c", command], check=True, timeout=30)


def eventually(port: Port, what: Callable[[], bool], seconds: float = 10.0) -> bool:
    """Drain until it is so."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        port.drain()
        if what():
            return True
        time.sleep(0.005)
    return False


def open_port(slots: int = 1) -> Port:
    port = Port.open(Bus(name="palm", interface="socketcan", channel="vcan0"), Slab(slots))
    port.route(0x281, 0)
    return port


@pytest.fixture
def port() -> Iterator[Port]:
    port = open_port()
    yield port
    port.close()


def test_every_kind_of_frame_is_told_apart(port: Port) -> None:
    before = time.monotonic_ns()
    run(
        "cansend vcan0 281#0100020003000400; cansend vcan0 281#01; cansend vcan0 281#R; cansend vcan0 701#05;"
        "cansend vcan0 00000281#0100020003000400; cansend vcan0 20000004#0001000000000000"
    )
    assert select.select([port.fileno()], [], [], 1.0)[0]
    others = port.drain()
    counters = port.counters
    assert (counters.samples, counters.short, counters.foreign, counters.errors) == (1, 1, 2, 1)
    assert [(can_id, data) for can_id, data, _ in others] == [(0x701, b"\x05")]
    assert port.slab.read()[0].tolist() == [1, 2, 3, 4]
    assert before < port.slab.t_ns[0] < others[0][2] <= time.monotonic_ns()  # kernel stamps, our clock
    assert not select.select([port.fileno()], [], [], 0)[0]


def test_own_frames_do_not_come_back(port: Port) -> None:
    assert port.send(0x80, b"")
    assert port.drain() == []
    assert port.counters.frames == 0


def test_interface_may_go_down_and_come_up(port: Port) -> None:
    run("ip link set vcan0 down")
    try:
        assert eventually(port, lambda: port.counters.receive_errors == 1)
        assert "down" in port.problem
        assert not port.send(0x80, b"")
    finally:
        run("ip link set vcan0 up")
    run("cansend vcan0 281#0100020003000400")
    assert eventually(port, lambda: port.counters.samples == 1)
    assert port.problem == ""
    assert port.send(0x80, b"")


def test_interface_may_be_unplugged_and_plugged_in_again(port: Port) -> None:
    descriptor = port.fileno()
    run("ip link del vcan0")
    try:
        assert eventually(port, lambda: "No such device" in port.problem)
        assert not port.send(0x80, b"")
    finally:
        run("ip link add vcan0 type vcan && ip link set vcan0 up")
    assert eventually(port, lambda: port.problem == "")
    run("cansend vcan0 281#0100020003000400")
    assert select.select([port.fileno()], [], [], 1.0)[0]
    assert eventually(port, lambda: port.counters.samples == 1)
    assert port.fileno() == descriptor


def test_what_the_kernel_drops_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receivers, "RECEIVE_BUFFER_BYTES", 1)  # the kernel's least: a few frames
    port = open_port()
    run("cangen vcan0 -g 0 -n 500 -I 700 -L 8 -D i")
    port.drain()
    run("cansend vcan0 281#0100020003000400")  # the count comes with the next frame
    assert eventually(port, lambda: port.counters.samples == 1)
    assert port.counters.overflow == 501 - port.counters.frames > 0
    port.close()


def test_a_flood_of_strangers_costs_no_sample(port: Port) -> None:
    for number in range(12):
        run(f"cangen vcan0 -g 0 -n 400 -I 700 -L 8; cansend vcan0 281#{number:02x}00020003000400")
        port.drain()
    assert (port.counters.frames, port.counters.samples, port.counters.overflow) == (4812, 12, 0)
    assert port.slab.read()[0, 0] == 11
