"""Prompt and read single keys on a terminal; plain lines when standard input or output is a pipe.

Public names: `Key`, `DialogueCancelled`, `Dialogue`, `open_dialogue`, `TerminalDialogue`, `PlainDialogue`.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Protocol

from rich.console import Console
from rich.live import Live
from rich.text import Text

from handtouch.host.signals import InterruptGuard

_REDRAW_PERIOD_NS = 100_000_000
_STYLES = {"": "", "ask": "bold", "good": "green", "bad": "yellow"}


class Key(Enum):
    """Keys that a prompt accepts."""

    ENTER = ""
    AGAIN = "a"
    SKIP = "s"
    QUIT = "q"


class DialogueCancelled(Exception):  # noqa: N818 - not an error
    """The user ended the present step with a key."""

    def __init__(self, key: Key) -> None:
        self.key = key


class Dialogue(Protocol):
    """Output of lines and live text, and input of keys."""

    @property
    def accepts_keys(self) -> bool:
        """Keys can still be read: the input has not ended."""

    def print_line(self, text: str, style: str = "") -> None:
        """Print a line; `style`: "good", "bad", "ask" or none."""

    def show_live(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """Replace the live text by that of `draw`, which is called only if it is displayed."""

    def read_key(self) -> Key | None:
        """Return the next key without waiting, None if there is none. Raises KeyboardInterrupt on Ctrl-C."""


@contextlib.contextmanager
def open_dialogue() -> Iterator[Dialogue]:
    """Open a dialogue with live text if standard input and output are a terminal, else with plain lines.

    Until it is closed, `read_key` raises KeyboardInterrupt for SIGINT and SIGTERM; a second signal interrupts
    at once.
    """
    with InterruptGuard() as interrupts, _open(interrupts) as dialogue:
        yield dialogue


@contextlib.contextmanager
def _open(interrupts: InterruptGuard) -> Iterator[Dialogue]:
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        yield PlainDialogue(interrupts)
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        with Live(console=Console(highlight=False), auto_refresh=False, transient=True) as live:
            yield TerminalDialogue(live, interrupts)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class TerminalDialogue:
    """Lines with live text below; single keys without Enter."""

    accepts_keys = True

    def __init__(self, live: Live, interrupts: InterruptGuard) -> None:
        self._live, self._interrupts = live, interrupts
        self._last_drawn_ns = 0

    def print_line(self, text: str, style: str = "") -> None:
        """Print a line above the live text."""
        self._live.update(Text(""))
        self._live.console.print(Text(text, style=_STYLES[style]))

    def show_live(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """Redraw the live text at most ten times a second."""
        if t_ns - self._last_drawn_ns >= _REDRAW_PERIOD_NS:
            self._last_drawn_ns = t_ns
            self._live.update(draw(), refresh=True)

    def read_key(self) -> Key | None:
        """Return the next known key."""
        self._interrupts.check()
        while select.select([sys.stdin], (), (), 0)[0]:
            pressed = os.read(sys.stdin.fileno(), 1).decode(errors="replace").lower()
            if not pressed:
                self.accepts_keys = False
                return None
            if (key := _parse_key("" if pressed in "\r\n" else pressed)) is not None:
                return key
        return None


class PlainDialogue:
    """Plain lines, each flushed; a key is a line of input."""

    def __init__(self, interrupts: InterruptGuard) -> None:
        self.accepts_keys = True
        self._interrupts = interrupts
        self._pending_lines: deque[str] = deque()
        self._partial_line = b""

    def print_line(self, text: str, style: str = "") -> None:  # noqa: ARG002 - plain lines have no style
        """Print a line."""
        print(text, flush=True)

    def show_live(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """Do nothing: there is no live text."""

    def read_key(self) -> Key | None:
        """Return the next line that is a known key."""
        self._interrupts.check()
        self._read_lines()
        while self._pending_lines:
            if (key := _parse_key(self._pending_lines.popleft().strip().lower())) is not None:
                return key
        return None

    def _read_lines(self) -> None:
        while self.accepts_keys and select.select([sys.stdin], (), (), 0)[0]:
            data = os.read(sys.stdin.fileno(), 1024)
            if not data:
                self.accepts_keys = False
            *lines, self._partial_line = (self._partial_line + data).split(b"\n")
            self._pending_lines.extend(line.decode(errors="replace") for line in lines)


def _parse_key(text: str) -> Key | None:
    try:
        return Key(text)
    except ValueError:
        return None
