"""The command `figures`: the paper's theoretical figures."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.cli.errors import failing, needing
from handtouch.cli.options import add_json, add_output
from handtouch.cli.progress import ProgressLine
from handtouch.host.json_output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `figures`."""
    parser.set_defaults(command=run)
    add_output(
        parser, "out", "folder to write to (default: figures)", default=Path("figures"), metavar="FOLDER"
    )
    add_json(parser)


def run(out: Path, as_json: bool = False) -> int:
    """Draw the paper's theoretical figures, print their paths.

    Exit status 0, 1 (the folder can't be written), 2 (without matplotlib).
    """
    from handtouch.field.figures import draw_figures

    with needing("figures"), failing(1, OSError), ProgressLine() as progress:
        paths = draw_figures(out, progress.update)
    if as_json:
        print_json({"files": paths})
    else:
        print(*paths, sep="\n")
    return 0
