"""Building blocks of the command line: adding a command, options that several have, types of values."""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from handtouch.host.endpoints import COMPLETE_ENDPOINT, CONTROL_ENDPOINT, LIVE_ENDPOINT, to_connect

EXIT_STATUS_HELP = (
    "Exit status: 0 success; 1 failure, or a problem was found; 2 wrong usage, a file that is missing or "
    "invalid, or a package that isn't installed; 130 interrupted before the end."
)

MAX_LISTED_CHOICES = 10
"""of an error message"""
ENDPOINTS = {
    "live": (LIVE_ENDPOINT, "live stream, which drops what a slow subscriber can't take"),
    "complete": (COMPLETE_ENDPOINT, "complete stream, which queues messages for slow subscribers"),
    "control": (CONTROL_ENDPOINT, "control endpoint"),
}
"""Key of `[daemon]` -> default and description of an endpoint that commands connect to."""

Subparsers: TypeAlias = "argparse._SubParsersAction[Any]"


class SuggestingParser(argparse.ArgumentParser):
    """Parser whose error for an unknown command or choice names the closest one, if one is close."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and the error, and exit with status 2."""
        found = re.fullmatch(r"(.*invalid choice: '(.*)') \(choose from (.*)\)", message, re.DOTALL)
        if found is not None:
            choices = re.findall(r"[\w-]+", found[3])
            if close := difflib.get_close_matches(found[2], choices, 1):
                message = f"{found[1]}; did you mean {close[0]!r}?"
            elif len(choices) > MAX_LISTED_CHOICES:
                message = f"{found[1]}; see `{self.prog} --help`"
        super().error(message)


class CommandParser(SuggestingParser):
    """Parser of a command, whose module is imported and whose arguments are added when they are needed.

    `adder`, "module:function", names the function that adds them, and sets the default `command`: the
    function that runs the command with its options as keyword arguments, and returns the exit status.
    """

    def __init__(self, *, adder: str = "", **options: Any) -> None:
        super().__init__(**options)
        self._adder = adder

    def add_own_arguments(self) -> None:
        """Import the module, once, and add the arguments."""
        if adder := self._adder:
            self._adder = ""
            module, _, name = adder.partition(":")
            getattr(importlib.import_module(module), name)(self)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Add the arguments and parse them. What this command doesn't know is an error, with its usage."""
        self.add_own_arguments()
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            known = [text for action in self._actions for text in action.option_strings]
            close = difflib.get_close_matches(unknown[0].partition("=")[0], known, 1)
            hint = f"did you mean {close[0]}?" if close else f"see `{self.prog} --help`"
            self.error(f"unrecognized arguments: {' '.join(unknown)}; {hint}")
        return options, unknown


class PrintCompletion(argparse.Action):
    """Print the completion script of a shell for all commands, and exit."""

    def __call__(
        self, parser: argparse.ArgumentParser, _namespace: Any, shell: Any, _option: Any = None
    ) -> None:
        import shtab  # only here, so that commands start quickly

        _complete_paths(parser, shtab.FILE, shtab.DIRECTORY)
        print(shtab.complete(parser, shell))
        parser.exit()


def _complete_paths(parser: argparse.ArgumentParser, files: Any, folders: Any) -> None:
    """Mark the arguments of a parser and its commands that are completed with paths."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                command.add_own_arguments()
                _complete_paths(command, files, folders)
        elif action.type is Path or action.metavar == "FILE":
            action.complete = folders if action.metavar == "FOLDER" else files  # type: ignore[attr-defined]


def add_command(
    commands: Subparsers, name: str, function: Callable[..., int], text: str
) -> argparse.ArgumentParser:
    """Add a subcommand that calls `function` with its options as keyword arguments.

    `text` is its line in the command's help and the description in its own help.
    """
    parser: argparse.ArgumentParser = commands.add_parser(name, **describe_command(text))
    parser.set_defaults(command=function)
    return parser


def describe_command(text: str) -> dict[str, Any]:
    """Return the help, description and epilogue of a command."""
    return {"help": text, "description": text[0].upper() + text[1:] + ".", "epilog": EXIT_STATUS_HELP}


def add_config(parser: argparse.ArgumentParser, text: str = "deployment file (TOML)", **options: Any) -> None:
    """Add the deployment file, a positional argument, as `config_path`."""
    parser.add_argument("config_path", type=Path, metavar="CONFIG", help=text, **options)


def add_bus(
    parser: argparse.ArgumentParser,
    text: str = "open this CAN interface for bus NAME instead of the one in the deployment file, e.g. "
    "can0=udp_multicast:239.74.163.2 (no hardware), can0=socketcan:vcan0; repeatable",
) -> None:
    """Add `--bus`, which may be given several times, as `buses`."""
    parser.add_argument(
        "--bus",
        dest="buses",
        action="append",
        default=[],
        metavar="NAME=INTERFACE:CHANNEL[,OPTION=VALUE...]",
        help=text,
    )


def add_endpoint(parser: argparse.ArgumentParser, kind: str, *, config: bool = True) -> None:
    """Add `--endpoint` and `--key`, and `--config` unless the command has it: which daemon to talk to.

    `kind`: a key of ENDPOINTS. `main` replaces the endpoint by `find_endpoint` before the command runs; a
    command with a deployment file of its own does so itself.
    """
    default, text = ENDPOINTS[kind]
    if config:
        parser.set_defaults(endpoint_kind=kind)
        parser.add_argument(
            "--config",
            dest="daemon_config",
            type=Path,
            metavar="FILE",
            help="deployment file of the daemon, for its endpoint (default: the file in $HANDTOUCH_CONFIG, "
            "if set)",
        )
    parser.add_argument(
        "--endpoint", help=f"the daemon's {text} (default: as the deployment file says, else {default})"
    )
    add_key(parser)


def find_endpoint(kind: str, endpoint: str | None = None, config: Path | None = None) -> str:
    """Return the endpoint to connect to: the given one, the deployment's, or the default.

    Without `config` the deployment is the file in $HANDTOUCH_CONFIG, if set. Raises ValueError for a file
    that can't be used.
    """
    file = config or os.environ.get("HANDTOUCH_CONFIG")
    if endpoint is not None or not file:
        return endpoint or ENDPOINTS[kind][0]
    from handtouch.config import load  # only here, so that commands start quickly

    return to_connect(getattr(load(Path(file)).daemon, kind))


def add_key(parser: argparse.ArgumentParser) -> None:
    """Add `--key`."""
    parser.add_argument(
        "--key",
        metavar="FILE",
        help="client key, for a daemon that requires one (default: the file in $HANDTOUCH_KEY, if set)",
    )


def add_json(parser: argparse._ActionsContainer, text: str = "print JSON (docs/command_line.md)") -> None:
    """Add `--json` as `as_json`."""
    parser.add_argument("--json", dest="as_json", action="store_true", help=text)


def add_output(parser: argparse.ArgumentParser, dest: str, text: str, **options: Any) -> None:
    """Add `-o`, `--output`: the file or folder that a command writes."""
    parser.add_argument("-o", "--output", dest=dest, type=Path, help=text, **options)


def add_percepts(parser: argparse.ArgumentParser) -> None:
    """Add `--percepts`."""
    parser.add_argument(
        "--percepts",
        action="store_true",
        help="also subscribe to percepts (slip, shape, friction), so that the daemon computes them",
    )


def add_number(
    parser: argparse._ActionsContainer,
    name: str,
    metavar: str,
    text: str,
    *,
    default: float | None = None,
    **options: Any,
) -> None:
    """Add an option that takes a finite number above 0; its default is stated, unless the text does."""
    if default is not None and "(default" not in text:
        text += f" (default: {default:g})"
    parser.add_argument(name, type=positive_number, metavar=metavar, default=default, help=text, **options)


def positive_number(text: str) -> float:
    """Parse a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0")
    return value


def integer(least: int, most: int, text: str) -> Callable[[str], int]:
    """Return a parser of integers (decimal, 0x...) from `least` to `most`; `text` describes them."""

    def parse(value: str) -> int:
        try:
            number = int(value, 0)
        except ValueError:
            number = least - 1
        if not least <= number <= most:
            raise argparse.ArgumentTypeError(f"{value}: must be {text}")
        return number

    return parse


def comma_separated(text: str) -> list[str]:
    """Split a list such as "thumb_*,index_*"."""
    return [part.strip() for part in text.split(",") if part.strip()]
