"""`handtouch view`: the hand in the browser, live; a subscriber like any other, in a process of its own.

Public names: `run`. The page draws with WebGL and needs nothing from elsewhere.
"""

from __future__ import annotations

import sys
import threading
import time
import webbrowser
from typing import Any

from handtouch.client import LIVE, Subscriber, connect
from handtouch.signals import stop_on_signals
from handtouch.view.page.picture import Picture
from handtouch.view.page.serve import PageServer

TOPICS = ("hand/*", "health/*/*", "joints/*", "service", "config")
PERCEPTS = "percept/*/*"
HOST, PORT = "127.0.0.1", 5588
_UPDATES_PER_S = 30
_QUEUE = 2000


def run(
    *,
    endpoint: str = LIVE,
    key: str | None = None,
    host: str = HOST,
    port: int = PORT,
    show: bool = False,
    seconds: float = 0.0,
    percepts: bool = False,
) -> int:
    """Serve the page until Ctrl-C, or for `seconds`; `show` opens it in this machine's browser.

    `percepts`: what is felt above contacts, too, which the daemon computes only for who asks.

    Exit status 0, 1 when the daemon doesn't let us in, 2 for an endpoint, key or port that can't be used.
    """
    stop = stop_on_signals()
    picture = Picture(percepts)
    try:
        topics = (*TOPICS, PERCEPTS) if percepts else TOPICS
        messages = connect(*topics, endpoint=endpoint, key=key, queue=_QUEUE)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    with messages:
        try:
            server = PageServer(picture.board, host, port)
        except (OSError, OverflowError) as error:
            print(_no_port(host, port, error), file=sys.stderr)
            return 2
        print(f"handtouch view: {server.url} shows {endpoint}; Ctrl-C ends it", flush=True)
        if show:
            webbrowser.open(server.url)
        try:
            _follow(messages, picture, server, stop, time.monotonic() + seconds if seconds else float("inf"))
        except PermissionError as error:
            print(error, file=sys.stderr)
            return 1
        finally:
            server.close()
    return 0


def _follow(
    messages: Subscriber[Any], picture: Picture, server: PageServer, stop: threading.Event, end_s: float
) -> None:
    next_s = time.monotonic()
    while not stop.is_set() and (now_s := time.monotonic()) < end_s:
        message = messages.recv(max(0.0, next_s - now_s))
        if message is not None:
            with server.changed:
                picture.take(message)
        if (now_s := time.monotonic()) >= next_s:
            with server.changed:
                picture.step(messages.alive)
            server.tell()
            next_s = max(next_s + 1 / _UPDATES_PER_S, now_s)


def _no_port(host: str, port: int, error: Exception) -> str:
    return (
        f"the page can't be served at {host}:{port}: {getattr(error, 'strerror', None) or error}; is another "
        "view open there? `handtouch view --port 0` takes a free port"
    )
