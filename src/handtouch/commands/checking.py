"""The commands for setting up a hand: `check`, `doctor`, `scan`, `commission`, `figures`, `design`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, add_bus, add_config, add_json, command, positive


def add(commands: Commands) -> None:
    """Add `check`, `doctor`, `scan`, `commission`, `figures` and `design`."""
    check = command(commands, "check", _check, "check a deployment, compute its bus load, warn")
    check.add_argument("config", type=Path, nargs="?", help="deployment file")
    add_json(check)
    check.add_argument(
        "--schema", action="store_true", help="print the JSON schema of deployment files instead"
    )

    doctor = command(commands, "doctor", _doctor, "what this machine lacks to serve a deployment")
    doctor.add_argument("config", type=Path, nargs="?", help="deployment file")
    add_json(doctor)

    _add_scan(commands)
    _add_commission(commands)

    figures = command(commands, "figures", _figures, "redraw the paper's theoretical figures")
    figures.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")

    design = command(commands, "design", _design, "expected location error of a pad as configured")
    add_config(design)
    design.add_argument("--link", help="pad to draw (default: the first)")
    design.add_argument("--out", type=Path, default=Path("design"), help="folder (default: design)")


def _add_scan(commands: Commands) -> None:
    scan = command(
        commands, "scan", _scan, "who is on the buses, with what a deployment file needs to know of them"
    )
    scan.add_argument("config", type=Path, nargs="?", help="deployment file to compare with")
    add_bus(scan, "a bus to look at, or another python-can interface for one of the deployment")
    scan.add_argument(
        "--seconds", type=positive, help="listen for so long first (default: 1, with --listen 5)"
    )
    add_json(scan)
    asking = scan.add_mutually_exclusive_group()
    asking.add_argument("--listen", action="store_true", help="send nothing at all")
    asking.add_argument("--lss", action="store_true", help="find nodes without an id too; changes none")
    asking.add_argument(
        "--assign",
        type=_node_id,
        metavar="FIRST_ID",
        help="find nodes without an id and give them one, which they store: that of the deployment for their "
        "serial number, else the first free one from FIRST_ID upwards, in the order of their serial numbers",
    )
    scan.add_argument(
        "--lss-wait-ms",
        type=positive,
        default=5.0,
        help="wait at least so long for LSS answers (default: 5)",
    )


def _add_commission(commands: Commands) -> None:
    commission = command(
        commands,
        "commission",
        _commission,
        "press one pad after another: finds swapped nodes, the order of electrodes and dead channels, and "
        "writes them to the deployment file",
    )
    add_config(commission)
    add_bus(commission)
    commission.add_argument(
        "--link",
        action="append",
        default=[],
        metavar="PATTERN",
        help='pads to do, such as "thumb_*" or "left/index_distal" (default: all that are not done yet)',
    )
    commission.add_argument("--dry-run", action="store_true", help="show what would change, write nothing")
    commission.add_argument("--yes", action="store_true", help="take swapped nodes over without asking")
    commission.add_argument(
        "--seconds", type=positive, default=60.0, help="wait so long for a press or a key (default: 60)"
    )


def _check(asked: argparse.Namespace) -> int:
    from handtouch import check

    return check.run(asked.config, json=asked.json, schema=asked.schema)


def _doctor(asked: argparse.Namespace) -> int:
    from handtouch import doctor

    return doctor.run(asked.config, json=asked.json)


def _scan(asked: argparse.Namespace) -> int:
    from handtouch import scan

    request = scan.Request(
        listen_only=asked.listen,
        lss=asked.lss or asked.assign is not None,
        assign=asked.assign,
        seconds=asked.seconds or (5.0 if asked.listen else 1.0),
        lss_wait_s=asked.lss_wait_ms * 1e-3,
    )
    return scan.run(asked.config, asked.bus, request, as_json=asked.json)


def _commission(asked: argparse.Namespace) -> int:
    from handtouch import commission

    return commission.run(
        asked.config,
        asked.bus,
        links=asked.link,
        dry_run=asked.dry_run,
        yes=asked.yes,
        patience_s=asked.seconds,
    )


def _figures(asked: argparse.Namespace) -> int:
    from handtouch import figures

    return figures.run(asked.out)


def _design(asked: argparse.Namespace) -> int:
    from handtouch import design

    return design.run(asked.config, asked.out, link=asked.link)


def _node_id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = 0
    if not 1 <= value <= 127:
        raise argparse.ArgumentTypeError(f"{text}: must be a node id, 1 to 127 (0x01 to 0x7F)")
    return value
