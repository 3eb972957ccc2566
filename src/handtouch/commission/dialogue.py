"""Words to a terminal or a pipe, and keys from it.

Public names: `open_dialogue`, `Terminal`, `Lines`.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections import deque
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from .outcome import Dialogue, Key
from .press import PRESSED, PressDetector

_REDRAW_NS = 100_000_000
_BAR = 40
_STYLES = {"": "", "ask": "bold", "good": "green", "bad": "yellow"}


@contextlib.contextmanager
def open_dialogue() -> Iterator[Dialogue]:
    """Live feedback where standard input and output are a terminal, else plain lines."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        yield Lines()
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        with Live(console=Console(highlight=False), auto_refresh=False, transient=True) as live:
            yield Terminal(live)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class Terminal:
    """Lines above, the channels of the pad in question below; single keys, without Enter behind them."""

    listens = True

    def __init__(self, live: Live) -> None:
        self._live = live
        self._drawn_ns = 0

    def say(self, text: str, style: str = "") -> None:
        """A line that stays."""
        self._live.update(Text(""))
        self._live.console.print(Text(text, style=_STYLES[style]))

    def show(self, t_ns: int, slot: int, name: str, detector: PressDetector) -> None:
        """Four bars, ten times a second."""
        if t_ns - self._drawn_ns >= _REDRAW_NS:
            self._drawn_ns = t_ns
            self._live.update(bars(slot, name, detector), refresh=True)

    def key(self) -> Key | None:
        """The next key; others than ours are ignored."""
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

    def __init__(self) -> None:
        self.listens = True
        self._waiting: deque[str] = deque()
        self._part = b""

    def say(self, text: str, style: str = "") -> None:  # noqa: ARG002 - plain lines have no style
        """A line."""
        print(text, flush=True)

    def show(self, t_ns: int, slot: int, name: str, detector: PressDetector) -> None:
        """Nothing: only what stays is written."""

    def key(self) -> Key | None:
        """The next line, as far as it is a key."""
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


def bars(slot: int, name: str, detector: PressDetector) -> Text:
    """The channels of a slot, on a scale to the strongest, from the least that counts as a press."""
    deltas = detector.deltas[slot]
    scale = max(float(np.abs(deltas).max()), PRESSED * float(detector.noise[slot]) / 2)
    pressed = detector.level[slot] > PRESSED
    text = Text()
    for channel, delta in enumerate(deltas.tolist(), 1):
        filled = round(_BAR * abs(delta) / scale)
        text.append(f"  {channel} ", "dim")
        text.append("█" * filled, "cyan" if pressed else "dim")
        text.append("·" * (_BAR - filled), "dim")
        text.append(f" {delta:+7.0f}\n")
    text.append(f"  {name}   a: again, s: skip, q: quit", "dim")
    return text


def _key(text: str) -> Key | None:
    try:
        return Key(text)
    except ValueError:
        return None
