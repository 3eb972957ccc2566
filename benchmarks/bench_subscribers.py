"""Subscribers: cost of 1, 10 and 100 for the publisher and each other; one stalled, one killed.

One subscriber to a hand of 15 pads at 200 Hz, 5 touched by sliding contacts, beside other subscribers to the
same hand frames: bystanders share a process, each with its own connection; the one that is stopped (SIGSTOP)
or killed (SIGKILL) has a process to itself. Medians over passes through all cases. Latency is from the last
frame of a SYNC to the message; periods lost are those of the measured subscriber. Tick and send are means per
period; the daemon's share of a core is the loop's thread alone, and all threads with those of ZeroMQ, which
write to every connection. Congestion counts the times that a queue was found full, such as that of the
stalled subscriber. All run on one machine, so a hundred readers also compete for its CPUs.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks.bench_latency import Turn
from benchmarks.page import Report, middle
from benchmarks.served_hand import (
    JOINING_S,
    MOST,
    PORT,
    ProcessorShare,
    asked_of,
    bystanders,
    in_own_network,
    in_turns,
    on_loopback,
    receive,
    serving,
    stage_us,
    sync_of,
)
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

Rows = list[dict[str, Any]]


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
    late_us = Turn(known, sent_ns, {}, 0, {}).latencies_us()
    busy = [status["service"]["process"]["loop_cpu_s"] for status in (before, after)]
    took_s = (after["service"]["t_ns"] - before["service"]["t_ns"]) * 1e-9
    return {
        "subscribers": name,
        "p50, us": float(np.percentile(late_us, 50)),
        "p99, us": float(np.percentile(late_us, 99)),
        "tick, us": stage_us(before, after, "tick"),
        "send, us": stage_us(before, after, "send"),
        "loop, %": 100 * (busy[1] - busy[0]) / took_s,
        "daemon, %": 100 * share,
        "lost": int(np.count_nonzero(np.diff(known[:, 0]) > 1.5 * np.median(np.diff(known[:, 0])))),
        "congestion": after["service"]["congestion_episodes"]["live"]
        - before["service"]["congestion_episodes"]["live"],
    }


def main() -> None:
    asked = asked_of(__doc__, seconds=5.0, turns=2, quick_s=1.5)
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = on_loopback(Path(folder), PORT)
        with serving(config) as (pid, stamps):
            rows = in_turns(asked.turns, CASES, lambda name: case(config, pid, stamps, asked.seconds, name))
    report = Report(asked.quick, passes=asked.turns, seconds_of_a_case=asked.seconds)
    report.table("Cases", middle(rows, ("subscribers",), ("lost", "congestion")))
    report.keep()


if __name__ == "__main__":
    main()
