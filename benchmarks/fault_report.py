"""Report of a fault campaign: statistics by kind, failures, and the page.

Public names: `by_kind`, `verdict`, `section`, `page`.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from benchmarks.fault_acts import Fault
from benchmarks.fault_kinds import KINDS

LEAK_KB_PER_MIN = 300.0


def by_kind(done: list[Fault]) -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        faults = [fault for fault in done if fault.kind is kind and fault.failures != ["paused"]]
        if not faults:
            continue
        detect = [(max(f.reported_ns.values()) - f.start_ns) * 1e-9 for f in faults if f.reported_ns]
        recover = [(max(f.well_ns.values()) - f.ended_ns) * 1e-9 for f in faults if f.well_ns]
        required = kind.reported is not None or kind.reported_by_bus is not None
        failures = Counter(failure for f in faults for failure in set(f.failures))
        rows.append(
            {
                "kind": kind.name,
                "expected": kind.expected,
                "number": len(faults),
                "reported": len(faults) - failures["not reported"] if required else None,
                "detect_s": spread(detect) if required else None,
                "recover_s": None if kind.quiet or kind.loose else spread(recover),
                "failures": dict(failures),
            }
        )
    return rows


def spread(values: list[float]) -> dict[str, float] | None:
    """Median, 90 % and worst."""
    if not values:
        return None
    median, p90, worst = np.percentile(values, [50, 90, 100]).tolist()
    return {"median": round(median, 3), "p90": round(p90, 3), "worst": round(worst, 3)}


def verdict(results: dict[str, Any]) -> list[str]:
    """Return the failures; empty if there are none."""
    wrong = [
        f"{row['kind']}: {number} {failure}"
        for row in results["kinds"]
        for failure, number in row["failures"].items()
    ]
    unexpected = Counter(f"{s['state']}, {s['reason']}" for s in results["surprises"])
    wrong += [f"without a fault, {number} times: {what}" for what, number in unexpected.items()]
    wrong += [f"contact without a touch: {ghost}" for ghost in results["ghosts"]]
    wrong += [f"exception: {line}" for line in results["exceptions"]]
    if results["samples_lost"]:
        wrong.append(f"{results['samples_lost']} samples lost on the way")
    used = results["resources"]
    if used["rss_kb_per_min"] > LEAK_KB_PER_MIN:
        wrong.append(f"memory grows by {used['rss_kb_per_min']} kB a minute")
    if used["descriptors"][2] > used["descriptors"][1]:
        wrong.append(f"descriptors grow: {used['descriptors']}")
    if results["exit_status"]:
        wrong.append(f"exit status {results['exit_status']}")
    return wrong


def page(every: dict[str, dict[str, Any]]) -> str:
    parts = [
        "# Fault campaign\n\nFaults of simulated nodes and of their bus at random times (Poisson, seeded), "
        "several at once on different nodes;\neach lasts a random time and is removed. The daemon runs in "
        "its own process; a client checks\n`health` and `service`. Times are "
        "those of the messages, after the fault began and after it was removed;\ncounters that "
        "are published once a second (`missed_samples`) or twice (`service`) are reported no "
        "sooner. A node has\nrecovered when it is operational and its samples are valid.\n\nDuring every "
        "fault: no node without a fault changes its state, no untouched pad reports a contact.\n\n"
        "A busy machine pauses nodes and daemon. Reports while a fault-free node sent nothing\n"
        "are counted separately, as void.\n\n"
        "On SocketCAN by `tests/socketcan/vcan-run .venv/bin/python\n"
        "benchmarks/stress_faults.py --interface socketcan --faults 60 --rate 1 --period-ms 20 "
        "--patience 3`.\n"
    ]
    parts += [section(results) for results in every.values()]
    return "\n".join(parts)


def section(results: dict[str, Any]) -> str:
    rows = "\n".join(
        f"| {row['kind']} | {row['expected']} | {row['number']} | {share(row)} | {times(row['detect_s'])} "
        f"| {times(row['recover_s'])} |"
        for row in results["kinds"]
    )
    used, wrong = results["resources"], verdict(results)
    undisturbed = results["undisturbed"]

    def series(name: str) -> str:
        return ", ".join(map(str, used[name]))

    return f"""
## {results["interface"]}

{results["faults"]} faults in {results["seconds"]:.0f} s, {results["rate"]:g} a second,
seed {results["seed"]}.
15 nodes at {1000 / results["period_ms"]:.0f} Hz. Limits: {results["patience"]:g} times those of a robot.
On {results["machine"]}; load {results["load"]:.1f} at the end.
{results["made_by"]}.

Seconds: median, 90 %, worst.

| fault | expected report | number | reported | until reported | until recovered |
| --- | --- | --- | --- | --- | --- |
{rows}

A dash: not required. Stuck channels and dead electrodes are diagnosed by the supervisor; here the node only
has to stay operational and the others undisturbed.

| | |
| --- | --- |
| wrong report, no recovery, or disturbance | {"; ".join(wrong) or "nothing"} |
| samples sent by the nodes and lost on the way | {results["samples_lost"]} of {results["samples_sent"]} |
| nodes without a fault: ticks without their sample | {undisturbed["missed"]} of {undisturbed["samples"]} |
| void because of machine pauses: faults, states | {results["void"]}, {results["excused"]} |
| ticks overrun | {results["overruns"]} of {results["ticks"]} |
| memory of the daemon, MB: start, half, end | {series("rss_mb")} |
| its growth in the second half, kB a minute | {used["rss_kb_per_min"]:+.0f} |
| file descriptors: start, half, end, most | {series("descriptors")} |
| threads: start, half, end, most | {series("threads")} |
| exceptions on stderr | {len(results["exceptions"])} |
| exit status | {results["exit_status"]} |
"""


def share(row: dict[str, Any]) -> str:
    return "-" if row["reported"] is None else f"{100 * row['reported'] / row['number']:.0f} %"


def times(values: dict[str, float] | None) -> str:
    return "-" if values is None else f"{values['median']:.2f}, {values['p90']:.2f}, {values['worst']:.2f}"
