"""Arguments of the commands of `handtouch calibrations`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.cli.options import Subparsers, add_command, add_command_group, add_json, add_output, integer

_TEXT = "handtouch.cli.calibrations_text"


def add(commands: Subparsers) -> None:
    """Add `calibrations`."""
    actions = add_command_group(
        commands,
        "calibrations",
        "inspect and manage the calibration store",
        "Inspect and manage the calibration store: the calibrations of every sensor by serial number, with "
        "their history.",
    )
    for action in (
        _add_list(actions),
        _add_show(actions),
        _add_diff(actions),
        _add_rollback(actions),
        _add_export(actions),
        _add_import(actions),
    ):
        _add_store(action)


def _add_list(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "list", f"{_TEXT}:run_list", "list every sensor and its newest calibration")
    add_json(parser)
    return parser


def _add_show(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(
        actions, "show", f"{_TEXT}:run_show", "show a sensor's versions and the contents of one of them"
    )
    _add_sensor(parser)
    parser.add_argument(
        "--version", dest="number", type=int, metavar="N", help="version to show (default: the newest)"
    )
    add_json(parser)
    return parser


def _add_diff(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(
        actions, "diff", f"{_TEXT}:run_diff", "compare two versions; exit status 1 if they differ"
    )
    _add_sensor(parser)
    parser.add_argument(
        "--from", dest="before", type=int, metavar="N", help="older version (default: the one before --to)"
    )
    parser.add_argument(
        "--to", dest="after", type=int, metavar="N", help="newer version (default: the newest)"
    )
    add_json(parser)
    return parser


def _add_rollback(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(
        actions, "rollback", f"{_TEXT}:run_roll_back", "make a copy of an older version the newest one"
    )
    _add_sensor(parser)
    parser.add_argument("number", metavar="VERSION", type=int, help="version to restore")
    add_json(parser)
    return parser


def _add_export(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "export", f"{_TEXT}:run_export", "export calibrations as JSON")
    parser.add_argument(
        "sensors",
        metavar="SENSOR",
        nargs="*",
        help="serial number, or link that it was last on (default: all)",
    )
    parser.add_argument("--history", action="store_true", help="export every version, not only the newest")
    add_output(parser, "out", "file to write (default: standard output)", metavar="FILE")
    return parser


def _add_import(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(
        actions, "import", f"{_TEXT}:run_import", "import exported calibrations as new versions"
    )
    parser.add_argument(
        "file", metavar="FILE", type=Path, help="file written by `handtouch calibrations export`"
    )
    parser.add_argument(
        "--serial",
        type=integer(1, 0xFFFFFFFF, "a serial number, 1 to 4294967295"),
        help="sensor to import for (default: the one that was exported)",
    )
    parser.add_argument(
        "--other-sensor",
        action="store_true",
        help="allow the calibration of another sensor, which stays marked as such",
    )
    add_json(parser)
    return parser


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sensor", metavar="SENSOR", help="serial number, or link that it was last on")


def _add_store(parser: argparse.ArgumentParser) -> None:
    store = parser.add_mutually_exclusive_group()
    store.add_argument(
        "--config",
        dest="deployment",
        type=Path,
        metavar="CONFIG",
        help="deployment file, for its [daemon] store (default: the store of the current user)",
    )
    store.add_argument("--store", type=Path, metavar="FILE", help="path of the store")
