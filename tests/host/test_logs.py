"""Log records are written in order, never block the caller, and repeated messages are rate-limited."""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from handtouch.host import logs
from handtouch.host.logs import (
    BoundedLogHandler,
    JournaldSink,
    LineLogSink,
    LogRateLimiter,
)

SECOND = 1_000_000_000


class MemorySink:
    """A sink that keeps records; blocked like a full pipe while `unblocked` is cleared."""

    def __init__(self) -> None:
        self.records: list[logging.LogRecord] = []
        self.unblocked = threading.Event()
        self.unblocked.set()

    def write(self, record: logging.LogRecord) -> None:
        assert self.unblocked.wait(60)
        self.records.append(record)

    def close(self) -> None:
        """Nothing to close."""

    @property
    def texts(self) -> list[str]:
        return [record.getMessage() for record in self.records]


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    made = logging.getLogger("test_logs")
    made.propagate = False
    made.setLevel(logging.DEBUG)
    yield made
    made.handlers.clear()


def record(text: str, level: int = logging.INFO, **fields: object) -> logging.LogRecord:
    made = logging.LogRecord("handtouch.health", level, "file.py", 1, text, None, None)
    made.fields = fields
    return made


def test_messages_are_written_in_order_and_closing_writes_queued_ones(logger: logging.Logger) -> None:
    sink = MemorySink()
    handler = BoundedLogHandler(sink, limit=LogRateLimiter(burst=1000))
    logger.addHandler(handler)
    handler.start()
    for number in range(500):
        logger.info("number %d", number)
    handler.close()
    assert sink.texts == [f"number {number}" for number in range(500)]
    assert handler.dropped == handler.suppressed == 0


def test_blocked_sink_never_blocks_callers_and_drops_are_counted(logger: logging.Logger) -> None:
    sink = MemorySink()
    sink.unblocked.clear()
    handler = BoundedLogHandler(sink, limit=LogRateLimiter(burst=10**6))
    logger.addHandler(handler)
    handler.start()
    for number in range(5000):  # would never return if a call could wait
        logger.info("number %d", number)
    assert 3990 <= handler.dropped <= 4000
    sink.unblocked.set()
    handler.close()
    assert len([text for text in sink.texts if text.startswith("number")]) == 5000 - handler.dropped
    assert f"{handler.dropped} log messages dropped: the log reader is too slow" in sink.texts


def test_unread_pipe_never_blocks_callers(logger: logging.Logger) -> None:
    reading, writing = os.pipe()
    handler = BoundedLogHandler(LineLogSink(writing), limit=LogRateLimiter(burst=10**6))
    logger.addHandler(handler)
    handler.start()
    for number in range(5000):
        logger.info("%s %d", "x" * 1000, number)
    assert handler.dropped > 3000
    os.close(reading)  # the thread's write fails now; the thread keeps running
    handler.close()
    os.close(writing)


def test_repeated_cause_is_limited_and_its_suppressed_count_logged(logger: logging.Logger) -> None:
    now_ns = 100 * SECOND
    sink = MemorySink()
    handler = BoundedLogHandler(
        sink, clock=lambda: now_ns, limit=LogRateLimiter(burst=3, window_ns=10 * SECOND)
    )
    logger.addHandler(handler)
    handler.start()
    for _ in range(50):
        logger.warning("bus %s: queue full, %d", "can0", _)
        logger.warning("bus %s: queue full, %d", "can1", _)
    now_ns += 11 * SECOND
    logger.info("something else")
    handler.close()
    for bus in ("can0", "can1"):
        assert len([text for text in sink.texts if text.startswith(f"bus {bus}: queue full")]) == 3
        summary = f'47 more messages in the last 10 s like "bus {bus}: queue full, 49"'
        assert sink.texts.count(summary) == 1
    assert handler.suppressed == 94


def test_a_measured_value_makes_no_cause_of_its_own(logger: logging.Logger) -> None:
    sink = MemorySink()
    handler = BoundedLogHandler(sink, clock=lambda: 0, limit=LogRateLimiter(burst=3, window_ns=10 * SECOND))
    logger.addHandler(handler)
    for late_ms in range(5):
        logger.warning("late by %.0f ms", float(late_ms))
        logger.warning("%s is late", f"bus {late_ms}")
    handler.start()
    handler.close()
    assert [text for text in sink.texts if text.startswith("late")] == [f"late by {n} ms" for n in range(3)]
    assert len(sink.texts) == 3 + 5


def test_malformed_format_string_does_not_raise(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", False)
    handler = BoundedLogHandler(MemorySink())
    logger.addHandler(handler)
    handler.start()
    logger.info("number %d", "none")
    handler.close()


def test_lines_for_journald_have_a_priority_prefix_and_fields() -> None:
    reading, writing = os.pipe()
    lines = LineLogSink(writing, with_fields=True)
    lines.write(record("lost\nreally", logging.WARNING, hand="left", link="thumb_tip"))
    lines.write(record("all is well"))
    os.close(writing)
    with os.fdopen(reading) as read:
        assert read.read() == (
            "<4>WARNING handtouch.health: lost\n<4>really hand=left link=thumb_tip\n"
            "<6>INFO handtouch.health: all is well\n"
        )


def fields_of(datagram: bytes) -> dict[str, bytes]:
    """Parse the fields of a datagram of journald's native protocol."""
    fields = {}
    while datagram:
        name, _, rest = datagram.partition(b"\n")
        if b"=" in name:
            key, _, value = name.partition(b"=")
            fields[key.decode()], datagram = value, rest
        else:
            size = int.from_bytes(rest[:8], "little")
            fields[name.decode()], datagram = rest[8 : 8 + size], rest[9 + size :]
    return fields


def test_journald_sink_sends_records_with_fields(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "journal"))
        sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sink = JournaldSink(sender, str(tmp_path / "journal"))
        sink.write(record("lost\nreally = so", logging.ERROR, hand="left", link="thumb_tip"))
        got = fields_of(journal.recv(65536))
        sink.close()
    assert got["MESSAGE"] == b"lost\nreally = so"
    assert got["PRIORITY"] == b"3"
    assert got["LOGGER"] == b"handtouch.health"
    assert (got["HANDTOUCH_HAND"], got["HANDTOUCH_LINK"]) == (b"left", b"thumb_tip")


def test_a_record_about_several_pads_has_the_field_of_each(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "journal"))
        sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sink = JournaldSink(sender, str(tmp_path / "journal"))
        sink.write(record("stale", hand="left", link=["thumb_tip", "index_tip"]))
        datagram = journal.recv(65536)
        sink.close()
    assert datagram.count(b"HANDTOUCH_LINK=") == 2
    assert b"HANDTOUCH_LINK=thumb_tip\n" in datagram
    assert b"HANDTOUCH_LINK=index_tip\n" in datagram


@pytest.fixture
def untouched() -> Iterator[None]:
    """Restore the loggers afterwards."""
    root, ours = logging.getLogger(), logging.getLogger("handtouch")
    handlers, level, our_level = root.handlers[:], root.level, ours.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    ours.setLevel(our_level)


@pytest.mark.usefixtures("untouched")
def test_level_is_set_at_start_and_changes_at_run_time() -> None:
    handler = logs.start_logging("warning", {})
    assert not logging.getLogger("handtouch.health").isEnabledFor(logging.INFO)
    logs.set_level("debug")
    assert logging.getLogger("handtouch.health").isEnabledFor(logging.DEBUG)
    with pytest.raises(ValueError, match="must be one of debug, info, warning, error"):
        logs.set_level("loud")
    handler.close()


def test_stderr_is_the_journal_only_if_journal_stream_names_it() -> None:
    status = os.fstat(2)
    assert logs.is_journal(2, f"{status.st_dev}:{status.st_ino}")
    assert not logs.is_journal(2, f"{status.st_dev}:{status.st_ino + 1}")
    assert not logs.is_journal(2, "")


def test_causes_beyond_the_limit_share_one_and_memory_stays_bounded() -> None:
    limit = LogRateLimiter(burst=3, window_ns=10 * SECOND)
    passed = sum(
        limit.allows(("bus", "node %d", str(number), ""), f"node {number}", 0) for number in range(100_000)
    )
    assert passed <= 1003
    assert limit.take_suppressed(11 * SECOND) == [("bus", "node 99999", 99_000 - 3)]


def test_first_message_of_a_new_state_is_never_suppressed(logger: logging.Logger) -> None:
    sink = MemorySink()
    handler = BoundedLogHandler(sink, clock=lambda: 0, limit=LogRateLimiter(burst=3, window_ns=10 * SECOND))
    logger.addHandler(handler)
    handler.start()
    node = {"hand": "right", "link": "thumb_tip"}
    for _ in range(50):
        logger.warning("%s: %s", "right/thumb_tip", "lost", extra={"fields": node, "state": "absent"})
    logger.error("%s: %s", "right/thumb_tip", "two nodes", extra={"fields": node, "state": "duplicate"})
    handler.close()
    assert sink.texts == ["right/thumb_tip: lost"] * 3 + ["right/thumb_tip: two nodes"]
