"""The real processes in cycles of trouble: daemon, simulated nodes, recorder, view, Zenoh bridge, subscriber.

Public names: `run_cycles`. In each cycle a node is replaced, another one has a fault, and one process is
stopped, killed or finds its disk full. All in real time; the store and the recordings are on a small disk.
"""

from __future__ import annotations

import itertools
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from benchmarks.client_checks import Truth, longest_age_s, watch_hand, watch_ros
from benchmarks.compressed_days import Act
from benchmarks.page import ROOT, progress
from benchmarks.served_hand import descriptors, on_loopback, resident_mb
from handtouch.client import connect, request
from handtouch.config import load

CYCLE_S = 40.0
NODE_FAULTS = ("emcy", "changed_setting", "boot_loop", "illegal_nmt_state")
TROUBLES = (
    "supervisor killed", "daemon restarted", "percept process killed", "recorder restarted",
    "daemon killed", "view restarted", "bridge restarted", "nodes paused",
)  # fmt: skip
SERVED_S = 90.0
"""Longest time until all pads are operational again, on a machine with other load."""
TRANSIENT_S = 60.0
"""A trouble explains warnings up to this time after it, on such a machine."""
HOST_PAUSES = re.compile("the loop was late|late ticks by longest part|was paused")
"""Messages about other load of the machine."""


class Processes:
    """The processes by name; stderr of each goes to a file with the time of every line."""

    def __init__(self, commands: dict[str, list[str]], folder: Path) -> None:
        self.commands, self.folder = commands, folder
        self.running: dict[str, subprocess.Popen[str]] = {}
        self.lines: list[tuple[float, str, str]] = []
        self.ends: list[tuple[float, str, int]] = []
        self._files: dict[str, tuple[Path, IO[str], int]] = {}

    def start(self, name: str) -> None:
        """Start one that doesn't run."""
        path = self.folder / f"{name}.err"
        output = path.open("a")
        command = [sys.executable, "-m", *self.commands[name]]
        self.running[name] = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output, text=True)
        output.close()
        self._files.setdefault(name, (path, path.open(), 0))

    def stop(self, name: str, by: signal.Signals = signal.SIGTERM) -> None:
        """Stop one and keep its exit status."""
        process = self.running.pop(name)
        process.send_signal(by)
        self.ends.append((time.monotonic(), name, process.wait(30)))

    def poll(self) -> None:
        """Read new lines, and restart what ended by itself, as a service manager does."""
        now_s = time.monotonic()
        for name, (_, file, _) in self._files.items():
            self.lines += [(now_s, name, line.rstrip("\n")) for line in file.readlines() if line.strip()]
        for name, process in list(self.running.items()):
            if (status := process.poll()) is not None:
                self.ends.append((now_s, name, status))
                self.start(name)

    def close(self) -> None:
        """Stop all."""
        for name in list(self.running):
            self.stop(name)
        self.poll()
        for _, file, _ in self._files.values():
            file.close()


def scenario_text(links: list[str], serials: list[int], cycles: int) -> tuple[str, list[Act]]:
    """Return a scenario of touches, replaced nodes and faults of nodes, and these acts."""
    rng = np.random.default_rng(43)
    tables, acts = ["repeat = true", "pause_s = 1.0"], []
    for number in range(4 * len(links)):
        path = [[round(float(x), 2) for x in rng.uniform(0.15, 0.85, 2)] for _ in range(3)]
        tables.append(
            f'[[touch]]\nlink = "{links[number % len(links)]}"\nfrom_s = {0.5 + 0.6 * number}\n'
            "duration_s = 2.0\n"
            f"path = {path}\nforce_n = [0.5, {rng.uniform(1, 4):.2f}, 1.0]"
        )
    for cycle in range(cycles):
        at, pad = CYCLE_S * (cycle + 1), cycle % len(links)
        serial = 5000 + cycle if cycle % 2 == 0 or cycle < 2 else serials[pad]
        tables.append(f'[[swap]]\nlink = "{links[pad]}"\nat_s = {at}\nserial = {serial}')
        acts.append(Act("node replaced", at, at, pad))
        kind, other = NODE_FAULTS[cycle % len(NODE_FAULTS)], (pad + 7) % len(links)
        tables.append(
            f'[[node_fault]]\nkind = "{kind}"\nlink = "{links[other]}"\n'
            f"from_s = {at + 5}\nuntil_s = {at + 12}"
        )
        acts.append(Act(kind, at + 5, at + 12, other))
    return "\n".join(tables) + "\n", acts


def run_cycles(minutes: float, folder: Path, fill: Callable[[bool], None]) -> dict[str, Any]:
    """Run as many cycles as fit; `folder` is on the small disk that `fill` fills (True) and frees."""
    port = free_port()
    path = on_loopback(folder, port)
    deployment = load(path)
    links = [pad.link for _, pad in deployment.pads]
    serials = [pad.serial or 0 for _, pad in deployment.pads]
    cycles = max(3, round(60 * minutes / CYCLE_S) - 1)
    text, acts = scenario_text(links, serials, cycles)
    complete, control = (f"ipc://{folder}/{name}" for name in ("complete", "control"))
    page = free_port()
    scenario, started = folder / "scenario.toml", folder / "started"
    processes = Processes(
        {
            "nodes": ["benchmarks.client_checks", str(path), str(scenario), str(started)],
            "daemon": ["handtouch", "run", str(path)],
            "recorder": [
                "handtouch", "record", str(path), "-o", str(folder / "recordings"), "--percepts",
                "--rotate-mb", "4", "--keep-free-mb", "8",
            ],
            "view": ["handtouch", "view", "--endpoint", f"ipc://{folder}/live", "--port", str(page)],
            "bridge": [
                "handtouch", "bridge", "zenoh", str(path), "--listen", f"tcp/127.0.0.1:{free_port()}",
            ],
        },
        folder,
    )  # fmt: skip
    scenario.write_text(text)
    truth = Truth.of_process(scenario, started)
    for name in processes.commands:
        processes.start(name)
    rows: list[dict[str, Any]] = []
    memory: list[tuple[float, dict[str, tuple[float, int]]]] = []
    troubles: list[Act] = []
    begin_s = time.monotonic()
    with (
        connect("hand/*", "percept/*/*", endpoint=complete) as reader,
        watch_hand(f"ipc://{folder}/live", control, truth, longest_age_s(deployment)) as checked,
        watch_ros(complete, truth) as checked_ros,
    ):
        served = wait_served(control, len(links), processes)
        while reader.recv(0) is not None:
            pass  # what waited meanwhile
        start_s = time.monotonic()
        for cycle in range(cycles):
            kind = "disk full" if cycle in (cycles // 3, 2 * cycles // 3) else TROUBLES[cycle % len(TROUBLES)]
            at_s = time.monotonic()
            trouble(kind, processes, control, fill, truth)
            troubles.append(Act(kind, at_s, time.monotonic()))
            late_ms: list[float] = []
            freed = False
            while (left_s := start_s + (cycle + 1) * CYCLE_S - time.monotonic()) > 0:
                until_s = time.monotonic() + min(1.0, left_s)
                while time.monotonic() < until_s:
                    message = reader.recv(0.2)
                    if message is not None and not message.retained:
                        late_ms.append((time.monotonic_ns() - message.t_ns) * 1e-6)
                processes.poll()
                if kind == "disk full" and not freed and left_s < CYCLE_S / 2:
                    fill(False)
                    freed = True
                    troubles.append(Act("disk freed", time.monotonic(), time.monotonic()))
                for old in sorted((folder / "recordings").glob("*.mcap"))[:-3]:
                    old.unlink()
                figures = {
                    name: (resident_mb(process.pid), descriptors(process.pid))
                    for name, process in processes.running.items()
                    if process.poll() is None
                }
                memory.append((time.monotonic() - begin_s, figures))
            with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{page}/", timeout=10) as got:
                got.read()
            rows.append(
                {
                    "cycle": cycle,
                    "trouble": kind,
                    "frames": len(late_ms),
                    "p50, ms": float(np.median(late_ms or [np.nan])),
                    "p99, ms": float(np.percentile(late_ms or [np.nan], 99)),
                    "lost": reader.lost_messages,
                }
            )
            progress(rows[-1])
        served_again = wait_served(control, len(links), processes)
        status = request("status", endpoint=control, timeout_s=30)
    processes.close()
    return {
        "minutes": (time.monotonic() - begin_s) / 60,
        "rows": rows,
        "memory": memory,
        "served": [served, served_again],
        "ends": [(at - start_s, name, code) for at, name, code in processes.ends],
        "supervisor": status["service"]["supervisor"],
        "checked": [found.figures() for found in (checked.finish(), checked_ros.found)],
        "contradictions": [*checked.found.texts, *checked_ros.found.texts],
        "log": [(at - start_s, name, line) for at, name, line in processes.lines],
        "acts": [a._asdict() for a in acts]
        + [t._replace(from_s=t.from_s - start_s, until_s=t.until_s - start_s)._asdict() for t in troubles],
    }


def trouble(
    kind: str, processes: Processes, control: str, fill: Callable[[bool], None], truth: Truth
) -> None:
    """Cause a trouble."""
    name, _, what = kind.partition(" ")
    if kind == "disk full":
        fill(True)
    elif kind in ("supervisor killed", "percept process killed"):
        with suppress(OSError, KeyError, TypeError):
            service = request("status", endpoint=control, timeout_s=30)["service"]
            pid = service["supervisor" if name == "supervisor" else "percepts"]["pid"]
            subprocess.run(["kill", "-KILL", str(pid)], check=True)
    elif kind == "nodes paused":
        processes.running["nodes"].send_signal(signal.SIGSTOP)
        time.sleep(1.0)
        processes.running["nodes"].send_signal(signal.SIGCONT)
    else:
        processes.stop(name, signal.SIGKILL if what == "killed" else signal.SIGTERM)
        if name == "daemon":
            truth.deaths_ns.append(time.monotonic_ns())
        processes.start(name)


def wait_served(control: str, pads: int, processes: Processes) -> float:
    """Wait until all pads are operational; return the time that took [s], infinite if they aren't."""
    begin_s = time.monotonic()
    while (took_s := time.monotonic() - begin_s) < SERVED_S:
        processes.poll()
        with suppress(OSError):
            states = [pad["state"] for pad in request("status", endpoint=control, timeout_s=5)["pads"]]
            if sum(state in ("clear", "touched") for state in states) == pads:
                return took_s
        time.sleep(0.5)
    return float("inf")


def unexplained(
    log: list[tuple[float, str, str]], acts: list[dict[str, Any]], links: list[str]
) -> list[tuple[float, str, str]]:
    """Return warnings and errors that neither an act of the time before explains, of its own pad or of all,
    nor other load of the machine."""
    left = []
    for at, name, line in log:
        if HOST_PAUSES.search(line) or not re.search(r"\b(WARNING|ERROR|CRITICAL|Traceback|Error)\b", line):
            continue
        pads = {links.index(link) for link in links if re.search(rf"\b{link}\b", line)}
        near = [act for act in acts if act["from_s"] - 1 <= at <= act["until_s"] + TRANSIENT_S]
        if not any(act["pad"] in pads or act["pad"] < 0 for act in near):
            left.append((at, name, line))
    return left


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def growth(memory: list[tuple[float, dict[str, tuple[float, int]]]]) -> dict[str, tuple[float, float, int]]:
    """Return of each process' latest run its memory at a third and at the end [MB], and its descriptors."""
    found = {}
    for name in sorted(set(itertools.chain.from_iterable(figures for _, figures in memory))):
        own = [figures[name] for _, figures in memory if name in figures]
        found[name] = own[len(own) // 3][0], own[-1][0], own[-1][1]
    return found
