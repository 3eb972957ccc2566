"""The command `init`: write a commented deployment to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_bus
from handtouch.cli.progress import ProgressLine
from handtouch.procedures.scan import ScanRequest, buses_to_scan, channel_names, scan_buses
from handtouch.procedures.scan.fragment import FoundNodes, starting_deployment

_DEFAULT_BUS = "can0=socketcan:can0"
_INVENTED_NODE = NodeFacts(1, answers=True, inputs=4)
"""Node of a deployment that is written without a scan: four analogue inputs"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `init`."""
    parser.set_defaults(command=run)
    parser.add_argument("path", type=Path, metavar="FILE", help="new deployment file")
    parser.add_argument(
        "--from-scan", action="store_true", help="with a pad for each node found on the buses, instead of one"
    )
    add_bus(parser, f"bus, e.g. can0=socketcan:can0; repeatable (default: {_DEFAULT_BUS})")


def run(path: Path, *, from_scan: bool, buses: Sequence[str]) -> int:
    """Write the file; exit status 0, 1 (no bus or node, or it can't be written), 2 (wrong usage)."""
    found, problems = _found(buses_to_scan(None, buses or [_DEFAULT_BUS]), from_scan)
    if from_scan and not any(nodes for _, nodes in found):
        raise CommandError("\n".join(["no node with four channels answered", *problems]), 1)
    if path.exists():
        raise CommandError(f"{path} exists; give the name of a new file", 2)
    with failing(1, OSError), path.open("x", encoding="utf-8") as file:
        file.write(starting_deployment(found))
    pads = sum(len(nodes) for _, nodes in found)
    print(
        f"{path}: {pads} pad{'s' * (pads != 1)}; replace the values of lines marked CHECK, then\n"
        f"  handtouch check {path}\n"
        f"  handtouch demo --config {path} --view      # a preview, without hardware"
    )
    return 0


def _found(buses: Sequence[config.Bus], from_scan: bool) -> tuple[FoundNodes, list[str]]:
    """Return the nodes of each bus, and what the scan found wrong."""
    if not from_scan:
        return [(bus, [_INVENTED_NODE]) for bus in buses], []
    with ProgressLine() as progress:
        reports = scan_buses(buses, ScanRequest(), None, progress.update)
    nodes = [(report.bus, [node for node in report.nodes if channel_names(node)]) for report in reports]
    return nodes, [problem for report in reports for problem in report.problems]
