"""Latency from the last frame of a SYNC to the subscriber: of the real daemon beside a bare loop.

Nodes, daemon and subscriber are three processes, with ZeroMQ over ipc; the shipped hand of 15 pads, 5 touched
by contacts at rest or sliding. The floor is a bare loop in place of the daemon: it sends SYNC, receives the
same frames with the same library, sends a message of the same size when the last has come, and computes
nothing. Daemon and floor take turns, as ordinary processes, and where this user may have it, with real-time
priority, the daemon then also with busy_poll_us. *To floor*: p50 and p99 over those of the floor it is
compared with. *Stages*: means of the daemon's own histograms. *By rate*: a minute of each, sliding, as
`make soak ONLY=cyclic` measures an hour. SocketCAN is measured under `tests/socketcan/vcan-run`.
"""

from __future__ import annotations

import itertools
import multiprocessing
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.page import Report, middle, progress
from benchmarks.served_hand import (
    FLOOR_ID,
    MOST,
    PATHS,
    PORT,
    VCAN,
    ProcessorShare,
    asked_of,
    film,
    in_own_network,
    losses,
    nodes,
    on_loopback,
    open_bus,
    receive,
    stage_us,
    sync_of,
    wait_for_touch,
)
from handtouch.client import request
from handtouch.config import load
from handtouch.config.tables import Daemon as DaemonTable
from handtouch.host import realtime


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


class Turn(NamedTuple):
    """Results of one pass: rows (k, 2) of SYNC time and arrival time of each message [ns], and statistics."""

    came_ns: NDArray[np.int64]
    last_frames_ns: NDArray[np.int64]
    figures: dict[str, Any]
    size: int
    stages_us: dict[str, float]
    """Mean time per period in each stage of the daemon's loop."""

    def latencies_us(self) -> NDArray[np.float64]:
        """Return the latency from the last frame of each SYNC to the message of its tick."""
        sync_ns, got_ns = self.came_ns.T
        which = np.searchsorted(self.last_frames_ns, sync_ns)
        known = which < len(self.last_frames_ns)
        late_us = (got_ns[known] - self.last_frames_ns[which[known]]) * 1e-3
        return np.asarray(late_us[late_us > 0])  # one that left without the last frame has none to count from


def serve_and_receive(
    config: Path,
    samples: NDArray[np.int64],
    endpoint: str,
    server: Callable[[Event], BaseProcess | subprocess.Popen[bytes]],
    seconds: float,
    prepared: bool = False,
) -> Turn:
    """Measure one pass with this server between nodes, whose answers may be prepared, and a subscriber."""
    stamps, stop = multiprocessing.Array("q", 1 + MOST, lock=False), multiprocessing.Event()
    parameters = config, samples, stamps, stop, prepared
    worker = multiprocessing.Process(target=nodes, args=parameters, daemon=True)
    worker.start()
    process = server(stop)
    control, figures, stages = load(config).daemon.control, {}, dict[str, float]()
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
            after = request("status", endpoint=control, timeout_s=30)
            figures = losses(before, after)
            stages = {name: stage_us(before, after, name) for name in after["service"]["loop"]["stages"]}
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
    return Turn(np.array(known), last_frames_ns, {"CPU, %": 100 * share, **figures}, size, stages)


def daemon_turn(config: Path, samples: NDArray[np.int64], seconds: float, prepared: bool = False) -> Turn:
    """Measure one pass of `handtouch run`."""
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    live = load(config).daemon.live
    server: Callable[[Event], subprocess.Popen[bytes]] = lambda _: subprocess.Popen(command)  # noqa: E731
    return serve_and_receive(config, samples, live, server, seconds, prepared)


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


BUSY_POLL_US, PRIORITY = 1000, 40
OPTIONS = {"realtime_priority": PRIORITY, "busy_poll_us": BUSY_POLL_US}
FIRST = ", ".join(("daemon", *(f"{name} = {value}" for name, value in OPTIONS.items())))
FLOORS = {"daemon": "floor", FIRST: "floor with that priority"}
"""Floor that each is compared with"""
SUMS = ("ticks", "congestion episodes", "samples missed", "overruns")


def with_options(text: str) -> str:
    """Return a deployment file with real-time settings."""
    options = "".join(f"{name} = {value}\n" for name, value in OPTIONS.items())
    return text.replace("[daemon]\n", f"[daemon]\n{options}")


def measure(report: Report, config: Path, turns: int, seconds: float) -> None:
    """Measure daemon and floor alternately, for each motion of the contacts."""
    films = {name: film(load(config), path) for name, path in PATHS.items()}
    first = config.with_name("first.toml")
    first.write_text(with_options(config.read_text()))
    if troubles := realtime.check_realtime_settings(load(first).daemon):
        print(f"without: {troubles[0]}")
    rows: list[dict[str, Any]] = []
    stages: list[dict[str, Any]] = []
    for number in range(turns):
        for motion, samples in films.items():
            done = {"daemon": daemon_turn(config, samples, seconds)}
            size = done["daemon"].size
            done["floor"] = floor_turn(config, samples, seconds, size)
            if not troubles:
                done[FIRST] = daemon_turn(first, samples, seconds)
                done[FLOORS[FIRST]] = floor_turn(config, samples, seconds, size, PRIORITY)
            stages.append({"contacts": motion, "pass": number, **done["daemon"].stages_us})
            for who, turn in done.items():
                late_us = turn.latencies_us()
                p50, p99, worst = np.percentile(late_us, [50, 99, 100]).tolist()
                row = {"turn": number, "contacts": motion, "case": who, "p50, us": p50, "p99, us": p99}
                rows.append(row | {"worst, us": worst, "ticks": len(late_us), **turn.figures})
                progress(rows[-1])
    table = middle(rows, ("contacts", "case"), SUMS)
    of = {(row["contacts"], row["case"]): row for row in table}
    for row in table:
        if (floor := of.get((row["contacts"], FLOORS.get(row["case"], "")))) is not None:
            row["to floor"] = [row[key] / floor[key] for key in ("p50, us", "p99, us")]
    report.table("Latency", table)
    report.table("Stages of the loop, us a period", stages)


RATES_HZ = 200, 1000
PASS_SYNCS = 60_000
"""SYNCs after which the daemon starts again: a pass keeps all messages in memory"""
LATE_US = 5000.0
_LATENESS = re.compile(r"^(\d+)[ \t]+(\d+)$", re.MULTILINE)


def at_rate(folder: Path, rate_hz: int) -> Path:
    """Write the shipped hand at a rate of SYNC, with real-time settings where this user may have them."""
    config = on_loopback(folder, PORT)
    period = f"sync_period_ms = {1e3 / rate_hz:g}\n"
    text = re.sub(r"sync_period_ms = .*\n", period, config.read_text(), count=1)
    config.write_text(with_options(text))
    if realtime.check_realtime_settings(load(config).daemon):
        config.write_text(text)
    return config


def distribution(rate_hz: int, seconds: float) -> list[dict[str, Any]]:
    """Return rows of the daemon's latency at a rate of SYNC; and by `cyclictest`, where that is installed, of
    the system's timers."""
    turns, left_s = list[Turn](), seconds
    while left_s > 0:
        pass_s = min(left_s, PASS_SYNCS / rate_hz)
        with tempfile.TemporaryDirectory(prefix="ht.") as folder:
            config = at_rate(Path(folder), rate_hz)
            turns.append(daemon_turn(config, film(load(config), PATHS["sliding"]), pass_s, prepared=True))
        left_s -= pass_s
        progress({"SYNCs/s": rate_hz, "left, s": left_s})
    late_us = np.concatenate([turn.latencies_us() for turn in turns])
    sums = {name: sum(turn.figures[name] for turn in turns) for name in SUMS if name != "ticks"}
    rows = [{"SYNCs/s": rate_hz, "of": "last frame to subscriber", **_percentiles(late_us), **sums}]
    if woken_us := cyclictest_us(rate_hz, seconds):
        rows.append({"SYNCs/s": rate_hz, "of": "cyclictest", **_percentiles(np.array(woken_us))})
    return rows


def _percentiles(late_us: NDArray[np.float64]) -> dict[str, Any]:
    names = ("p50, us", "p99, us", "99.9 %, us", "99.99 %, us", "worst, us")
    shares = np.percentile(late_us, [50, 99, 99.9, 99.99, 100]).tolist()
    late = 100 * float(np.mean(late_us > LATE_US))
    return {"periods": len(late_us), **dict(zip(names, shares, strict=True)), "later than 5 ms, %": late}


def cyclictest_us(rate_hz: int, seconds: float) -> list[float]:
    """Return how late [us] `cyclictest` was woken in each period; nothing without it."""
    program = shutil.which("cyclictest")
    if program is None:
        return []
    period_us, most_us = round(1e6 / rate_hz), 100_000
    command = [program, "--quiet", "--mlockall", f"--interval={period_us}", f"--histogram={most_us}"]
    command += [f"--priority={PRIORITY}", f"--loops={round(seconds * rate_hz)}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = [(float(late), int(count)) for late, count in _LATENESS.findall(done.stdout)]
    return list(itertools.chain.from_iterable(itertools.repeat(late, count) for late, count in found))


def main() -> None:
    asked = asked_of(__doc__, seconds=6.0, turns=3, quick_s=0.5)
    if not VCAN.exists():
        in_own_network()
    bus = "socketcan" if VCAN.exists() else "udp_multicast"
    report = Report(asked.quick, bus, passes=asked.turns, seconds_of_a_pass=asked.seconds)
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        measure(report, on_loopback(Path(folder), PORT), asked.turns, asked.seconds)
    minute_s = 1.0 if asked.quick else 60.0
    report.table("By rate", [row for rate_hz in RATES_HZ for row in distribution(rate_hz, minute_s)])
    report.keep()


if __name__ == "__main__":
    main()
