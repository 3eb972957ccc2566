"""Recording of a daemon's complete stream to MCAP files, in a process of its own.

Public names: `RecordOptions`, `Capture`.
"""

from __future__ import annotations

import itertools
import os
import platform
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from handtouch import __version__, wire
from handtouch.client import SERVICE_TIMEOUT_S, Subscriber
from handtouch.host.endpoints import COMPLETE_ENDPOINT
from handtouch.record.mcap_file import RecordingFile
from handtouch.record.recorder import MessageRecorder, NoScenes, RotationLimits, SceneConverter

PATTERNS = (
    "config",  # before the state, which is read with it
    *(topic.pattern for topic in wire.TOPICS if topic.prefix not in ("config", "hand", "raw", "percept")),
)
"""Recorded topics: all but hand frames, which follow from `tick`, and percepts, computed on request."""
BYTES_PER_MB = 1_000_000
_QUEUE_MESSAGES = 200_000
"""Messages queued while the disk is slow: a quarter of a minute of fifteen touched pads at 500 Hz."""
_POLL_PERIOD_S = 1.0


@dataclass(frozen=True)
class RecordOptions:
    """Recorded topics and destination; sizes in MB of 10^6 bytes."""

    config: Path | None = None
    out: Path = Path()
    endpoint: str = COMPLETE_ENDPOINT
    key: str | None = None
    seconds: float = 0.0
    """0: until stopped"""
    hand: bool = False
    """also record hand frames"""
    percepts: bool = False
    rotate_mb: float = 0.0
    rotate_minutes: float = 0.0
    keep_free_mb: float = 200.0
    marks: TextIO | None = None
    """each line is a mark; None: no marks"""


class RecordingFiles:
    """The files of one recording, named and opened one after another.

    Raises FileExistsError, NotADirectoryError or another OSError for a destination that can't be written.
    """

    def __init__(self, options: RecordOptions, endpoint: str) -> None:
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

    def open_next(self, t_ns: int) -> RecordingFile:
        """Open the next file, whose first message is of `t_ns`."""
        began = datetime.fromtimestamp(t_ns * 1e-9, UTC)
        number = len(self.paths) + 1
        if self._options.out.suffix != ".mcap":
            path = self.folder / f"handtouch-{began:%Y%m%dT%H%M%S}-{number:03}.mcap"
        elif number == 1:
            path = self._options.out
        else:  # the next free number: an earlier recording may have left files
            path = next(
                path
                for later in itertools.count(number)
                if not (path := self._options.out.with_stem(f"{self._options.out.stem}-{later:03}")).exists()
            )
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
        """Return the free space of the disk."""
        disk = os.statvfs(self.folder)
        return disk.f_bavail * disk.f_frsize


class Capture:
    """A recording of one daemon; use as a context manager, around `run`.

    Opened by `open`. `recorder` has the counts, `files` the paths; `end_reason`: why `run` returned before it
    was stopped, else empty. `has_foxglove`: Foxglove's topics are recorded, by the extra `foxglove`.
    """

    def __init__(self, options: RecordOptions, endpoint: str, source: Subscriber[Any]) -> None:
        self.endpoint = endpoint
        self.files = RecordingFiles(options, endpoint)
        make_scenes = _scene_converter()
        self.has_foxglove = make_scenes is not NoScenes
        self.recorder = MessageRecorder(self.files.open_next, _rotation_limits(options), make_scenes)
        self.end_reason = ""
        self._options, self._source = options, source

    @classmethod
    def open(cls, options: RecordOptions) -> Capture:
        """Subscribe to the daemon. Raises ConfigError, ValueError, OSError for wrong options."""
        topics = (*PATTERNS, *["hand/*"] * options.hand, *["percept/*/*"] * options.percepts)
        source = Subscriber[Any].open(topics, options.endpoint, _QUEUE_MESSAGES, options.key)
        try:
            return cls(options, options.endpoint, source)
        except OSError:
            source.close()
            raise

    def __enter__(self) -> Capture:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()

    def run(self, stop: threading.Event, on_poll: Callable[[bool], None] = lambda _: None) -> None:
        """Record until stopped, the time is over, or the disk is full; complete the file.

        `on_poll` is called once a second; its argument: the daemon has published lately. Raises
        PermissionError if the daemon rejects the key.
        """
        try:
            self.end_reason = self._record(stop, on_poll)
            self.recorder.finish()
        except PermissionError:
            raise
        except OSError as error:
            if self.files.latest is not None:
                self.files.latest.abandon()
            self.end_reason = (
                f"{error.strerror or error}: recording ended; the file is readable up to this point"
            )

    def _record(self, stop: threading.Event, on_poll: Callable[[bool], None]) -> str:
        options, source, recorder = self._options, self._source, self.recorder
        end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
        next_poll_s, received_s = 0.0, time.monotonic()
        marks = _read_marks(options.marks) if options.marks else None
        while not stop.is_set() and (now_s := time.monotonic()) < end_s:
            if (parts := source.recv_unchecked(0.1)) is not None:
                received_s = now_s
                recorder.add_message(parts, time.monotonic_ns())
            while marks and not marks.empty():
                recorder.add_mark(*marks.get())
            if now_s < next_poll_s:
                continue
            next_poll_s = now_s + _POLL_PERIOD_S
            recorder.poll(time.monotonic_ns())
            if recorder.state_requested:
                recorder.state_requested = False
                source.resubscribe("state")
            on_poll(now_s - received_s < SERVICE_TIMEOUT_S)
            if self.files.free_bytes() < options.keep_free_mb * BYTES_PER_MB:
                return (
                    f"less than {options.keep_free_mb:g} MB are free in {self.files.folder}: recording ended"
                )
        return ""


def _read_marks(lines: TextIO) -> queue.SimpleQueue[tuple[str, int]]:
    """Return a queue of lines and the times of reading them, since 1970 UTC, which a thread fills."""
    marks: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()

    def read() -> None:
        for line in lines:
            marks.put((line.strip(), time.time_ns()))

    threading.Thread(target=read, name="marks", daemon=True).start()
    return marks


def _scene_converter() -> Callable[[], SceneConverter]:
    """Return the maker of Foxglove's messages, or one that makes none if the extra isn't installed."""
    try:
        from handtouch.record.foxglove import FoxgloveConverter
    except ImportError:
        return NoScenes
    return FoxgloveConverter


def _rotation_limits(options: RecordOptions) -> RotationLimits:
    max_bytes = round(options.rotate_mb * BYTES_PER_MB)
    max_duration_ns = round(options.rotate_minutes * 60e9)
    return RotationLimits(max_bytes or 1 << 62, max_duration_ns or 1 << 62)
