"""The shipped hand on a bus of its own: its nodes, daemon and subscribers, as processes to be measured.

Nodes, daemon and subscribers are processes on a udp_multicast bus over loopback (in a network namespace of
their own where that is to be had), or on vcan0 under `tests/socketcan/vcan-run`.

Public names: `in_own_network`, `on_loopback`, `open_bus`, `SpacedBus`; `film`, `nodes`, `PreparedAnswers`,
`serving`, `daemon_process`, `bystanders`; `receive`, `sync_of`, `wait_for_touch`, `losses`, `stage_us`;
`ProcessorShare`, `processor_s`, `resident_mb`, `descriptors`; `asked_of`, `in_turns`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import can
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.page import Rows, options, progress
from handtouch import wire
from handtouch.canbus.bus.load import frame_bits
from handtouch.canbus.cia301 import SYNC
from handtouch.config import Deployment, load, shipped
from handtouch.device import DeviceBus
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

CHANNEL, PORT = "239.74.163.9", 43999
VCAN = Path("/sys/class/net/vcan0")
TOUCHED = 5
TOUCH_TIMEOUT_S = 60.0
ROUND_S = 5.0
SETTLED_S = 6.0
"""Wait after the first contacts: the supervisor process starts, which loads one CPU for 3 s"""
PATHS = {"resting": "[[0.4, 0.4]]", "sliding": "[[0.3, 0.3], [0.7, 0.4], [0.3, 0.5], [0.7, 0.6], [0.4, 0.7]]"}
"""Path of the contacts, passed within ROUND_S in both directions"""
MOST = 400_000
MIN_SLEEP_S = 80e-6
"""Shorter sleeps end too late by more than that"""
FLOOR_ID = b"hand/floor"
JOINING_S = 1.0
HEARTBEAT_S = 0.1
"""Heartbeat period of a node with prepared answers"""


class SendingBus:
    """A bus whose `send` a subclass replaces."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


class StampedBus(SendingBus):
    """A bus that records the send time of the last frame of each reply to SYNC."""

    def __init__(self, bus: can.BusABC, last_id: int, stamps: Any) -> None:
        super().__init__(bus)
        self._last_id, self._stamps = last_id, stamps

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == self._last_id:  # before, for it may be answered before `send` returns
            count = int(self._stamps[0])
            self._stamps[1 + count % (len(self._stamps) - 1)] = time.monotonic_ns()
            self._stamps[0] = count + 1
        self._bus.send(message, timeout)


class SpacedBus(SendingBus):
    """A bus that sends a frame no sooner after the one before than that takes at a bit rate."""

    def __init__(self, bus: can.BusABC, bitrate_bit_s: int) -> None:
        super().__init__(bus)
        self._bitrate_bit_s, self._free_s = bitrate_bit_s, 0.0

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        while (left_s := self._free_s - time.monotonic()) > 0:
            time.sleep(left_s if left_s > MIN_SLEEP_S else 0.0)
        self._bus.send(message, timeout)
        self._free_s = time.monotonic() + frame_bits(len(message.data)) / self._bitrate_bit_s


def open_bus() -> can.BusABC:
    """Open the bus shared by all processes."""
    if VCAN.exists():
        return can.Bus(VCAN.name, interface="socketcan", ignore_config=True)
    return can.Bus(CHANNEL, interface="udp_multicast", port=PORT, ignore_config=True)


def film(deployment: Deployment, path: str, touched: Iterable[int] = range(TOUCHED)) -> NDArray[np.int64]:
    """Return counts (k, pads, 4), one sample per SYNC: contacts slide along the path and back."""
    links = [pad.link for hand in deployment.hands for pad in hand.pads]
    touches = "\n".join(
        f'[[touch]]\nlink = "{link}"\nfrom_s = 0\nduration_s = {ROUND_S + 1}\nramp_s = 0.4\nforce_n = [1.5]\n'
        f"radius_mm = 2.5\npath = {path}"
        for link in (links[n] for n in touched)
    )
    hand = VirtualHand(deployment, Scenario.parse(touches), WORLDS["ideal"].draw(Family.REPORTING.seed(1)))
    times_s = np.arange(0.5, 0.5 + ROUND_S, deployment.daemon.sync_period_ms * 1e-3)
    there = np.stack([hand.sample(t_s) for t_s in times_s])
    return np.concatenate([there, there[::-1]])


def nodes(config: Path, samples: NDArray[np.int64], stamps: Any, stop: Event, prepared: bool = False) -> None:
    """Run the simulated nodes in a process; they repeat the samples.

    prepared: once they are operational they only answer SYNC, with frames made before, and send heartbeats.
    """
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    period_ns = round(deployment.daemon.sync_period_ms * 1e6)
    with open_bus() as bus:
        stamped: Any = StampedBus(bus, 0x280 + pads[-1].node_id, stamps)
        devices = DeviceBus(stamped, lambda t_ns: samples[t_ns // period_ns % len(samples)])
        made = [devices.add(pad.node_id, serial=pad.serial) for pad in pads]
        devices.start()
        while prepared and not all(node.state == "OPERATIONAL" for node in made):
            stop.wait(0.5)
        if not prepared:
            stop.wait()
        devices.stop()
        if prepared:
            answers = PreparedAnswers(
                [pad.node_id for pad in pads], samples, deployment.daemon.sync_period_ms
            )
            while not stop.is_set():
                message = bus.recv(0.1)
                if message is not None and message.arbitration_id == SYNC:
                    for frame in answers.next():
                        stamped.send(frame)


class PreparedAnswers:
    """What nodes answer to each SYNC, made before: samples (k, nodes, 4), one after the other, and their
    heartbeats, in turns. `count`: SYNCs answered."""

    def __init__(self, node_ids: Sequence[int], samples: NDArray[np.int64], period_ms: float) -> None:
        self._answers = [
            [_frame(0x280 + node_id, own.tobytes()) for node_id, own in zip(node_ids, row, strict=True)]
            for row in samples.astype("<i2")
        ]
        self._alive = [_frame(0x700 + node_id, b"\x05") for node_id in node_ids]
        self._heartbeat_syncs = max(len(node_ids), round(HEARTBEAT_S * 1e3 / period_ms))
        self.count = 0

    def next(self) -> list[can.Message]:
        """Return the frames that answer the next SYNC."""
        turn = self.count % self._heartbeat_syncs
        answers = self._answers[self.count % len(self._answers)]
        self.count += 1
        return [*answers, self._alive[turn]] if turn < len(self._alive) else answers


def _frame(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def receive(socket: zmq.Socket[bytes], seconds: float) -> list[tuple[list[bytes], int]]:
    """Receive for a time; decode later, as the floor uses the same subscriber."""
    received: list[tuple[list[bytes], int]] = []
    end_ns = time.monotonic_ns() + round(seconds * 1e9)
    now_ns = 0
    while now_ns < end_ns:
        parts = socket.recv_multipart()
        now_ns = time.monotonic_ns()
        received.append((parts, now_ns))
    return received


def sync_of(parts: list[bytes]) -> int | None:
    """Return the SYNC time of a message; None for a retained one."""
    if parts[0] == FLOOR_ID:
        return int.from_bytes(parts[1][:8], "little")
    frame = wire.decode(parts)
    return None if frame.retained else frame.t_ns


def wait_for_touch(socket: zmq.Socket[bytes], touched: int = TOUCHED) -> None:
    """Wait until so many pads are touched, and a while longer; the floor is ready with its first message.

    Raises:
        TimeoutError: they are not touched within TOUCH_TIMEOUT_S.
    """
    give_up_s = time.monotonic() + TOUCH_TIMEOUT_S
    while True:
        if time.monotonic() > give_up_s:
            raise TimeoutError(f"no frame of {touched} touched pads came within {TOUCH_TIMEOUT_S:.0f} s")
        if not socket.poll(1000):
            continue
        parts = socket.recv_multipart()
        if parts[0] == FLOOR_ID:
            break
        frame = wire.decode(parts)
        if isinstance(frame, wire.HandFrame) and frame.state.count(wire.PadState.TOUCHED) == touched:
            receive(socket, SETTLED_S)
            return
    receive(socket, 1.0)


def losses(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return losses between two replies to `status`."""

    def grown(figure: Callable[[dict[str, Any]], int]) -> int:
        return figure(after) - figure(before)

    return {
        "congestion episodes": grown(lambda status: sum(status["service"]["congestion_episodes"].values())),
        "samples missed": grown(lambda status: sum(pad["missed_samples"] for pad in status["pads"])),
        "overruns": grown(lambda status: status["service"]["overruns"]),
    }


def stage_us(before: dict[str, Any], after: dict[str, Any], stage: str) -> float:
    """Return the mean time per period in a stage of the loop between two replies to `status`."""
    sums = [status["service"]["loop"]["stages"][stage] for status in (before, after)]
    count = sum(sums[1]["counts"]) - sum(sums[0]["counts"])
    return float((sums[1]["sum_s"] - sums[0]["sum_s"]) / max(1, count) * 1e6)


class ProcessorShare:
    """CPU share of a process between `start` and `stop`, of one CPU."""

    def start(self, pid: int) -> None:
        self._pid, self._used_s, self._since_s = pid, processor_s(pid), time.monotonic()

    def stop(self) -> float:
        return (processor_s(self._pid) - self._used_s) / (time.monotonic() - self._since_s)


def processor_s(*pids: int) -> float:
    """Return the processor time that processes have used, all threads, without children."""
    stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    return sum(int(stat[11]) + int(stat[12]) for stat in stats) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def descriptors(pid: int) -> int:
    """Return the number of open files of a process."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def in_own_network() -> None:
    """Run this program again in a network namespace with multicast over loopback, if possible."""
    if os.environ.get("HANDTOUCH_BENCH_NETWORK"):
        return
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    inside = 'ip link set lo up && ip route add 239.0.0.0/8 dev lo && exec "$@"'
    try:
        subprocess.run(["unshare", "--net", *user, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return  # then over this host's own network
    os.environ["HANDTOUCH_BENCH_NETWORK"] = "1"
    command = ["unshare", "--net", *user, "sh", "-c", inside, "sh", sys.executable, *sys.argv]
    os.execvp("unshare", command)


def on_loopback(folder: Path, port: int, file: str = "utah_mit.toml") -> Path:
    """Write a shipped hand on a udp_multicast bus with endpoints in `folder`; return the path."""
    endpoints = "\n".join(f'{s} = "ipc://{folder}/{s}"' for s in ("live", "complete", "control", "inputs"))
    own = f'{endpoints}\nstore = "{folder}/calibrations.db"'
    text = shipped.path(file).read_text().replace("[daemon]\n", f"[daemon]\n{own}\n")
    if VCAN.exists():
        text = text.replace('channel = "can0"', f'channel = "{VCAN.name}"')
    else:
        channel = f'channel = "{CHANNEL}"\noptions = {{ port = {port} }}'
        text = text.replace('"socketcan"', '"udp_multicast"').replace('channel = "can0"', channel)
    config = folder / "hand.toml"
    config.write_text(text)
    return config


def bystanders(endpoint: str, count: int, stop: Event) -> None:
    """Run subscribers in a process; they only read."""
    with zmq.Context() as context:
        context.set(zmq.MAX_SOCKETS, 2 * count + 10)
        poller, sockets = zmq.Poller(), []
        for _ in range(count):
            socket = context.socket(zmq.SUB)
            socket.setsockopt(zmq.LINGER, 0)
            socket.subscribe("hand/")
            socket.connect(endpoint)
            poller.register(socket, zmq.POLLIN)
            sockets.append(socket)
        while not stop.is_set():
            for socket, _ in poller.poll(100):
                socket.recv_multipart()
        for socket in sockets:
            socket.close()


@contextmanager
def serving(config: Path, touched: int = TOUCHED) -> Iterator[tuple[int, Any]]:
    """Run simulated nodes and the daemon from when pads are touched; yield its process and send times."""
    deployment = load(config)
    stamps, stop = multiprocessing.Array("q", 1 + MOST, lock=False), multiprocessing.Event()
    samples = film(deployment, PATHS["sliding"], range(touched))
    worker = multiprocessing.Process(target=nodes, args=(config, samples, stamps, stop), daemon=True)
    worker.start()
    try:
        with daemon_process(config) as pid:
            with zmq.Context() as context, context.socket(zmq.SUB) as socket:
                socket.setsockopt(zmq.LINGER, 0)
                socket.subscribe("hand/")
                socket.connect(deployment.daemon.live)
                wait_for_touch(socket, touched)
            yield pid, stamps
    finally:
        stop.set()
        worker.join()


@contextmanager
def daemon_process(config: Path) -> Iterator[int]:
    """Run the daemon; yield its process."""
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    daemon = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield daemon.pid
    finally:
        daemon.terminate()
        daemon.wait()


def in_turns(turns: int, cases: Iterable[str], measured: Callable[[str], dict[str, Any]]) -> Rows:
    """Measure all cases repeatedly, and print each result."""
    rows = []
    for turn in range(turns):
        for name in cases:
            rows.append({"turn": turn, **measured(name)})
            progress(rows[-1])
    return rows


def asked_of(about: str | None, *, seconds: float, turns: int, quick_s: float) -> argparse.Namespace:
    """Return the options of a benchmark with repeated cases."""
    parser = options(about)
    parser.add_argument("--seconds", type=float, default=seconds, help="of a case")
    parser.add_argument("--turns", type=int, default=turns)
    asked = parser.parse_args()
    if asked.quick:
        asked.turns, asked.seconds = 1, quick_s
    return asked
