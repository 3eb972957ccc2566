"""The same hand over slcan: nodes and daemon have an adapter each, a pseudo-terminal; a hub is the wire."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from handtouch.canbus.bus import receivers
from handtouch.canbus.bus.port import Port
from handtouch.config import Bus
from handtouch.core.slab import Slab

LONGEST_S = 60.0
FRAMES = b"tTrR"
SAMPLE = b"t28180100020003000400\r"


class Adapter:
    """An slcan adapter: a pseudo-terminal behind a path that outlives it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.output = bytearray()  # what the terminal has no room for yet
        self.is_open = False
        self._line = bytearray()
        self.plug()

    def plug(self) -> None:
        """Put it in; a program opens the path."""
        self.fd, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Pull it out under the program."""
        self.path.unlink(missing_ok=True)
        os.close(self.fd)
        os.close(self._slave)
        self.fd, self.is_open = -1, False
        self.output.clear()

    def read(self) -> list[bytes]:
        """Frames that the program has sent; its commands are obeyed."""
        frames = []
        *lines, rest = (bytes(self._line) + os.read(self.fd, 65536)).split(b"\r")
        self._line[:] = rest
        for line in lines:
            if line[:1] and line[:1] in FRAMES:
                frames.append(line + b"\r")
            else:
                self.is_open = line[:1] == b"O" or (self.is_open and line[:1] != b"C")
                self.output += b"\r"  # done
        return frames

    def write(self, piece: int) -> None:
        """Pass on at most so many bytes: lines come in pieces."""
        with contextlib.suppress(BlockingIOError):
            del self.output[: os.write(self.fd, self.output[:piece])]


class Hub:
    """The wire between adapters, in a thread; `piece` bytes at a time."""

    def __init__(self, *adapters: Adapter, piece: int = 17) -> None:
        self.adapters = adapters
        self.lock = threading.Lock()
        self._piece = piece
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Hub:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        for adapter in self.adapters:
            if adapter.fd >= 0:
                adapter.unplug()

    def inject(self, adapter: Adapter, data: bytes) -> None:
        """Bytes that the adapter makes up."""
        with self.lock:
            adapter.output += data

    def _run(self) -> None:
        while not self._over.is_set():
            with self.lock:
                there = [adapter for adapter in self.adapters if adapter.fd >= 0]
                full = [adapter.fd for adapter in there if adapter.output]
                readable, writable, _ = select.select([a.fd for a in there], full, [], 0)
                for adapter in there:
                    if adapter.fd in readable:
                        for frame in adapter.read():
                            for other in there:
                                if other is not adapter and other.is_open:
                                    other.output += frame
                    if adapter.fd in writable:
                        adapter.write(self._piece)
            if not readable and not writable:
                select.select([a.fd for a in there], [], [], 0.002)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(Adapter(tmp_path / "node_tty"), Adapter(tmp_path / "robot_tty")) as hub:
        yield hub


def bus_of(adapter: Adapter) -> str:
    return f"can0=slcan:{adapter.path},sleep_after_open=0"


def port_on(adapter: Adapter, slab: Slab) -> Port:
    options: dict[str, str | int | float | bool] = {"sleep_after_open": 0}
    return Port.open(Bus(name="palm", interface="slcan", channel=str(adapter.path), options=options), slab)


def start(rig: Any, hub: Hub) -> None:
    """Nodes on the first adapter, the daemon on the second."""
    nodes, robot = hub.adapters
    rig.bus = [bus_of(nodes)]
    rig.simulate()
    rig.bus = [bus_of(robot)]
    rig.start("run")
    rig.wait_operational()


def wait_contacts(rig: Any, ends: int) -> None:
    """Wait until so many contacts have ended, one has begun and some messages say how they go on."""
    events: Counter[str] = Counter()
    end_s = time.monotonic() + LONGEST_S
    with rig.subscribe("contact/*/*") as messages:
        while events["released"] < ends or events["begin"] < 1 or events["update"] <= 10:
            assert time.monotonic() < end_s, (events, rig.all_printed())
            message = messages.recv(0.5)
            if message is not None:
                events[message.end_reason or message.event] += 1


@pytest.mark.timeout(240)
def test_hand_works_over_slcan(rig: Any, hub: Hub) -> None:
    start(rig, hub)
    wait_contacts(rig, ends=2)
    bus = rig.status()["service"]["buses"]["can0"]
    assert (bus["state"], bus["problem"], bus["unknown_frames"], bus["overflow"]) == ("active", "", 0, 0)
    assert (bus["sync"]["by"], bus["sync"]["other_syncs"]) == ("loop", 0)


@pytest.mark.timeout(240)
def test_garbled_lines_are_counted_and_unplugged_adapter_recovers(rig: Any, hub: Hub) -> None:
    start(rig, hub)
    before = rig.status()["service"]["buses"]["can0"]
    robot = hub.adapters[1]
    for garbage in GARBAGE:
        hub.inject(robot, garbage + b"\r")
        time.sleep(0.05)  # apart, as they would come
    rig.wait(
        "counted the garbage",
        lambda status: status["service"]["buses"]["can0"]["receive_failures"] > before["receive_failures"],
    )
    wait_contacts(rig, ends=1)
    rig.wait_operational()

    with hub.lock:
        robot.unplug()
    status = rig.wait("down", lambda status: status["service"]["buses"]["can0"]["state"] == "down")
    assert "plug the adapter in" in status["service"]["buses"]["can0"]["problem"]
    with hub.lock:
        robot.plug()
    rig.wait_operational()
    wait_contacts(rig, ends=1)
    status = rig.wait("active", lambda status: status["service"]["buses"]["can0"]["state"] == "active")
    assert status["service"]["buses"]["can0"]["problem"] == ""


GARBAGE = [
    b"\xff\xfe\x80",
    b"t",
    b"t28",
    b"t-12800000000000000",
    b"tFFF80000000000000000",
    b"t281z",
    b"t2819000000000000000000",
    b"t28180000",
    b"t2818zzzzzzzzzzzzzzzz",
    b"T",
    b"d281F00",
    b"\x00\x00",
    b"hello world",
]


@pytest.mark.parametrize("garbage", GARBAGE)
def test_garbled_lines_neither_stop_a_port_nor_lose_the_next_frame(hub: Hub, garbage: bytes) -> None:
    nodes, robot = hub.adapters
    slab = Slab(1)
    port = port_on(robot, slab)
    port.route(0x281, 0)
    with can.Bus(
        interface="slcan", channel=str(nodes.path), sleep_after_open=0, bitrate=1_000_000
    ) as stranger:
        assert stranger is not None
        hub.inject(robot, garbage + b"\r" + SAMPLE)
        end_s = time.monotonic() + 10
        while not port.counters.samples:
            assert time.monotonic() < end_s, port.counters
            select.select([port], [], [], 0.1)
            assert all(0 <= can_id < 0x800 for can_id, _, _ in port.drain())
        assert slab.unpack_counts()[0].tolist() == [1, 2, 3, 4]
        while not port.send(0x701, bytes(1), remote=True):  # refused by a machine too busy to take it
            assert time.monotonic() < end_s, port.counters
        got = stranger.recv(5.0)
        assert got is not None
        assert (got.arbitration_id, got.is_remote_frame, got.dlc) == (0x701, True, 1)
    port.close()


def test_blocked_adapter_delays_sending_only_briefly_and_is_reported(tmp_path: Path) -> None:
    """The adapter's terminal buffer is full: the other end doesn't read."""
    adapter = Adapter(tmp_path / "tty")
    port = Port.open(
        Bus(name="palm", interface="slcan", channel=str(adapter.path), options={"sleep_after_open": 0}),
        Slab(1),
    )
    worst_s, sent = 0.0, 0
    for _ in range(2000):
        start_s = time.monotonic()
        sent += port.send(0x201, bytes(8))
        worst_s = max(worst_s, time.monotonic() - start_s)
        if sent < _:
            break
    assert 0 < sent < 2000
    assert port.counters.queue_full + port.counters.send_failures >= 1
    assert worst_s < 5
    adapter.unplug()
    port.close()


def test_repeated_unplugging_leaks_no_descriptor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can's slcan leaves its terminal open when closing it fails."""
    monkeypatch.setattr(receivers, "_MIN_RETRY_S", 0.01)
    with Hub(Adapter(tmp_path / "tty")) as hub:
        adapter = hub.adapters[0]
        port = port_on(adapter, Slab(1))
        counts = []
        for number in range(5):
            with hub.lock:
                adapter.unplug()
                adapter.plug()
            end_s = time.monotonic() + 20
            while port.counters.frames <= number or adapter.output:
                assert time.monotonic() < end_s, port.update_state(time.monotonic_ns()).problem
                select.select([port], [], [], 0.05)
                port.drain()
                if adapter.is_open and port.counters.frames <= number and not adapter.output:
                    hub.inject(adapter, SAMPLE)
            counts.append(len(os.listdir("/proc/self/fd")))
        port.close()
    assert len(set(counts)) == 1
