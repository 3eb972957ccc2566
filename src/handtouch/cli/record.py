"""The command `handtouch record`: progress and summary.

Public name: `run`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from handtouch.cli.errors import failing
from handtouch.cli.options import (
    add_endpoint,
    add_json,
    add_number,
    add_output,
    add_percepts,
    find_endpoint,
)
from handtouch.cli.progress import ProgressLine
from handtouch.host.installation import extra_command
from handtouch.host.json_output import print_json
from handtouch.host.signals import stop_on_signals
from handtouch.record.capture import BYTES_PER_MB, Capture, RecordOptions
from handtouch.record.schemas import MARK

NO_MESSAGE_TEXT = "no message received; is `handtouch run` running?"
_MAX_SHOWN_MINUTES = 600


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `record`."""
    parser.set_defaults(command=run)
    parser.add_argument(
        "config",
        metavar="CONFIG",
        type=Path,
        nargs="?",
        help="deployment file of the daemon, for its endpoint; stored in the recording",
    )
    add_output(
        parser,
        "out",
        "new .mcap file, or folder (default: the current folder)",
        default=Path(),
        metavar="PATH",
    )
    add_json(parser, "print a summary as JSON at the end")
    add_endpoint(parser, "complete", config=False)
    add_number(parser, "--seconds", "S", "duration (default: until Ctrl-C)", default=0.0)
    parser.add_argument(
        "--hand",
        action="store_true",
        help="also record hand frames, all pads in one message per tick (not needed: replay recomputes them)",
    )
    add_percepts(parser)
    parser.add_argument(
        "--marks",
        action="store_true",
        help="each line on standard input marks a moment, at which an exported dataset begins an episode: "
        "its text is the task, - leaves out what follows",
    )
    add_number(parser, "--rotate-mb", "MB", "start a new file after this size (default: never)", default=0.0)
    add_number(
        parser, "--rotate-minutes", "MIN", "start a new file after this time (default: never)", default=0.0
    )
    add_number(
        parser, "--keep-free-mb", "MB", "stop when the disk has less free space than this", default=200.0
    )


def run(*, as_json: bool, marks: bool = False, **options: Any) -> int:
    """Record until Ctrl-C, or for the given time; other `options` as of `record.capture.RecordOptions`.

    Exit status 0; 1 if no message was received, messages were lost, the disk is full or the daemon rejects
    the key; 2 for wrong usage or file.
    """
    with failing(2, ValueError, OSError):
        endpoint = find_endpoint("complete", options.pop("endpoint", None), options.get("config"))
        lines = sys.stdin if marks else None
        capture = Capture.open(RecordOptions(endpoint=endpoint, marks=lines, **options))
    stop = stop_on_signals()
    with ProgressLine() as line:
        line.print_line(f"recording {capture.endpoint} into {capture.files.folder or '.'}; stop with Ctrl-C")
        if not capture.has_foxglove:
            line.print_line(
                f"without Foxglove's topics (/handtouch/...); for them: {extra_command('foxglove')}"
            )
        with failing(1, PermissionError), capture:
            capture.run(stop, _RecordingProgress(capture, line).update)
        return _print_summary(capture, line, as_json)


class _RecordingProgress:
    """A progress line on a terminal; elsewhere a line when the daemon connects or disconnects."""

    def __init__(self, capture: Capture, line: ProgressLine) -> None:
        self._capture, self._line = capture, line
        self._began_s = time.monotonic()
        self._was_alive = True

    def update(self, alive: bool) -> None:
        """Show the progress; `alive`: the daemon has published lately."""
        if alive != self._was_alive and not self._line.shown:
            self._line.print_line("messages are received again" if alive else NO_MESSAGE_TEXT)
        self._was_alive = alive
        seconds = time.monotonic() - self._began_s
        self._line.update(_progress_text(self._capture, seconds) if alive else NO_MESSAGE_TEXT)


def _progress_text(capture: Capture, seconds: float) -> str:
    recorder = capture.recorder
    rate = recorder.size / max(seconds, 1.0)
    left = ""
    if rate:
        minutes = capture.files.free_bytes() / rate / 60
        left = f", disk full in {minutes:.0f} min" if minutes < _MAX_SHOWN_MINUTES else ""
    lost = sum(recorder.lost.values())
    marks = f", {recorder.messages[MARK]} marks" if recorder.messages[MARK] else ""
    return (
        f"{seconds:.0f} s, {recorder.size / BYTES_PER_MB:.1f} MB ({60 * rate / BYTES_PER_MB:.1f} MB/min), "
        f"{recorder.messages['tick']} ticks, {recorder.contacts} contacts, {lost} lost{marks}{left}"
    )


def _print_summary(capture: Capture, progress: ProgressLine, as_json: bool) -> int:
    recorder, paths = capture.recorder, capture.files.paths
    summary = recorder.summary()
    progress.print_line(
        f"{summary['messages']} messages, {summary['ticks']} ticks, {summary['contacts']} contacts, "
        f"{recorder.size / BYTES_PER_MB:.1f} MB in {', '.join(map(str, paths)) or 'no file'}"
    )
    if as_json:
        counts = {"messages": sum(recorder.messages.values()), "ticks": recorder.messages["tick"]}
        print_json(
            {
                "files": paths,
                "bytes": recorder.size,
                **counts,
                "contacts": recorder.contacts,
                "lost": dict(recorder.lost),
                "malformed": recorder.malformed,
                "end_reason": capture.end_reason,
            }
        )
    for topic, count in sorted(recorder.lost.items()):
        progress.print_line(f"{topic}: {count} messages lost; disk or machine are too slow")
    if recorder.malformed:
        progress.print_line(f"{recorder.malformed} malformed messages dropped")
    if capture.end_reason:
        progress.print_line(capture.end_reason)
    elif not paths:
        progress.print_line(NO_MESSAGE_TEXT)
    complete = paths and not capture.end_reason and not recorder.lost and not recorder.malformed
    return 0 if complete else 1
