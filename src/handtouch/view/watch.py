"""`handtouch watch`: a live view in a terminal, plain or JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import asdict
from typing import Any

from handtouch.client import LIVE, Subscriber, connect
from handtouch.view.lines import line
from handtouch.wire import Contact

_FRAMES_PER_S = 15
_UPDATE_LINES_PER_S = 4


def run(patterns: tuple[str, ...], *, endpoint: str = LIVE, style: str = "auto", seconds: float = 0) -> int:
    """Show messages until Ctrl-C, or for `seconds`; `style`: auto, live, plain or json. Exit status 0.

    With no pattern: contacts and health.
    """
    if style == "auto":
        style = "live" if sys.stdout.isatty() and not patterns else "plain"
    if style == "live":
        patterns = ("contact/*/*", "health/*/*", "service")
    stop = threading.Event()
    if seconds:
        timer = threading.Timer(seconds, stop.set)
        timer.daemon = True
        timer.start()
    try:
        with connect(*(patterns or ("contact/*/*", "health/*/*")), endpoint=endpoint) as messages:
            if style == "live":
                show_live(messages, stop, f"handtouch at {endpoint}")
            else:
                show_lines(messages, stop, as_json=style == "json")
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    except (KeyboardInterrupt, BrokenPipeError):
        return 0
    return 0


def show_live(messages: Subscriber, stop: threading.Event, title: str) -> None:
    """Draw the live view until `stop` is set."""
    from rich.live import Live

    from handtouch.view.terminal import HandView

    view = HandView(title)
    with Live(view.render(), refresh_per_second=_FRAMES_PER_S, screen=True, auto_refresh=False) as live:
        next_frame_s = time.monotonic()
        while not stop.is_set():
            message = messages.recv(max(0.0, next_frame_s - time.monotonic()))
            if message is not None:
                view.update(message)
            if time.monotonic() >= next_frame_s:
                live.update(view.render(messages.alive), refresh=True)
                next_frame_s = time.monotonic() + 1 / _FRAMES_PER_S


def show_lines(messages: Subscriber, stop: threading.Event, *, as_json: bool) -> None:
    """Print a line per message until `stop` is set; for people, updates of a contact are thinned out."""
    printed_ns: dict[str, int] = {}
    silent = False
    while not stop.is_set():
        message = messages.recv(0.2)
        if messages.alive == silent:
            silent = not messages.alive
            print(
                "the daemon is silent: is handtouch run up?" if silent else "the daemon is back",
                file=sys.stderr,
            )
        if message is None:
            continue
        if as_json:
            print(json.dumps(_plain(asdict(message))), flush=True)
        elif not isinstance(message, Contact) or message.event != "update":
            print(line(message), flush=True)
        elif message.t_ns - printed_ns.get(message.link, 0) >= 1e9 / _UPDATE_LINES_PER_S:
            printed_ns[message.link] = message.t_ns
            print(line(message), flush=True)


def _plain(value: Any) -> Any:
    """A value that JSON can hold: columns of bytes as hexadecimal."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value
