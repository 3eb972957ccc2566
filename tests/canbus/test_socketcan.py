"""A port on a real SocketCAN bus, with can-utils as another device; needs a vcan0."""

from __future__ import annotations

import select
import subprocess
import time
from collections.abc import Callable, Iterator

import can
import pytest

from handtouch.canbus.bus import receivers
from handtouch.canbus.bus.bus_state import BusState, ErrorState
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.sync import Sync
from handtouch.config import Bus
from handtouch.core.slab import Slab

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


def look(port: Port) -> BusState:
    return port.update_state(time.monotonic_ns())


def open_port(slots: int = 1) -> Port:
    port = Port.open(Bus(name="palm", interface="socketcan", channel="vcan0"), Slab(slots))
    port.route(0x281, 0)
    return port


@pytest.fixture
def port() -> Iterator[Port]:
    port = open_port()
    yield port
    port.close()


def test_every_kind_of_frame_is_distinguished(port: Port) -> None:
    before = time.monotonic_ns()
    run(
        "cansend vcan0 281#0100020003000400; cansend vcan0 281#01; cansend vcan0 281#R; cansend vcan0 701#05;"
        "cansend vcan0 00000281#0100020003000400; cansend vcan0 20000004#0001000000000000"
    )
    assert select.select([port.fileno()], [], [], 1.0)[0]
    others = port.drain()
    counters = port.counters
    assert (counters.samples, counters.wrong_length, counters.unknown_frames, counters.error_frames) == (
        1,
        1,
        2,
        1,
    )
    assert [(can_id, data) for can_id, data, _ in others] == [(0x701, b"\x05")]
    assert port.slab.unpack_counts()[0].tolist() == [1, 2, 3, 4]
    assert before < port.slab.arrival_ns[0] < others[0][2] <= time.monotonic_ns()  # kernel stamps, our clock
    assert not select.select([port.fileno()], [], [], 0)[0]


def test_bursts_longer_than_a_batch_are_read_whole_with_rising_stamps(port: Port) -> None:
    run("cangen vcan0 -g 0 -n 600 -I 281 -L 8 -D i; cangen vcan0 -g 0 -n 3 -I 701 -L 1 -D i")
    run("cangen vcan0 -g 0 -n 600 -I 281 -L 8 -D i")
    others = port.drain()
    assert [can_id for can_id, _, _ in others] == [0x701] * 3
    assert (port.counters.samples, port.counters.frames, port.counters.overflow) == (1200, 1203, 0)
    assert others[0][2] <= others[1][2] <= others[2][2] < port.slab.arrival_ns[0] <= time.monotonic_ns()
    assert int.from_bytes(port.slab.unpack_counts()[0].astype("<i2").tobytes(), "little") == 599


def test_own_frames_do_not_come_back(port: Port) -> None:
    assert port.send(0x80, b"")
    assert port.drain() == []
    assert port.counters.frames == 0


def test_interface_may_go_down_and_come_up(port: Port) -> None:
    run("ip link set vcan0 down")
    try:
        assert eventually(port, lambda: port.counters.receive_failures == 1)
        assert "ip link set vcan0 up" in look(port).problem
        assert port.bus_state.error_state is ErrorState.DOWN
        assert not port.send(0x80, b"")
        assert (port.counters.send_failures, port.counters.queue_full) == (1, 0)
    finally:
        run("ip link set vcan0 up")
    run("cansend vcan0 281#0100020003000400")
    assert eventually(port, lambda: port.counters.samples == 1)
    assert look(port).problem == ""
    assert port.send(0x80, b"")


def test_interface_is_detected_up_on_a_bus_without_other_senders(port: Port) -> None:
    run("ip link set vcan0 down")
    try:
        assert eventually(port, lambda: look(port).error_state is ErrorState.DOWN)
    finally:
        run("ip link set vcan0 up")
    assert eventually(port, lambda: port.send(0x80, b""))
    assert look(port).error_state is ErrorState.ACTIVE


def test_interface_may_be_unplugged_and_plugged_in_again(port: Port) -> None:
    descriptor = port.fileno()
    run("ip link del vcan0")
    try:
        assert eventually(port, lambda: "No such device" in look(port).problem)
        assert not port.send(0x80, b"")
    finally:
        run("ip link add vcan0 type vcan && ip link set vcan0 up")
    assert eventually(port, lambda: look(port).problem == "")
    run("cansend vcan0 281#0100020003000400")
    assert select.select([port.fileno()], [], [], 1.0)[0]
    assert eventually(port, lambda: port.counters.samples == 1)
    assert port.fileno() == descriptor


def test_frames_dropped_by_the_kernel_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receivers, "RECEIVE_BUFFER_BYTES", 1)  # the kernel's least: a few frames
    port = open_port()
    run("cangen vcan0 -g 0 -n 500 -I 700 -L 8 -D i")
    port.drain()
    assert port.counters.overflow == 500 - port.counters.frames > 0
    port.close()


def test_error_frames_are_reported_as_text(port: Port) -> None:
    """By cansend, in the layout of <linux/can/error.h>; vcan itself makes none."""
    run("cansend vcan0 20000204#0020000000008803; cansend vcan0 20000020#; cansend vcan0 20000002#0B")
    assert eventually(port, lambda: port.counters.error_frames == 3)
    figures = look(port).report()
    assert figures["state"] == "passive"
    assert (figures["transmit_errors"], figures["receive_errors"]) == (0x88, 3)
    assert figures["causes"] == {"transmit passive": 1, "no acknowledge": 1, "lost arbitration": 1}
    run("cansend vcan0 20000040#0000000000000000")
    assert eventually(port, lambda: look(port).error_state is ErrorState.BUS_OFF)
    assert "restart-ms 100" in port.problem
    run("cansend vcan0 20000100#0000000000000000")
    assert eventually(port, lambda: look(port).error_state is ErrorState.ACTIVE)
    assert port.problem == ""


def test_remote_frame_is_sent_as_one(port: Port) -> None:
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        assert port.send(0x701, bytes(1), remote=True)
        got = other.recv(2.0)
    assert got is not None
    assert (got.arbitration_id, got.is_remote_frame, got.dlc, got.data) == (0x701, True, 1, bytearray())


def produce(sync: Sync, port: Port, seconds: float) -> int:
    """Run the daemon's loop; return the number of cycles."""
    cycles, end_s = 0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        now_ns = time.monotonic_ns()
        select.select([port.fileno()], [], [], max(0.0, (sync.wake_ns - now_ns) * 1e-9))
        for can_id, _, t_ns in port.drain():
            assert can_id == 0x80
            sync.handle_sync(port.name, t_ns)
        cycles += len(sync.poll(time.monotonic_ns(), port.received_until_ns))
        port.update_state(time.monotonic_ns())
    return cycles


def syncs_of(other: can.BusABC) -> int:
    count = 0
    while (message := other.recv(0)) is not None:
        count += message.arbitration_id == 0x80
    return count


def test_kernel_sends_sync_at_changing_periods_and_stops(port: Port) -> None:
    sync = Sync([port], 20_000_000)
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        sync.start(time.monotonic_ns())
        for period_ns, seconds in ((20_000_000, 1.0), (100_000_000, 2.0), (20_000_000, 1.0)):
            sync.set_period(period_ns, time.monotonic_ns())
            cycles = produce(sync, port, seconds)
            expected = seconds * 1e9 / period_ns
            assert expected / 2 < cycles < expected + 3
            assert expected / 2 < syncs_of(other) < expected + 3
        assert sync.report("palm", time.monotonic_ns())["by"] == "kernel"
        assert port.counters.sent == 0  # by the loop
        assert sync.report("palm", time.monotonic_ns())["other_syncs"] == 0
        assert sync.report("palm", time.monotonic_ns())["jitter_us"]["p50"] < 20_000
        sync.stop()
        syncs_of(other)
        time.sleep(0.1)  # long enough for five more
        assert syncs_of(other) == 0


def test_loop_takes_over_while_the_interface_is_missing_and_one_sender_is_left(port: Port) -> None:
    sync = Sync([port], 20_000_000)
    sync.start(time.monotonic_ns())
    produce(sync, port, 0.3)
    run("ip link del vcan0")
    try:
        cycles = produce(sync, port, 1.0)
        assert cycles > 20  # silence of the bus is no silence of the hand
        assert sync.report("palm", time.monotonic_ns())["by"] == "loop"
        assert port.counters.send_failures > 0
    finally:
        run("ip link add vcan0 type vcan && ip link set vcan0 up")
    produce(sync, port, 6.5)
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        produce(sync, port, 1.0)
        assert 25 < syncs_of(other) < 54
    assert sync.report("palm", time.monotonic_ns())["by"] == "kernel"
    assert sync.report("palm", time.monotonic_ns())["other_syncs"] == 0
    sync.stop()


def test_other_sync_producer_is_reported(port: Port) -> None:
    sync = Sync([port], 20_000_000)
    sync.start(time.monotonic_ns())
    other = subprocess.Popen(["cangen", "vcan0", "-g", "10", "-I", "080", "-L", "0", "-n", "150"])
    produce(sync, port, 2.5)
    other.wait()
    figures = sync.report("palm", time.monotonic_ns())
    assert figures["other_syncs"] > 20
    assert 'sync = "consumer"' in figures["problem"]
    sync.stop()


def test_a_flood_of_foreign_frames_costs_no_sample(port: Port) -> None:
    for number in range(12):
        run(f"cangen vcan0 -g 0 -n 400 -I 700 -L 8; cansend vcan0 281#{number:02x}00020003000400")
        port.drain()
    assert (port.counters.frames, port.counters.samples, port.counters.overflow) == (4812, 12, 0)
    assert port.slab.unpack_counts()[0, 0] == 11


def test_frames_that_waited_when_the_interface_went_down_do_not_make_it_look_up(port: Port) -> None:
    """The kernel reports the error before the frames that are still in the queue."""
    run("cansend vcan0 281#0100020003000400; cansend vcan0 281#0200020003000400; ip link set vcan0 down")
    states = []
    for _ in range(20):
        port.drain()
        states.append(look(port).error_state)
        time.sleep(0.01)
    run("ip link set vcan0 up")
    assert port.counters.samples == 2
    assert set(states[1:]) == {ErrorState.DOWN}
    run("cansend vcan0 281#0300020003000400")
    assert eventually(port, lambda: look(port).error_state is ErrorState.ACTIVE)
