"""Progress of long commands: one line on standard error, only if that is a terminal.

Public name: `ProgressLine`.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from typing import Self

_PERIOD_S = 0.1
_ERASE_LINE = "\r\x1b[2K"


class ProgressLine:
    """A line that each update overwrites, at most ten times a second, and that the end erases.

    Nothing is written if standard error isn't a terminal, or a terminal without control sequences.
    """

    def __init__(self) -> None:
        self.shown = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._next_s = 0.0

    def update(self, text: str) -> None:
        """Show a text, cut to the width of the terminal."""
        now_s = time.monotonic()
        if not self.shown or now_s < self._next_s:
            return
        self._next_s = now_s + _PERIOD_S
        print(
            _ERASE_LINE + text[: shutil.get_terminal_size().columns - 1], end="", file=sys.stderr, flush=True
        )

    def print_line(self, text: str) -> None:
        """Print a line that stays, terminal or not."""
        self.erase()
        print(text, file=sys.stderr, flush=True)

    def erase(self) -> None:
        """Erase the line, so that other output can follow."""
        if self.shown:
            print(_ERASE_LINE, end="", file=sys.stderr, flush=True)
            self._next_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.erase()
