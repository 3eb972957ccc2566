"""What a scan found, as text or JSON.

Public names: `as_text`, `as_json`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from io import StringIO
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts, TpdoFacts, four_channels
from handtouch.canbus.find.traffic import meaning

from .fragment import Found, channel_names, fragment
from .judge import Verdict, names_by_serial
from .look import BusReport

_WIDE = 200
"""Columns where there is no terminal to ask: a line a node, for grep."""
_MOST_STREAMS = 24

Deployment = config.Deployment | None


def as_json(
    reports: Sequence[BusReport], verdicts: Sequence[Verdict], deployment: Deployment, well: bool
) -> str:
    """One object: `ok`, `buses`, `verdicts`, `fragment`."""
    report = {
        "ok": well,
        "buses": [_plain(report) for report in reports],
        "verdicts": [asdict(verdict) for verdict in verdicts],
        "fragment": fragment(_new(reports, verdicts, deployment), deployment),
    }
    return json.dumps(report, indent=2) + "\n"


def as_text(
    reports: Sequence[BusReport], verdicts: Sequence[Verdict], deployment: Deployment, well: bool
) -> str:
    """A table of nodes and one of traffic for each bus, what is wrong, and the fragment."""
    terminal = sys.stdout.isatty()
    file = StringIO()
    width = None if terminal else _WIDE
    console = Console(file=file, width=width, force_terminal=terminal, highlight=False, emoji=False)
    for report in reports:
        _show_bus(console, report, {v.node_id: v for v in verdicts if v.bus == report.bus.name})
    for problem in (problem for report in reports for problem in report.problems):
        console.print(Text(problem, "red"))
    text = fragment(_new(reports, verdicts, deployment), deployment)
    if text:
        console.print("\nFor the deployment file:\n")
        console.print(Text(text), soft_wrap=True)
    console.print(Text("all is well" if well else "not all is well", "green" if well else "red"))
    return file.getvalue()


def _new(reports: Sequence[BusReport], verdicts: Sequence[Verdict], deployment: Deployment) -> Found:
    """Nodes that no pad of the deployment has, by id or by serial number, and of which there is one."""
    known = {(verdict.bus, verdict.node_id) for verdict in verdicts if verdict.pad}
    serials = set(names_by_serial(deployment))

    def new(bus: str, node: NodeFacts) -> bool:
        return (bus, node.node_id) not in known and node.serial not in serials and not node.conflict

    return [(report.bus, [n for n in report.nodes if new(report.bus.name, n)]) for report in reports]


def _show_bus(console: Console, report: BusReport, verdicts: dict[int, Verdict]) -> None:
    bus, took = report.bus, report.took_s
    console.print(
        Text(
            f"{bus.name}: {bus.interface} {bus.channel}, {bus.bitrate_bit_s / 1e3:g} kbit/s, "
            f"load {report.load:.0%}, {report.error_frames} error frames, "
            f"{report.others} frames of other kinds (29-bit, remote, FD)"
        )
    )
    steps = {"listen": "listened", "ask": "asked all ids", "read": "read the nodes", "lss": "LSS"}
    console.print(Text(", ".join(f"{steps[step]} {seconds:.2f} s" for step, seconds in took.items())))
    nodes = {node.node_id: node for node in report.nodes}
    if nodes or verdicts:
        columns = ("id", "state", "vendor", "product", "revision", "serial", "name", "channels", "pad", "")
        table = _table(*columns, right=("id", "vendor", "product", "revision", "serial"))
        for node_id in sorted(nodes.keys() | verdicts.keys()):
            node = nodes.get(node_id, NodeFacts(node_id))
            table.add_row(*_cells(node, verdicts.get(node_id), "ask" in took))
        console.print(table)
    for address in report.unconfigured:
        given = report.assigned.get(address)
        console.print(Text(f"without an id: {address}" + (f", now node {given}" if given else "")))
    if report.streams:
        console.print(_traffic(report))
    console.print()


def _cells(node: NodeFacts, verdict: Verdict | None, asked: bool) -> Iterator[Text]:
    state = node.state or ("silent" if not node.answers else "no heartbeat")
    yield Text(f"{node.node_id} 0x{node.node_id:02X}")
    yield Text(state)
    for value in (node.vendor_id, node.product_code, node.revision):
        yield Text("" if value is None else f"0x{value:X}")
    yield Text("" if node.serial is None else str(node.serial))
    yield Text(node.name)
    yield Text(_channels(node) if node.answers else "no SDO answer" if asked else "not asked")
    yield Text(verdict.pad if verdict else "")
    yield (
        Text.assemble((verdict.wrong, "red"), " " * bool(verdict.wrong), verdict.remark)
        if verdict
        else Text()
    )


def _channels(node: NodeFacts) -> str:
    """Where the four channels are, in words."""
    names = channel_names(node)
    chosen = four_channels(node.tpdos)
    if not names:
        return "no four channels"
    if chosen is None:
        return f"{node.inputs} analogue inputs, in no TPDO"
    tpdos = [tpdo for tpdo in node.tpdos if tpdo.number in chosen[1]]
    return f"{names[0]} to {names[3].partition(':')[2]} in " + ", ".join(map(_tpdo, tpdos))


def _tpdo(tpdo: TpdoFacts) -> str:
    kind = tpdo.transmission
    when = (
        f"every {kind if kind and kind > 1 else ''} SYNC".replace("  ", " ")
        if kind is not None and 1 <= kind <= 240
        else "on change, at SYNC"
        if kind == 0
        else "on request"
        if kind in (252, 253)
        else "on events"
    )
    return f"TPDO{tpdo.number} ({when}{'' if tpdo.enabled else ', off'})"


def _traffic(report: BusReport) -> Table:
    """Identifiers heard, those of nobody first, then the most frequent."""
    table = _table("heard", "Hz", "bytes", "what", right=("Hz",))
    seconds = report.took_s["listen"]
    rows = [
        (_what(report, can_id), can_id, stream, stream.rate_hz(seconds))
        for can_id, stream in report.streams.items()
    ]
    rows.sort(key=lambda row: (bool(row[0]), -row[3], row[1]))
    for what, can_id, stream, rate_hz in rows[:_MOST_STREAMS]:
        sizes = ", ".join(map(str, sorted(stream.sizes)))
        table.add_row(f"0x{can_id:03X}", f"{rate_hz:.1f}", sizes, Text(what or "of nobody found here"))
    if len(rows) > _MOST_STREAMS:
        table.add_row(f"{len(rows) - _MOST_STREAMS} more", "", "", "")
    return table


def _what(report: BusReport, can_id: int) -> str:
    owners = {
        tpdo.cob_id: f"TPDO{tpdo.number} of node {node.node_id}"
        for node in report.nodes
        for tpdo in node.tpdos
        if tpdo.cob_id is not None and tpdo.enabled
    }
    return meaning(can_id, owners, {node.node_id for node in report.nodes})


def _table(*columns: str, right: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", no_wrap=column != "")
    return table


def _plain(report: BusReport) -> dict[str, Any]:
    """A bus as JSON has it; identifiers and objects are numbers."""
    bus, seconds = report.bus, report.took_s["listen"]
    return {
        "name": bus.name,
        "interface": bus.interface,
        "channel": bus.channel,
        "bitrate_bit_s": bus.bitrate_bit_s,
        "load": round(report.load, 4),
        "error_frames": report.error_frames,
        "other_frames": report.others,
        "took_s": {step: round(took_s, 4) for step, took_s in report.took_s.items()},
        "nodes": [{**asdict(node), "channels": channel_names(node)} for node in report.nodes],
        "unconfigured": [
            {**asdict(address), "assigned": report.assigned.get(address)} for address in report.unconfigured
        ],
        "traffic": [
            {
                "identifier": can_id,
                "count": stream.count,
                "rate_hz": round(stream.rate_hz(seconds), 2),
                "bytes": sorted(stream.sizes),
                "what": _what(report, can_id),
            }
            for can_id, stream in sorted(report.streams.items())
        ],
        "problems": report.problems,
    }
