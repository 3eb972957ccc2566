"""What the daemon says: lines for people, fields for the journal; saying it never delays a tick.

Public names: `start`, `Logs`, `set_level`, `LEVELS`.

Loggers put records into a bounded queue; a thread of its own writes them, as slowly as disk or pipe allow.
What the queue can't take is dropped and counted, and of one cause that repeats a few are said, then their
number.
"""

from __future__ import annotations

import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

LEVELS = ("debug", "info", "warning", "error")
_ROOT = "handtouch"
_QUEUE = 1000
_BURST, _WINDOW_NS = 10, 10_000_000_000
"""Messages of one cause that are said in a window of time."""
_CAUSES = 1000
"""Known at a time; beyond them, what a message is about is no longer told apart."""
_LOOK_NS = 1_000_000_000
_FLUSH_S = 1.0
"""Longest that the end waits for a reader who doesn't read."""
_JOURNAL = "/run/systemd/journal/socket"
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

Cause = tuple[str, str, str]


class Outlet(Protocol):
    """Where the writing thread puts what is to be said."""

    def write(self, record: logging.LogRecord) -> None: ...

    def close(self) -> None: ...


def set_level(level: str) -> None:
    """Say what is at least so grave, from now on. Raises ValueError naming the levels."""
    if level not in LEVELS:
        raise ValueError(f"log level {level!r:.40}: must be one of {', '.join(LEVELS)}")
    logging.getLogger(_ROOT).setLevel(level.upper())


def start(level: str = "info", environment: Mapping[str, str] = os.environ) -> Logs:
    """Send what all loggers say to the journal, where stderr is one, or to stderr; `close` it at the end."""
    outlet: Outlet
    if not _is_journal(2, environment.get("JOURNAL_STREAM", "")):
        outlet = Lines(2)
    elif Path(_JOURNAL).exists():
        outlet = Journal(_JOURNAL)
    else:
        outlet = Lines(2, with_fields=True)
    logs = Logs(outlet)
    root = logging.getLogger()
    root.setLevel(logging.WARNING)  # other packages
    root.handlers[:] = [logs]
    set_level(level)
    return logs


class Limit:
    """Which messages of a cause still pass; the same text about the same thing is one cause. Times in ns."""

    def __init__(self, burst: int = _BURST, window_ns: int = _WINDOW_NS) -> None:
        self._burst, self._window_ns = burst, window_ns
        self._causes: dict[Cause, list[int]] = {}  # since when, how many
        self._lock = threading.Lock()

    def passes(self, cause: Cause, now_ns: int) -> bool:
        """Whether to say another of this cause."""
        with self._lock:
            if len(self._causes) >= _CAUSES and cause not in self._causes:
                cause = (*cause[:2], "")
            seen = self._causes.setdefault(cause, [now_ns, 0])
            if now_ns - seen[0] >= self._window_ns and seen[1] <= self._burst:
                seen[:] = [now_ns, 0]
            seen[1] += 1
            return seen[1] <= self._burst

    def over(self, now_ns: int) -> list[tuple[Cause, int]]:
        """Causes whose window is over, with how many weren't said; they start anew."""
        with self._lock:
            done = [cause for cause, seen in self._causes.items() if now_ns - seen[0] >= self._window_ns]
            counts = [(cause, self._causes.pop(cause)[1] - self._burst) for cause in done]
        return [(cause, count) for cause, count in counts if count > 0]


class Logs(logging.Handler):
    """Queues records for its thread. `dropped`: the queue had no room for them; `silenced`: repeated."""

    def __init__(
        self, outlet: Outlet, clock: Callable[[], int] = time.monotonic_ns, limit: Limit | None = None
    ) -> None:
        super().__init__()
        self.dropped = self.silenced = 0
        self._outlet, self._clock = outlet, clock
        self._limit = limit or Limit()
        self._queue: queue.Queue[logging.LogRecord | None] = queue.Queue(_QUEUE)
        self._told_dropped = 0
        self._looked_ns = clock()
        self._thread = threading.Thread(target=self._write, name="handtouch-log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record, or count it."""
        try:
            if not self._limit.passes(_cause(record), self._clock()):
                self.silenced += 1
                return
            record.msg, record.args = record.getMessage(), None  # what it is made of may change
            self._queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1
        except Exception:  # noqa: BLE001 - a wrong format must not stop who says it
            self.handleError(record)

    def close(self) -> None:
        """Say what is queued, if somebody reads it within a second."""
        super().close()
        try:
            self._queue.put(None, timeout=_FLUSH_S)
        except queue.Full:
            return
        self._thread.join(_FLUSH_S)
        if not self._thread.is_alive():
            self._outlet.close()

    def _write(self) -> None:
        while True:
            try:
                record = self._queue.get(timeout=1.0)
            except queue.Empty:
                pass
            else:
                if record is None:
                    return
                self._outlet.write(record)
            self._tell_unsaid(self._clock())

    def _tell_unsaid(self, now_ns: int) -> None:
        """How much was not said, and why; looked at now and then."""
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            for (name, text, about), count in self._limit.over(now_ns):
                about = f" about {about}" if about else ""
                self._say(name, f'{count} more like "{text}"{about} in the last ten seconds')
        if self.dropped > self._told_dropped:
            lost, self._told_dropped = self.dropped - self._told_dropped, self.dropped
            self._say(_ROOT, f"{lost} log messages were lost: nobody read them in time")

    def _say(self, name: str, text: str) -> None:
        self._outlet.write(logging.LogRecord(name, logging.WARNING, "", 0, text, None, None))


class Lines:
    """A line a record; `with_fields`, for a journal at the other end: a priority before it, fields behind."""

    def __init__(self, file: int, with_fields: bool = False) -> None:
        self._file, self._with_fields = file, with_fields
        self._formatter = logging.Formatter("%(levelname)s %(name)s: %(message)s")

    def write(self, record: logging.LogRecord) -> None:
        """Write it all; where nobody reads any more, it is lost."""
        text = self._formatter.format(record)
        if self._with_fields:
            text += "".join(f" {key}={value}" for key, value in _fields(record).items())
            prefix = f"<{_PRIORITY.get(record.levelno, 6)}>"
            text = "\n".join(prefix + line for line in text.split("\n"))
        data = f"{text}\n".encode(errors="backslashreplace")
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError:
            return

    def close(self) -> None:
        """Nothing: the file is its opener's."""


class Journal:
    """The journal's own protocol: every record with its fields, for `journalctl HANDTOUCH_LINK=...`."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._address = address
        self._formatter = logging.Formatter("%(message)s")
        self._otherwise = Lines(2, with_fields=True)

    def write(self, record: logging.LogRecord) -> None:
        """Send it; as a line where the journal doesn't take it."""
        values = {
            "MESSAGE": self._formatter.format(record),
            "PRIORITY": str(_PRIORITY.get(record.levelno, 6)),
            "SYSLOG_IDENTIFIER": "handtouch",
            "LOGGER": record.name,
            "THREAD_NAME": str(record.threadName),
            **{f"HANDTOUCH_{key.upper()}": value for key, value in _fields(record).items()},
        }
        try:
            self._socket.sendto(b"".join(_field(key, value) for key, value in values.items()), self._address)
        except OSError:
            self._otherwise.write(record)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


def _field(key: str, value: str) -> bytes:
    """A field as the journal takes it: with its length where the value has lines of its own."""
    data = value.encode(errors="backslashreplace")
    if b"\n" in data:
        return key.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"
    return key.encode() + b"=" + data + b"\n"


def _cause(record: logging.LogRecord) -> Cause:
    """What two messages must have in common to be of one cause: text before values, and what it is about."""
    about = " ".join(_fields(record).values())
    if not about and isinstance(record.args, tuple) and record.args:
        about = str(record.args[0])
    return record.name, str(record.msg), about


def _fields(record: logging.LogRecord) -> dict[str, str]:
    """What a message is about, given as `extra={"fields": {...}}`."""
    fields = getattr(record, "fields", {})
    return {key: str(value) for key, value in fields.items()}


def _is_journal(file: int, stream: str) -> bool:
    """Whether the file is the stream, DEVICE:INODE, that systemd says leads to the journal."""
    try:
        status = os.fstat(file)
    except OSError:
        return False
    return stream == f"{status.st_dev}:{status.st_ino}"
