"""Arguments of the commands of `handtouch calibrations`."""

from __future__ import annotations

from pathlib import Path

from handtouch.cli.options import Subparsers, add_command, add_command_group, add_json, integer

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

    listed = add_command(actions, "list", f"{_TEXT}:run_list", "list every sensor and its newest calibration")
    add_json(listed)

    show = add_command(
        actions, "show", f"{_TEXT}:run_show", "show a sensor's versions and the contents of one of them"
    )
    show.add_argument(
        "--version", dest="number", type=int, metavar="N", help="version to show (default: the newest)"
    )
    add_json(show)

    diff = add_command(
        actions, "diff", f"{_TEXT}:run_diff", "compare two versions; exit status 1 if they differ"
    )
    diff.add_argument(
        "--from", dest="before", type=int, metavar="N", help="older version (default: the one before --to)"
    )
    diff.add_argument("--to", dest="after", type=int, metavar="N", help="newer version (default: the newest)")

    back = add_command(
        actions, "rollback", f"{_TEXT}:run_roll_back", "make a copy of an older version the newest one"
    )

    export = add_command(actions, "export", f"{_TEXT}:run_export", "export calibrations as JSON")
    export.add_argument(
        "units", metavar="SENSOR", nargs="*", help="serial number, or link that it is on (default: all)"
    )
    export.add_argument("--history", action="store_true", help="export every version, not only the newest")
    export.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: standard output)")

    imported = add_command(
        actions, "import", f"{_TEXT}:run_import", "import exported calibrations as new versions"
    )
    imported.add_argument(
        "file", metavar="FILE", type=Path, help="file written by `handtouch calibrations export`"
    )
    imported.add_argument(
        "--serial",
        type=integer(1, 0xFFFFFFFF, "a serial number, 1 to 4294967295"),
        help="sensor to import for (default: the one that was exported)",
    )
    imported.add_argument(
        "--other-sensor",
        action="store_true",
        help="allow the calibration of another sensor, which stays marked as such",
    )

    for action in (show, diff, back):
        action.add_argument("unit", metavar="SENSOR", help="serial number, or link that it was last on")
    back.add_argument("number", metavar="VERSION", type=int, help="version to restore")
    for action in (listed, show, diff, back, export, imported):
        store = action.add_mutually_exclusive_group()
        store.add_argument(
            "--config",
            dest="deployment",
            type=Path,
            metavar="CONFIG",
            help="deployment file, for its [daemon] store (default: the store of the current user)",
        )
        store.add_argument("--store", type=Path, metavar="FILE", help="path of the store")
