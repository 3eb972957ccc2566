"""The command `conformance`: a table for each node, JSON, a report file."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.text import Text

from handtouch import __version__, config
from handtouch.canbus.bus.port import Port
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_bus, add_json, add_number
from handtouch.core.slab import Slab
from handtouch.host.json_output import to_json
from handtouch.procedures.commission import refuse_beside_daemon
from handtouch.procedures.conformance import (
    ConformanceOptions,
    NodeReport,
    PortLine,
    Targets,
    Verdict,
    check_bus_is_free,
    compare_serials,
    count_verdicts,
    find_nodes,
    run_checks,
    select_targets,
)
from handtouch.procedures.dialogue import Dialogue, open_dialogue

_STYLES = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.NOT_TESTED: "dim"}
_NAME_WIDTH = 24
_MAX_NAMES = 8
Progress = Callable[[str], None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `conformance`."""
    parser.set_defaults(command=run)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NODE",
        help='node id (5, 0x05, can0:5) or, with --config, pad ("right/index_distal", "thumb_*")',
    )
    parser.add_argument(
        "--all", dest="all_nodes", action="store_true", help="all nodes: of the deployment, or that respond"
    )
    parser.add_argument(
        "--config",
        dest="config_path",
        type=Path,
        metavar="CONFIG",
        help="deployment file with the buses, and what it states about the nodes (channels, EDS, identity, "
        "noise, excitation)",
    )
    add_bus(
        parser,
        "bus, e.g. can0=socketcan:can0; with --config, the interface to open for bus NAME instead of the one "
        "in the file; repeatable",
    )
    parser.add_argument("--eds", type=Path, metavar="FILE", help="EDS to compare the object dictionary with")
    add_number(
        parser,
        "--sync-ms",
        "MS",
        "shortest SYNC period; twice and four times that are tested, too (default: that of the "
        "deployment, or 5)",
    )
    parser.add_argument(
        "--no-reset",
        action="store_true",
        help="send no NMT reset, by which a node loses settings that it hasn't stored",
    )
    parser.add_argument("--no-lss", action="store_true", help="send no LSS request")
    output = parser.add_mutually_exclusive_group()  # prompts are no JSON
    output.add_argument(
        "--interactive",
        action="store_true",
        help="also prompt for a power cycle, a press and an error (keys: s skips a step, q quits)",
    )
    add_json(output)
    parser.add_argument(
        "--report",
        dest="report_path",
        type=Path,
        metavar="FILE",
        help="also write the report to a file: JSON if its name ends in .json, else text",
    )


def run(
    names: Sequence[str],
    *,
    all_nodes: bool,
    config_path: Path | None,
    buses: Sequence[str],
    eds: Path | None,
    sync_ms: float | None,
    no_reset: bool,
    no_lss: bool,
    interactive: bool,
    as_json: bool,
    report_path: Path | None,
) -> int:
    """Test nodes and print the results; exit status 0, 1 (a check failed, no node, bus in use), 2 (usage)."""
    if bool(names) == all_nodes:
        raise CommandError("handtouch conformance: give node ids or pads, or --all", 2)
    deployment = None if config_path is None else config.load(config_path)
    targets = select_targets(deployment, buses, names, None if eds is None else str(eds))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the node is set back
    daemon = (deployment.daemon if deployment else None) or config.Daemon()
    options = ConformanceOptions(
        sync_period_ms=sync_ms or daemon.sync_period_ms,
        window_fraction=daemon.sample_window_fraction,
        resets=not no_reset,
        lss=not no_lss,
    )
    if deployment is not None:
        refuse_beside_daemon(daemon.control)
    try:
        reports = _test_all(targets, options, interactive)
    except KeyboardInterrupt:
        print("interrupted; the node was set back", file=sys.stderr)
        raise
    if not reports:
        raise CommandError("no node responds; check power, bit rate and termination", 1)
    print(reports_json(reports) if as_json else to_text(reports, terminal=sys.stdout.isatty()), end="")
    if report_path is not None:
        text = reports_json(reports) if report_path.suffix == ".json" else to_text(reports, terminal=False)
        with failing(1, OSError):
            report_path.write_text(text, encoding="utf-8")
    return 0 if all(report.ok for report in reports) else 1


def reports_json(reports: Sequence[NodeReport]) -> str:
    """Format reports as one JSON object: `ok`, `version`, `nodes`."""
    report = {
        "ok": all(report.ok for report in reports),
        "version": __version__,
        "nodes": [report.to_map() for report in reports],
    }
    return to_json(report, indent=2) + "\n"


def to_text(reports: Sequence[NodeReport], *, terminal: bool) -> str:
    """Format reports: a line for each check with its measurement, a remedy below failed ones; then those not
    tested, by reason.
    """
    file = StringIO()
    console = Console(file=file, force_terminal=terminal, highlight=False, emoji=False)
    for report in reports:
        name = f" ({report.pad})" if report.pad else ""
        console.print(Text(f"{report.bus}: node {report.node_id} 0x{report.node_id:02X}{name}", "bold"))
        for result in report.results:
            if result.verdict is Verdict.NOT_TESTED:
                continue
            line = Text("  ")
            line.append(f"{result.verdict.value:<11}", _STYLES[result.verdict])
            line.append(f"{result.name:<{_NAME_WIDTH}}{result.detail}".rstrip())
            console.print(line, soft_wrap=True)
            if result.remedy:
                console.print(Text(f"{'':13}-> {result.remedy}"), soft_wrap=True)
        for names, why in _group_untested(report):
            console.print(Text(f"  {Verdict.NOT_TESTED.value:<11}{names}: {why}", "dim"), soft_wrap=True)
        counts = ", ".join(f"{count} {verdict.value}" for verdict, count in count_verdicts(report))
        console.print(Text(f"  {counts}", "green" if report.ok else "red"))
        if report.restore_problem:
            text = f"  not set back: {report.restore_problem}; switch the node off and on"
            console.print(Text(text, "red"), soft_wrap=True)
        console.print()
    return file.getvalue()


def _group_untested(report: NodeReport) -> Iterator[tuple[str, str]]:
    """Yield the checks that were not made, by reason."""
    reasons: dict[str, list[str]] = {}
    for result in report.results:
        if result.verdict is Verdict.NOT_TESTED:
            reasons.setdefault(result.detail, []).append(result.name)
    for why, names in reasons.items():
        yield ", ".join(names) if len(names) <= _MAX_NAMES else f"{len(names)} other checks", why


def _test_all(targets: Targets, options: ConformanceOptions, interactive: bool) -> list[NodeReport]:
    """Test the nodes of all buses, one after the other. Raises BusError and BusInUseError."""
    with ExitStack() as stack:
        if interactive:
            dialogue = stack.enter_context(open_dialogue())
            return _test_buses(targets, options, _live_progress(dialogue), dialogue)
        console = Console(stderr=True)
        if not console.is_terminal:
            return _test_buses(targets, options, lambda _: None, None)
        status = stack.enter_context(console.status(""))
        return _test_buses(targets, options, status.update, None)


def _test_buses(
    targets: Targets, options: ConformanceOptions, progress: Progress, operator: Dialogue | None
) -> list[NodeReport]:
    reports = []
    for bus in targets.buses:
        port = Port.open(bus, Slab(1))
        try:
            line = PortLine(port)
            progress(f"{bus.name}: listening")
            heard = check_bus_is_free(line, bus.name)
            nodes = targets.nodes_on(bus.name)
            if targets.find_all:
                found = heard.union(find_nodes(line))
                nodes = [targets.describe_found(bus.name, node_id) for node_id in sorted(found)]
            for number, node in enumerate(nodes, 1):
                report_step = _labelled(
                    progress, f"{bus.name}: node {node.node_id}, {number} of {len(nodes)}"
                )
                reports.append(run_checks(line, node, options, report_step, operator))
        finally:
            port.close()
    compare_serials(reports)
    return reports


def _labelled(progress: Progress, label: str) -> Progress:
    return lambda text: progress(f"{label}: {text}")


def _live_progress(dialogue: Dialogue) -> Progress:
    return lambda text: dialogue.show_live(time.monotonic_ns(), lambda: Text(text))
