"""The command line: `main`, and the parser of all commands, which are families in `handtouch.commands`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from handtouch import __version__
from handtouch.commands import asking, bridge, calibrations, checking, keys, looking, recording, serving
from handtouch.commands.options import EXIT, Command

FAMILIES = (serving, looking, recording, asking, bridge, keys, checking, calibrations)
"""Each with `add`, in the order of `--help`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; exit status 0 (well), 1 (it failed) or 2 (wrong usage or configuration)."""
    # small arrays all through: threads of the linear algebra would only fight the hot thread for a core
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    asked = build_parser().parse_args(arguments)
    run: Command = asked.command
    try:
        return run(asked)
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # the reader of our output left, as `| head` does
        sys.stderr.close()
        return 0


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="handtouch",
        epilog=EXIT,
        description="Gives a robot hand a sense of touch: CANopen touch sensors in, contacts out.",
    )
    parser.add_argument("--version", action="version", version=f"handtouch {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for family in FAMILIES:
        family.add(commands)
    return parser
