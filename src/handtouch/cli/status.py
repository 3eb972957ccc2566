"""Output of `handtouch status`: state of the daemon, its buses and its pads."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from handtouch.cli.requests import add_request, scene_lines, send_request
from handtouch.cli.tables import make_table, output_console, print_table
from handtouch.host.json_output import print_json
from handtouch.view.message_lines import (
    UNCALIBRATED_STATES,
    diagnosis_text,
    is_same_reason,
    names_text,
    tick_rate_text,
)

_Column = tuple[str, bool, Callable[[dict[str, Any]], str]]
_LINK: _Column = ("link", False, lambda pad: f"{pad['hand']}/{pad['link']}")
_STATE: _Column = ("state", False, lambda pad: pad["state"] + _calibration_note(pad))
_RATE: _Column = ("Hz", True, lambda pad: f"{pad['rate_hz']:.0f}")
_REASON: _Column = ("reason", False, lambda pad: _reason(pad))
_MIN_COMMON = 3
"""Pads with one reason from which on it is printed once: it takes fewer lines then"""
_COLUMNS = (_LINK, _STATE, _RATE, _REASON)
"""Columns of the table of pads: header, number, text of a pad."""
_VERBOSE_COLUMNS = (
    _LINK,
    _STATE,
    ("node", False, lambda pad: pad["node_state"] + " (event)" * (pad["sampling"] == "event")),
    ("id", True, lambda pad: str(pad["node_id"])),
    ("serial", True, lambda pad: "" if pad["serial"] is None else str(pad["serial"])),
    _RATE,
    ("missed", True, lambda pad: str(pad["missed_samples"])),
    ("heartbeats missed", True, lambda pad: str(pad["heartbeats_missed"])),
    ("reboots", True, lambda pad: str(pad["reboots"])),
    _REASON,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `status`."""
    add_request(parser, run)
    parser.add_argument(
        "-v", "--verbose", action="store_true", help="also timing, buses' counters, scenes and nodes"
    )


def run(*, endpoint: str, key: str | None, as_json: bool, verbose: bool) -> int:
    """Print the status; exit status 0 (pads and store ok), 1 (not all, or no daemon), 2 (usage)."""
    answer = send_request("status", endpoint, key)
    if as_json:
        print_json(answer)
    else:
        print_status(answer, output_console(), verbose)
    return 0 if is_all_ok(answer) else 1


def is_all_ok(answer: dict[str, Any]) -> bool:
    """Return True if all pads are ok, and calibrations can be stored."""
    return all(map(is_ok, answer["pads"])) and not _store_error(answer)


def _store_error(answer: dict[str, Any]) -> str:
    return str((answer["service"].get("supervisor") or {}).get("store_error", ""))


def is_ok(pad: dict[str, Any]) -> bool:
    """Return True for a calibrated pad that works or is switched off."""
    return pad["state"] in ("clear", "touched", "off") and not _calibration_note(pad)


def print_status(answer: dict[str, Any], console: Console, verbose: bool = False) -> None:
    """Print the reply to the control command `status`: a verdict, what is wrong, pads; `verbose`: all."""
    service = answer["service"]
    console.print(_verdict(answer), style="green" if is_all_ok(answer) else "red")
    if " of " in _rate_text(service) and (late := service["loop"]["late"]):
        part = max(late, key=lambda name: late[name])
        console.print(f"ticks are late, mostly by {part}: docs/watch.md has the remedies", style="yellow")
    if verbose:
        _print_daemon(service, console)
    if not service["core_compiled"]:
        console.print("core: uncompiled, fifty times slower per contact; `handtouch doctor` names the remedy")
    for name, bus in service["buses"].items():
        _print_bus(name, bus, console, verbose)
    if verbose:
        for line in scene_lines(answer["scene"]):
            console.print(line)
    _print_pads(answer["pads"], console, _VERBOSE_COLUMNS if verbose else _COLUMNS)
    _print_supervisor(answer, console, verbose)
    _print_rejected_adaptation(answer, console)
    _print_failed_channels(answer, console)
    percepts = service.get("percepts")
    if percepts is not None and (percepts["restarts"] or (verbose and percepts["state"] != "stopped")):
        console.print(f"percepts {_process_text(percepts)}; {percepts['dropped']} messages dropped")


def _verdict(answer: dict[str, Any]) -> str:
    """Return one line: pads that are ok, those that aren't by their states, rate and load of the buses."""
    pads, service = answer["pads"], answer["service"]
    faulty = Counter(_STATE[2](pad) for pad in pads if not is_ok(pad))
    causes = f" ({', '.join(f'{count} {state}' for state, count in faulty.items())})" if faulty else ""
    buses = ", ".join(f"{name} {100 * bus['load']:.0f} %" for name, bus in service["buses"].items())
    return (
        f"{len(pads) - faulty.total()} of {len(pads)} pads ok{causes}, {_rate_text(service)} Hz"
        + (f", {buses}" if buses else "")
        + ("; calibrations can't be stored" if _store_error(answer) else "")
    )


def _rate_text(service: dict[str, Any]) -> str:
    names = ("rate_hz", "period_s", "overruns", "uptime_s")
    return tick_rate_text(**{name: service[name] for name in names})


def _print_daemon(service: dict[str, Any], console: Console) -> None:
    """Print ticks, congestion, mean durations of the stages of a cycle, resources and rejections."""
    tick, loop, process = service["tick_us"], service["loop"], service["process"]
    console.print(
        f"handtouch {service['version']}, process {service['pid']}, up {service['uptime_s']:.0f} s: "
        f"{service['ticks']} ticks at {_rate_text(service)} Hz, {service['overruns']} overruns"
        + (f", tick {tick['p50']:.0f} us (p99 {tick['p99']:.0f}, max {tick['max']:.0f})" if tick else "")
    )
    episodes = _counts_text(service["congestion_episodes"])
    console.print(
        f"congestion episodes: {episodes}; subscriptions: {', '.join(service['subscriptions']) or 'none'}"
    )
    means = (
        f"{stage} {1e3 * figures['sum_s'] / sum(figures['counts']):.2f}"
        for stage, figures in loop["stages"].items()
        if figures["counts"]
    )
    console.print(
        f"mean time per cycle, ms: {', '.join(means) or 'none yet'}; late ticks: {_counts_text(loop['late'])}"
    )
    console.print(
        f"memory {process['memory_bytes'] / 1e6:.0f} MB, {process['cpu_s']:.0f} s of CPU time, "
        f"of which the main loop {process['loop_cpu_s']:.0f} s; rejected: {_counts_text(service['rejected'])}"
    )


def _print_bus(name: str, bus: dict[str, Any], console: Console, verbose: bool) -> None:
    """Print a bus that has a problem; `verbose`: every one, with its counters."""
    sync = bus["sync"]
    counts = ", ".join(
        f"{key} {value}" for key, value in bus.items() if isinstance(value, int) and key != "since_ns"
    )
    causes = [f"{cause} {count}" for cause, count in bus["causes"].items()]
    problems = "; ".join(filter(None, [bus["problem"], sync["problem"]]))
    if not verbose:
        if problems or bus["state"] != "active":
            console.print(Text(f"bus {name}: {bus['state']}; {problems}", "red"))
        return
    jitter = sync["jitter_us"]
    line = (
        f"bus {name}: {bus['state']}, load {100 * bus['load']:.0f} %, SYNC by {sync['by']}"
        + (f" (jitter p99 {jitter['p99']:.0f} us, max {jitter['max']:.0f})" if jitter else "")
        + f", {counts}"
        + (f"; error frames: {', '.join(causes)}" if causes else "")
    )
    console.print(Text.assemble(line, " " if problems else "", (problems, "red")))


def _print_pads(pads: list[dict[str, Any]], console: Console, columns: Sequence[_Column]) -> None:
    """Print a table of the pads, after the reasons that several have in common."""
    common: list[tuple[str, list[str]]] = []
    for pad in pads:
        alike = next((names for reason, names in common if is_same_reason(reason, _reason(pad))), None)
        if alike is None:
            common.append((_reason(pad), alike := []))
        alike.append(_LINK[2](pad))
    once = {name for reason, names in common if reason and len(names) >= _MIN_COMMON for name in names}
    for reason, names in common:
        if names[0] in once:
            console.print(f"{names_text(names)}: {reason}")
    table = make_table(
        *(header for header, _, _ in columns),
        right=[header for header, number, _ in columns if number],
        wrapped=("reason",),
    )
    for pad in pads:
        short = "as above" if _LINK[2](pad) in once else _reason(pad)
        table.add_row(*(short if column is _REASON else column[2](pad) for column in columns))
    print_table(console, table)


def _reason(pad: dict[str, Any]) -> str:
    return "; ".join(filter(None, [pad["reason"], *_active_errors(pad)]))


def _active_errors(pad: dict[str, Any]) -> list[str]:
    """Return the errors that the node has reported by EMCY and not cleared, unless the reason names them."""
    active = [error for error in pad["emergencies"] if error["cleared_ns"] is None]
    return [f"EMCY {e['text']}" for e in active[-2:] if f"0x{e['code']:04X}" not in pad["reason"]]


def _process_text(figures: dict[str, Any]) -> str:
    """Describe the state of a child process."""
    lag = "" if figures["lag_s"] is None else f", {figures['lag_s']:.1f} s behind"
    exited = f" (last exit: {figures['exit_reason']})" if figures["exit_reason"] else ""
    process = "" if figures["pid"] is None else f", process {figures['pid']}"
    return f"{figures['state']}{process}{lag}, {figures['restarts']} restarts{exited}"


def _print_supervisor(answer: dict[str, Any], console: Console, verbose: bool) -> None:
    """Print the supervisor's faults and diagnoses; `verbose`: also the state of its process."""
    figures = answer["service"].get("supervisor")
    if figures is None:
        return
    if verbose or figures["restarts"]:
        summary = figures["summary"] or "not known yet"
        console.print(f"supervisor {_process_text(figures)}; calibrations: {summary}")
    if figures["store_error"]:
        console.print(f"calibration store: {figures['store_error']}", style="red")
    for pad in answer["pads"]:
        for diagnosis in pad.get("diagnoses", ()):
            console.print(f"{pad['hand']}/{pad['link']}: {diagnosis_text(diagnosis)}", style="yellow")


def _print_rejected_adaptation(answer: dict[str, Any], console: Console) -> None:
    """Print the pads whose adaptation isn't compensated."""
    if rejected := [pad["link"] for pad in answer["pads"] if pad.get("adaptation_status") == "rejected"]:
        text = f"adaptation not compensated, as steady holds drift less without: {', '.join(rejected)}"
        console.print(text)


def _print_failed_channels(answer: dict[str, Any], console: Console) -> None:
    """Print the pads whose shear pad or second sheet has a failed channel."""
    for pad in answer["pads"]:
        if (status := pad.get("shear_status", "")) in ("dead", "saturated", "shorted"):
            text = f"{pad['hand']}/{pad['link']}: channels of the shear pad {status}; check its leads"
            console.print(text, style="yellow")
        if (status := pad.get("second_sheet_status", "operational")) not in ("", "operational", "no_zero"):
            text = f"{pad['hand']}/{pad['link']}: second sheet {status}; check its lead and its layer"
            console.print(text, style="yellow")


def _calibration_note(pad: dict[str, Any]) -> str:
    state = pad.get("calibration_state")
    return f" ({state})" if state in UNCALIBRATED_STATES else ""


def _counts_text(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count) or "none"
