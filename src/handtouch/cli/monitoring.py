"""Arguments of the commands that show the state of a running daemon: `watch`, `view`, `status`, `support`."""

from __future__ import annotations

from pathlib import Path

from handtouch.cli.options import (
    LIVE_HELP,
    Subparsers,
    add_command,
    add_config,
    add_endpoint,
    add_json,
    add_key,
    add_output,
    add_percepts,
    integer,
    positive_number,
)
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT


def add(commands: Subparsers) -> None:
    """Add `watch`, `view`, `status` and `support`."""
    _add_watch(commands)
    _add_view(commands)

    status = add_command(
        commands,
        "status",
        "handtouch.cli.status:run",
        "print the health of a running daemon: rates, losses, buses, nodes, calibrations, diagnoses",
    )
    add_endpoint(status, CONTROL_ENDPOINT, "control endpoint")
    add_json(status)
    _add_support(commands)


def _add_watch(commands: Subparsers) -> None:
    watch = add_command(
        commands, "watch", "handtouch.cli.watch:run", "show the messages of a running daemon in the terminal"
    )
    watch.add_argument(
        "patterns",
        metavar="PATTERN",
        nargs="*",
        help='topics such as "contact/*/thumb_*", "hand/*", "service" (default: contacts and health)',
    )
    add_endpoint(watch, LIVE_ENDPOINT, LIVE_HELP)
    style = watch.add_mutually_exclusive_group()
    style.add_argument(
        "--plain", dest="style", action="store_const", const="plain", help="print lines, also on a terminal"
    )
    style.add_argument(
        "--json", dest="style", action="store_const", const="json", help="print JSON, a line per message"
    )
    watch.add_argument(
        "--seconds", type=positive_number, default=0.0, metavar="S", help="duration (default: until Ctrl-C)"
    )
    watch.set_defaults(style="auto")


def _add_view(commands: Subparsers) -> None:
    view = add_command(
        commands, "view", "handtouch.cli.view:run", "serve a live 3D view of a running daemon's hands"
    )
    view.add_argument(
        "--foxglove",
        action="store_true",
        help="serve Foxglove (scene, frames, log, values to plot) over its WebSocket, instead of a page",
    )
    add_endpoint(view, LIVE_ENDPOINT, LIVE_HELP)
    view.add_argument(
        "--host", default="127.0.0.1", help="address that the page is served at (default: 127.0.0.1)"
    )
    view.add_argument(
        "--port",
        type=integer(0, 65535, "a port, 0 to 65535"),
        help="TCP port of the page, 0 for any free one (default: 5588; 8765 for Foxglove)",
    )
    view.add_argument(
        "--open", dest="show", action="store_true", help="open the page, or Foxglove, in a browser"
    )
    view.add_argument(
        "--seconds", type=positive_number, default=0.0, metavar="S", help="duration (default: until Ctrl-C)"
    )
    add_percepts(view)


def _add_support(commands: Subparsers) -> None:
    support = add_command(
        commands,
        "support",
        "handtouch.cli.support_text:run",
        "collect versions, deployment, status, logs and a short recording in one archive, without secrets",
    )
    add_config(support, "deployment file of the daemon, also for its endpoints", nargs="?")
    add_output(
        support,
        "out",
        "new archive (default: handtouch-support-HOST-TIME.tar.gz in the current folder)",
        metavar="FILE",
    )
    support.add_argument(
        "--seconds",
        type=positive_number,
        default=5.0,
        metavar="S",
        help="duration of the recording (default: 5)",
    )
    support.add_argument(
        "--log",
        dest="logs",
        action="append",
        type=Path,
        default=[],
        metavar="FILE",
        help="log file to add, where the journal doesn't have the daemon's log; repeatable",
    )
    add_key(support)
