"""Cost of the page in the browser: updates delivered, frames drawn, CPU shares of view and daemon.

The real daemon and simulated nodes, as in bench_latency, but with all 15 pads touched by sliding contacts,
and joint states at 100 Hz. Cases alternate: no subscriber; a reader of hand frames, like a controller;
the view without a page; with a page that only reads; with a page in Chromium, rendering in software without a
graphics processor. Chromium is left out where it isn't installed. The daemon's cost is the CPU time of its
loop per tick, which other processes hardly change, and ratios within a round. Writes
docs/benchmarks/view.{md,json}.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import shutil
import statistics
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

from benchmarks.bench_latency import (
    PORT,
    ProcessorShare,
    in_own_network,
    on_loopback,
)
from benchmarks.bench_subscribers import Rows, asked_of, bystanders, in_turns, serving, write
from benchmarks.page import made_by
from handtouch import Robot
from handtouch.client import request
from handtouch.config import load

HERE = Path(__file__).parents[1] / "tests" / "javascript"
NO_SUBSCRIBER, READER, VIEW, PAGE, BROWSER, PERCEPTS = (
    "no subscriber",
    "a reader of hand frames",
    "the view, no page open",
    "the view, a page that only reads",
    "the view, a page in Chromium",
    "the view --percepts, a page that only reads",
)
RATE_HZ = 200
ALL = 15  # pads are touched: the most that there is to show
JOINING_S = 2.0
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
        self.bytes = 0
        self._stream = urllib.request.urlopen(f"{url}changes")
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._stream:
            self.bytes += len(line)
            self.updates += line.startswith(b"data: ")


class Chromium:
    """The page in a browser, driven by tests/javascript/browser.mjs."""

    def __init__(self, folder: Path, url: str) -> None:
        self._process = subprocess.Popen(
            ["node", str(folder / "browser.mjs"), shutil.which("chromium") or ""],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ask(open=url)
        self.ask(wait="handtouch.counts.frames > 3")

    def ask(self, **command: Any) -> Any:
        """Send a command; return its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline()).get("value")

    def counts(self) -> dict[str, int]:
        """Return the numbers of received updates and drawn frames."""
        return dict(self.ask(evaluate="handtouch.counts"))

    def close(self) -> None:
        """Close the browser."""
        self._process.communicate()


def case(config: Path, pid: int, seconds: float, name: str, packages: Path | None) -> dict[str, Any]:
    """Measure shares and rates over a time."""
    daemon = load(config).daemon
    row: dict[str, Any] = {"case": name}
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
            browser = Chromium(packages, url) if name == BROWSER and packages else None
            time.sleep(JOINING_S)
            start_s, before = time.monotonic(), browser.counts() if browser else {}
            read = (page.updates, page.bytes) if page else (0, 0)
            row |= shares(daemon.control, pid, view_pid, seconds)
            took_s = time.monotonic() - start_s
            if page:
                row["updates_hz"] = (page.updates - read[0]) / took_s
                row["kilobytes_s"] = (page.bytes - read[1]) / took_s / 1e3
            if browser:
                after = browser.counts()
                row["updates_hz"] = (after["updates"] - before["updates"]) / took_s
                row["frames_hz"] = (after["frames"] - before["frames"]) / took_s
                browser.close()
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
    row = {"daemon": cpu.stop(), "view": of_view.stop() if view_pid else None}
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
        "tick_ms": 1e3 * loop_s / max(1, ticks),
        "perceive_ms": 1e3 * perceive_s / max(1, ticks),
        "latency_ms": median_ms(counts[0], counts[1]),
        "ticks_hz": ticks / took_s,
        "overruns": after["overruns"] - before["overruns"],
        "congestion_episodes": sum(after["congestion_episodes"].values())
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


def measure(config: Path, turns: int, seconds: float, packages: Path | None) -> Rows:
    """Run all cases repeatedly with one daemon."""
    still = threading.Event()
    robot = threading.Thread(target=send_joints, args=(load(config).daemon.inputs, still))
    cases = (NO_SUBSCRIBER, READER, VIEW, PAGE, *([BROWSER] if packages else []), PERCEPTS)
    with serving(config, ALL) as (pid, _):
        robot.start()
        try:
            return in_turns(turns, cases, lambda name: case(config, pid, seconds, name, packages))
        finally:
            still.set()
            robot.join()


def browser_packages(folder: Path) -> Path | None:
    """Install the packages that drive Chromium, before entering the private network, if it is installed."""
    if not (shutil.which("chromium") and shutil.which("npm")):
        return None
    shutil.copytree(HERE, folder)
    install = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"]
    subprocess.run(install, cwd=folder, check=True)
    return folder


def page_of(results: dict[str, Any]) -> str:
    """Return the page of results."""
    rows = results["rows"]
    reader = {row["turn"]: row["tick_ms"] for row in rows if row["case"] == READER}
    for row in rows:
        row["to_reader"] = row["tick_ms"] / reader[row["turn"]]
        if row["view"] is not None and row.get("updates_hz"):
            row["update_ms"] = 1e3 * row["view"] / row["updates_hz"]
    lines = []
    for name in dict.fromkeys(row["case"] for row in rows):
        of_case = [row for row in rows if row["case"] == name]

        def middle(key: str, form: str, of_case: list[dict[str, Any]] = of_case) -> str:
            values = [row[key] for row in of_case if row.get(key) is not None]
            return format(statistics.median(values), form) if values else ""

        loop = f"{middle('tick_ms', '.2f')} | {RATE_HZ / 1e3 * float(middle('tick_ms', '.4f')):.0%}"
        of_loop = (
            f"{middle('to_reader', '.2f')} | {middle('latency_ms', '.2f')} | {middle('ticks_hz', '.0f')}"
        )
        page = (
            f"{middle('updates_hz', '.1f')} | {middle('frames_hz', '.1f')} | {middle('kilobytes_s', '.0f')}"
        )
        of_view = f"{middle('view', '.1%')} | {middle('update_ms', '.1f')}"
        lines.append(f"| {name} | {loop} | {of_loop} | {of_view} | {page} |")
    turns = 1 + max(row["turn"] for row in rows)
    return f"""# The view

A hand of 15 pads at {RATE_HZ} Hz, all touched by sliding contacts, with joint states at 100 Hz. Medians of
{turns} round{"s" * (turns > 1)} through all cases, {results["seconds"]:.0f} s each.
{results["machine"]}; load average when it ended {results["load"]:.1f}.

| subscriber | loop, ms per tick | share of a core | ratio to reader | latency, ms | ticks/s | view \
| ms per update | updates/s | frames/s drawn | kB/s |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(lines)}

* *loop* is CPU time of the daemon's loop per tick, and its share of a core at {RATE_HZ} ticks/s; *ratio to
  reader* is relative to a reader of hand frames in the same round. Without a subscriber, the daemon
  computes no positions and forces. The cost of a view is its excess over that reader, which is what any
  controller does: joints and health; with --percepts also the percepts, computed after the contacts.
* *latency* is from the last sample to the last message of a tick, median, by the daemon's own clock.
* *view* is the share of a core that `handtouch view` takes. *updates* are delivered to the page, nominally
  30 per second; *frames* are drawn: Chromium renders 1024 x 640 pixels in software here, on the same cores,
  and the page then uses at most half of the time.
* Where ticks/s are below {RATE_HZ}, other processes used the machine: rates are lower limits then.

{made_by()}.
"""


def main() -> None:
    asked = asked_of(__doc__, seconds=5.0, turns=1, quick_s=2.0)
    if "HANDTOUCH_BENCH_PACKAGES" not in os.environ:
        with tempfile.TemporaryDirectory(prefix="ht.") as folder:
            os.environ["HANDTOUCH_BENCH_PACKAGES"] = str(browser_packages(Path(folder) / "js") or "")
            subprocess.run([sys.executable, *sys.argv], check=True)
        return
    in_own_network()
    packages = os.environ["HANDTOUCH_BENCH_PACKAGES"]
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = on_loopback(Path(folder), PORT)
        rows = measure(config, asked.turns, asked.seconds, Path(packages) if packages else None)
    write("view", page_of, rows, asked)


if __name__ == "__main__":
    main()
