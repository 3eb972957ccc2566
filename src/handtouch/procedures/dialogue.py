"""Prompt and read single keys on a terminal; plain lines when standard input or output is a pipe.

Public names: `Key`, `DialogueCancelled`, `Dialogue`, `open_dialogue`, `TerminalDialogue`, `PlainDialogue`;
`GuidedProcedure`, the base of procedures with an operator.
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
from typing import Generic, Protocol, TypeVar

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


class TimedSample(Protocol):
    """A sample with its time."""

    @property
    def sync_ns(self) -> int: ...


Sample = TypeVar("Sample", bound=TimedSample)


class GuidedProcedure(Generic[Sample]):
    """A procedure with an operator. Samples, which come without end, carry its time.

    timeout_s: of waiting for the operator. key_at_timeout: taken for an answer that doesn't come.
    """

    key_at_timeout = Key.QUIT

    def __init__(self, samples: Iterator[Sample], dialogue: Dialogue, timeout_s: float) -> None:
        self._samples, self._dialogue = samples, dialogue
        self._timeout_ns = round(timeout_s * 1e9)

    def timed_samples(self) -> Iterator[tuple[Sample, int]]:
        """Yield the next samples, each with the time since the first of them [ns]."""
        start_ns: int | None = None
        for sample in self._samples:
            start_ns = sample.sync_ns if start_ns is None else start_ns
            yield sample, sample.sync_ns - start_ns

    def ask_key(self, question: str) -> Key:
        """Wait for a key; `key_at_timeout` after the time limit, or without keyboard input."""
        self.print_line(f"  {question}", "ask")
        for sample, waited_ns in self.timed_samples():
            self.observe(sample)
            if (key := self._dialogue.read_key()) is not None:
                return key
            if not self._dialogue.accepts_keys or waited_ns > self._timeout_ns:
                break
        return self.key_at_timeout

    def observe(self, sample: Sample) -> None:
        """Process a sample that comes while a key is awaited."""

    def raise_on_key(self) -> None:
        """Raise DialogueCancelled for any key but Enter."""
        key = self._dialogue.read_key()
        if key is not None and key is not Key.ENTER:
            raise DialogueCancelled(key)

    def print_line(self, text: str, style: str = "") -> None:
        """Print a line; styles as in `Dialogue`."""
        self._dialogue.print_line(text, style)


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
