"""Command line: `main` and the parser of all commands.

A command's arguments, work and output are in one module, which is imported only when the command is used;
`COMMANDS` lists the modules; entry points of the group `handtouch.commands` add others (docs/extend.md).
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from handtouch import __version__
from handtouch.cli.errors import failing
from handtouch.cli.options import (
    EXIT_STATUS_HELP,
    CommandParser,
    PrintCompletion,
    SuggestingParser,
    describe_command,
    find_endpoint,
)

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

COMMANDS = {
    "demo": "run a simulated hand, the daemon and a live view together for half a minute; needs no hardware",
    "run": "run the daemon: read the sensor nodes of a deployment and publish contacts until SIGINT or "
    "SIGTERM",
    "init": "write a commented deployment file to start from, with the nodes found on a bus or without",
    "simulate": "simulate the sensor nodes of a deployment on its CAN buses",
    "watch": "show the messages of a running daemon in the terminal",
    "view": "serve a live 3D view of a running daemon's hands",
    "status": "print the health of a running daemon: rates, losses, buses, nodes, calibrations, diagnoses",
    "support": "collect versions, deployment, status, logs and a short recording in one archive, without "
    "secrets",
    "record": "record the messages of a running daemon to MCAP files",
    "replay": "recompute the contacts of a recording or a CAN log, with the same code as the daemon",
    "export": "export a recording as CSV or Parquet tables",
    "plot": "plot a recording: contacts over time and on pads, forces, health",
    "tare": "zero (tare) pads; refused for loaded pads",
    "scene": "show or change the scene: the links and outputs that a task uses, and at what rate; the rest "
    "isn't computed",
    "snapshot": "print every pad once: touched or not, and its contact with position and force",
    "calibrate": "measure a pad's contact law (force against current) with known weights (--weights), or "
    "set values of its calibration (--gains, --offsets, --law); with neither, print the active "
    "calibration",
    "disable": "disable pads: no contacts, excitation off",
    "enable": "enable disabled pads again",
    "reload": "make the daemon read its deployment file again; pads that don't change are not disturbed",
    "object": "state which known object a hand handles, whose pose the percept `object` estimates",
    "log": "set the daemon's log level",
    "bridge": "forward the topics of daemons to a ROS 2 or Zenoh network",
    "keys": "manage the keys (ZeroMQ CURVE) with which clients on other machines connect to a daemon",
    "check": "check a deployment file: errors, bus load, warnings (exit status 1)",
    "doctor": "check that this machine can run the daemon: packages, clock, socket buffers, CAN interfaces, "
    "endpoints",
    "scan": "find the nodes on CAN buses, compare them with a deployment file, and print the tables to add "
    "to it",
    "conformance": "test sensor nodes on a bus against docs/firmware.md: objects, NMT, heartbeat, EMCY, PDO "
    "timing, LSS",
    "commission": "identify each pad's node, electrode order and dead channels from guided presses, and "
    "write them to the deployment file",
    "figures": "draw the theoretical figures of the paper that the sensor model comes from",
    "design": "draw a pad's expected position error, or find the best electrodes for a goal (docs/design.md)",
    "calibrations": "inspect and manage the calibration store: the calibrations of every sensor by serial "
    "number, with their history",
    "node": "run sensor nodes on this computer: four ADC channels per pad (Linux IIO), CANopen on its CAN "
    "interface, until SIGINT or SIGTERM",
}
"""Commands in the order of `--help`, which shows these lines; `handtouch.cli.NAME` holds each."""

REQUESTS = ("tare", "scene", "snapshot", "disable", "enable", "reload", "object", "log")
"""Commands that send one request to the daemon, which `handtouch.cli.requests` holds."""

INTERRUPTED_STATUS = 130
"""Exit status of a command that Ctrl-C ended before its result, as that of a shell."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; exit status 0 (success), 1 (failure), 2 (wrong usage or file) or 130 (interrupted)."""
    # arrays are small: threads of the linear algebra library would only compete with the daemon's main thread
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _replace_what_cannot_be_encoded()
    try:
        return _run(arguments)
    except KeyboardInterrupt:  # commands that run until Ctrl-C catch it themselves
        return INTERRUPTED_STATUS
    except BrokenPipeError:  # the reader of our output has exited, as `| head` does
        _discard_output()
        return 0
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _discard_output()
        print(f"handtouch: the output can't be written: {error.strerror}", file=sys.stderr)
        return 1


def _run(arguments: Sequence[str] | None) -> int:
    given = sys.argv[1:] if arguments is None else arguments
    parser = build_parser(own_only=bool(given) and given[0] in COMMANDS)
    if not given:
        parser.print_help(sys.stderr)
        return 2
    try:
        options = vars(parser.parse_args(given))
        command: Callable[..., int] = options.pop("command")
        if (kind := options.pop("endpoint_kind", None)) is not None:
            config = options.pop("daemon_config")
            with failing(2, ValueError, OSError):
                options["endpoint"] = find_endpoint(kind, options["endpoint"], config)
        return command(**options)
    except Exception as error:
        if (status := getattr(error, "exit_status", None)) is None:
            raise
        print(error, file=sys.stderr)
        return int(status)
    finally:  # --help and wrong usage end by SystemExit
        if sys.stdout is not None:
            sys.stdout.flush()  # while an error of it can be handled


def _added_commands() -> Iterable[EntryPoint]:
    """Return the entry points of commands that other packages add."""
    from importlib.metadata import entry_points  # only here, so that handtouch's own commands start quickly

    return entry_points(group="handtouch.commands")


def _replace_what_cannot_be_encoded() -> None:
    """Show characters that a terminal or file can't encode as "?", instead of ending with an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _discard_output() -> None:
    """Let later output go nowhere, also what the interpreter flushes at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser(*, own_only: bool = False) -> argparse.ArgumentParser:
    """Return the parser of all commands; the module of one is imported when that command is parsed.

    own_only: without those that other packages add, for which all installed packages are looked through.
    """
    parser = SuggestingParser(
        prog="handtouch",
        epilog=EXIT_STATUS_HELP,
        description="Middleware for tactile sensors of a robot hand: reads CANopen sensor nodes and "
        "publishes contacts (position, force, uncertainty) over ZeroMQ. First look: demo. On a robot: "
        "describe its hands, nodes and buses in a deployment file (TOML, such as config/utah_mit.toml), then "
        "check, doctor, scan, commission and run; watch shows the contacts.",
    )
    parser.add_argument("--version", action="version", version=f"handtouch {__version__}")
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        default=argparse.SUPPRESS,
        choices=("bash", "zsh", "tcsh"),
        help="print the completion script of a shell (docs/command_line.md)",
    )
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=CommandParser
    )
    for name, text in COMMANDS.items():
        adder = f"requests:add_{name}" if name in REQUESTS else f"{name}:add_arguments"
        commands.add_parser(name, adder=f"handtouch.cli.{adder}", **describe_command(text))
    for found in () if own_only else _added_commands():
        text = f"from the package {found.dist.name}" if found.dist else "from another package"
        commands.add_parser(found.name, adder=found.value, **describe_command(text))
    return parser
