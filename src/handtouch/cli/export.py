"""The command `export`: tables of a recording, or a LeRobot dataset."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handtouch.cli.errors import failing, needing
from handtouch.cli.options import add_json, add_number, add_output
from handtouch.cli.progress import ProgressLine
from handtouch.host.json_output import print_json

if TYPE_CHECKING:
    from handtouch.record.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `export`."""
    parser.set_defaults(command=run)
    parser.add_argument("path", metavar="RECORDING", type=Path, help="MCAP recording")
    parser.add_argument(
        "--format",
        dest="format_",
        choices=("csv", "parquet", "lerobot"),
        default="csv",
        help="tables as csv or parquet, or a dataset for LeRobot (v3.0); the latter two need "
        "handtouch[export] (default: csv)",
    )
    add_output(
        parser,
        "folder",
        "folder to write to (default: tables, for lerobot dataset)",
        default=None,
        metavar="FOLDER",
    )
    add_json(parser)
    dataset = parser.add_argument_group("with --format lerobot")
    add_number(dataset, "--fps", "HZ", "rate of the dataset's frames", default=30.0)
    dataset.add_argument("--hand", default="", help="hand to export (default: the only one)")
    dataset.add_argument(
        "--frame", choices=("pad", "link", "palm"), default="link", help="frame of positions (default: link)"
    )
    add_number(dataset, "--max-gap", "S", "time without a frame that ends an episode", default=1.0)
    dataset.add_argument("--task", default="touch", help="task of the episodes, in words (default: touch)")


def run(path: Path, folder: Path | None, format_: str, as_json: bool = False, **options: Any) -> int:
    """Export a recording; exit status 0, 1 (empty, or nothing written), 2 (no recording, no pyarrow)."""
    from handtouch.record.recording import Recording

    if format_ != "csv":
        with needing("export", f"--format {format_}: "):
            import pyarrow  # noqa: F401
    with failing(2, OSError, ValueError):
        recording = Recording(path)
    if format_ == "lerobot":
        return _export_dataset(recording, folder or Path("dataset"), as_json, **options)
    return _export_tables(recording, folder or Path("tables"), format_, as_json)


def _export_dataset(recording: Recording, folder: Path, as_json: bool, **options: Any) -> int:
    from handtouch.record.lerobot import export_lerobot

    options["max_gap_s"] = options.pop("max_gap")
    with failing(1, OSError, ValueError, LookupError), ProgressLine() as progress, recording.checked():
        counts = export_lerobot(recording, folder, **options, on_progress=progress.update)
    if as_json:
        print_json({"folder": folder, **counts._asdict()})
    else:
        joints = f"{len(counts.joints)} joints" if counts.joints else "no joint states"
        print(f"{folder}: {counts.episodes} episodes, {counts.frames} frames; {joints}")
    _print_damage(recording)
    return 0


def _export_tables(recording: Recording, folder: Path, format_: str, as_json: bool) -> int:
    from handtouch.record.export import export

    with failing(1, OSError, ValueError), ProgressLine() as progress, recording.checked():
        counts = export(recording, folder, format_, progress.update)
    tables = {folder / f"{name}.{format_}": rows for name, rows in counts.items()}
    if as_json:
        print_json({"tables": [{"file": file, "rows": rows} for file, rows in tables.items()]})
    else:
        for file, rows in tables.items():
            print(f"{file}: {rows} rows")
    _print_damage(recording)
    if not counts:
        print(f"{recording.path}: holds no message of a daemon", file=sys.stderr)
    return 0 if counts else 1


def _print_damage(recording: Recording) -> None:
    if recording.truncation:
        print(f"{recording.path}: {recording.truncation}; all else is exported", file=sys.stderr)
    if recording.malformed_messages:
        skipped = f"{recording.malformed_messages} malformed messages skipped"
        print(f"{recording.path}: {skipped}", file=sys.stderr)
