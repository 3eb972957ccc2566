"""The command `plot`: plots of a recording."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from handtouch.cli.errors import failing, needing
from handtouch.cli.options import add_json, add_number, add_output
from handtouch.cli.progress import ProgressLine
from handtouch.host.json_output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `plot`."""
    parser.set_defaults(command=run)
    parser.add_argument("path", metavar="RECORDING", type=Path, help="MCAP recording")
    add_output(
        parser, "folder", "folder to write to (default: plots)", default=Path("plots"), metavar="FOLDER"
    )
    add_json(parser)
    parser.add_argument(
        "--from",
        dest="from_s",
        type=float,
        default=0.0,
        metavar="S",
        help="begin, in seconds since the recording's first message (default: 0)",
    )
    add_number(parser, "--to", "S", "end, in the same seconds (default: the recording's end)", dest="to_s")


def run(
    path: Path, folder: Path, from_s: float = 0.0, to_s: float | None = None, as_json: bool = False
) -> int:
    """Plot a recording; exit status 0, 1 (empty, or figures not written), 2 (no recording, no matplotlib)."""
    from handtouch.record.plot import draw, read_plot_data
    from handtouch.record.recording import Recording

    with needing("figures", "handtouch plot: "):
        import matplotlib  # noqa: F401
    with failing(2, OSError, ValueError):
        recording = Recording(path)
    with failing(1, OSError, ValueError), ProgressLine() as progress, recording.checked():
        progress.update(f"reading {path}")
        files = draw(read_plot_data(recording, from_s, to_s), folder, progress.update)
    if as_json:
        print_json({"files": files})
    else:
        print(*files, sep="\n")
    if recording.truncation:
        print(f"{path}: {recording.truncation}; all else is plotted", file=sys.stderr)
    return 0
