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
BLUE, ORANGE, GREEN, GREY, PURPLE = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#8a8a8a",
    "#aa5fa0",
)  # distinct with colour blindness
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
        "methods": draw_methods,
        "methods_force": draw_methods_force,
        "position": draw_position,
        "coverage": draw_coverage,
        "latency": draw_latency,
        "tick": draw_tick,
        "bus": draw_bus,
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
    """Load of the CAN bus of 15 pads, by scene."""
    loads = {
        row["case"]: number(row["bus load, %"])
        for row in table("skipping", "Hand (least, median, greatest)")
        if "bare loop" not in row["case"]
    }
    bars = axes.barh(list(loads), list(loads.values()), color=BLUE)
    axes.bar_label(bars, fmt="%.0f %%", padding=3)
    axes.set(xlabel="load of a 1 Mbit/s bus, 15 pads at 200 Hz, %")
    axes.set_yticks(range(len(loads)), [name.replace(", ", ",\n") for name in loads], fontsize=7)
    axes.invert_yaxis()


def draw_methods(axes: Axes, column: str = "position rms, mm", label: str = "rms position error, mm") -> None:
    """Run time against error of the ways from four currents to a contact, in the world `default`."""
    kinds = {
        "paper": (GREY, "the paper's formulas"),
        "common": (ORANGE, "common alternatives"),
        "labelled": (PURPLE, "learned from 16 to 512 labelled presses"),
        "theory": (BLUE, "exact theory"),
        "core": (GREEN, "handtouch, no labels"),
    }
    rows = table("methods", "World default")
    for kind, (colour, name) in kinds.items():
        own = [row for row in rows if row["kind"] == kind]
        points = [(number(row["us each, 15 in a call"]), number(row[column])) for row in own]
        size = 110 if kind == "core" else 30
        marker = "*" if kind == "core" else "o"
        us, errors = zip(*points, strict=True)
        axes.scatter(us, errors, s=size, marker=marker, color=colour, label=name, zorder=3)
    for learner in ("polynomial", "Gaussian process", "neural network"):
        own = [row for row in rows if row["way"].startswith(learner)]
        line = [(number(row["us each, 15 in a call"]), number(row[column])) for row in own]
        axes.plot(*zip(*line, strict=True), "-", color=PURPLE, linewidth=0.8)
        axes.annotate(learner, line[0], xytext=(5, 4), textcoords="offset points", color=PURPLE, fontsize=7)
    (floor,) = (
        number(row[column])
        for row in table("methods", "Floors")
        if row["case"] == "world default" and row["cause"] == "tolerances and noise"
    )
    axes.axhline(floor, color=GREY, linewidth=1, linestyle="--")
    axes.annotate("least possible without labels", (0.99, floor), xycoords=("axes fraction", "data"),
                  xytext=(0, 3), textcoords="offset points", ha="right", color=GREY, fontsize=8)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="us per contact, 15 at once", ylabel=label)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(lambda y, _: f"{y:g}" if f"{y:e}"[0] in "235" else "")
    axes.legend(frameon=False, fontsize=7, loc="upper right")


def draw_methods_force(axes: Axes) -> None:
    """The same for forces."""
    draw_methods(axes, "force rms, %", "rms force error, %")


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
