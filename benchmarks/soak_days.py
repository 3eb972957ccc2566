"""Three days of mixed use with faults, compressed, and the real processes in cycles of trouble.

*Compressed*: pipeline, percepts, supervision with its store on a small disk, and recorder in one process,
where time is an argument and runs as fast as the processor permits; samples of a hand of the world `default`
from another one, at 100 Hz in use, 20 Hz at rest and 5 Hz at night, the second half of each day, without use.
Not here: sockets, CANopen master and child processes; replaced nodes are the master's events. Memory is least
after a restart; the nights have no restart and no contact. *Within*: positions of pads without a fault in
their 95 % region. The last recordings are replayed. *Processes*: daemon with supervisor and percept process,
simulated nodes, recorder, view, Zenoh bridge and a subscriber, in real time. In each cycle of 40 s a node is
replaced and another one has a fault, beside the trouble in the table; the disk has store and recordings.
Latency is from the frame's stamp to the subscriber. A checker beside the other clients knows the scenario,
and when the daemon died: nothing may contradict it. No touched pad is shown as clear, nor the reverse, from
0.3 s after a change on; what isn't sampled is unknown, also in sums; no frame is older than its limit; a dead
daemon is known within 50 ms. *Problems* must be none.

ARGS="--hours 72 --minutes 20"; status 1 if something is wrong.
"""

from __future__ import annotations

import errno
import itertools
import os
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.page import Report, options

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small


from benchmarks.compressed_days import AFTERWARDS_S, FULL_DISK_S, Days, is_work, run_days
from benchmarks.cycled_processes import growth, run_cycles, unexplained
from benchmarks.scores import Share
from benchmarks.served_hand import in_own_network
from handtouch.record.recording import Recording
from handtouch.record.replay_recording import replay_recording

HOURS, MINUTES = 72.0, 20.0
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
    return wrong


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


def report_compressed(quick: bool, days: dict[str, Any]) -> bool:
    """Keep what the compressed days gave."""
    of_all, by_day = days["whole"], memory_by_day(days["memory"])
    report = Report(
        quick, "compressed", hours=days["hours"], full_disk_min=min(FULL_DISK_S, 600 * days["hours"]) / 60
    )
    memory = {
        "least resident memory, MB": [day.least_mb for day in by_day],
        "at the begin of the night, MB": [day.night_mb[0] for day in by_day],
        "at its end, MB": [day.night_mb[1] for day in by_day],
        "records of the test itself besides, MB": [day.end[5] for day in by_day],
        "descriptors": [day.end[2] for day in by_day],
        "objects of Python": [day.end[3] for day in by_day],
        "calibration store, kB": [day.end[4] / 1e3 for day in by_day],
    }
    report.table(
        "Days",
        [{"case": name} | {f"day {k + 1}": v for k, v in enumerate(of)} for name, of in memory.items()],
    )
    replayed = [sum(part) for part in zip(*days["replays"], strict=True)]
    whole = {
        "ticks": of_all.ticks,
        "contacts": of_all.contacts,
        "messages": days["messages"],
        "within, %": Share.of_mask(np.array(of_all.inside, np.bool_)),
        "errors of gains, %": [100 * min(days["gain_errors"]), 100 * max(days["gain_errors"])],
        "replayed messages": replayed[1],
        "equal": replayed[2],
        "diagnoses without a cause": len(days["alarms"]),
        "log messages without one": len(days["unexplained"]),
    }
    report.table("Whole time", [whole | Counter(days["states"])])
    report.table("Acts", [Counter(act["kind"] for act in days["acts"])])
    return finish(report, {"compressed": days})


def report_processes(quick: bool, cycles: dict[str, Any]) -> bool:
    """Keep what the cycles of trouble gave."""
    report = Report(quick, "processes", minutes=cycles["minutes"])
    report.table("Cycles", cycles["rows"])
    sizes = growth(cycles["memory"]).items()
    report.table(
        "Processes",
        [
            {"process": name, "MB at 1/3": a, "MB at the end": b, "descriptors": n}
            for name, (a, b, n) in sizes
        ],
    )
    served = {"all pads after, s": cycles["served"][0], "at the end after, s": cycles["served"][1]}
    restarts = {"restarts of the supervisor in the last session": cycles["supervisor"]["restarts"]}
    report.table("Service", [served | restarts])
    report.table("What clients showed", cycles["checked"])
    return finish(report, {"processes": cycles})


def finish(report: Report, found: dict[str, Any]) -> bool:
    """Keep a report with the problems of its part; return whether there are none."""
    wrong = problems(found)
    report.table("Problems", [{"problem": line} for line in wrong])
    return report.keep() and not wrong


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=HOURS, help="compressed; 0: not that")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="of the processes; 0: not that")
    asked = parser.parse_args()
    disk = on_small_disk()
    in_own_network()
    if asked.quick:
        asked.hours, asked.minutes = min(asked.hours, 0.3), min(asked.minutes, 2.0)
    well = True
    if asked.minutes:
        folder = disk / "processes"
        folder.mkdir()
        cycles = run_cycles(asked.minutes, folder, Filler(disk))
        links = [pad.link for _, pad in Days(1.0).use.deployment.pads]
        cycles["unexplained"] = unexplained(cycles.pop("log"), cycles["acts"], links)
        well &= report_processes(asked.quick, cycles)
    if asked.hours:
        with tempfile.TemporaryDirectory(prefix="ht.") as recordings:
            well &= report_compressed(asked.quick, compressed(asked.hours, disk, Path(recordings)))
    return int(not well)


if __name__ == "__main__":
    sys.exit(main())
