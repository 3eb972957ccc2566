"""`handtouch view`: serve the page in the browser, or Foxglove, and print the URL."""

from __future__ import annotations

import argparse
import time
import webbrowser
from contextlib import ExitStack
from typing import Any

from handtouch.cli.errors import CommandError, failing, needing
from handtouch.cli.options import add_endpoint, add_number, add_percepts, integer
from handtouch.client import connect
from handtouch.host.endpoints import is_loopback
from handtouch.host.signals import stop_on_signals
from handtouch.view import page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    parser.set_defaults(command=run)
    parser.add_argument(
        "--foxglove",
        action="store_true",
        help="serve Foxglove (scene, frames, log, values to plot) over its WebSocket, instead of a page",
    )
    add_endpoint(parser, "live")
    parser.add_argument(
        "--host", default="127.0.0.1", help="loopback address that it is served at (default: 127.0.0.1)"
    )
    parser.add_argument(
        "--port",
        type=integer(0, 65535, "a port, 0 to 65535"),
        help="TCP port of the page, 0 for any free one (default: 5588; 8765 for Foxglove)",
    )
    parser.add_argument(
        "--open", dest="show", action="store_true", help="open the page, or Foxglove, in a browser"
    )
    add_number(parser, "--seconds", "S", "duration (default: until Ctrl-C)", default=0.0)
    add_percepts(parser)


def run(
    *,
    endpoint: str,
    key: str | None,
    host: str,
    port: int | None,
    show: bool = False,
    seconds: float = 0.0,
    percepts: bool = False,
    foxglove: bool = False,
) -> int:
    """Serve the page, or Foxglove, until Ctrl-C, or for `seconds`; `show` opens it in this machine's browser.

    Exit status 0, 1 when the daemon rejects this client, 2 for an unusable endpoint, key, host or port, or
    without the extra.
    """
    if not is_loopback(host):
        raise CommandError(
            f"--host {host}: is reachable from other machines, and HTTP has no keys; leave it out, and open "
            "an SSH tunnel on the other machine: ssh -L 5588:localhost:5588 ROBOT",
            2,
        )
    stop = stop_on_signals()
    end_s = time.monotonic() + seconds if seconds else float("inf")
    shown: Any = page
    if foxglove:
        with needing("foxglove", "Foxglove's package is missing: "):
            from handtouch.view import foxglove as shown
    port = shown.PORT if port is None else port
    patterns = (*shown.PATTERNS, *[page.PERCEPT_PATTERN] * percepts)
    with failing(2, ValueError):
        messages = connect(*patterns, endpoint=endpoint, key=key, queue=shown.QUEUE_MESSAGES)
    with messages, ExitStack() as stack:
        try:
            server = stack.enter_context(shown.open_server(host, port, percepts))
        except (OSError, OverflowError, RuntimeError) as error:
            raise CommandError(
                f"can't serve at {host}:{port}: {getattr(error, 'strerror', None) or error}; if another view "
                "uses the port, take a free one with `handtouch view --port 0`",
                2,
            ) from error
        where = f" in {server.app_url}" if foxglove else ""
        print(f"handtouch view: {server.url} shows {endpoint}{where}; Ctrl-C to stop", flush=True)
        if show:
            webbrowser.open(server.app_url if foxglove else server.url)
        with failing(1, PermissionError):
            shown.serve(messages, server, stop, end_s)
    return 0
