"""Plots of docs/key_figures.md, drawn from the recorded results of the benchmarks whenever the site is built.

`python docs/key_figures.py FOLDER` draws them without the site. Needs matplotlib.
"""

from __future__ import annotations

import json
import math
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "benchmarks"
WORLDS = ("ideal", "default", "harsh")
BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#8a8a8a"  # distinct with colour blindness
STYLE = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "handtouch",
    "figure.facecolor": "white",
}
SIZE_INCH = (5.6, 3.6)


def draw_all(folder: Path) -> None:
    """Write one SVG per figure into `folder`, created if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Callable[[Axes], None]] = {
        "position": draw_position,
        "coverage": draw_coverage,
        "latency": draw_latency,
        "tick": draw_tick,
        "bus": draw_bus,
        "methods": draw_methods,
        "slip": draw_slip,
        "diagnosis": draw_diagnosis,
        "swap": draw_swap,
        "light_touch": draw_light_touch,
    }
    with matplotlib.rc_context(STYLE):
        for name, draw in figures.items():
            figure = Figure(figsize=SIZE_INCH, layout="constrained")
            draw(figure.add_subplot())
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


def table(name: str, title: str, part: str = "") -> list[dict[str, Any]]:
    """Return the rows of a table of a benchmark's recorded results."""
    results = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    rows: list[dict[str, Any]] = results["parts"][part]["tables"][title]
    return rows


def number(cell: Any) -> float:
    """Return the number of a cell, NaN without one; of a share, its percentage."""
    if isinstance(cell, dict):
        return 100 * float(cell["count"]) / cell["total"] if cell["total"] else math.nan
    words = str(cell).rstrip("%").split()
    try:
        return float(words[0].rstrip("%"))
    except (IndexError, ValueError):
        return math.nan


def draw_position(axes: Axes) -> None:
    """Rms error of valid positions by world."""
    rows = {row["case"]: number(row["rms error"]) for row in table("worlds", "Position")}
    states = {case.split(", ")[1] for case in rows if case.startswith("ideal, ")}
    (learnt,) = states - {"as configured"}
    for shift, colour, state in ((-0.2, BLUE, "as configured"), (0.2, ORANGE, learnt)):
        errors = [rows[f"{world}, {state}"] for world in WORLDS]
        bars = axes.bar([n + shift for n in range(len(WORLDS))], errors, 0.38, color=colour, label=state)
        axes.bar_label(bars, fmt="%.2g", padding=2)
    axes.set(xticks=range(len(WORLDS)), xticklabels=WORLDS, ylabel="rms position error, mm")
    axes.margins(y=0.15)
    axes.legend(frameon=False)


def draw_coverage(axes: Axes) -> None:
    """Share of true values within the stated 95 % regions by world."""
    for shift, colour, quantity in ((-0.2, BLUE, "Position"), (0.2, ORANGE, "Force")):
        rows = {row["case"]: number(row["in 95 %"]) for row in table("worlds", quantity)}
        shares = [rows[f"{world}, as configured"] for world in WORLDS]
        bars = axes.bar(
            [n + shift for n in range(len(WORLDS))], shares, 0.38, color=colour, label=quantity.lower()
        )
        axes.bar_label(bars, fmt="%.0f", padding=2)
    axes.axhline(95, color=GREY, linewidth=1, linestyle="--")
    axes.set(xticks=range(len(WORLDS)), xticklabels=WORLDS, ylabel="within the stated 95 % region, %")
    axes.set_ylim(0, 119)
    axes.legend(frameon=False, ncols=2, loc="upper center")


def draw_latency(axes: Axes) -> None:
    """Latency from the last CAN frame to the subscriber, median and 99th percentile."""
    rows = {
        row["case"]: (1e-3 * number(row["p50, us"]), 1e-3 * number(row["p99, us"]))
        for row in table("latency", "Latency", "udp_multicast")
        if row["contacts"] == "sliding"
    }
    names = {
        "daemon": "handtouch",
        "floor": "bare loop",
        "daemon, realtime_priority = 40, busy_poll_us = 1000": "handtouch,\nreal-time",
        "floor with that priority": "bare loop,\nreal-time",
    }
    names = {who: name for who, name in names.items() if who in rows}
    for shift, colour, label, column in ((-0.2, BLUE, "median", 0), (0.2, ORANGE, "99th percentile", 1)):
        values = [rows[who][column] for who in names]
        bars = axes.bar([n + shift for n in range(len(names))], values, 0.38, color=colour, label=label)
        axes.bar_label(bars, fmt="%.2f", padding=2)
    axes.set(xticks=range(len(names)), xticklabels=names.values(), ylabel="last CAN frame to subscriber, ms")
    axes.margins(y=0.15)
    axes.legend(frameon=False)


def draw_tick(axes: Axes) -> None:
    """Time to compute all pads once, by touched pads."""
    rows = [row for row in table("tick", "Microseconds") if int(row["touched"]) == int(row["pads"])]
    for colour, contacts in ((BLUE, "static"), (ORANGE, "sliding")):
        points = sorted(
            (int(row["pads"]), number(row["tick"])) for row in rows if row["contacts"] == contacts
        )
        axes.plot(*zip(*points, strict=True), "o-", color=colour, label=f"{contacts} contacts on all pads")
    axes.set(xscale="log", yscale="log", xlabel="pads", ylabel="one tick of all pads, us")
    sizes = sorted({int(row["pads"]) for row in rows})
    axes.set_xticks(sizes, [f"{size}" for size in sizes])
    axes.minorticks_off()
    axes.legend(frameon=False)


def draw_bus(axes: Axes) -> None:
    """Load of the CAN bus of 15 pads, by sampling."""
    loads: dict[str, list[float]] = defaultdict(list)
    for row in table("idle", "Load"):
        loads[row["scene"]].append(number(row["bus load, %"]))
    axes.barh(list(loads), [max(values) for values in loads.values()], color=GREY, label="most")
    bars = axes.barh(
        list(loads), [min(values) for values in loads.values()], color=BLUE, label="all untouched"
    )
    axes.bar_label(bars, fmt="%.0f %%", padding=3)
    axes.set(xlabel="load of a 1 Mbit/s bus, 15 pads at 200 Hz, %")
    axes.set_yticks(range(len(loads)), [name.replace(", ", ",\n") for name in loads])
    axes.invert_yaxis()
    axes.legend(frameon=False, loc="lower right")


def draw_methods(axes: Axes) -> None:
    """Run time against error of ways to locate a contact on an ideal pad."""
    kinds = {
        "paper": (GREY, "the paper's"),
        "instead": (ORANGE, "common alternatives"),
        "handtouch": (BLUE, "handtouch.field"),
        "core": (GREEN, "in the daemon"),
    }
    rows = table("methods", "Ideal pad")
    for kind, (colour, label) in kinds.items():
        points = [
            (number(row["us each, 15 in a call"]), number(row["rms, mm"]))
            for row in rows
            if row["kind"] == kind
        ]
        axes.plot(*zip(*points, strict=True), "o", color=colour, label=label)
    axes.set(
        xscale="log", yscale="log", xlabel="us per contact, 15 at once", ylabel="rms error without noise, mm"
    )
    axes.axhline(
        number(table("methods", "Floors, mm")[0]["noise of the channels"]), color=GREY, linestyle="--"
    )
    axes.text(0.99, 0.86, "noise of the channels", transform=axes.transAxes, ha="right", color=GREY)
    axes.legend(frameon=False, loc="lower right", fontsize=8)


def draw_slip(axes: Axes) -> None:
    """Detection latency of slips in the world `default` by speed, with the bound of a test that knows it."""
    rows = [
        {key: cell if key == "world" else number(cell) for key, cell in row.items()}
        for row in table("slip", "From onset to alarm")
    ]
    rows = [row for row in rows if (row["world"], row["Hz"]) == ("default", 200.0)]
    for colour, force_n in ((BLUE, 0.5), (ORANGE, 2.0), (GREEN, 5.0)):
        of_force = [row for row in rows if row["N"] == force_n]
        for column, line, label in (("median ms", "o-", f"{force_n:g} N"), ("bound ms", ":", None)):
            points = sorted((row["mm/s"], row[column]) for row in of_force if math.isfinite(row[column]))
            axes.plot(*zip(*points, strict=True), line, color=colour, label=label)
    axes.set(xscale="log", yscale="log", xlabel="speed, mm/s", ylabel="median detection latency, ms")
    axes.legend(frameon=False, title="dotted: knows the speed")


def draw_diagnosis(axes: Axes) -> None:
    """Share of episodes with a fault that are diagnosed correctly."""
    rows = [row for row in table("diagnose", "World default") if int(row["events"])]
    recall = [number(row["recall, %"]) for row in rows]
    bars = axes.barh([row["played"] for row in rows], recall, color=BLUE)
    axes.bar_label(bars, fmt="%.0f", padding=3)
    axes.set(xlabel="episodes with the correct diagnosis, %", xlim=(0, 112))
    axes.invert_yaxis()


def draw_light_touch(axes: Axes) -> None:
    """Share of steps that are seen within 50 ms by force, with offered thresholds, and what sheets allow."""
    colours = dict(zip(WORLDS, (GREY, BLUE, ORANGE), strict=True))
    for world in WORLDS[1:]:
        rows = table("light_touch", "Touches", f"{world}: touches")
        rows = [row for row in rows if row["speed, N/s"] == "step"]
        force = [1000 * float(row["force, N"]) for row in rows]
        for column, style in (("within 50 ms", "o-"), ("seen as shipped", "s:"), ("sheet responds", "--")):
            label = f"{world}, {column}" if column != "within 50 ms" else f"{world}, offered"
            share = [number(row[column]) for row in rows]
            axes.plot(force, share, style, color=colours[world], label=label, markersize=4)
    axes.axvline(2 * 9.80665, color=GREY, linewidth=0.8)
    axes.annotate("2 gf", (2 * 9.80665, 103), ha="center", fontsize=8)
    axes.set(xlabel="force of a step, mN", ylabel="share of touches, %", xscale="log", ylim=(0, 110))
    axes.set_xticks([10, 20, 50, 100], labels=["10", "20", "50", "100"])
    axes.legend(frameon=False, fontsize=7)


def draw_swap(axes: Axes) -> None:
    """Position error of a replaced node in the world `default` by contacts since."""
    by_pad: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    columns = ("contacts since", "position error, rms mm", "with the true gains, rms mm")
    for row in table("swap", "Errors"):
        if row["world"] == "default":
            by_pad[row["pad"]].append(tuple(number(row[column]) for column in columns))
    for colour, (pad, rows) in zip((BLUE, ORANGE, GREEN), by_pad.items(), strict=False):
        contacts, errors, known = zip(*sorted(rows), strict=True)
        axes.plot(contacts, errors, "o-", color=colour, label=f"pad {pad}")
        axes.plot(contacts, known, ":", color=colour)
    axes.set(xlabel="contacts since the replacement", ylabel="rms position error, mm", yscale="log")
    axes.set_yticks([0.04, 0.06, 0.08, 0.1], ["0.04", "0.06", "0.08", "0.1"])
    axes.minorticks_off()
    axes.legend(frameon=False, title="dotted: gains known")


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]))
