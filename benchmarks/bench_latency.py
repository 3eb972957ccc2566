"""From the last frame of a SYNC to the subscriber: latency, processor share and losses of the real daemon.

Nodes, daemon and subscriber are three processes on a udp_multicast bus over loopback (in a network namespace
of their own where that is to be had), or on vcan0 under `tests/socketcan/vcan-run`. The floor is a bare loop
in place of the daemon: it sends SYNC, receives the same frames with the same library, sends a message of the
same size when the last has come, and computes nothing. Daemon and floor take turns, as ordinary processes,
and where this user may have it, with real-time priority, the daemon then also with busy_poll_us; with
contacts at rest and with sliding ones. Ratios are of medians over the turns. Writes
docs/benchmarks/latency.{md,json}.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.page import made_by, options, output_folder
from handtouch import wire
from handtouch.client import request
from handtouch.config import Deployment, load, shipped
from handtouch.config.tables import Daemon as DaemonTable
from handtouch.daemon import stage_timer as histogram
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.device import DeviceBus
from handtouch.host import realtime
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
BUSY_POLL_US, PRIORITY = 1000, 40
PATHS = {"resting": "[[0.4, 0.4]]", "sliding": "[[0.3, 0.3], [0.7, 0.4], [0.3, 0.5], [0.7, 0.6], [0.4, 0.7]]"}
"""Path of the contacts, passed within ROUND_S in both directions"""
MOST = 400_000
FLOOR_ID = b"hand/floor"


class StampedBus:
    """A bus that records the send time of the last frame of each reply to SYNC."""

    def __init__(self, bus: can.BusABC, last_id: int, stamps: Any) -> None:
        self._bus, self._last_id, self._stamps = bus, last_id, stamps

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == self._last_id:  # before, for it may be answered before `send` returns
            count = int(self._stamps[0])
            self._stamps[1 + count % (len(self._stamps) - 1)] = time.monotonic_ns()
            self._stamps[0] = count + 1
        self._bus.send(message, timeout)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


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


def nodes(config: Path, samples: NDArray[np.int64], stamps: Any, stop: Event) -> None:
    """Run the simulated nodes in a process; they repeat the samples."""
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    period_ns = round(deployment.daemon.sync_period_ms * 1e6)
    with open_bus() as bus:
        devices = DeviceBus(
            StampedBus(bus, 0x280 + pads[-1].node_id, stamps),  # type: ignore[arg-type]  # it quacks like one
            lambda t_ns: samples[t_ns // period_ns % len(samples)],
        )
        for pad in pads:
            devices.add(pad.node_id, serial=pad.serial)
        devices.start()
        stop.wait()
        devices.stop()


def bare_loop(endpoint: str, count: int, size: int, period_s: float, priority: int, stop: Event) -> None:
    """Run the floor: receive, store, send, without computing; start the nodes by NMT, each by its id."""
    context = zmq.Context()
    socket = context.socket(zmq.PUB)
    socket.bind(endpoint)
    if priority:
        refused = realtime.apply_realtime_settings(DaemonTable(realtime_priority=priority))
        assert not refused, refused
    slab = bytearray(8 * 128)
    payload = bytes(size - len(FLOOR_ID) - 8)
    with open_bus() as bus:
        booted: set[int] = set()
        while len(booted) < count:
            message = bus.recv(1.0)
            if message is not None and message.arbitration_id > 0x700:
                booted.add(message.arbitration_id - 0x700)
        for node_id in booted:
            bus.send(can.Message(arbitration_id=0, data=[1, node_id], is_extended_id=False))
        next_s = time.monotonic()
        while not stop.is_set():
            time.sleep(max(0.0, next_s - time.monotonic()))
            t_ns = time.monotonic_ns()
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            missing = count
            while missing:
                message = bus.recv(1.0)  # all come, only late: who gave up would be one frame ahead for good
                if message is None:
                    break
                if 0x280 < message.arbitration_id < 0x300:
                    start = 8 * (message.arbitration_id - 0x280)
                    slab[start : start + 8] = message.data
                    missing -= 1
            socket.send_multipart([FLOOR_ID, t_ns.to_bytes(8, "little") + payload])
            next_s += period_s
    socket.close()
    context.term()


class Tracer(histogram.StageTimer):
    """Records the end of each part of the loop."""

    def __init__(self, now_ns: int) -> None:
        super().__init__(now_ns)
        self.trace: list[tuple[int, int]] = []

    def lap(self, stage: int, now_ns: int) -> None:
        self.trace.append((stage, now_ns))
        super().lap(stage, now_ns)

    def record_wait(self, wake_ns: int, now_ns: int) -> None:
        self.trace.append((histogram.WAIT, now_ns))
        super().record_wait(wake_ns, now_ns)


def traced(config: Path, out: Path, stop: Event) -> None:
    """Run the daemon with a tracer in a process."""
    with HandtouchDaemon.open(load(config)) as daemon:
        tracer = Tracer(time.monotonic_ns())
        daemon.reporter.stage_timer = tracer
        over = threading.Event()

        def end() -> None:
            stop.wait()
            over.set()

        threading.Thread(target=end, daemon=True).start()
        daemon.run(over)
    np.save(out, np.array(tracer.trace, dtype=np.int64))


class Turn(NamedTuple):
    """Results of one pass: rows (k, 2) of SYNC time and arrival time of each message [ns], and statistics."""

    came_ns: NDArray[np.int64]
    last_frames_ns: NDArray[np.int64]
    figures: dict[str, Any]
    size: int

    def latencies_us(self) -> NDArray[np.float64]:
        """Return the latency from the last frame of each SYNC to the message of its tick."""
        sync_ns, got_ns = self.came_ns.T
        which = np.searchsorted(self.last_frames_ns, sync_ns)
        known = which < len(self.last_frames_ns)
        late_us = (got_ns[known] - self.last_frames_ns[which[known]]) * 1e-3
        return np.asarray(late_us[late_us > 0])  # one that left without the last frame has none to count from


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


def serve_and_receive(
    config: Path,
    samples: NDArray[np.int64],
    endpoint: str,
    server: Callable[[Event], BaseProcess | subprocess.Popen[bytes]],
    seconds: float,
) -> Turn:
    """Measure one pass with this server between nodes and a subscriber."""
    stamps, stop = multiprocessing.Array("q", 1 + MOST, lock=False), multiprocessing.Event()
    worker = multiprocessing.Process(target=nodes, args=(config, samples, stamps, stop), daemon=True)
    worker.start()
    process = server(stop)
    control, figures = load(config).daemon.control, {}
    cpu = ProcessorShare()
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, 100_000)
        socket.subscribe("hand/")
        socket.connect(endpoint)
        wait_for_touch(socket)
        is_daemon = isinstance(process, subprocess.Popen)
        before = request("status", endpoint=control, timeout_s=30) if is_daemon else {}
        cpu.start(process.pid or 0)
        received = receive(socket, seconds)
        share = cpu.stop()
        if is_daemon:
            figures = losses(before, request("status", endpoint=control, timeout_s=30))
    if isinstance(process, subprocess.Popen):
        process.terminate()
        process.wait()
        stop.set()
    else:
        stop.set()
        process.join()
    worker.join()
    known = [(sync, at_ns) for parts, at_ns in received if (sync := sync_of(parts)) is not None]
    size = sum(len(part) for part in received[-1][0])
    last_frames_ns = np.array(stamps[1 : 1 + stamps[0]])
    return Turn(np.array(known), last_frames_ns, {"processor_share": share, **figures}, size)


def losses(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return losses between two replies to `status`."""

    def grown(figure: Callable[[dict[str, Any]], int]) -> int:
        return figure(after) - figure(before)

    return {
        "congestion_episodes": grown(lambda status: sum(status["service"]["congestion_episodes"].values())),
        "samples_missed": grown(lambda status: sum(pad["missed_samples"] for pad in status["pads"])),
        "overruns": grown(lambda status: status["service"]["overruns"]),
    }


def daemon_turn(config: Path, samples: NDArray[np.int64], seconds: float) -> Turn:
    """Measure one pass of `handtouch run`."""
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    live = load(config).daemon.live
    return serve_and_receive(config, samples, live, lambda _: subprocess.Popen(command), seconds)


def floor_turn(
    config: Path, samples: NDArray[np.int64], seconds: float, size: int, priority: int = 0
) -> Turn:
    """Measure one pass of the bare loop with messages of the given size."""
    endpoint = f"ipc://{config.parent}/floor"
    period_s = load(config).daemon.sync_period_ms * 1e-3

    def server(stop: Event) -> BaseProcess:
        args = endpoint, samples.shape[1], size, period_s, priority, stop
        process = multiprocessing.Process(target=bare_loop, args=args, daemon=True)
        process.start()
        return process

    return serve_and_receive(config, samples, endpoint, server, seconds)


def where_it_goes(config: Path, samples: NDArray[np.int64], seconds: float) -> dict[str, float]:
    """Return the medians [us] of the parts of the latency from the last frame to the subscriber."""
    out = config.parent / "trace.npy"

    def server(stop: Event) -> BaseProcess:
        process = multiprocessing.Process(target=traced, args=(config, out, stop), daemon=True)
        process.start()
        return process

    turn = serve_and_receive(config, samples, load(config).daemon.live, server, seconds)
    stage, at_ns = np.load(out).T
    rows = []
    for sync_ns, got_ns in turn.came_ns.tolist():
        which = int(np.searchsorted(turn.last_frames_ns, sync_ns))
        if which == len(turn.last_frames_ns):
            continue
        last_ns = int(turn.last_frames_ns[which])
        begin, end = np.searchsorted(at_ns, [sync_ns, got_ns + 2_000_000])
        tick = begin + np.flatnonzero(stage[begin:end] == histogram.TICK)
        if not len(tick) or stage[tick[0] - 2 : tick[0] + 2].tolist() != list(_WAY):
            continue
        woke, received, ticked, sent = at_ns[tick[0] - 2 : tick[0] + 2].tolist()
        if received < last_ns:
            continue
        started = max(woke, last_ns)
        rows.append((started - last_ns, received - started, ticked - received, sent - ticked, got_ns - sent))
    return dict(zip(PARTS, np.median(np.array(rows) * 1e-3, axis=0).tolist(), strict=True))


OPTIONS = {"realtime_priority": PRIORITY, "busy_poll_us": BUSY_POLL_US}
FIRST = ", ".join(("daemon", *(f"{name} = {value}" for name, value in OPTIONS.items())))
FLOORS = {"daemon": "floor", FIRST: "floor with that priority"}
"""Floor that each is compared with"""
_WAY = histogram.WAIT, histogram.RECEIVE, histogram.TICK, histogram.SEND
PARTS = (
    "until the loop reads the bus",
    "receiving the waiting frames",
    "tick",
    "encoding and sending",
    "until the subscriber receives it",
)


class ProcessorShare:
    """CPU share of a process between `start` and `stop`, of one CPU."""

    def start(self, pid: int) -> None:
        self._pid, self._ticks, self._since_s = pid, self._read(pid), time.monotonic()

    def stop(self) -> float:
        ticks = self._read(self._pid) - self._ticks
        return float(ticks / os.sysconf("SC_CLK_TCK") / (time.monotonic() - self._since_s))

    @staticmethod
    def _read(pid: int) -> int:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return int(fields[11]) + int(fields[12])


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


def on_loopback(folder: Path, port: int) -> Path:
    """Write the shipped hand on a udp_multicast bus with endpoints in `folder`; return the path."""
    endpoints = "\n".join(f'{s} = "ipc://{folder}/{s}"' for s in ("live", "complete", "control", "inputs"))
    own = f'{endpoints}\nstore = "{folder}/calibrations.db"'
    text = shipped.path("utah_mit.toml").read_text().replace("[daemon]\n", f"[daemon]\n{own}\n")
    if VCAN.exists():
        text = text.replace('channel = "can0"', f'channel = "{VCAN.name}"')
    else:
        channel = f'channel = "{CHANNEL}"\noptions = {{ port = {port} }}'
        text = text.replace('"socketcan"', '"udp_multicast"').replace('channel = "can0"', channel)
    config = folder / "hand.toml"
    config.write_text(text)
    return config


def machine() -> str:
    """Return a description of the machine."""
    where = f"{os.environ['VCAN_RUN']}, " if "VCAN_RUN" in os.environ else ""
    return f"{where}{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"


def measure(config: Path, turns: int, seconds: float) -> dict[str, Any]:
    """Measure daemon and floor alternately, for each motion of the contacts."""
    deployment = load(config)
    films = {name: film(deployment, path) for name, path in PATHS.items()}
    first = config.with_name("first.toml")
    options = "\n".join(f"{name} = {value}" for name, value in OPTIONS.items())
    first.write_text(config.read_text().replace("[daemon]\n", f"[daemon]\n{options}\n"))
    if troubles := realtime.check_realtime_settings(load(first).daemon):
        print(f"without: {troubles[0]}")
    rows: list[dict[str, Any]] = []
    for number in range(turns):
        for motion, samples in films.items():
            done = {"daemon": daemon_turn(config, samples, seconds)}
            size = done["daemon"].size
            done["floor"] = floor_turn(config, samples, seconds, size)
            if not troubles:
                done[FIRST] = daemon_turn(first, samples, seconds)
                done[FLOORS[FIRST]] = floor_turn(config, samples, seconds, size, PRIORITY)
            for who, turn in done.items():
                late_us = turn.latencies_us()
                p50, p99, worst = np.percentile(late_us, [50, 99, 100]).tolist()
                figures = {"n": len(late_us), "p50_us": p50, "p99_us": p99, "max_us": worst, **turn.figures}
                rows.append({"turn": number, "contacts": motion, "who": who, "bytes": turn.size, **figures})
                print(rows[-1], flush=True)
    return {
        "machine": machine(),
        "load": os.getloadavg()[0],
        "rate_hz": 1e3 / deployment.daemon.sync_period_ms,
        "pads": len(deployment.hands[0].pads),
        "bus": deployment.buses[0].interface,
        "seconds": seconds,
        "turns": rows,
        "parts_us": where_it_goes(config, films["sliding"], seconds),
    }


def write(results: dict[str, dict[str, Any]], out: Path) -> str:
    """Return the page, of one or both buses."""
    text = "# Latency: last frame of a SYNC to the subscriber\n" + "".join(map(section, results.values()))
    text += "\nSocketCAN is measured under `tests/socketcan/vcan-run`.\n"
    (out / "latency.md").write_text(text)
    (out / "latency.json").write_text(json.dumps(results, indent=1) + "\n")
    return text


def section(results: dict[str, Any]) -> str:
    """Return the section of one bus."""
    rows, ratios = [], []
    for motion in PATHS:
        middle = {}
        for who in dict.fromkeys((*FLOORS, *FLOORS.values())):
            turns = [row for row in results["turns"] if (row["contacts"], row["who"]) == (motion, who)]
            if not turns:  # an earlier run, on the other bus, or one without the right to priority
                continue
            middle[who] = [
                statistics.median(turn[key] for turn in turns)
                for key in ("p50_us", "p99_us", "max_us", "processor_share")
            ]
            p50, tail, worst, share = middle[who]
            rows.append(f"| {motion} | {who} | {p50:.0f} | {tail:.0f} | {worst:.0f} | {share:.0%} |")
        for who in [who for who in FLOORS if who in middle]:
            median, p99 = (middle[who][k] / middle[FLOORS[who]][k] for k in (0, 1))
            ratios.append(f"* {motion}, {who}, to {FLOORS[who]}: median {median:.2f}, p99 {p99:.2f}")
    served = [row for row in results["turns"] if row["who"] == "daemon"]
    lost, missed, overruns = (
        sum(row[key] for row in served) for key in ("congestion_episodes", "samples_missed", "overruns")
    )
    ticks, count = sum(row["n"] for row in served), len(served) // len(PATHS)
    parts = "\n".join(f"| {part} | {us:.0f} |" for part, us in results["parts_us"].items())
    return f"""
## On {results["bus"]}

{results["pads"]} pads at {results["rate_hz"]:.0f} Hz, {TOUCHED} touched; medians of {count}
passes of {results["seconds"]:.0f} s each, daemon and floor alternately. Nodes, daemon and subscriber are
three processes, with ZeroMQ over ipc. {results["machine"]};
load average when it ended {results["load"]:.1f}. {results["made_by"]}.

| contacts | | p50, us | p99, us | worst, us | CPU share |
| --- | --- | --- | --- | --- | --- |
{chr(10).join(rows)}

Ratio to the floor, a bare loop that sleeps in python-can's `recv` for the same frames, sends a message of the
same size, and computes nothing:

{chr(10).join(ratios)}

Of {ticks} ticks of the daemon: {lost} congestion episodes, {missed} samples missed, {overruns} overruns.

Parts of the daemon's latency with sliding contacts, from a traced pass (medians, us):

| part | us |
| --- | --- |
{parts}
"""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=6.0, help="of a turn")
    parser.add_argument("--turns", type=int, default=3)
    asked = parser.parse_args()
    if not VCAN.exists():
        in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        turns, seconds = (1, 0.5) if asked.quick else (asked.turns, asked.seconds)
        found = measure(on_loopback(Path(folder), PORT), turns, seconds)
    out = output_folder(asked.quick)
    found["made_by"] = made_by()
    path = out / "latency.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    results = {bus: results[bus] for bus in ("udp_multicast", "socketcan") if bus in results}
    print(write({**results, found["bus"]: found}, out))


if __name__ == "__main__":
    main()
