"""Log output: text lines on stderr or records with fields in the systemd journal, without delaying a tick.

Public names: `start_logging`, `is_journal`, `BoundedLogHandler`, `set_level`, `LEVELS`.

Loggers put records into a bounded queue that a separate thread writes, as slowly as disk or pipe allow.
Records that the queue can't take are dropped and counted. Repeated messages are limited: the first ones are
written, then their number.
"""

from __future__ import annotations

import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

LEVELS = ("debug", "info", "warning", "error")
_ROOT_LOGGER = "handtouch"
_QUEUE_RECORDS = 1000
_MAX_MESSAGES_PER_WINDOW, _RATE_WINDOW_NS = 10, 10_000_000_000
"""Messages of one cause that are logged in a window of time; further ones are only counted."""
_MAX_CAUSES = 1000
"""Causes tracked at a time; beyond them, objects and states share one limit per text."""
_SUPPRESSED_CHECK_PERIOD_NS = 1_000_000_000
_FLUSH_TIMEOUT_S = 1.0
"""Longest time that closing waits for a blocked reader."""
_JOURNALD_SOCKET = "/run/systemd/journal/socket"
_SYSLOG_PRIORITY = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}

Cause = tuple[str, str, str, str]
"""logger, text before formatting, object, state of the object"""


class LogSink(Protocol):
    """Destination of log records; called from the writing thread only."""

    def write(self, record: logging.LogRecord) -> None: ...

    def close(self) -> None: ...


def set_level(level: str) -> None:
    """Set the least severity that is logged. Raises ValueError naming the levels."""
    if level not in LEVELS:
        raise ValueError(f"log level {level!r:.40}: must be one of {', '.join(LEVELS)}")
    logging.getLogger(_ROOT_LOGGER).setLevel(level.upper())


def start_logging(level: str = "info", environment: Mapping[str, str] = os.environ) -> BoundedLogHandler:
    """Log to the journal if stderr is connected to it, else to stderr; `close` the handler at the end."""
    sink: LogSink
    if not is_journal(2, environment.get("JOURNAL_STREAM", "")):
        sink = LineLogSink(2)
    elif Path(_JOURNALD_SOCKET).exists():
        sink = JournaldSink(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM), _JOURNALD_SOCKET)
    else:
        sink = LineLogSink(2, with_fields=True)
    handler = BoundedLogHandler(sink)
    handler.start()
    root = logging.getLogger()
    root.setLevel(logging.WARNING)  # other packages
    root.handlers[:] = [handler]
    set_level(level)
    return handler


class LogRateLimiter:
    """Limits the messages of each cause: the same text about the same object in the same state.

    The first message of a new state always passes, however often the object was logged before. Times in ns.
    """

    def __init__(self, burst: int = _MAX_MESSAGES_PER_WINDOW, window_ns: int = _RATE_WINDOW_NS) -> None:
        self._max_messages, self._window_ns = burst, window_ns
        self._causes: dict[Cause, _Window] = {}
        self._lock = threading.Lock()

    def allows(self, cause: Cause, text: str, now_ns: int) -> bool:
        """Count a message; return False if the limit of its cause is reached."""
        with self._lock:
            if len(self._causes) >= _MAX_CAUSES and cause not in self._causes:
                cause = (*cause[:2], "", "")
            window = self._causes.get(cause)
            if window is None or (
                now_ns - window.since_ns >= self._window_ns and window.count <= self._max_messages
            ):
                window = self._causes[cause] = _Window(now_ns)
            window.count += 1
            window.text = text
            return window.count <= self._max_messages

    def take_suppressed(self, now_ns: int) -> list[tuple[str, str, int]]:
        """Return logger, newest text and number of suppressed messages of causes whose window has ended."""
        with self._lock:
            ended = [c for c, window in self._causes.items() if now_ns - window.since_ns >= self._window_ns]
            windows = [(cause[0], self._causes.pop(cause)) for cause in ended]
        counts = [(name, window.text, window.count - self._max_messages) for name, window in windows]
        return [(name, text, count) for name, text, count in counts if count > 0]


@dataclass(slots=True)
class _Window:
    """Messages of one cause since the window's beginning."""

    since_ns: int
    count: int = 0
    text: str = ""


class BoundedLogHandler(logging.Handler):
    """Queues records for its writing thread, which `start` starts.

    `dropped` counts records that the queue couldn't take, `suppressed` those beyond the rate limit.
    """

    def __init__(
        self,
        sink: LogSink,
        clock: Callable[[], int] = time.monotonic_ns,
        limit: LogRateLimiter | None = None,
    ) -> None:
        super().__init__()
        self.dropped = self.suppressed = 0
        self._sink, self._clock = sink, clock
        self._rate_limiter = limit or LogRateLimiter()
        self._queue: queue.Queue[logging.LogRecord | None] = queue.Queue(_QUEUE_RECORDS)
        self._reported_dropped = 0
        self._last_check_ns = clock()
        self._thread = threading.Thread(target=self._write_records, name="handtouch-log", daemon=True)

    def start(self) -> None:
        """Start the writing thread."""
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record; count it if it is suppressed or the queue is full."""
        try:
            text = record.getMessage()  # now, as the arguments may change before they are written
            if not self._rate_limiter.allows(_cause(record), text, self._clock()):
                self.suppressed += 1
                return
            record.msg, record.args = text, None
            self._queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1
        except Exception:  # noqa: BLE001 - a wrong format must not stop the caller
            self.handleError(record)

    def close(self) -> None:
        """Write the queued records, waiting at most two seconds for a blocked reader."""
        super().close()
        if self._thread.ident is None:
            self._sink.close()
            return
        try:
            self._queue.put(None, timeout=_FLUSH_TIMEOUT_S)
        except queue.Full:
            return
        self._thread.join(_FLUSH_TIMEOUT_S)
        if not self._thread.is_alive():
            self._sink.close()

    def _write_records(self) -> None:
        while True:
            try:
                record = self._queue.get(timeout=1.0)
            except queue.Empty:
                pass
            else:
                if record is None:
                    return
                self._sink.write(record)
            self._report_lost(self._clock())

    def _report_lost(self, now_ns: int) -> None:
        """Log the numbers of suppressed and dropped messages."""
        if now_ns - self._last_check_ns >= _SUPPRESSED_CHECK_PERIOD_NS:
            self._last_check_ns = now_ns
            for name, text, count in self._rate_limiter.take_suppressed(now_ns):
                self._write_warning(name, f'{count} more messages in the last 10 s like "{text}"')
        if self.dropped > self._reported_dropped:
            lost, self._reported_dropped = self.dropped - self._reported_dropped, self.dropped
            self._write_warning(_ROOT_LOGGER, f"{lost} log messages dropped: the log reader is too slow")

    def _write_warning(self, name: str, text: str) -> None:
        self._sink.write(logging.LogRecord(name, logging.WARNING, "", 0, text, None, None))


class LineLogSink:
    """Writes text lines; `with_fields`: with journald's priority prefix and the fields after the text."""

    def __init__(self, file: int, with_fields: bool = False) -> None:
        self._file, self._with_fields = file, with_fields
        self._formatter = logging.Formatter("%(levelname)s %(name)s: %(message)s")

    def write(self, record: logging.LogRecord) -> None:
        """Write the whole record; it is lost if the reader has closed the file."""
        text = self._formatter.format(record)
        if self._with_fields:
            text += "".join(f" {key}={value}" for key, value in _fields(record))
            prefix = f"<{_SYSLOG_PRIORITY.get(record.levelno, 6)}>"
            text = "\n".join(prefix + line for line in text.split("\n"))
        data = f"{text}\n".encode(errors="backslashreplace")
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError:
            return

    def close(self) -> None:
        """Leave the file open: it belongs to the caller."""


class JournaldSink:
    """Sends records with fields in journald's native protocol, for `journalctl HANDTOUCH_LINK=...`."""

    def __init__(self, datagram_socket: socket.socket, address: str) -> None:
        """Send by a Unix datagram socket, which `close` closes, to the journal's socket at `address`."""
        self._socket, self._address = datagram_socket, address
        self._formatter = logging.Formatter("%(message)s")
        self._fallback = LineLogSink(2, with_fields=True)

    def write(self, record: logging.LogRecord) -> None:
        """Send the record; write it as a line to stderr if the journal refuses it."""
        values = [
            ("MESSAGE", self._formatter.format(record)),
            ("PRIORITY", str(_SYSLOG_PRIORITY.get(record.levelno, 6))),
            ("SYSLOG_IDENTIFIER", "handtouch"),
            ("LOGGER", record.name),
            ("THREAD_NAME", str(record.threadName)),
            *((f"HANDTOUCH_{key.upper()}", value) for key, value in _fields(record)),
        ]
        try:
            self._socket.sendto(b"".join(_encode_field(key, value) for key, value in values), self._address)
        except OSError:
            self._fallback.write(record)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _encode_field(key: str, value: str) -> bytes:
    """Encode a field for journald: with its length if the value has several lines."""
    data = value.encode(errors="backslashreplace")
    if b"\n" in data:
        return key.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"
    return key.encode() + b"=" + data + b"\n"


def _cause(record: logging.LogRecord) -> Cause:
    """Return the cause of a message: logger, unformatted text, object and the object's state.

    The object is its fields, else its first argument unless that is a measured value.
    """
    about = " ".join(value for _, value in _fields(record))
    if not about and isinstance(record.args, tuple) and record.args and not isinstance(record.args[0], float):
        about = str(record.args[0])
    return record.name, str(record.msg), about, str(getattr(record, "state", ""))


def _fields(record: logging.LogRecord) -> list[tuple[str, str]]:
    """Return the object of a message, given as `extra={"fields": {...}}`; a list is a field for each value.

    The journal finds a record by any of the values of a field.
    """
    fields = getattr(record, "fields", {})
    return [
        (key, str(value))
        for key, given in fields.items()
        for value in (given if isinstance(given, list) else [given])
    ]


def is_journal(file: int, stream: str) -> bool:
    """Return True if the file is `stream` (DEVICE:INODE), systemd's connection to the journal."""
    try:
        status = os.fstat(file)
    except OSError:
        return False
    return stream == f"{status.st_dev}:{status.st_ino}"
