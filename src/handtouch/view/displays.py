"""Displays of messages in a terminal: a live table, or one line per message.

Public names: `Display`, `LiveDisplay`, `LineDisplay`, `show_messages`.
"""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, Self

from handtouch import wire
from handtouch.client import Subscriber
from handtouch.host.json_output import print_json_line
from handtouch.view.message_lines import DISCONNECTED_TEXT, active_errors, message_line

_FRAMES_PER_S = 15
_MAX_UPDATE_LINES_PER_S = 1
_INDENT = 16 * " "
"""of continued lines: the width of a time"""


class Display(AbstractContextManager["Display"], Protocol):
    """Shows messages as they are received."""

    def show_message(self, message: wire.Message) -> None:
        """Show a message, at once or with the next frame."""

    def refresh(self, problem: str) -> None:
        """Redraw, `_FRAMES_PER_S` times a second; `problem`: why no daemon is connected, "" while one is."""


class LiveDisplay:
    """The live table, on the terminal's alternate screen."""

    def __init__(self, title: str) -> None:
        from rich.live import Live

        from handtouch.view.terminal import HandView

        self._view = HandView(title)
        self._live = Live(self._view, screen=True, auto_refresh=False)

    def show_message(self, message: wire.Message) -> None:
        self._view.update(message)

    def refresh(self, problem: str) -> None:
        self._view.problem = problem
        self._live.refresh()

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()


class LineDisplay:
    """One line per message; plain lines omit repetitions, JSON lines contain every message.

    `columns`: width that plain lines are shortened to, and those with a reason wrapped at; None: not.
    """

    def __init__(self, as_json: bool = False, columns: int | None = None) -> None:
        self._as_json = as_json
        self._columns = columns
        self._printed_ns: dict[tuple[str, str], int] = {}
        self._percepts: dict[tuple[str, str], tuple[str, str]] = {}
        self._health: dict[tuple[str, str], tuple[str, ...]] = {}
        self._has_problem = False

    def show_message(self, message: wire.Message) -> None:
        if self._as_json:
            print_json_line(message)
            return
        if self._has_changed(message):
            line = message_line(message)
            if self._columns is not None and len(line) > self._columns:
                if isinstance(message, wire.Health):  # its reason and remedy are at the end
                    line = textwrap.fill(line, self._columns, subsequent_indent=_INDENT)
                else:
                    line = line[: self._columns - 1] + "…"
            print(line, flush=True)

    def _has_changed(self, message: wire.Message) -> bool:
        if isinstance(message, wire.Health):
            pad_state = "clear" if message.state == "touched" else message.state
            kinds = tuple(str(diagnosis.get("kind")) for diagnosis in message.diagnoses)
            state = (
                pad_state,
                message.node_state,
                message.reason,
                message.calibration_state,
                *kinds,
                *active_errors(message),
            )
            pad = (message.hand, message.link)
            known, self._health[pad] = self._health.get(pad), state
            return state != known
        if isinstance(message, wire.Contact):
            pad = (message.hand, message.link)
            since_ns = message.t_ns - self._printed_ns.get(pad, 0)
            if message.event == "update" and since_ns < 1e9 / _MAX_UPDATE_LINES_PER_S:
                return False
            self._printed_ns[pad] = message.t_ns
        if isinstance(message, wire.Percept):
            topic = (f"{message.kind} {message.hand}", message.link)
            state = (message.state, message.label)
            since_ns = message.t_ns - self._printed_ns.get(topic, 0)
            known, self._percepts[topic] = self._percepts.get(topic), state
            if (
                message.kind != "action_request"
                and state == known
                and since_ns < 1e9 / _MAX_UPDATE_LINES_PER_S
            ):
                return False
            self._printed_ns[topic] = message.t_ns
        return True

    def refresh(self, problem: str) -> None:
        if bool(problem) != self._has_problem:
            self._has_problem = bool(problem)
            print(problem or "daemon connected again", file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        sys.stdout.flush()


def show_messages(messages: Subscriber[wire.Message], display: Display, done: Callable[[], bool]) -> None:
    """Show received messages until `done`."""
    next_frame_s = 0.0
    while not done():
        message = messages.recv(max(0.0, next_frame_s - time.monotonic()))
        if message is not None:
            display.show_message(message)
        if time.monotonic() >= next_frame_s:
            lost = DISCONNECTED_TEXT if messages.has_received else messages.connection.reason_of_silence
            display.refresh("" if messages.alive else lost)
            next_frame_s = time.monotonic() + 1 / _FRAMES_PER_S
