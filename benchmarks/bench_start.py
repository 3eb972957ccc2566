"""Start: time to the daemon's first hand frame and to the output of a command.

15 simulated nodes are there, on udp_multicast over loopback, and a subscriber waits for `handtouch run` to
start: the first hand frame, and the first in which every pad delivers. Seconds and MB, medians, with warm
caches of files; *no tables*: without cached tables of the pads.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import zmq

from benchmarks.page import Report, Rows, middle, options
from benchmarks.served_hand import (
    PATHS,
    PORT,
    film,
    in_own_network,
    nodes,
    on_loopback,
    processor_s,
    resident_mb,
)
from handtouch import wire
from handtouch.config import load
from handtouch.daemon.table_cache import cache_path

AIMS = (
    ("first", "first frame", 1.0, "s"), ("no tables", "first frame", 2.0, "s"),
    ("first", "memory", 120.0, "MB"), ("help", "help", 0.3, "s"),
)  # fmt: skip


def first_frames(config: Path) -> dict[str, float]:
    """Return the seconds from the start of `handtouch run` to its first hand frame, and to one with all pads.

    And its CPU time until the first, which other load on the machine hardly changes, and its resident memory
    with all pads [MB].
    """
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RECONNECT_IVL, 10)
        socket.setsockopt(zmq.RCVTIMEO, 60_000)
        socket.subscribe("hand/")
        socket.connect(load(config).daemon.live)
        start_s = time.monotonic()
        daemon = subprocess.Popen(
            [sys.executable, "-m", "handtouch", "run", str(config)], stderr=subprocess.DEVNULL
        )
        found: dict[str, float] = {}
        try:
            while "all pads" not in found:
                frame = wire.decode(socket.recv_multipart())
                now_s = time.monotonic() - start_s
                assert isinstance(frame, wire.HandFrame)
                if not found:
                    found |= {"first frame": now_s, "processor": processor_s(daemon.pid)}
                if max(frame.state) <= wire.PadState.TOUCHED:
                    found |= {"all pads": now_s, "memory": resident_mb(daemon.pid)}
        finally:
            daemon.terminate()
            daemon.wait()
    return found


def help_once() -> dict[str, float]:
    """Return the seconds that `handtouch --help` takes."""
    start_s, before = time.monotonic(), os.times()
    subprocess.run([sys.executable, "-m", "handtouch", "--help"], check=True, stdout=subprocess.DEVNULL)
    took_s, after = time.monotonic() - start_s, os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return {"help": took_s, "help, processor": used}


def measure(config: Path, runs: int) -> Rows:
    """Return the medians of each case."""

    def first_without_tables() -> dict[str, float]:
        shutil.rmtree(cache_path(), ignore_errors=True)
        return first_frames(config)

    once: dict[str, Callable[[], dict[str, float]]] = {
        "no tables": first_without_tables,
        "first": lambda: first_frames(config),
        "help": help_once,
    }
    rows = [{"case": case, **measured()} for _ in range(runs) for case, measured in once.items()]
    return middle(rows, ("case",))


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--runs", type=int, default=5)
    asked = parser.parse_args()
    if asked.quick:
        asked.runs = 2
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = on_loopback(Path(folder), PORT)
        os.environ["XDG_CACHE_HOME"] = folder  # its tables, not the user's
        stamps, stop = multiprocessing.Array("q", 1 + 1000, lock=False), multiprocessing.Event()
        samples = film(load(config), PATHS["resting"])
        worker = multiprocessing.Process(target=nodes, args=(config, samples, stamps, stop), daemon=True)
        worker.start()
        results = measure(config, asked.runs)
        stop.set()
        worker.join()
    report = Report(asked.quick, runs=asked.runs)
    report.table("Start", results)
    of_case = {row["case"]: row for row in results}
    for case, name, aim, unit in AIMS:
        report.limit(f"{case}: {name}", of_case[case][name], aim, unit)
    return int(not report.keep() and not asked.quick)


if __name__ == "__main__":
    sys.exit(main())
