"""The hand in the browser, live: a subscriber in a process of its own, and the page that it serves.

Public names: `open_server`, `serve`, `PATTERNS`. The page draws with WebGL and loads nothing from other
hosts.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from handtouch.client import Subscriber
from handtouch.view.page.model import PageModel, VersionedValues
from handtouch.view.page.server import PageServer

PATTERNS = ("hand/*", "health/*/*", "joints/*", "service", "config")
PERCEPT_PATTERN = "percept/*/*"
HOST, PORT = "127.0.0.1", 5588
QUEUE_MESSAGES = 2000
_UPDATES_PER_S = 30


def open_server(host: str, port: int, percepts: bool) -> PageServer:
    """Return a server of the page, to be started; `percepts` are subscribed."""
    values = VersionedValues()
    values.set_value("percepts_enabled", percepts)
    return PageServer(values, host, port)


def serve(messages: Subscriber[Any], server: PageServer, stop: threading.Event, end_s: float) -> None:
    """Update the pages of a started server until `stop` or the monotonic time `end_s`.

    Raises PermissionError when the daemon rejects this client.
    """
    model = PageModel(server.values)
    next_s = time.monotonic()
    while not stop.is_set() and (now_s := time.monotonic()) < end_s:
        message = messages.recv(max(0.0, next_s - now_s))
        if message is not None:
            with server.condition:
                model.add_message(message)
        if (now_s := time.monotonic()) >= next_s:
            with server.condition:
                model.update_values(messages.alive)
            server.notify_pages()
            next_s = max(next_s + 1 / _UPDATES_PER_S, now_s)
