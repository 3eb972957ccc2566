"""`handtouch view`: serve the page in the browser and print its URL."""

from __future__ import annotations

import sys
import time
import webbrowser

from handtouch.client import connect
from handtouch.host.signals import stop_on_signals
from handtouch.view import page
from handtouch.view.page.model import PageModel
from handtouch.view.page.server import PageServer


def run(
    *,
    endpoint: str,
    key: str | None,
    host: str,
    port: int,
    show: bool = False,
    seconds: float = 0.0,
    percepts: bool = False,
) -> int:
    """Serve the page until Ctrl-C, or for `seconds`; `show` opens it in this machine's browser.

    Exit status 0, 1 when the daemon rejects this client, 2 for an unusable endpoint, key or port.
    """
    stop = stop_on_signals()
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


def _bind_error_text(host: str, port: int, error: Exception) -> str:
    return (
        f"can't serve the page at {host}:{port}: {getattr(error, 'strerror', None) or error}; if another "
        "view uses the port, take a free one with `handtouch view --port 0`"
    )
