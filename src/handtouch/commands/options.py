"""What families share: how a command is added, options that several have, values that options take."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

LIVE = "tcp://127.0.0.1:5580"
CONTROL = "tcp://127.0.0.1:5581"

EXIT = (
    "Exit status: 0 all is well, 1 something failed or is not well (check: warnings), 2 wrong usage or file."
)

Command = Callable[[argparse.Namespace], int]
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def command(commands: Commands, name: str, function: Command, text: str) -> argparse.ArgumentParser:
    """A command that `function` runs; its text is told by `handtouch --help` and by its own."""
    description = text[0].upper() + text[1:] + "."
    parser = commands.add_parser(name, help=text, description=description, epilog=EXIT)
    parser.set_defaults(command=function)
    return parser


def family(commands: Commands, name: str, text: str, description: str) -> Commands:
    """A command that has commands of its own: these."""
    parser = commands.add_parser(name, help=text, description=description, epilog=EXIT)
    return parser.add_subparsers(title="commands", metavar="COMMAND", required=True)


def add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, help="deployment file (TOML)")


def add_bus(
    parser: argparse.ArgumentParser,
    text: str = "use another python-can interface for a bus of the deployment",
) -> None:
    parser.add_argument(
        "--bus",
        action="append",
        default=[],
        metavar="NAME=INTERFACE:CHANNEL[,OPTION=VALUE...]",
        help=text,
    )


def add_endpoint(parser: argparse.ArgumentParser, default: str, text: str) -> None:
    parser.add_argument("--endpoint", default=default, help=f"{text} (default: {default})")
    add_key(parser)


def add_key(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--key",
        metavar="FILE",
        help="key for a daemon that asks for one (default: the file that HANDTOUCH_KEY names, if set)",
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="as JSON")


def add_percepts(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--percepts",
        action="store_true",
        help="slip, hardness, shape and texture too, which the daemon then computes",
    )


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0")
    return value
