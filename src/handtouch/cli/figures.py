"""The command `figures`: the paper's theoretical figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from handtouch.cli.options import add_json, add_output
from handtouch.cli.progress import ProgressLine
from handtouch.host.installation import extra_command
from handtouch.host.json_output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `figures`."""
    parser.set_defaults(command=run)
    add_output(
        parser, "out", "folder to write to (default: figures)", default=Path("figures"), metavar="FOLDER"
    )
    add_json(parser)


def run(out: Path, as_json: bool = False) -> int:
    """Draw the paper's theoretical figures, print their paths; exit status as of `draw_with_progress`."""
    from handtouch.field.figures import draw_figures

    paths: list[Path] = []
    if status := draw_with_progress("figures", lambda progress: paths.extend(draw_figures(out, progress))):
        return status
    if as_json:
        print_json({"files": paths})
    else:
        print(*paths, sep="\n")
    return 0


def draw_with_progress(command: str, draw: Callable[[Callable[[str], None]], None]) -> int:
    """Draw with a progress line; exit status 0, 1 (folder can't be written), 2 (without matplotlib)."""
    try:
        with ProgressLine() as progress:
            draw(progress.update)
    except ImportError as error:
        print(f"handtouch {command}: {error}; {extra_command('figures')}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"handtouch {command}: {error}", file=sys.stderr)
        return 1
    return 0
