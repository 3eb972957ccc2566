"""`handtouch status`: how the daemon, its buses and its pads fare, asked over the control endpoint."""

from __future__ import annotations

import json
import sys
from typing import Any

from rich.console import Console
from rich.table import Table

from handtouch.client import CONTROL, request
from handtouch.view.lines import DOUBTED, finding_text
from handtouch.view.scene import scene_lines

_WIDE = 200
"""Columns where there is no terminal to ask: a line a pad, for grep."""


def run(*, endpoint: str = CONTROL, key: str | None = None, as_json: bool = False) -> int:
    """Print the status; exit status 0 if every pad is well, 1 if not or if no daemon answers, 2 (usage)."""
    try:
        answer = request("status", endpoint=endpoint, key=key)
    except (OSError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 1
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    if as_json:
        print(json.dumps(answer, indent=2))
    else:
        _show(answer, Console(width=None if sys.stdout.isatty() else _WIDE))
    return 0 if all(map(_is_well, answer["pads"])) else 1


def _is_well(pad: dict[str, Any]) -> bool:
    return pad["state"] in ("clear", "touched", "off") and pad.get("trust") not in DOUBTED


def _show_supervisor(answer: dict[str, Any], console: Console) -> None:
    """How the slow half fares, and all that it found."""
    figures = answer["service"].get("supervisor")
    if figures is None:
        return
    lag = "" if figures["lag_s"] is None else f", {figures['lag_s']:.1f} s behind"
    died = f" (died last: {figures['died_of']})" if figures["died_of"] else ""
    process = "" if figures["pid"] is None else f", process {figures['pid']}"
    console.print(
        f"supervisor {figures['state']}{process}{lag}, {figures['restarts']} restarts{died}; "
        f"units: {figures['word'] or 'not known yet'}",
        highlight=False,
    )
    if figures["store"]:
        console.print(f"calibration store: {figures['store']}", highlight=False, markup=False, style="red")
    for pad in answer["pads"]:
        for finding in pad.get("findings", ()):
            text = f"{pad['hand']}/{pad['link']}: {finding_text(finding)}"
            console.print(text, highlight=False, markup=False, style="yellow")


def _show_loop(service: dict[str, Any], console: Console) -> None:
    """Where a period goes, what made ticks late, and what was refused."""
    loop, process = service["loop"], service["process"]
    means = (
        f"{stage} {1e3 * figures['sum_s'] / sum(figures['counts']):.2f}"
        for stage, figures in loop["stages"].items()
        if figures["counts"]
    )
    console.print(f"a period, ms: {', '.join(means) or 'none yet'}; late ticks: {_counts(loop['late'])}")
    console.print(
        f"memory {process['memory_bytes'] / 1e6:.0f} MB, {process['cpu_s']:.0f} s of processor time, "
        f"of which the loop {process['loop_cpu_s']:.0f} s; refused: {_counts(service['refused'])}"
    )


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count) or "none"


def _show(answer: dict[str, Any], console: Console) -> None:
    service = answer["service"]
    tick = service["tick_us"]
    console.print(
        f"handtouch {service['version']}, process {service['pid']}, up {service['uptime_s']:.0f} s: "
        f"{service['ticks']} ticks at {service['rate_hz']:.0f} Hz, {service['overruns']} overruns"
        + (f", tick {tick['p50']:.0f} us (p99 {tick['p99']:.0f}, max {tick['max']:.0f})" if tick else "")
    )
    drops = ", ".join(f"{count} on {stream}" for stream, count in service["drops"].items() if count) or "none"
    console.print(
        f"messages dropped: {drops}; subscriptions: {', '.join(service['subscriptions']) or 'none'}"
    )
    _show_loop(service, console)
    for name, bus in service["buses"].items():
        sync = bus["sync"]
        counts = ", ".join(
            f"{key} {value}" for key, value in bus.items() if isinstance(value, int) and key != "since_ns"
        )
        told = [f"{cause} {count}" for cause, count in bus["causes"].items()]
        problems = "; ".join(filter(None, [bus["problem"], sync["problem"]]))
        jitter = sync["jitter_us"]
        console.print(
            f"bus {name}: {bus['state']}, load {100 * bus['load']:.0f} %, SYNC by {sync['by']}"
            + (f" (jitter p99 {jitter['p99']:.0f} us, max {jitter['max']:.0f})" if jitter else "")
            + f", {counts}"
            + (f"; error frames: {', '.join(told)}" if told else "")
            + (f" [red]{problems}[/red]" if problems else "")
        )
    for line in scene_lines(answer["scene"]):
        console.print(line, highlight=False, markup=False)
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("link", "pad", "node", "id", "serial", "Hz", "missed", "beats missed", "reboots", "why"):
        number = column in ("id", "serial", "Hz", "missed", "beats missed", "reboots")
        table.add_column(column, justify="right" if number else "left", no_wrap=column != "why")
    for pad in answer["pads"]:
        table.add_row(
            f"{pad['hand']}/{pad['link']}",
            pad["state"] + (f" ({pad['trust']})" if pad.get("trust") in DOUBTED else ""),
            pad["node"] + (" (event)" if pad["pace"] == "event" else ""),
            str(pad["node_id"]),
            "" if pad["serial"] is None else str(pad["serial"]),
            f"{pad['rate_hz']:.0f}",
            str(pad["missed"]),
            str(pad["heartbeats_missed"]),
            str(pad["reboots"]),
            "; ".join(filter(None, [pad["reason"], *pad["emergencies"][-1:]])),
        )
    console.print(table)
    _show_supervisor(answer, console)
