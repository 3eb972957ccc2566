"""Words to a terminal or a pipe, and keys from it.

Public names: `Key`, `Dialogue`, `open_dialogue`, `Terminal`, `Lines`.
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

from handtouch.signals import Interrupts

_REDRAW_NS = 100_000_000
_STYLES = {"": "", "ask": "bold", "good": "green", "bad": "yellow"}


class Key(Enum):
    """What the person may say."""

    ENTER = ""
    AGAIN = "a"
    SKIP = "s"
    QUIT = "q"


class Dialogue(Protocol):
    """Where words go, and keys come from."""

    @property
    def listens(self) -> bool:
        """Whether anybody can still press a key."""

    def say(self, text: str, style: str = "") -> None:
        """A line that stays; `style`: "good", "bad", "ask" or nothing."""

    def show(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """What is felt now, in the place of what was shown before; drawn only where somebody sees it."""

    def key(self) -> Key | None:
        """The next key pressed, None if there is none; doesn't wait. Raises KeyboardInterrupt once Ctrl-C
        was."""


@contextlib.contextmanager
def open_dialogue() -> Iterator[Dialogue]:
    """Live feedback where standard input and output are a terminal, else plain lines.

    Until it is closed, SIGINT and SIGTERM are told by `key`; a second one interrupts whatever is done.
    """
    with Interrupts() as interrupts, _opened(interrupts) as dialogue:
        yield dialogue


@contextlib.contextmanager
def _opened(interrupts: Interrupts) -> Iterator[Dialogue]:
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        yield Lines(interrupts)
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        with Live(console=Console(highlight=False), auto_refresh=False, transient=True) as live:
            yield Terminal(live, interrupts)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class Terminal:
    """Lines above, what is felt now below; single keys, without Enter behind them."""

    listens = True

    def __init__(self, live: Live, interrupts: Interrupts) -> None:
        self._live, self._interrupts = live, interrupts
        self._drawn_ns = 0

    def say(self, text: str, style: str = "") -> None:
        """A line that stays."""
        self._live.update(Text(""))
        self._live.console.print(Text(text, style=_STYLES[style]))

    def show(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """Ten times a second."""
        if t_ns - self._drawn_ns >= _REDRAW_NS:
            self._drawn_ns = t_ns
            self._live.update(draw(), refresh=True)

    def key(self) -> Key | None:
        """The next key; others than ours are ignored."""
        self._interrupts.check()
        while select.select([sys.stdin], (), (), 0)[0]:
            pressed = os.read(sys.stdin.fileno(), 1).decode(errors="replace").lower()
            if not pressed:
                self.listens = False
                return None
            if (key := _key("" if pressed in "\r\n" else pressed)) is not None:
                return key
        return None


class Lines:
    """Plain lines, each flushed; keys are lines too. When the input ends, nobody listens any more."""

    def __init__(self, interrupts: Interrupts) -> None:
        self.listens = True
        self._interrupts = interrupts
        self._waiting: deque[str] = deque()
        self._part = b""

    def say(self, text: str, style: str = "") -> None:  # noqa: ARG002 - plain lines have no style
        """A line."""
        print(text, flush=True)

    def show(self, t_ns: int, draw: Callable[[], Text]) -> None:
        """Nothing: only what stays is written."""

    def key(self) -> Key | None:
        """The next line, as far as it is a key."""
        self._interrupts.check()
        self._read()
        while self._waiting:
            if (key := _key(self._waiting.popleft().strip().lower())) is not None:
                return key
        return None

    def _read(self) -> None:
        while self.listens and select.select([sys.stdin], (), (), 0)[0]:
            data = os.read(sys.stdin.fileno(), 1024)
            if not data:
                self.listens = False
            *lines, self._part = (self._part + data).split(b"\n")
            self._waiting.extend(line.decode(errors="replace") for line in lines)


def _key(text: str) -> Key | None:
    try:
        return Key(text)
    except ValueError:
        return None
