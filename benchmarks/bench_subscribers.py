"""Cost of 1, 10 and 100 subscribers for the publisher and each other; one stalled, one killed.

The real daemon and simulated nodes, as in bench_latency. One subscriber's latency is measured while others
read the same hand frames: bystanders share a process, each with its own connection; the one that is stopped
(SIGSTOP) or killed (SIGKILL) has a process to itself. All cases are gone through several times.
Writes docs/benchmarks/subscribers.{md,json}.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks.bench_latency import (
    MOST,
    PATHS,
    PORT,
    TOUCHED,
    ProcessorShare,
    Turn,
    film,
    in_own_network,
    machine,
    nodes,
    on_loopback,
    receive,
    sync_of,
    wait_for_touch,
)
from benchmarks.page import made_by, options, output_folder
from handtouch.client import request
from handtouch.config import load

CASES = {
    "1": (0, None),
    "10": (9, None),
    "100": (99, None),
    "10, one of them stalled": (8, signal.SIGSTOP),
    "10, one of them killed": (8, signal.SIGKILL),
}
"""Case -> other subscribers, and the signal sent to one more"""
JOINING_S = 1.0

Rows = list[dict[str, Any]]


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
def company(endpoint: str, count: int, fate: signal.Signals | None) -> Iterator[None]:
    """Run other subscribers; stop or kill one more during the measurement."""
    stop = multiprocessing.Event()
    others = multiprocessing.Process(target=bystanders, args=(endpoint, count, stop), daemon=True)
    victim = multiprocessing.Process(
        target=bystanders, args=(endpoint, 1, multiprocessing.Event()), daemon=True
    )
    if count:
        others.start()
    if fate is not None:
        victim.start()
    time.sleep(JOINING_S)
    if fate is not None:  # in the midst of what is measured
        threading.Timer(1.0, os.kill, (victim.pid or 0, fate)).start()
    try:
        yield
    finally:
        stop.set()
        if count:
            others.join()
        if fate is not None:
            victim.kill()
            victim.join()


def stage_us(before: dict[str, Any], after: dict[str, Any], stage: str) -> float:
    """Return the mean time per period in a stage of the loop between two replies to `status`."""
    sums = [status["service"]["loop"]["stages"][stage] for status in (before, after)]
    count = sum(sums[1]["counts"]) - sum(sums[0]["counts"])
    return float((sums[1]["sum_s"] - sums[0]["sum_s"]) / max(1, count) * 1e6)


def case(config: Path, pid: int, stamps: Any, seconds: float, name: str) -> dict[str, Any]:
    """Measure one subscriber beside others."""
    endpoints = load(config).daemon
    count, fate = CASES[name]
    cpu = ProcessorShare()
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, 100_000)
        socket.subscribe("hand/")
        socket.connect(endpoints.live)
        with company(endpoints.live, count, fate):
            while socket.poll(0):
                socket.recv_multipart()
            before = request("status", endpoint=endpoints.control, timeout_s=10)
            cpu.start(pid)
            received = receive(socket, seconds)
            share = cpu.stop()
            after = request("status", endpoint=endpoints.control, timeout_s=10)
    known = np.array([(sync, at) for parts, at in received if (sync := sync_of(parts)) is not None])
    sent_ns = np.sort(np.array(stamps[1 : 1 + min(stamps[0], MOST)]))
    late_us = Turn(known, sent_ns, {}, 0).latencies_us()
    busy = [status["service"]["process"]["loop_cpu_s"] for status in (before, after)]
    took_s = (after["service"]["t_ns"] - before["service"]["t_ns"]) * 1e-9
    return {
        "case": name,
        "p50_us": float(np.percentile(late_us, 50)),
        "p99_us": float(np.percentile(late_us, 99)),
        "send_us": stage_us(before, after, "send"),
        "tick_us": stage_us(before, after, "tick"),
        "loop_share": (busy[1] - busy[0]) / took_s,
        "share": share,
        "lost": int(np.count_nonzero(np.diff(known[:, 0]) > 1.5 * np.median(np.diff(known[:, 0])))),
        "congestion_episodes": after["service"]["congestion_episodes"]["live"]
        - before["service"]["congestion_episodes"]["live"],
    }


@contextmanager
def serving(config: Path, touched: int = TOUCHED) -> Iterator[tuple[int, Any]]:
    """Run simulated nodes and the daemon from when pads are touched; yield its process and send times."""
    deployment = load(config)
    stamps, stop = multiprocessing.Array("q", 1 + MOST, lock=False), multiprocessing.Event()
    samples = film(deployment, PATHS["sliding"], range(touched))
    worker = multiprocessing.Process(target=nodes, args=(config, samples, stamps, stop), daemon=True)
    worker.start()
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    daemon = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.subscribe("hand/")
            socket.connect(deployment.daemon.live)
            wait_for_touch(socket, touched)
        yield daemon.pid, stamps
    finally:
        daemon.terminate()
        daemon.wait()
        stop.set()
        worker.join()


def in_turns(turns: int, cases: Iterable[str], measured: Callable[[str], dict[str, Any]]) -> Rows:
    """Measure all cases repeatedly, and print each result."""
    rows = []
    for turn in range(turns):
        for name in cases:
            rows.append({"turn": turn, **measured(name)})
            print(rows[-1], flush=True)
    return rows


def measure(config: Path, turns: int, seconds: float) -> Rows:
    """Measure all cases repeatedly with one daemon."""
    with serving(config) as (pid, stamps):
        return in_turns(turns, CASES, lambda name: case(config, pid, stamps, seconds, name))


def page_of(results: dict[str, Any]) -> str:
    """Return the page."""
    lines = []
    for name in CASES:
        rows = [row for row in results["rows"] if row["case"] == name]
        middle = {
            key: statistics.median(row[key] for row in rows)
            for key in ("p50_us", "p99_us", "tick_us", "send_us", "loop_share", "share")
        }
        spread = max(row["p50_us"] for row in rows) - min(row["p50_us"] for row in rows)
        lost, episodes = (sum(row[key] for row in rows) for key in ("lost", "congestion_episodes"))
        lines.append(
            f"| {name} | {middle['p50_us']:.0f} | {spread:.0f} | {middle['p99_us']:.0f} | {lost} "
            f"| {middle['tick_us']:.0f} | {middle['send_us']:.0f} | {middle['loop_share']:.1%} "
            f"| {middle['share']:.1%} | {episodes} |"
        )
    turns = 1 + max(row["turn"] for row in results["rows"])
    return f"""# Subscribers

One subscriber to a hand of 15 pads at 200 Hz, 5 touched by sliding contacts, beside other subscribers.
Medians of {turns} passes over all cases, {results["seconds"]:.0f} s each; spread is that of the
medians per pass. Latency is from the last frame of a SYNC to the message; periods lost are those of the
measured subscriber. Tick and send are means per period; the daemon's share of a core is the loop's thread
alone, and all threads with those of ZeroMQ, which write to every connection. Congestion counts the times
that a queue was found full, such as that of the stalled subscriber. All run on one
machine, so a hundred readers also compete for its CPUs.
{results["machine"]}; load average when it ended {results["load"]:.1f}.

| subscribers | p50, us | spread | p99, us | periods lost | tick, us | send, us | loop | daemon | congestion |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(lines)}

{made_by()}.
"""


def asked_of(about: str | None, *, seconds: float, turns: int, quick_s: float) -> argparse.Namespace:
    """Return the options of a benchmark with repeated cases."""
    parser = options(about)
    parser.add_argument("--seconds", type=float, default=seconds, help="of a case")
    parser.add_argument("--turns", type=int, default=turns)
    asked = parser.parse_args()
    if asked.quick:
        asked.turns, asked.seconds = 1, quick_s
    return asked


def write(name: str, page_of: Callable[[dict[str, Any]], str], rows: Rows, asked: argparse.Namespace) -> None:
    """Write the page of a benchmark and its data."""
    results = {"rows": rows, "seconds": asked.seconds, "machine": machine(), "load": os.getloadavg()[0]}
    out, page = output_folder(asked.quick), page_of(results)
    (out / f"{name}.md").write_text(page)
    (out / f"{name}.json").write_text(json.dumps(results, indent=1) + "\n")
    print(page)


def main() -> None:
    asked = asked_of(__doc__, seconds=5.0, turns=2, quick_s=1.5)
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        rows = measure(on_loopback(Path(folder), PORT), asked.turns, asked.seconds)
    write("subscribers", page_of, rows, asked)


if __name__ == "__main__":
    main()
