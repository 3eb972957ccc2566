"""`handtouch run`: run the daemon."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from handtouch.cli.options import add_bus, add_config
from handtouch.daemon import serve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    parser.set_defaults(command=run_command)
    add_config(parser)
    add_bus(parser)


def run_command(config_path: Path, buses: Sequence[str]) -> int:
    """Run the daemon; exit status 1 if buses or endpoints can't be opened, 2 for wrong configuration."""
    serve.run(config_path, buses)
    return 0
