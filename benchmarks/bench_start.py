"""Start: time to the daemon's first hand frame and to the output of a command.

15 simulated nodes are there, on udp_multicast over loopback, and a subscriber waits for `handtouch run` to
start: the first hand frame, and the first in which every pad delivers. Seconds and MB, medians, warm and cold
alternately; before a cold start the files of Python and its packages are dropped from the page cache, except
pages mapped by other processes.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from benchmarks.page import Report, options
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


def forget_files() -> None:
    """Ask the kernel to drop the pages of Python's and the packages' files."""
    folders = {Path(sys.prefix), Path(os.__file__).parent, Path(__file__).parents[1] / "src"}
    for folder in folders:
        for path in folder.rglob("*"):
            if path.suffix in (".py", ".pyc", ".so", ".toml", ".eds") or ".so." in path.name:
                try:
                    descriptor = os.open(path, os.O_RDONLY)
                except OSError:  # a dangling link, or not ours to read
                    continue
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
                os.close(descriptor)


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


def medians(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the median of each value."""
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]}


def measure(config: Path, runs: int) -> dict[str, Any]:
    """Measure warm and cold starts alternately."""

    def first_without_tables() -> dict[str, float]:
        shutil.rmtree(cache_path(), ignore_errors=True)
        return first_frames(config)

    once: dict[str, Callable[[], dict[str, float]]] = {
        "no tables": first_without_tables,
        "first": lambda: first_frames(config),
        "help": help_once,
    }
    found: dict[str, dict[str, list[dict[str, float]]]] = {
        cache: {name: [] for name in once} for cache in ("warm", "cold")
    }
    for _ in range(runs):
        for cache, rows in found.items():
            for name, measured in once.items():
                if cache == "cold":
                    forget_files()
                rows[name].append(measured())
                print(cache, rows[name][-1], flush=True)
    return {cache: {name: medians(rows[name]) for name in once} for cache, rows in found.items()}


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
    rows = [
        {"case": f"{case}: {name}", **{cache: of[case][name] for cache, of in results.items()}}
        for case in ("first", "no tables", "help")
        for name in results["warm"][case]
    ]
    report.table("Start", rows)
    for case, name, aim, unit in AIMS:
        report.limit(f"{case}: {name}, warm", results["warm"][case][name], aim, unit)
    return int(not report.keep() and not asked.quick)


if __name__ == "__main__":
    sys.exit(main())
