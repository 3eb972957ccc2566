"""The command `scan`: the nodes found, as text or JSON."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts, TpdoFacts, find_channels_of_node
from handtouch.canbus.find.traffic import describe_identifier
from handtouch.cli.options import add_bus, add_config, add_json, add_number, integer
from handtouch.cli.progress import ProgressLine
from handtouch.cli.tables import make_table, output_console, print_table
from handtouch.host.json_output import to_json
from handtouch.procedures.scan import (
    BusReport,
    NodeComparison,
    ScanRequest,
    buses_to_scan,
    channel_names,
    compare_nodes,
    fragment,
    nodes_without_pad,
    scan_buses,
)

_MAX_STREAMS = 24

OptionalDeployment = config.Deployment | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `scan`."""
    parser.set_defaults(command=run)
    add_config(parser, "deployment file to compare with", nargs="?")
    add_bus(
        parser,
        "bus to scan, e.g. can0=socketcan:can0; with CONFIG, the interface to open for bus NAME instead of "
        "the one in the file; repeatable",
    )
    add_number(
        parser, "--seconds", "S", "time to listen before nodes are queried (default: 1, with --listen 5)"
    )
    add_json(parser)
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--listen", action="store_true", help="only listen: send no frame at all")
    mode.add_argument(
        "--lss", action="store_true", help="also find nodes without a node id (LSS); changes none"
    )
    mode.add_argument(
        "--assign",
        type=integer(1, 127, "a node id, 1 to 127 (0x01 to 0x7F)"),
        metavar="FIRST_ID",
        help="find nodes without a node id and store one in each: the deployment's for that serial number, "
        "else the first free one from FIRST_ID upwards, in the order of serial numbers",
    )
    add_number(parser, "--lss-wait-ms", "MS", "minimum time to wait for an LSS response", default=5.0)


def run(
    config_path: Path | None,
    *,
    buses: Sequence[str],
    as_json: bool,
    listen: bool,
    lss: bool,
    assign: int | None,
    seconds: float | None,
    lss_wait_ms: float,
) -> int:
    """Scan and print; exit status 0, 1 (a node missing or different, none found, no bus), 2 (usage)."""
    request = ScanRequest(
        listen_only=listen,
        lss=lss or assign is not None,
        first_assigned_id=assign,
        listen_s=seconds or (5.0 if listen else 1.0),
        lss_wait_s=lss_wait_ms * 1e-3,
    )
    deployment = None if config_path is None else config.load(config_path)
    with ProgressLine() as progress:
        reports = scan_buses(buses_to_scan(deployment, buses), request, deployment, progress.update)
    comparisons = compare_nodes(deployment, reports)
    ok = not any(comparison.problem for comparison in comparisons)
    ok = ok and not any(report.problems for report in reports)
    write = scan_to_json if as_json else to_text
    print(write(reports, comparisons, deployment, ok), end="")
    return 0 if ok else 1


def scan_to_json(
    reports: Sequence[BusReport],
    comparisons: Sequence[NodeComparison],
    deployment: OptionalDeployment,
    ok: bool,
) -> str:
    """Format a scan as one JSON object: `ok`, `buses`, `comparisons`, `fragment`."""
    report = {
        "ok": ok,
        "buses": [_bus_as_json(report) for report in reports],
        "comparisons": [asdict(comparison) for comparison in comparisons],
        "fragment": fragment(nodes_without_pad(reports, comparisons, deployment), deployment),
    }
    return to_json(report, indent=2) + "\n"


def to_text(
    reports: Sequence[BusReport],
    comparisons: Sequence[NodeComparison],
    deployment: OptionalDeployment,
    ok: bool,
) -> str:
    """Format a scan: tables of nodes and of traffic for each bus, problems, and the fragment."""
    terminal = sys.stdout.isatty()
    file = StringIO()
    console = output_console(file, terminal=terminal)
    for report in reports:
        of_bus = {entry.node_id: entry for entry in comparisons if entry.bus == report.bus.name}
        _print_bus(console, report, of_bus)
    for problem in (problem for report in reports for problem in report.problems):
        console.print(Text(problem, "red"))
    text = fragment(nodes_without_pad(reports, comparisons, deployment), deployment)
    if text:
        console.print("\nFor the deployment file:\n")
        console.print(Text(text), soft_wrap=True)
    console.print(Text("no problems" if ok else "problems found", "green" if ok else "red"))
    return file.getvalue()


def _print_bus(console: Console, report: BusReport, comparisons: dict[int, NodeComparison]) -> None:
    bus, durations = report.bus, report.durations_s
    console.print(
        Text(
            f"{bus.name}: {bus.interface} {bus.channel}, {bus.bitrate_bit_s / 1e3:g} kbit/s, "
            f"load {report.bus_load:.0%}, {report.error_frames} error frames, "
            f"{report.other_frames} other frames (29-bit, remote, FD)"
        )
    )
    steps = {"listen": "listened", "query": "queried all node ids", "read": "read the nodes", "lss": "LSS"}
    console.print(Text(", ".join(f"{steps[step]} {seconds:.2f} s" for step, seconds in durations.items())))
    nodes = {node.node_id: node for node in report.nodes}
    if nodes or comparisons:
        columns = ("id", "NMT state", "vendor", "product", "revision", "serial", "name", "channels", "EMCY")
        table = make_table(
            *columns, "pad", "", right=("id", "vendor", "product", "revision", "serial"), wrapped=("",)
        )
        for node_id in sorted(nodes.keys() | comparisons.keys()):
            node = nodes.get(node_id, NodeFacts(node_id))
            table.add_row(*_node_cells(node, comparisons.get(node_id), "query" in durations))
        print_table(console, table)
    for address in report.unconfigured:
        assigned_id = report.assigned.get(address)
        assigned = f", assigned node id {assigned_id}" if assigned_id else ""
        console.print(Text(f"without node id: {address}{assigned}"))
    if report.streams:
        print_table(console, _traffic_table(report))
    console.print()


def _node_cells(node: NodeFacts, comparison: NodeComparison | None, queried: bool) -> Iterator[Text]:
    yield Text(f"{node.node_id} 0x{node.node_id:02X}")
    yield Text(node.state or "unknown")
    for value in (node.vendor_id, node.product_code, node.revision):
        yield Text("" if value is None else f"0x{value:X}")
    yield Text("" if node.serial is None else str(node.serial))
    yield Text(node.name)
    no_response = "invalid SDO response" if node.error else "no SDO response"
    yield Text(_describe_channels(node) if node.answers else no_response if queried else "not queried")
    yield Text(node.emergency)
    if comparison is None:
        yield from (Text(), Text())
        return
    yield Text(comparison.pad)
    yield Text.assemble((comparison.problem, "red"), " " * bool(comparison.problem), comparison.remark)


def _describe_channels(node: NodeFacts) -> str:
    """Describe the objects of the four channels and the TPDOs that carry them."""
    names = channel_names(node)
    chosen = find_channels_of_node(node)
    if not names:
        return "no four channels"
    if chosen is None:
        return f"{node.inputs} analogue inputs, in no TPDO"
    tpdos = [tpdo for tpdo in node.tpdos if tpdo.number in chosen[1]]
    return f"{names[0]} to {names[3].partition(':')[2]} in " + ", ".join(map(_describe_tpdo, tpdos))


def _describe_tpdo(tpdo: TpdoFacts) -> str:
    kind = "unknown" if tpdo.transmission is None else tpdo.transmission
    return f"TPDO{tpdo.number} (transmission type {kind}{'' if tpdo.enabled else ', disabled'})"


def _traffic_table(report: BusReport) -> Table:
    """Return a table of the COB-IDs received: unknown ones first, then the most frequent."""
    table = make_table("COB-ID", "Hz", "bytes", "source", right=("Hz",))
    seconds = report.durations_s["listen"]
    rows = [
        (_describe_identifier(report, can_id), can_id, stream, stream.rate_hz(seconds))
        for can_id, stream in report.streams.items()
    ]
    rows.sort(key=lambda row: (bool(row[0]), -row[3], row[1]))
    for source, can_id, stream, rate_hz in rows[:_MAX_STREAMS]:
        sizes = ", ".join(map(str, sorted(stream.data_lengths)))
        table.add_row(f"0x{can_id:03X}", f"{rate_hz:.1f}", sizes, Text(source or "unknown"))
    if len(rows) > _MAX_STREAMS:
        table.add_row(f"{len(rows) - _MAX_STREAMS} more", "", "", "")
    return table


def _describe_identifier(report: BusReport, can_id: int) -> str:
    owners = {
        tpdo.cob_id: f"TPDO{tpdo.number} of node {node.node_id}"
        for node in report.nodes
        for tpdo in node.tpdos
        if tpdo.cob_id is not None and tpdo.enabled
    }
    return describe_identifier(can_id, owners, {node.node_id for node in report.nodes})


def _bus_as_json(report: BusReport) -> dict[str, Any]:
    """Return a bus as JSON values; COB-IDs and objects are numbers."""
    bus, seconds = report.bus, report.durations_s["listen"]
    return {
        "name": bus.name,
        "interface": bus.interface,
        "channel": bus.channel,
        "bitrate_bit_s": bus.bitrate_bit_s,
        "load": round(report.bus_load, 4),
        "error_frames": report.error_frames,
        "other_frames": report.other_frames,
        "durations_s": {step: round(duration_s, 4) for step, duration_s in report.durations_s.items()},
        "nodes": [{**asdict(node), "channels": channel_names(node)} for node in report.nodes],
        "unconfigured": [
            {**asdict(address), "assigned": report.assigned.get(address)} for address in report.unconfigured
        ],
        "traffic": [
            {
                "identifier": can_id,
                "count": stream.count,
                "rate_hz": round(stream.rate_hz(seconds), 2),
                "bytes": sorted(stream.data_lengths),
                "source": _describe_identifier(report, can_id),
            }
            for can_id, stream in sorted(report.streams.items())
        ],
        "problems": report.problems,
    }
