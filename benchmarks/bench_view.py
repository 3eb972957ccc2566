"""The view: cost of the page in the browser for the daemon; its updates per second.

A hand of 15 pads at 200 Hz, all touched by sliding contacts, with joint states at 100 Hz. Cases alternate: no
subscriber; a reader of hand frames, like a controller; the view without a page; with a page that only reads;
with a page in Chromium, rendering 1024 x 640 pixels in software on the same cores, left out where it isn't
installed. Medians over rounds. *Loop* is processor time of the daemon's loop per tick; *ratio to reader* is
relative to a reader in the same round. Without a subscriber, the daemon computes no positions and forces.
*Latency* is from the last sample to the last message of a tick, median, by the daemon's own clock. *View* is
the share of a core that `handtouch view` takes; *updates* are delivered to the page, nominally 30 per second;
*frames* are drawn.
"""

from __future__ import annotations

import math
import multiprocessing
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.page import Report, Rows, middle
from benchmarks.served_hand import (
    JOINING_S,
    PORT,
    ProcessorShare,
    asked_of,
    bystanders,
    in_own_network,
    in_turns,
    on_loopback,
    serving,
)
from handtouch import Robot
from handtouch.client import request
from handtouch.config import load

NO_SUBSCRIBER, READER, VIEW, PAGE, PERCEPTS = (
    "no subscriber",
    "a reader of hand frames",
    "the view, no page open",
    "the view, a page that only reads",
    "the view --percepts, a page that only reads",
)
RATE_HZ = 200
ALL = 15  # pads are touched: the most that there is to show
JOINTS = ("index_mcp", "index_pip", "index_dip", "middle_mcp", "ring_mcp", "thumb_cmc")


@contextmanager
def view(endpoint: str, *options: str) -> Iterator[tuple[int, str]]:
    """Run `handtouch view`; yield its process id and URL."""
    command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", "0", "--endpoint", endpoint]
    command += options
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.pid, next(word for word in process.stdout.readline().split() if "http" in word)
        process.terminate()


class Reader:
    """A page that only reads: counts `updates`, and their intervals."""

    def __init__(self, url: str) -> None:
        self.updates = 0
        self._stream = urllib.request.urlopen(f"{url}changes")
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._stream:
            self.updates += line.startswith(b"data: ")


def case(config: Path, pid: int, seconds: float, name: str) -> dict[str, Any]:
    """Measure shares and rates over a time."""
    daemon = load(config).daemon
    row: dict[str, Any] = {"subscriber": name}
    stop = multiprocessing.Event()
    reader = multiprocessing.Process(target=bystanders, args=(daemon.live, 1, stop), daemon=True)
    if name == READER:
        reader.start()
    if name in (NO_SUBSCRIBER, READER):
        time.sleep(JOINING_S)
        row |= shares(daemon.control, pid, None, seconds)
    else:
        with view(daemon.live, *["--percepts"] * (name == PERCEPTS)) as (view_pid, url):
            page = Reader(url) if name in (PERCEPTS, PAGE) else None
            time.sleep(JOINING_S)
            start_s = time.monotonic()
            read = page.updates if page else 0
            row |= shares(daemon.control, pid, view_pid, seconds)
            took_s = time.monotonic() - start_s
            if page:
                row["updates/s"] = (page.updates - read) / took_s
    stop.set()
    if name == READER:
        reader.join()
    return row


def shares(control: str, pid: int, view_pid: int | None, seconds: float) -> dict[str, Any]:
    """Measure the CPU shares of the daemon's loop, the daemon and the view, and tick statistics."""
    cpu, of_view = ProcessorShare(), ProcessorShare()
    before = request("status", endpoint=control, timeout_s=30)["service"]
    cpu.start(pid)
    if view_pid:
        of_view.start(view_pid)
    time.sleep(seconds)
    row = {"daemon, %": 100 * cpu.stop(), "view, %": 100 * of_view.stop() if view_pid else None}
    after = request("status", endpoint=control, timeout_s=30)["service"]
    took_s = (after["t_ns"] - before["t_ns"]) * 1e-9
    loop_s, ticks = (
        after["process"]["loop_cpu_s"] - before["process"]["loop_cpu_s"],
        after["ticks"] - before["ticks"],
    )
    stages = after["loop"]["stages"]
    perceive_s = stages["percepts"]["sum_s"] - before["loop"]["stages"]["percepts"]["sum_s"]
    counts = [late["loop"]["latency"]["counts"] for late in (before, after)]
    return row | {
        "loop, ms per tick": 1e3 * loop_s / max(1, ticks),
        "of it percepts": 1e3 * perceive_s / max(1, ticks),
        "latency, ms": median_ms(counts[0], counts[1]),
        "ticks/s": ticks / took_s,
        "overruns": after["overruns"] - before["overruns"],
        "congestion": sum(after["congestion_episodes"].values())
        - sum(before["congestion_episodes"].values()),
    }


def median_ms(before: list[int], after: list[int]) -> float:
    """Return the median of a histogram's increments, interpolated within its bin."""
    counts = [now - then for then, now in zip([*before, *[0] * len(after)], after, strict=False)]
    half, below = sum(counts) / 2, 0.0
    for number, count in enumerate(counts):
        if below + count >= half and count:
            low = 0.0 if number == 0 else 1.024e-3 * 2 ** (number - 1)
            return float(low + (1.024e-3 * 2**number - low) * (half - below) / count)
        below += count
    return math.nan


def send_joints(endpoint: str, stop: threading.Event) -> None:
    """Send the joint states of a moving robot."""
    with Robot(endpoint, key="") as robot:
        while not stop.wait(0.01):
            now_s = time.monotonic()
            robot.send_joints("right", {name: 0.4 + 0.3 * math.sin(now_s) for name in JOINTS})


def measure(config: Path, turns: int, seconds: float) -> Rows:
    """Run all cases repeatedly with one daemon."""
    still = threading.Event()
    robot = threading.Thread(target=send_joints, args=(load(config).daemon.inputs, still))
    cases = (NO_SUBSCRIBER, READER, VIEW, PAGE, PERCEPTS)
    with serving(config, ALL) as (pid, _):
        robot.start()
        try:
            return in_turns(turns, cases, lambda name: case(config, pid, seconds, name))
        finally:
            still.set()
            robot.join()


def main() -> None:
    asked = asked_of(__doc__, seconds=5.0, turns=1, quick_s=2.0)
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        rows = measure(on_loopback(Path(folder), PORT), asked.turns, asked.seconds)
    reader = {row["turn"]: row["loop, ms per tick"] for row in rows if row["subscriber"] == READER}
    for row in rows:
        row["ratio to reader"] = row["loop, ms per tick"] / reader[row["turn"]]
    report = Report(asked.quick, rate_hz=RATE_HZ, rounds=asked.turns, seconds_of_a_case=asked.seconds)
    report.table("Cases", middle(rows, ("subscriber",)))
    report.keep()


if __name__ == "__main__":
    main()
