"""`handtouch record`: a subscriber of the complete stream that writes MCAP; a slow disk is its own trouble.

Public names: `Options`, `run`.
"""

from __future__ import annotations

import os
import platform
import sys
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zmq

from handtouch import __version__, wire
from handtouch.client import SILENCE_S, Subscriber
from handtouch.config import ConfigError, load
from handtouch.record.file import RecordingFile
from handtouch.record.recorder import Limits, Recorder
from handtouch.signals import stop_on_signals

COMPLETE = "tcp://127.0.0.1:5582"
TOPICS = tuple(
    "/".join([topic.prefix, *["*"] * topic.parts])
    for topic in wire.TOPICS
    if topic.prefix not in ("hand", "raw", "percept")
)
"""All but frames of each tick, which follow from `tick`, and percepts, which are computed for who asks."""
_QUEUE = 200_000
"""Messages that wait here while the disk is slow: a quarter of a minute of fifteen touched pads at 500 Hz."""
_MB = 1_000_000
_LOOK_S = 1.0
_LINE_S = 10.0


@dataclass(frozen=True)
class Options:
    """What to record, and where to; sizes in MB of 10^6 bytes."""

    config: Path | None = None
    out: Path = Path()
    endpoint: str | None = None
    key: str | None = None
    seconds: float = 0.0
    """0: until told to stop"""
    hand: bool = False
    """frames of the whole hand too"""
    percepts: bool = False
    rotate_mb: float = 0.0
    rotate_minutes: float = 0.0
    keep_free_mb: float = 200.0


class _Wire(Subscriber[Any]):
    """Messages as they came."""

    def parts(self, wait_ms: int) -> list[bytes] | None:
        """The next message, None after `wait_ms` without one. Raises PermissionError."""
        while True:
            try:
                return list(self._socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                if not self._door.poll(wait_ms):
                    return None

    def ask_for_state(self) -> None:
        """Who subscribes is told."""
        self._socket.unsubscribe("state")
        self._socket.subscribe("state")


class _Files:
    """Names and opens one file after another."""

    def __init__(self, options: Options, endpoint: str) -> None:
        self._options, self._endpoint = options, endpoint
        self.paths: list[Path] = []
        self.latest: RecordingFile | None = None
        if options.out.suffix == ".mcap":
            self.folder = options.out.parent
        else:
            self.folder = options.out
            self.folder.mkdir(parents=True, exist_ok=True)
        if options.out.suffix == ".mcap" and options.out.exists():
            raise FileExistsError(f"-o {options.out}: exists already; give another name")
        if not os.access(self.folder, os.W_OK):
            raise NotADirectoryError(f"-o {options.out}: can't write to the folder {self.folder}")

    def open(self, t_ns: int) -> RecordingFile:
        """The next file; its first message is of `t_ns`."""
        began = datetime.fromtimestamp(t_ns * 1e-9, UTC)
        number = len(self.paths) + 1
        if self._options.out.suffix != ".mcap":
            path = self.folder / f"handtouch-{began:%Y%m%dT%H%M%S}-{number:03}.mcap"
        elif number == 1:
            path = self._options.out
        else:
            path = self._options.out.with_stem(f"{self._options.out.stem}-{number:03}")
        about = {
            "handtouch": __version__,
            "host": platform.node(),
            "endpoint": self._endpoint,
            "began": began.isoformat(),
            "part": str(number),
        }
        self.latest = RecordingFile(path, about)
        if self._options.config is not None:
            text = self._options.config.read_bytes()
            self.latest.attach(self._options.config.name, "application/toml", text, t_ns)
        self.paths.append(path)
        return self.latest

    def free_bytes(self) -> int:
        """Room that is left on the disk."""
        disk = os.statvfs(self.folder)
        return disk.f_bavail * disk.f_frsize


class _Progress:
    """A line that is kept up to date on a terminal; elsewhere one now and then."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._began_s = self._said_s = time.monotonic()

    def say(self, recorder: Recorder, files: _Files, alive: bool) -> None:
        now_s = time.monotonic()
        if not self._terminal and now_s - self._said_s < _LINE_S:
            return
        self._said_s = now_s
        line = _status(recorder, files, alive, now_s - self._began_s)
        print(f"\r\x1b[2K{line}" if self._terminal else line, end="" if self._terminal else "\n",
              file=sys.stderr, flush=True)  # fmt: skip

    def tell(self, words: str) -> None:
        """Words of their own line."""
        print(f"\r\x1b[2K{words}" if self._terminal else words, file=sys.stderr, flush=True)


def _status(recorder: Recorder, files: _Files, alive: bool, seconds: float) -> str:
    if not alive:
        return "the daemon is silent: is handtouch run up?"
    rate = recorder.size / max(seconds, 1.0)
    left = ""
    if rate:
        minutes = files.free_bytes() / rate / 60
        left = f", room for {minutes:.0f} min" if minutes < 600 else ""
    lost = sum(recorder.lost.values())
    return (
        f"{seconds:.0f} s, {recorder.size / _MB:.1f} MB ({60 * rate / _MB:.1f} MB/min), "
        f"{recorder.messages['tick']} ticks, {recorder.contacts} contacts, {lost} lost{left}"
    )


def run(options: Options) -> int:
    """Record until Ctrl-C, or for so many seconds.

    Exit status 0; 1 where nothing was heard, messages were lost, the disk is full or the daemon doesn't let
    us in; 2 for wrong usage or file.
    """
    try:
        endpoint = _endpoint(options)
        files = _Files(options, endpoint)
        topics = (*TOPICS, *["hand/*"] * options.hand, *["percept/*/*"] * options.percepts)
        source = _Wire(topics, endpoint, _QUEUE, options.key)
    except (ConfigError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    stop = stop_on_signals()
    limits = Limits(
        *(round(value * unit) or 1 << 62 for value, unit in (
            (options.rotate_mb, _MB), (options.rotate_minutes, 60_000_000_000)
        ))
    )  # fmt: skip
    recorder = Recorder(files.open, limits)
    progress = _Progress()
    progress.tell(f"recording {endpoint} into {files.folder or '.'}; Ctrl-C ends it")
    with source:
        try:
            ended = _loop(options, source, recorder, files, progress, stop)
            recorder.finish()
        except PermissionError as error:
            progress.tell(str(error))
            return 1
        except OSError as error:
            if files.latest is not None:
                files.latest.abandon()
            ended = f"{error.strerror or error}: recording ends here, and can be read up to here"
    return _end(recorder, files, progress, ended)


def _loop(
    options: Options,
    source: _Wire,
    recorder: Recorder,
    files: _Files,
    progress: _Progress,
    stop: threading.Event,
) -> str:
    """Record; why it ended, empty where it was told to. Raises OSError, PermissionError."""
    end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
    look_s, heard_s = 0.0, time.monotonic()
    while not stop.is_set() and (now_s := time.monotonic()) < end_s:
        if (parts := source.parts(100)) is not None:
            heard_s = now_s
            recorder.take(parts, time.monotonic_ns())
        if now_s < look_s:
            continue
        look_s = now_s + _LOOK_S
        recorder.poll(time.monotonic_ns())
        if recorder.asks:
            recorder.asks = False
            source.ask_for_state()
        progress.say(recorder, files, now_s - heard_s < SILENCE_S)
        if files.free_bytes() < options.keep_free_mb * _MB:
            return f"less than {options.keep_free_mb:g} MB are free in {files.folder}: recording ends here"
    return ""


def _end(recorder: Recorder, files: _Files, progress: _Progress, ended: str) -> int:
    summary = recorder.summary()
    progress.tell(
        f"{summary['messages']} messages, {summary['ticks']} ticks, {summary['contacts']} contacts, "
        f"{recorder.size / _MB:.1f} MB in {', '.join(map(str, files.paths)) or 'no file'}"
    )
    for topic, count in sorted(recorder.lost.items()):
        progress.tell(f"{count} messages of {topic} were lost: disk or machine are too slow for them")
    if recorder.malformed:
        progress.tell(f"{recorder.malformed} messages were dropped: they don't keep the contract")
    if ended:
        progress.tell(ended)
    elif not files.paths:
        progress.tell("nothing was heard: is handtouch run up?")
    well = files.paths and not ended and not recorder.lost and not recorder.malformed
    return 0 if well else 1


def _endpoint(options: Options) -> str:
    """Where the complete stream is. Raises ConfigError, ValueError."""
    if options.endpoint is not None:
        return options.endpoint
    if options.config is None:
        return COMPLETE
    endpoint = load(options.config).daemon.complete
    if endpoint.endswith(":*"):
        raise ValueError(f"{options.config}: {endpoint} is any free port; give --endpoint")
    return endpoint.replace("tcp://*:", "tcp://127.0.0.1:").replace("tcp://0.0.0.0:", "tcp://127.0.0.1:")
