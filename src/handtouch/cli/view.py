"""`handtouch view`: serve the page in the browser, or Foxglove, and print the URL."""

from __future__ import annotations

import argparse
import sys
import threading
import time
import webbrowser

from handtouch.cli.options import add_endpoint, add_percepts, integer, positive_number
from handtouch.client import connect
from handtouch.host.endpoints import is_loopback
from handtouch.host.installation import extra_command
from handtouch.host.signals import stop_on_signals
from handtouch.view import page
from handtouch.view.page.model import PageModel
from handtouch.view.page.server import PageServer


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
    parser.add_argument(
        "--seconds", type=positive_number, default=0.0, metavar="S", help="duration (default: until Ctrl-C)"
    )
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
        print(
            f"--host {host}: is reachable from other machines, and HTTP has no keys; leave it out, and open "
            "an SSH tunnel on the other machine: ssh -L 5588:localhost:5588 ROBOT",
            file=sys.stderr,
        )
        return 2
    stop = stop_on_signals()
    if foxglove:
        return _serve_foxglove(endpoint, key, host, port, show, seconds, percepts, stop)
    port = page.PORT if port is None else port
    model = PageModel(percepts)
    server = PageServer(model.values, host, port)
    try:
        messages = connect(*page.patterns(percepts), endpoint=endpoint, key=key, queue=page.QUEUE_MESSAGES)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    with messages:
        try:
            server.start()
        except (OSError, OverflowError) as error:
            print(_bind_error_text(host, port, error), file=sys.stderr)
            return 2
        print(f"handtouch view: {server.url} shows {endpoint}; Ctrl-C to stop", flush=True)
        if show:
            webbrowser.open(server.url)
        try:
            end_s = time.monotonic() + seconds if seconds else float("inf")
            page.serve(messages, model, server, stop, end_s)
        except PermissionError as error:
            print(error, file=sys.stderr)
            return 1
        finally:
            server.close()
    return 0


def _serve_foxglove(
    endpoint: str,
    key: str | None,
    host: str,
    port: int | None,
    show: bool,
    seconds: float,
    percepts: bool,
    stop: threading.Event,
) -> int:
    try:
        from handtouch.view import foxglove
    except ImportError as error:
        print(f"Foxglove's package is missing ({error}): {extra_command('foxglove')}", file=sys.stderr)
        return 2
    patterns = (*foxglove.PATTERNS, *[page.PERCEPT_PATTERN] * percepts)
    port = foxglove.PORT if port is None else port
    try:
        messages = connect(*patterns, endpoint=endpoint, key=key, queue=foxglove.QUEUE_MESSAGES)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    with messages:
        try:
            server = foxglove.FoxgloveServer(host, port)
        except RuntimeError as error:
            print(_bind_error_text(host, port, error), file=sys.stderr)
            return 2
        with server:
            print(
                f"handtouch view: {server.url} shows {endpoint} in {server.app_url}; Ctrl-C to stop",
                flush=True,
            )
            if show:
                webbrowser.open(server.app_url)
            end_s = time.monotonic() + seconds if seconds else float("inf")
            try:
                foxglove.serve(messages, server, stop, end_s)
            except PermissionError as error:
                print(error, file=sys.stderr)
                return 1
    return 0


def _bind_error_text(host: str, port: int, error: Exception) -> str:
    return (
        f"can't serve at {host}:{port}: {getattr(error, 'strerror', None) or error}; if another "
        "view uses the port, take a free one with `handtouch view --port 0`"
    )
