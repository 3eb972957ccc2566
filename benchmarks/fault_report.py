"""What came of a fault campaign: figures by kind, what is wrong, and the page.

Public names: `by_kind`, `verdict`, `section`, `page`.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from fault_acts import Fault
from fault_kinds import KINDS

LEAK_KB_PER_MIN = 300.0


def by_kind(done: list[Fault]) -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        faults = [fault for fault in done if fault.kind is kind and fault.failures != ["paused"]]
        if not faults:
            continue
        detect = [(max(f.told_ns.values()) - f.start_ns) * 1e-9 for f in faults if f.told_ns]
        recover = [(max(f.well_ns.values()) - f.ended_ns) * 1e-9 for f in faults if f.well_ns]
        asked = kind.told is not None or kind.told_by_bus is not None
        failures = Counter(failure for f in faults for failure in set(f.failures))
        rows.append(
            {
                "kind": kind.name,
                "expected": kind.expected,
                "number": len(faults),
                "told": len(faults) - failures["not told"] if asked else None,
                "detect_s": spread(detect) if asked else None,
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
    """What is wrong; empty when all is as it should be."""
    wrong = [
        f"{row['kind']}: {number} {failure}"
        for row in results["kinds"]
        for failure, number in row["failures"].items()
    ]
    told = Counter(f"{s['state']}, {s['reason']}" for s in results["surprises"])
    wrong += [f"without a fault, {number} times: {what}" for what, number in told.items()]
    wrong += [f"contact out of nothing: {ghost}" for ghost in results["ghosts"]]
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
        "several at once on different nodes;\neach lasts a random while and is taken back. The daemon is a "
        "process of its own; a client on its stream judges by\nwhat `health` and `service` say. Times are "
        "those of the messages, after the fault began and after it was taken\nback; figures that "
        "are published once a second (`missed`, `emergencies`) or twice (`service`) are told no sooner. "
        "A node is well\nagain when it is operational and its samples are trusted.\n\nBeside every fault: no "
        "node without one changes its state, no pad that nothing touches shows a contact.\n\n"
        "A machine that is busy with other things pauses nodes and daemon. What was told while a node sent\n"
        "nothing, though nothing was wrong with it, is counted apart, as void.\n\n"
        "Made by `make stress ONLY=faults`; on SocketCAN by `tests/socketcan/vcan-run .venv/bin/python\n"
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

Seconds: median, 90 %, worst.

| fault | to be told | number | told | until told | until well |
| --- | --- | --- | --- | --- | --- |
{rows}

A dash: nothing of the kind is asked for. Stuck channels and dead electrodes are for the supervisor of pads to
name; here it is only asked that the node stays operational and the others undisturbed.

| | |
| --- | --- |
| told wrongly, not recovered, or disturbed | {"; ".join(wrong) or "nothing"} |
| samples sent by the nodes and lost on the way | {results["samples_lost"]} of {results["samples_sent"]} |
| nodes without a fault: ticks without their sample | {undisturbed["missed"]} of {undisturbed["samples"]} |
| void, as the machine paused: faults, states told | {results["void"]}, {results["excused"]} |
| ticks overrun | {results["overruns"]} of {results["ticks"]} |
| memory of the daemon, MB: start, half, end | {series("rss_mb")} |
| its slope in the second half, kB a minute | {used["rss_kb_per_min"]:+.0f} |
| file descriptors: start, half, end, most | {series("descriptors")} |
| threads: start, half, end, most | {series("threads")} |
| exceptions on stderr | {len(results["exceptions"])} |
| exit status | {results["exit_status"]} |
"""


def share(row: dict[str, Any]) -> str:
    return "-" if row["told"] is None else f"{100 * row['told'] / row['number']:.0f} %"


def times(values: dict[str, float] | None) -> str:
    return "-" if values is None else f"{values['median']:.2f}, {values['p90']:.2f}, {values['worst']:.2f}"
