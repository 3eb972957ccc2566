"""The command `export`: tables of a recording."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from handtouch.cli.errors import failing, needing
from handtouch.cli.options import add_json, add_output
from handtouch.cli.progress import ProgressLine
from handtouch.host.json_output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `export`."""
    parser.set_defaults(command=run)
    parser.add_argument("path", metavar="RECORDING", type=Path, help="MCAP recording")
    parser.add_argument(
        "--format",
        dest="format_",
        choices=("csv", "parquet"),
        default="csv",
        help="file format; parquet needs handtouch[export] (default: csv)",
    )
    add_output(
        parser, "folder", "folder to write to (default: tables)", default=Path("tables"), metavar="FOLDER"
    )
    add_json(parser)


def run(path: Path, folder: Path, format_: str, as_json: bool = False) -> int:
    """Export a recording; exit status 0, 1 (empty, or tables not written), 2 (no recording, no pyarrow)."""
    from handtouch.record.export import export
    from handtouch.record.recording import Recording

    if format_ == "parquet":
        with needing("export", "--format parquet: "):
            import pyarrow  # noqa: F401
    with failing(2, OSError, ValueError):
        recording = Recording(path)
    with failing(1, OSError, ValueError), ProgressLine() as progress, recording.checked():
        counts = export(recording, folder, format_, progress.update)
    tables = {folder / f"{name}.{format_}": rows for name, rows in counts.items()}
    if as_json:
        print_json({"tables": [{"file": file, "rows": rows} for file, rows in tables.items()]})
    else:
        for file, rows in tables.items():
            print(f"{file}: {rows} rows")
    if recording.truncation:
        print(f"{path}: {recording.truncation}; all else is exported", file=sys.stderr)
    if recording.malformed_messages:
        print(f"{path}: {recording.malformed_messages} malformed messages skipped", file=sys.stderr)
    if not counts:
        print(f"{path}: holds no message of a daemon", file=sys.stderr)
    return 0 if counts else 1
