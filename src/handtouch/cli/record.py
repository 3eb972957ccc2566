"""The command `handtouch record`: progress and summary.

Public name: `run`.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from handtouch.config import ConfigError
from handtouch.host.signals import stop_on_signals
from handtouch.record.capture import BYTES_PER_MB, Capture, RecordOptions

_PROGRESS_PERIOD_S = 10.0
_MAX_SHOWN_MINUTES = 600


def run(**options: Any) -> int:
    """Record until Ctrl-C, or for the given time; `options` as of `record.capture.RecordOptions`.

    Exit status 0; 1 if no message was received, messages were lost, the disk is full or the daemon rejects
    the key; 2 for wrong usage or file.
    """
    try:
        capture = Capture.open(RecordOptions(**options))
    except (ConfigError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    stop = stop_on_signals()
    progress = _ProgressLine(capture)
    progress.print_line(f"recording {capture.endpoint} into {capture.files.folder or '.'}; stop with Ctrl-C")
    with capture:
        try:
            capture.run(stop, progress.update)
        except PermissionError as error:
            progress.print_line(str(error))
            return 1
    return _print_summary(capture, progress)


class _ProgressLine:
    """A status line, kept up to date on a terminal; elsewhere printed every ten seconds."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._terminal = sys.stderr.isatty()
        self._started_s = self._printed_s = time.monotonic()

    def update(self, alive: bool) -> None:
        """Show the progress; `alive`: the daemon has published lately."""
        now_s = time.monotonic()
        if not self._terminal and now_s - self._printed_s < _PROGRESS_PERIOD_S:
            return
        self._printed_s = now_s
        line = _progress_text(self._capture, alive, now_s - self._started_s)
        print(f"\r\x1b[2K{line}" if self._terminal else line, end="" if self._terminal else "\n",
              file=sys.stderr, flush=True)  # fmt: skip

    def print_line(self, text: str) -> None:
        """Print a line of its own."""
        print(f"\r\x1b[2K{text}" if self._terminal else text, file=sys.stderr, flush=True)


def _progress_text(capture: Capture, alive: bool, seconds: float) -> str:
    if not alive:
        return "no message from the daemon; is `handtouch run` running?"
    recorder = capture.recorder
    rate = recorder.size / max(seconds, 1.0)
    left = ""
    if rate:
        minutes = capture.files.free_bytes() / rate / 60
        left = f", disk full in {minutes:.0f} min" if minutes < _MAX_SHOWN_MINUTES else ""
    lost = sum(recorder.lost.values())
    return (
        f"{seconds:.0f} s, {recorder.size / BYTES_PER_MB:.1f} MB ({60 * rate / BYTES_PER_MB:.1f} MB/min), "
        f"{recorder.messages['tick']} ticks, {recorder.contacts} contacts, {lost} lost{left}"
    )


def _print_summary(capture: Capture, progress: _ProgressLine) -> int:
    recorder, paths = capture.recorder, capture.files.paths
    summary = recorder.summary()
    progress.print_line(
        f"{summary['messages']} messages, {summary['ticks']} ticks, {summary['contacts']} contacts, "
        f"{recorder.size / BYTES_PER_MB:.1f} MB in {', '.join(map(str, paths)) or 'no file'}"
    )
    for topic, count in sorted(recorder.lost.items()):
        progress.print_line(f"{topic}: {count} messages lost; disk or machine are too slow")
    if recorder.malformed:
        progress.print_line(f"{recorder.malformed} malformed messages dropped")
    if capture.end_reason:
        progress.print_line(capture.end_reason)
    elif not paths:
        progress.print_line("no message received; is `handtouch run` running?")
    complete = paths and not capture.end_reason and not recorder.lost and not recorder.malformed
    return 0 if complete else 1
