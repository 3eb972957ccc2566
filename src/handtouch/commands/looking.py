"""The commands that show what a running daemon publishes: `watch`, `view`, `status`."""

from __future__ import annotations

import argparse

from handtouch.commands.options import (
    CONTROL,
    LIVE,
    Commands,
    add_endpoint,
    add_json,
    add_percepts,
    command,
    positive,
)


def add(commands: Commands) -> None:
    """Add `watch`, `view` and `status`."""
    _add_watch(commands)
    _add_view(commands)

    status = command(commands, "status", _status, "how the daemon, its buses and its pads fare")
    add_endpoint(status, CONTROL, "control endpoint")
    add_json(status)


def _add_watch(commands: Commands) -> None:
    watch = command(commands, "watch", _watch, "show what a running daemon publishes")
    watch.add_argument("pattern", nargs="*", help='topics such as "contact/*/thumb_*", "hand/*", "service"')
    add_endpoint(watch, LIVE, "stream to listen to")
    style = watch.add_mutually_exclusive_group()
    style.add_argument(
        "--plain", dest="style", action="store_const", const="plain", help="lines, in a terminal too"
    )
    style.add_argument("--json", dest="style", action="store_const", const="json", help="JSON lines")
    watch.add_argument("--seconds", type=positive, default=0.0, help="end after so long")


def _add_view(commands: Commands) -> None:
    view = command(commands, "view", _view, "show the hand of a running daemon in the browser, live")
    add_endpoint(view, LIVE, "stream to listen to")
    view.add_argument("--host", default="127.0.0.1", help="address to serve the page at (default: 127.0.0.1)")
    view.add_argument("--port", type=_port, default=5588, help="its port, 0 for a free one (default: 5588)")
    view.add_argument("--open", action="store_true", help="open the page in this machine's browser")
    view.add_argument("--seconds", type=positive, default=0.0, help="end after so long")
    add_percepts(view)


def _watch(asked: argparse.Namespace) -> int:
    from handtouch.view import watch

    return watch.run(
        tuple(asked.pattern),
        endpoint=asked.endpoint,
        key=asked.key,
        style=asked.style or "auto",
        seconds=asked.seconds,
    )


def _view(asked: argparse.Namespace) -> int:
    from handtouch.view import page

    return page.run(
        endpoint=asked.endpoint,
        key=asked.key,
        host=asked.host,
        port=asked.port,
        show=asked.open,
        seconds=asked.seconds,
        percepts=asked.percepts,
    )


def _status(asked: argparse.Namespace) -> int:
    from handtouch.view import status

    return status.run(endpoint=asked.endpoint, key=asked.key, as_json=asked.json)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text}: must be a port, 0 to 65535")
    return int(text)
