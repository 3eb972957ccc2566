"""`handtouch watch`: a live page in a terminal, plain or JSON lines anywhere else."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any, Protocol, Self

from handtouch import wire
from handtouch.client import LIVE, Subscriber, connect
from handtouch.view.lines import line

_FRAMES_PER_S = 15
_UPDATE_LINES_PER_S = 1


class Display(AbstractContextManager["Display"], Protocol):
    """Shows messages one way or another."""

    def take(self, message: wire.Message) -> None:
        """Show a message, at once or with the next frame."""

    def frame(self, alive: bool) -> None:
        """Draw; called `_FRAMES_PER_S` times a second with whether the daemon was heard lately."""


class LiveDisplay:
    """The live page, on the terminal's alternate screen."""

    def __init__(self, title: str) -> None:
        from rich.live import Live

        from handtouch.view.terminal import HandView

        self._view = HandView(title)
        self._live = Live(self._view, screen=True, auto_refresh=False)

    def take(self, message: wire.Message) -> None:
        self._view.update(message)

    def frame(self, alive: bool) -> None:
        self._view.alive = alive
        self._live.refresh()

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()


class LineDisplay:
    """A line per message; for people, what only repeats itself is thinned out."""

    def __init__(self, as_json: bool = False) -> None:
        self._as_json = as_json
        self._printed_ns: dict[tuple[str, str], int] = {}
        self._felt: dict[tuple[str, str], tuple[str, str]] = {}
        self._health: dict[tuple[str, str], tuple[str, ...]] = {}
        self._alive = True

    def take(self, message: wire.Message) -> None:
        if self._as_json:
            print(json.dumps(_plain(asdict(message))), flush=True)
            return
        if self._is_news(message):
            print(line(message), flush=True)

    def _is_news(self, message: wire.Message) -> bool:
        if isinstance(message, wire.Health):
            pad_state = "clear" if message.state == "touched" else message.state
            kinds = tuple(str(finding.get("kind")) for finding in message.findings)
            state = (pad_state, message.node, message.reason, message.trust, *kinds, *message.emergencies)
            pad = (message.hand, message.link)
            known, self._health[pad] = self._health.get(pad), state
            return state != known
        if isinstance(message, wire.Contact):
            pad = (message.hand, message.link)
            since_ns = message.t_ns - self._printed_ns.get(pad, 0)
            if message.event == "update" and since_ns < 1e9 / _UPDATE_LINES_PER_S:
                return False
            self._printed_ns[pad] = message.t_ns
        if isinstance(message, wire.Percept):
            what = (f"{message.kind} {message.hand}", message.link)
            state = (message.state, message.label)
            since_ns = message.t_ns - self._printed_ns.get(what, 0)
            known, self._felt[what] = self._felt.get(what), state
            if message.kind != "ask" and state == known and since_ns < 1e9 / _UPDATE_LINES_PER_S:
                return False
            self._printed_ns[what] = message.t_ns
        return True

    def frame(self, alive: bool) -> None:
        if alive != self._alive:
            self._alive = alive
            print(
                "the daemon is back" if alive else "the daemon is silent: is handtouch run up?",
                file=sys.stderr,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        sys.stdout.flush()


def follow(messages: Subscriber[wire.Message], display: Display, done: Callable[[], bool]) -> None:
    """Show messages as they come until `done`."""
    next_frame_s = 0.0
    while not done():
        message = messages.recv(max(0.0, next_frame_s - time.monotonic()))
        if message is not None:
            display.take(message)
        if time.monotonic() >= next_frame_s:
            display.frame(messages.alive)
            next_frame_s = time.monotonic() + 1 / _FRAMES_PER_S


def run(
    patterns: tuple[str, ...],
    *,
    endpoint: str = LIVE,
    key: str | None = None,
    style: str = "auto",
    seconds: float = 0,
) -> int:
    """Show messages until Ctrl-C, or for `seconds`; `style`: auto, plain or json.

    Exit status 0, 1 if nothing was heard in that time or the daemon doesn't let us in, 2 for wrong usage.
    Without a pattern, contacts and health; on a terminal that is the live page.
    """
    live = style == "auto" and sys.stdout.isatty() and not patterns
    wanted = patterns or (("contact/*/*", "health/*/*", "service") if live else ("contact/*/*", "health/*/*"))
    end_s = time.monotonic() + seconds if seconds else float("inf")
    try:
        messages = connect(*wanted, endpoint=endpoint, key=key)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    display: Display = LiveDisplay(f"handtouch at {endpoint}") if live else LineDisplay(style == "json")
    try:
        with messages, display:
            follow(messages, display, lambda: time.monotonic() > end_s)
            heard = messages.heard
    except PermissionError as error:
        print(error, file=sys.stderr)
        return 1
    if not heard:
        print(f"nothing was heard at {endpoint}: is handtouch run up?", file=sys.stderr)
    return 0 if heard else 1


def _plain(value: Any) -> Any:
    """A value that JSON can hold: columns of bytes as hexadecimal."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value
