"""Soak test of three days of mixed use, compressed, and of the real processes in cycles of trouble.

Part 1: pipeline, percepts, supervision with its store, and recorder in one process, time as an argument.
Part 2: daemon, nodes, recorder, view, bridge and a subscriber in real time. Part 3: two pipelines with the
same samples, one of which is reloaded every few minutes. Writes docs/benchmarks/soak_days.{md,json,png}.
ARGS="--hours 72 --minutes 20 --reload-hours 6"; status 1 if something is wrong.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.page import made_by, options, output_folder, progress, table

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small

import matplotlib

from benchmarks.bench_latency import machine
from benchmarks.client_checks import CHECKED
from benchmarks.compressed_days import AFTERWARDS_S, FULL_DISK_S, Days, is_work, run_days
from benchmarks.cycled_processes import growth, in_own_network, run_cycles, unexplained
from benchmarks.reloaded_days import RELOAD_PERIOD_S, compare_reloads
from handtouch.record.recording import Recording
from handtouch.record.replay_recording import replay_recording

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HOURS, MINUTES, RELOAD_HOURS = 72.0, 20.0, 6.0
DISK_MB = 96
MAX_GROWTH_MB = 20.0
"""Of the compressed part: of the least memory of a day, and in each night, which has no restart."""
START_UP_H = 2.0
"""Memory is compared from then on."""
MAX_GAIN_ERROR = 0.03
"""rms error of the gains of a calibrated pad: what 2 % standard deviation permits, with 1.5 times of it"""
RELEARNT_S = 4 * 3600.0
"""A replaced node explains messages about its calibration so long."""
DISK_VARIABLE = "HANDTOUCH_SOAK_DISK"


def on_small_disk() -> Path:
    """Return the folder of a small disk; first, run this program again in a mount namespace that has it."""
    if DISK_VARIABLE not in os.environ:
        _exec_on_small_disk()
    return Path(os.environ[DISK_VARIABLE])


def _exec_on_small_disk() -> None:
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    script = (
        f'd=$(mktemp -d) && mount -t tmpfs -o size={DISK_MB}m soak "$d" || exit 2\n'
        f'{DISK_VARIABLE}=$d "$@"; status=$?; umount "$d"; rmdir "$d"; exit $status'
    )
    os.execvp("unshare", ["unshare", "--mount", *user, "sh", "-c", script, "sh", sys.executable, *sys.argv])


class Filler:
    """Fills a disk with a file until nothing more can be written, or removes it."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "filler"

    def __call__(self, full: bool) -> None:
        if not full:
            self._path.unlink()
            return
        with self._path.open("wb", buffering=0) as file:
            for size in (1 << 20, 1 << 12, 1):
                try:
                    while True:
                        file.write(bytes(size))
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise


def compressed(hours: float, disk: Path, recordings: Path) -> dict[str, Any]:
    """Run the first part; return its figures, with the replay of the last recordings."""
    days = Days(hours)
    found = run_days(days, disk / "calibrations.db", Filler(disk), recordings)
    links = days.use.links
    found["unexplained"] = [
        (at, line) for at, line in found.pop("log") if not is_explained(at, line, found["acts"], links)
    ]
    found["alarms"] = [
        (entry["kind"], links[entry["pad"]], begin, end)
        for entry in found["diagnosed"]
        for begin, end in entry["at_s"]
        if not any(
            act["pad"] == entry["pad"] and act["from_s"] <= end and begin <= explained_until_s(act)
            for act in found["acts"]
        )
    ]
    replays = []
    for path in found.pop("last_recordings"):
        recording = Recording(Path(path))
        result = replay_recording(recording, lambda _: None).result
        replays.append((result.ticks, result.compared, result.equal))
    return found | {"replays": replays, "links": links}


def explained_until_s(act: dict[str, Any]) -> float:
    """Return the time [s] until which an act explains messages of its pad; nights teach no calibration."""
    at, left = float(act["until_s"]), RELEARNT_S
    if act["kind"] != "swap":
        return at + AFTERWARDS_S
    while left > 0:
        step = min(left, 60.0)
        left -= step if is_work(at) else 0.0
        at += step
    return at


def is_explained(at: float, line: str, acts: list[dict[str, Any]], links: list[str]) -> bool:
    """Return True for a message of a faulty or replaced pad, or about the store while its disk is full.

    After a restart or a crash a pad is replaced again, as the deployment states the serial number of its
    first node.
    """
    pads = {links.index(link) for link in links if re.search(rf"\b{link}\b", line)}
    restarted = any(
        act["kind"] in ("restart", "crash") and act["from_s"] - 1 <= at <= act["until_s"] + AFTERWARDS_S
        for act in acts
    )
    for act in acts:
        if act["pad"] in pads and act["from_s"] - 1 <= at <= explained_until_s(act):
            return True
        if act["kind"] == "swap" and act["pad"] in pads and act["from_s"] <= at and restarted:
            return True
        if act["kind"] == "disk full" and "store" in line and act["from_s"] <= at <= act["until_s"] + 120:
            return True
    return False


def problems(found: dict[str, Any]) -> list[str]:
    """Return what must not be, as text."""
    wrong = []
    if days := found.get("compressed"):
        by_day = memory_by_day(days["memory"])
        for first, last in {(by_day[0].least_mb, by_day[-1].least_mb), *(day.night_mb for day in by_day)}:
            if last - first > MAX_GROWTH_MB:
                wrong.append(f"memory grew from {first:.0f} to {last:.0f} MB")
        if by_day[-1].end[2] > by_day[0].end[2]:
            wrong.append(f"descriptors grew from {by_day[0].end[2]} to {by_day[-1].end[2]}")
        known = [
            e for e, state in zip(days["gain_errors"], days["states"], strict=True) if state == "calibrated"
        ]
        if max(known, default=0.0) > MAX_GAIN_ERROR:
            wrong.append(f"the gains of a calibrated pad are wrong by {max(known):.1%}")
        if days["lost"] or days["malformed"] or days["malformed_messages"] or days["store_error"]:
            wrong.append(f"lost {days['lost']}, malformed {days['malformed']}, {days['store_error']}")
        wrong += [f"replay: {same} of {count} equal" for _, count, same in days["replays"] if same != count]
        wrong += [f"unexplained at {at / 3600:.2f} h: {line[:200]}" for at, line in days["unexplained"]]
    if cycles := found.get("processes"):
        wrong += [
            f"{name} ended with status {code}" for _, name, code in cycles["ends"] if bad_end(name, code)
        ]
        if not np.isfinite(cycles["served"]).all():
            wrong.append("not all pads became operational")
        if cycles["rows"][-1]["lost"]:
            wrong.append(f"the subscriber lost {cycles['rows'][-1]['lost']} messages")
        wrong += cycles["contradictions"]
        wrong += [
            f"unexplained at {at:.0f} s: {name}: {line[:200]}" for at, name, line in cycles["unexplained"]
        ]
    if reloads := found.get("reloads"):
        wrong += [f"reloads changed another pad {reloads['difference']}"] * bool(reloads["difference"])
    return wrong


def stamp() -> str:
    """Return commit, machine and load of one of the two parts, which can be run apart."""
    return f"{made_by()}; {machine()}, load {os.getloadavg()[0]:.1f}"


def own_mb(row: tuple[float, ...]) -> float:
    """Return the resident memory of an entry of `memory` without what the test keeps itself."""
    return row[1] - row[5]


class DayMemory(NamedTuple):
    """Resident memory of a day without what the test keeps itself, and the last entry of `memory`.

    least_mb: after a restart. night_mb: at the begin and the end of the night.
    """

    least_mb: float
    night_mb: tuple[float, float]
    end: tuple[float, ...]


def memory_by_day(memory: list[tuple[float, ...]]) -> list[DayMemory]:
    """Return the memory of each day; the start-up is left out unless there is nothing else."""
    days = []
    for _, group in itertools.groupby(memory, lambda row: row[0] // 24):
        rows = list(group)
        settled = [own_mb(row) for row in rows if row[0] >= START_UP_H] or [own_mb(rows[-1])]
        night = [own_mb(row) for row in rows if not is_work(3600 * row[0])] or settled[-1:]
        days.append(DayMemory(min(settled), (night[0], night[-1]), rows[-1]))
    return days


def bad_end(name: str, code: int) -> bool:
    """Return True for an end by itself: only the recorder ends so (1), as its disk is full."""
    return code not in ((0, -9, 1) if name == "recorder" else (0, -9))


def plot(found: dict[str, Any], path: Path) -> None:
    """Draw memory, store, processor time and errors of the compressed days."""
    days = found["compressed"]
    figure, axes = plt.subplots(2, 2, figsize=(10, 5.5), sharex=True, layout="constrained")
    at, used, _, _, size, kept = np.array(days["memory"]).T
    axes[0, 0].plot(at, used - kept, label="daemon's parts")
    axes[0, 0].plot(at, used, color="0.7", label="with records of the test")
    axes[0, 0].set(ylabel="resident memory, MB", ylim=(0, None))
    axes[0, 0].legend(frameon=False)
    axes[0, 1].plot(at, size / 1e6)
    axes[0, 1].set(ylabel="calibration store, MB", ylim=(0, None))
    hours = np.arange(len(days["by_hour"])) + 0.5
    for name, label in (("tick_p50_us", "median"), ("tick_p99_us", "99th percentile")):
        axes[1, 0].plot(hours, [row[name] for row in days["by_hour"]], ".-", label=label)
    axes[1, 0].set(
        ylabel="processor time of a tick, us", xlabel="h", ylim=(0, 1.25 * axes[1, 0].get_ylim()[1])
    )
    axes[1, 0].legend(frameon=False, loc="upper left", ncols=2)
    axes[1, 1].plot(hours, [row["rms_mm"] for row in days["by_hour"]], ".-")
    axes[1, 1].set(ylabel="rms position error, mm", xlabel="h", ylim=(0, None))
    for act in days["acts"]:
        if act["kind"] == "disk full":
            for axis in axes.flat:
                axis.axvspan(act["from_s"] / 3600, act["until_s"] / 3600, color="0.85")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def page(found: dict[str, Any]) -> list[str]:
    """Return the lines of the page."""
    text = ["# Three days of mixed use", ""]
    if days := found.get("compressed"):
        rows, acts = days["by_hour"], Counter(act["kind"] for act in days["acts"])
        ticks, contacts = (sum(row[name] for row in rows) for name in ("ticks", "contacts"))
        inside = np.average([row["inside"] for row in rows if row["compared"]],
                            weights=[row["compared"] for row in rows if row["compared"]])  # fmt: skip
        by_day, replayed = (
            memory_by_day(days["memory"]),
            [sum(part) for part in zip(*days["replays"], strict=True)],
        )

        def row(name: str, values: Iterable[float]) -> str:
            return "| " + " | ".join([name, *(f"{value:.0f}" for value in values)]) + " |"

        text += [
            f"## {days['hours']:g} hours, compressed", "", f"{days['made']}.", "",
            "Time is an argument of everything here, and runs as fast as the processor permits: pipeline, "
            "percepts, supervision with its store on a small disk, and recorder, in one process; samples of "
            "a hand of the world `default` from another one, at 100 Hz in use, 20 Hz at rest and 5 Hz at "
            "night, the second half of each day, without use. Not here: "
            "sockets, CANopen master and child processes; replaced nodes are the master's events.", "",
            f"{ticks} ticks, {contacts} contacts, {days['messages']} messages recorded. "
            + "; ".join(f"{kind}: {count}" for kind, count in acts.items()) + ". "
            f"Each full disk lasts {min(FULL_DISK_S, 600 * days['hours']) / 60:.0f} min.", "",
            "| | " + " | ".join(f"day {day + 1}" for day in range(len(by_day))) + " |",
            "|---|" + "---|" * len(by_day),
            row("least resident memory, MB", (day.least_mb for day in by_day)),
            row("at the begin of the night, MB", (day.night_mb[0] for day in by_day)),
            row("at its end, MB", (day.night_mb[1] for day in by_day)),
            row("records of the test itself besides, MB", (day.end[5] for day in by_day)),
            row("descriptors", (day.end[2] for day in by_day)),
            row("objects of Python", (day.end[3] for day in by_day)),
            row("calibration store, kB", (day.end[4] / 1e3 for day in by_day)), "",
            "Memory is least after a restart, the same each day. With the first contacts after one, "
            "supervision makes the tables of its diagnoses, megabytes for each of the hand's designs of pads "
            "that is touched; the nights have no restart and no contact.", "",
            f"Positions of pads without a fault within their 95 % region: {inside:.1%}. Calibrations: "
            + ", ".join(f"{count} {state}" for state, count in Counter(days["states"]).items())
            + f"; rms errors of gains {100 * min(days['gain_errors']):.2f} to "
            f"{100 * max(days['gain_errors']):.2f} %. Replay of the last {len(days['replays'])} files: of "
            f"{replayed[0]} ticks, {replayed[2]} of {replayed[1]} messages are equal bit for bit. Diagnoses "
            f"without a cause: {sorted({kind for kind, *_ in days['alarms']}) or 'none'}; "
            f"log messages without one: {len(days['unexplained'])}.", "",
            "![Memory, store, processor time of a tick and position error by hour](soak_days.png)", "",
        ]  # fmt: skip
    if cycles := found.get("processes"):
        text += [
            f"## {cycles['minutes']:.0f} minutes of the real processes", "", f"{cycles['made']}.", "",
            "Daemon with supervisor and percept process, simulated nodes, recorder, view, Zenoh bridge and a "
            "subscriber to hand frames and percepts. In each cycle of 40 s a node is replaced and another "
            "one has a fault, beside the trouble in the table; the disk has store and recordings. Latency is "
            "from the frame's stamp to the subscriber, with all processes on this machine.", "",
            "| cycle | trouble | frames | p50, ms | p99, ms | lost |", "|---|---|---|---|---|---|",
            *(
                "| {cycle} | {trouble} | {frames} | {p50_ms:.2f} | {p99_ms:.1f} | {lost} |".format(**row)
                for row in cycles["rows"]
            ), "",
            "| process | MB at 1/3 | MB at the end | descriptors |", "|---|---|---|---|",
            *(
                f"| {name} | {early:.0f} | {late:.0f} | {files} |"
                for name, (early, late, files) in growth(cycles["memory"]).items()
            ), "",
            f"All pads operational after {cycles['served'][0]:.1f} s, at the end after "
            f"{cycles['served'][1]:.1f} s; the supervisor process was restarted "
            f"{cycles['supervisor']['restarts']} times in the last session; log messages without a cause: "
            f"{len(cycles['unexplained'])}.", "",
        ]  # fmt: skip
        text += table("What clients showed", CHECKED, cycles["checked"])
    if reloads := found.get("reloads"):
        text += [
            f"## {reloads['hours']:g} hours with reloads", "", f"{reloads['made']}.", "",
            "Two pipelines get the samples of part 1, without faults. One is reloaded every "
            f"{RELOAD_PERIOD_S / 60:g} min with random keys of the sheet and the gap of every second pad, "
            "which are a hand of their own: "
            f"{reloads['reloads']} reloads. Of the other {reloads['pads']} pads, {reloads['equal']} contact "
            "messages and columns of hand frames are equal bit for bit.", "",
        ]  # fmt: skip
    wrong = problems(found)
    return [*text, *(f"* {line}" for line in wrong or ["Nothing is wrong."]), ""]


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=HOURS, help="compressed; 0: not that")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="of the processes; 0: not that")
    parser.add_argument("--reload-hours", type=float, default=RELOAD_HOURS, help="with reloads; 0: not that")
    asked = parser.parse_args()
    disk = on_small_disk()
    in_own_network()
    if asked.quick:
        asked.hours, asked.minutes = min(asked.hours, 0.3), min(asked.minutes, 2.0)
        asked.reload_hours = min(asked.reload_hours, 0.1)
    out = output_folder(asked.quick)
    path = out / "soak_days.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    if asked.minutes:
        folder = disk / "processes"
        folder.mkdir()
        cycles = run_cycles(asked.minutes, folder, Filler(disk))
        links = [pad.link for _, pad in Days(1.0).use.deployment.pads]
        cycles["unexplained"] = unexplained(cycles.pop("log"), cycles["acts"], links)
        found["processes"] = cycles | {"made": stamp()}
        progress(problems({"processes": cycles}))
    if asked.hours:
        with tempfile.TemporaryDirectory(prefix="ht.") as recordings:
            found["compressed"] = compressed(asked.hours, disk, Path(recordings)) | {"made": stamp()}
    if asked.reload_hours:
        found["reloads"] = compare_reloads(asked.reload_hours) | {"made": stamp()}
    path.write_text(json.dumps(found, indent=1, default=str) + "\n")
    if "compressed" in found:
        plot(found, out / "soak_days.png")
    text = page(found)
    (out / "soak_days.md").write_text("\n".join(text))
    print("\n".join(text))
    return int(bool(problems(found)))


if __name__ == "__main__":
    sys.exit(main())
