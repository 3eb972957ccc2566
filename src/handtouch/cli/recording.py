"""The commands `record`, `replay`, `export` and `plot`: their arguments, and the output of the last two."""

from __future__ import annotations

import sys
from pathlib import Path

from handtouch.cli.errors import file_error_text
from handtouch.cli.options import (
    Subparsers,
    add_command,
    add_config,
    add_json,
    add_key,
    add_output,
    add_percepts,
    positive_number,
)
from handtouch.cli.progress import ProgressLine
from handtouch.host.endpoints import COMPLETE_ENDPOINT
from handtouch.host.json_output import print_json


def add(commands: Subparsers) -> None:
    """Add `record`, `replay`, `export` and `plot`."""
    _add_record(commands)
    _add_replay(commands)
    _add_export(commands)
    _add_plot(commands)


def _add_record(commands: Subparsers) -> None:
    record = add_command(
        commands,
        "record",
        "handtouch.cli.record:run",
        "record the messages of a running daemon to MCAP files",
    )
    record.add_argument(
        "config",
        metavar="CONFIG",
        type=Path,
        nargs="?",
        help="deployment file of the daemon, for its endpoint; stored in the recording",
    )
    add_output(
        record,
        "out",
        "new .mcap file, or folder (default: the current folder)",
        default=Path(),
        metavar="PATH",
    )
    add_json(record, "print a summary as JSON at the end")
    record.add_argument(
        "--endpoint",
        help="endpoint of the daemon's complete stream, which queues messages for slow subscribers "
        f"(default: the deployment's, or {COMPLETE_ENDPOINT})",
    )
    add_key(record)
    record.add_argument(
        "--seconds", type=positive_number, default=0.0, metavar="S", help="duration (default: until Ctrl-C)"
    )
    record.add_argument(
        "--hand",
        action="store_true",
        help="also record hand frames, all pads in one message per tick (not needed: replay recomputes them)",
    )
    add_percepts(record)
    record.add_argument(
        "--rotate-mb",
        type=positive_number,
        default=0.0,
        metavar="MB",
        help="start a new file after this size",
    )
    record.add_argument(
        "--rotate-minutes",
        type=positive_number,
        default=0.0,
        metavar="MIN",
        help="start a new file after this time",
    )
    record.add_argument(
        "--keep-free-mb",
        type=positive_number,
        default=200.0,
        metavar="MB",
        help="stop when the disk has less free space than this (default: 200)",
    )


def _add_replay(commands: Subparsers) -> None:
    replay = add_command(
        commands,
        "replay",
        "handtouch.cli.replay:run",
        "recompute the contacts of a recording or a CAN log, with the same code as the daemon",
    )
    replay.add_argument(
        "path",
        metavar="RECORDING",
        type=Path,
        help="MCAP recording, or CAN log readable by python-can: candump .log, .asc, .blf, .gz ...",
    )
    add_config(
        replay,
        "deployment file; required for a CAN log. Default for a recording: its own, and then every contact "
        "must be identical to the recorded one",
        nargs="?",
    )
    replay.add_argument(
        "--speed",
        type=_speed,
        metavar="FACTOR",
        help="1 as recorded, 2 twice as fast, max (default: max, with --publish 1)",
    )
    add_json(replay, "print every contact message as a line of JSON")
    replay.add_argument("--report", type=Path, metavar="FILE", help="write the comparison as JSON")
    replay.add_argument(
        "--publish", action="store_true", help="also publish the messages on the deployment's endpoints"
    )


def _add_export(commands: Subparsers) -> None:
    export = add_command(
        commands,
        "export",
        "handtouch.cli.recording:run_export",
        "export a recording as CSV or Parquet tables",
    )
    export.add_argument("path", metavar="RECORDING", type=Path, help="MCAP recording")
    export.add_argument(
        "--format",
        dest="format_",
        choices=("csv", "parquet"),
        default="csv",
        help="file format; parquet needs handtouch[export] (default: csv)",
    )
    add_output(
        export, "folder", "folder to write to (default: tables)", default=Path("tables"), metavar="FOLDER"
    )
    add_json(export)


def _add_plot(commands: Subparsers) -> None:
    plot = add_command(
        commands,
        "plot",
        "handtouch.cli.recording:run_plot",
        "plot a recording: contacts over time and on pads, forces, health",
    )
    plot.add_argument("path", metavar="RECORDING", type=Path, help="MCAP recording")
    add_output(plot, "folder", "folder to write to (default: plots)", default=Path("plots"), metavar="FOLDER")
    add_json(plot)
    plot.add_argument(
        "--from",
        dest="from_s",
        type=float,
        default=0.0,
        metavar="S",
        help="begin, in seconds since the recording's first message (default: 0)",
    )
    plot.add_argument(
        "--to",
        dest="to_s",
        type=positive_number,
        metavar="S",
        help="end, in the same seconds (default: the recording's end)",
    )


def run_export(path: Path, folder: Path, format_: str, as_json: bool = False) -> int:
    """Export a recording; exit status 0, 1 (empty, or tables not written), 2 (no recording, no pyarrow)."""
    from handtouch.record.export import export
    from handtouch.record.recording import Recording

    if format_ == "parquet":
        try:
            import pyarrow  # noqa: F401
        except ImportError as error:
            print(f"--format parquet: {error}; pip install 'handtouch[export]', or use csv", file=sys.stderr)
            return 2
    try:
        recording = Recording(path)
    except (OSError, ValueError) as error:
        print(file_error_text(error), file=sys.stderr)
        return 2
    try:
        with ProgressLine() as progress:
            counts = export(recording, folder, format_, progress.update)
    except (OSError, ValueError) as error:
        print(file_error_text(error), file=sys.stderr)
        return 1
    tables = {folder / f"{name}.{format_}": rows for name, rows in counts.items()}
    if as_json:
        print_json({"tables": [{"file": file, "rows": rows} for file, rows in tables.items()]})
    else:
        for file, rows in tables.items():
            print(f"{file}: {rows} rows")
    if recording.truncation:
        print(f"{path}: {recording.truncation}; all before it is exported", file=sys.stderr)
    if recording.malformed_messages:
        print(f"{path}: {recording.malformed_messages} malformed messages skipped", file=sys.stderr)
    if not counts:
        print(f"{path}: holds no message of a daemon", file=sys.stderr)
    return 0 if counts else 1


def run_plot(
    path: Path, folder: Path, from_s: float = 0.0, to_s: float | None = None, as_json: bool = False
) -> int:
    """Plot a recording; exit status 0, 1 (empty, or figures not written), 2 (no recording, no matplotlib)."""
    from handtouch.record.plot import draw, read_plot_data
    from handtouch.record.recording import Recording

    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        print(f"handtouch plot: {error}; pip install 'handtouch[figures]'", file=sys.stderr)
        return 2
    try:
        recording = Recording(path)
    except (OSError, ValueError) as error:
        print(file_error_text(error), file=sys.stderr)
        return 2
    try:
        with ProgressLine() as progress:
            progress.update(f"reading {path}")
            files = draw(read_plot_data(recording, from_s, to_s), folder, progress.update)
    except (OSError, ValueError) as error:
        print(file_error_text(error), file=sys.stderr)
        return 1
    if as_json:
        print_json({"files": files})
    else:
        print(*files, sep="\n")
    if recording.truncation:
        print(f"{path}: {recording.truncation}; all before it is plotted", file=sys.stderr)
    return 0


def _speed(text: str) -> float:
    return 0.0 if text == "max" else positive_number(text)
