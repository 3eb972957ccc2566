"""Start-up time: to the daemon's first hand frame and to the output of a command, by part.

15 simulated nodes are there, on udp_multicast over loopback, and a subscriber waits for `handtouch run` to
start: the first hand frame, and the first in which every pad delivers. Again with the files of Python and its
packages put out of the page cache, as far as the kernel lets go of what others have mapped. Writes
docs/benchmarks/start.{md,json}.
"""

from __future__ import annotations

import json
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

from benchmarks.bench_latency import (
    PATHS,
    PORT,
    film,
    in_own_network,
    machine,
    nodes,
    on_loopback,
    resident_mb,
)
from benchmarks.page import made_by, options, output_folder
from handtouch import wire
from handtouch.config import load
from handtouch.daemon.table_cache import cache_path

AIMS_S = {"first frame": 1.0, "first frame, no tables": 2.0, "help": 0.3}
AIM_MB = 120.0
STEPS = """
import sys, time
from pathlib import Path
start = time.perf_counter()
times = []
def lap(name):
    global start
    now = time.perf_counter(); times.append((name, now - start)); start = now
import numpy; lap("numpy")
import can, canopen; lap("python-can and canopen")
import pydantic; lap("pydantic")
from handtouch.core.pad_model import PadModel
from handtouch.daemon.table_cache import build_pad_model
import handtouch.daemon.serve as d; lap("other imports of the daemon")
deployment = d.load(Path(sys.argv[1])); lap("reading the deployment")
PadModel(deployment); lap("model of the pads, tables computed")
model = build_pad_model(deployment); lap("model of the pads, tables cached")
daemon = d.HandtouchDaemon.open(deployment, model); lap("opening endpoints and buses")
for name, took in times: print(f"{took} {name}")
"""


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


def processor_s(pid: int) -> float:
    """Return the CPU time of a process so far, user and system, all threads, without children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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


def steps(config: Path) -> dict[str, float]:
    """Return the seconds of each part of the start, without booting nodes."""
    done = subprocess.run(
        [sys.executable, "-c", STEPS, str(config)], check=True, capture_output=True, text=True
    )
    rows = [line.split(" ", 1) for line in done.stdout.splitlines()]
    return {name: float(took) for took, name in rows}


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
        "steps": lambda: steps(config),
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


def write(results: dict[str, Any], out: Path) -> str:
    """Return the page."""
    warm, cold = (
        {
            **results[cache]["first"],
            **results[cache]["help"],
            "first frame, no tables": results[cache]["no tables"]["first frame"],
        }
        for cache in ("warm", "cold")
    )
    titles = {
        "first frame": "`handtouch run` to the first hand frame at a subscriber",
        "first frame, no tables": "the same without cached tables of the pads",
        "processor": "CPU time of the daemon until then, user and system",
        "all pads": "to the first with samples of all pads",
        "help": "`handtouch --help`",
        "help, processor": "its CPU time",
    }
    rows = "\n".join(
        f"| {text} | {warm[name]:.2f} | {cold[name]:.2f} | {AIMS_S.get(name, '')} |"
        for name, text in titles.items()
    )
    parts = "\n".join(
        f"| {name} | {took:.2f} | {results['cold']['steps'][name]:.2f} |"
        for name, took in results["warm"]["steps"].items()
    )
    text = f"""# Start

15 simulated nodes run on udp_multicast over loopback. Seconds, medians of {results["runs"]} runs,
warm and cold alternately; before a cold start the files of Python and its packages are dropped from the page
cache, except pages mapped by other processes. {results["machine"]};
load average when it ended {results["load"]:.1f}.

| | warm | cold | aim |
| --- | --- | --- | --- |
{rows}

Resident memory of the daemon with all pads: {warm["memory"]:.0f} MB (aim {AIM_MB:.0f}).

By part, before the boot of the nodes:

| | warm | cold |
| --- | --- | --- |
{parts}

{made_by()}.
"""
    (out / "start.md").write_text(text)
    (out / "start.json").write_text(json.dumps(results, indent=1) + "\n")
    return text


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
    results |= {"runs": asked.runs, "machine": machine(), "load": os.getloadavg()[0]}
    print(write(results, output_folder(asked.quick)))
    return int(
        not asked.quick
        and any(
            results["warm"][key][name] > aim
            for key, name, aim in (
                ("first", "first frame", AIMS_S["first frame"]),
                ("no tables", "first frame", AIMS_S["first frame, no tables"]),
                ("first", "memory", AIM_MB),
                ("help", "help", AIMS_S["help"]),
            )
        )
    )


if __name__ == "__main__":
    sys.exit(main())
