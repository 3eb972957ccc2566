"""Soak test of the real daemon with a simulated hand: memory, descriptors, losses; status 1 if they grow.

Nodes, daemon and a subscriber to everything on a udp_multicast bus, the session played again and again.
ARGS="--minutes 60" sets how long.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.bench_latency import PORT, descriptors, in_own_network, on_loopback, resident_mb
from benchmarks.page import options
from handtouch.client import connect, request
from handtouch.config import load

SETTLED_S = 20.0
GROWTH_MB = 5.0


def soak(config: Path, minutes: float) -> int:
    """Run the test; return 1 if memory or descriptors grew or messages were lost."""
    endpoints = load(config).daemon
    nodes = subprocess.Popen([sys.executable, "-m", "handtouch", "simulate", str(config)])
    daemon = subprocess.Popen([sys.executable, "-m", "handtouch", "run", str(config)])
    try:
        with connect(
            "contact/*/*", "hand/*", "health/*/*", endpoint=endpoints.complete, queue=100_000
        ) as all_of_it:
            end_s = time.monotonic() + SETTLED_S
            while time.monotonic() < end_s:
                all_of_it.recv(1)
            before = (resident_mb(daemon.pid), descriptors(daemon.pid))
            ticks, next_s = (
                request("status", endpoint=endpoints.control, timeout_s=30)["service"]["ticks"],
                0.0,
            )
            end_s = time.monotonic() + 60 * minutes
            while time.monotonic() < end_s:
                all_of_it.recv(1)
                if time.monotonic() >= next_s:
                    next_s = time.monotonic() + max(5.0, 3 * minutes)
                    left = (end_s - time.monotonic()) / 60
                    now = (resident_mb(daemon.pid), descriptors(daemon.pid))
                    print(f"{left:6.1f} min to go: {now[0]:.1f} MB, {now[1]} descriptors")
            lost = all_of_it.lost_messages
        after = (resident_mb(daemon.pid), descriptors(daemon.pid))
        status = request("status", endpoint=endpoints.control, timeout_s=30)
        service, missed = status["service"], sum(pad["missed_samples"] for pad in status["pads"])
        print(
            f"{service['ticks'] - ticks} ticks, {service['overruns']} overruns, {missed} samples missed, "
            f"{lost} messages lost; memory {before[0]:.1f} -> {after[0]:.1f} MB, "
            f"descriptors {before[1]} -> {after[1]}"
        )
    finally:
        for process in (daemon, nodes):
            process.terminate()
            process.wait()
    return int(lost > 0 or after[0] - before[0] > GROWTH_MB or after[1] > before[1])


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    asked = parser.parse_args()
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        failed = soak(on_loopback(Path(folder), PORT + 1), 0.25 if asked.quick else asked.minutes)
    return 0 if asked.quick else failed  # a start is all growth


if __name__ == "__main__":
    sys.exit(main())
