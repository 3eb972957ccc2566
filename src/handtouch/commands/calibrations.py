"""The commands of `handtouch calibrations`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, add_json, command, family


def add(commands: Commands) -> None:
    """Add `calibrations` to the commands."""
    actions = family(
        commands,
        "calibrations",
        "the calibration store: what is known of every unit",
        "The calibration store: what is known of every unit, by serial number, with its history.",
    )

    listed = command(actions, "list", _list, "every unit and its newest calibration")
    add_json(listed)

    show = command(actions, "show", _show, "a unit's versions, and what one of them says")
    show.add_argument("--version", type=int, metavar="N", help="default: the newest")
    add_json(show)

    diff = command(actions, "diff", _diff, "what changed; exit status 1 if anything did")
    diff.add_argument("--from", dest="before", type=int, metavar="N", help="default: the one before --to")
    diff.add_argument("--to", dest="after", type=int, metavar="N", help="default: the newest")

    back = command(actions, "rollback", _rollback, "make an older version the newest again; none is lost")

    export = command(actions, "export", _export, "calibrations as JSON")
    export.add_argument("unit", nargs="*", help="serial number, or link that it is on (default: all)")
    export.add_argument("--history", action="store_true", help="every version (default: the newest)")
    export.add_argument("--out", type=Path, help="file (default: standard output)")

    taken = command(actions, "import", _import, "take over what was exported, as new versions")
    taken.add_argument("file", type=Path, help="written by `handtouch calibrations export`")
    taken.add_argument("--serial", type=_serial, help="for this unit (default: the one it was made for)")
    taken.add_argument(
        "--other-unit",
        action="store_true",
        help="though another unit's; marked as such for good",
    )

    for action in (show, diff, back):
        action.add_argument("unit", help="serial number, or link that it was on last")
    back.add_argument("number", type=int, help="version to go back to")
    for action in (listed, show, diff, back, export, taken):
        place = action.add_mutually_exclusive_group()
        place.add_argument("--config", type=Path, help="deployment file whose [daemon] store is meant")
        place.add_argument("--store", type=Path, metavar="FILE", help="the store itself")


def _list(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_list(asked.store, asked.config, asked.json)


def _show(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_show(asked.store, asked.config, asked.unit, asked.version, asked.json)


def _diff(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_diff(asked.store, asked.config, asked.unit, asked.before, asked.after)


def _rollback(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_roll_back(asked.store, asked.config, asked.unit, asked.number)


def _export(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_export(asked.store, asked.config, asked.unit, asked.history, asked.out)


def _import(asked: argparse.Namespace) -> int:
    from handtouch.supervise import calibrations

    return calibrations.run_import(asked.store, asked.config, asked.file, asked.serial, asked.other_unit)


def _serial(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = 0
    if not 1 <= value <= 0xFFFFFFFF:
        raise argparse.ArgumentTypeError(f"{text}: must be a serial number, 1 to 4294967295")
    return value
