"""What is said comes out whole and in order, never delays who says it, and nobody's flood drowns the rest."""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from handtouch.daemon import logs
from handtouch.daemon.logs import Journal, Limit, Lines, Logs

SECOND = 1_000_000_000


class Paper:
    """An outlet that keeps what it is given; while `held` it is stuck, as a full pipe is."""

    def __init__(self) -> None:
        self.records: list[logging.LogRecord] = []
        self.go_on = threading.Event()
        self.go_on.set()

    def write(self, record: logging.LogRecord) -> None:
        assert self.go_on.wait(60)
        self.records.append(record)

    def close(self) -> None:
        """Nothing to give back."""

    @property
    def said(self) -> list[str]:
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


def test_messages_come_out_in_order_and_closing_says_the_rest(logger: logging.Logger) -> None:
    paper = Paper()
    handler = Logs(paper, limit=Limit(burst=1000))
    logger.addHandler(handler)
    for number in range(500):
        logger.info("number %d", number)
    handler.close()
    assert paper.said == [f"number {number}" for number in range(500)]
    assert handler.dropped == handler.silenced == 0


def test_an_outlet_that_is_stuck_stops_nobody_and_what_is_lost_is_counted(logger: logging.Logger) -> None:
    paper = Paper()
    paper.go_on.clear()
    handler = Logs(paper, limit=Limit(burst=10**6))
    logger.addHandler(handler)
    for number in range(5000):  # would never return if a call could wait
        logger.info("number %d", number)
    assert 3990 <= handler.dropped <= 4000
    paper.go_on.set()
    handler.close()
    assert len([text for text in paper.said if text.startswith("number")]) == 5000 - handler.dropped
    assert f"{handler.dropped} log messages were lost: nobody read them in time" in paper.said


def test_a_pipe_that_nobody_reads_stops_nobody_either(logger: logging.Logger) -> None:
    reading, writing = os.pipe()
    handler = Logs(Lines(writing), limit=Limit(burst=10**6))
    logger.addHandler(handler)
    for number in range(5000):
        logger.info("%s %d", "x" * 1000, number)
    assert handler.dropped > 3000
    os.close(reading)  # the thread's write fails now, and it goes on
    handler.close()
    os.close(writing)


def test_a_cause_that_repeats_is_said_a_few_times_and_its_number_afterwards(logger: logging.Logger) -> None:
    now_ns = 100 * SECOND
    paper = Paper()
    handler = Logs(paper, clock=lambda: now_ns, limit=Limit(burst=3, window_ns=10 * SECOND))
    logger.addHandler(handler)
    for _ in range(50):
        logger.warning("bus %s: queue full, %d", "can0", _)
        logger.warning("bus %s: queue full, %d", "can1", _)
    now_ns += 11 * SECOND
    logger.info("something else")
    handler.close()
    for bus in ("can0", "can1"):
        assert len([text for text in paper.said if text.startswith(f"bus {bus}: queue full")]) == 3
        told = f'47 more like "bus %s: queue full, %d" about {bus} in the last ten seconds'
        assert paper.said.count(told) == 1
    assert handler.silenced == 94


def test_a_wrong_format_is_no_reason_to_stop(logger: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", False)
    handler = Logs(Paper())
    logger.addHandler(handler)
    logger.info("number %d", "none")
    handler.close()


def test_each_line_for_a_journal_has_its_priority_and_the_fields() -> None:
    reading, writing = os.pipe()
    lines = Lines(writing, with_fields=True)
    lines.write(record("lost\nreally", logging.WARNING, hand="left", link="thumb_tip"))
    lines.write(record("all is well"))
    os.close(writing)
    with os.fdopen(reading) as read:
        assert read.read() == (
            "<4>WARNING handtouch.health: lost\n<4>really hand=left link=thumb_tip\n"
            "<6>INFO handtouch.health: all is well\n"
        )


def fields_of(datagram: bytes) -> dict[str, bytes]:
    """The fields of a datagram of the journal's native protocol."""
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


def test_the_journal_gets_every_record_with_its_fields(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "journal"))
        outlet = Journal(str(tmp_path / "journal"))
        outlet.write(record("lost\nreally = so", logging.ERROR, hand="left", link="thumb_tip"))
        got = fields_of(journal.recv(65536))
        outlet.close()
    assert got["MESSAGE"] == b"lost\nreally = so"
    assert got["PRIORITY"] == b"3"
    assert got["LOGGER"] == b"handtouch.health"
    assert (got["HANDTOUCH_HAND"], got["HANDTOUCH_LINK"]) == (b"left", b"thumb_tip")


@pytest.fixture
def untouched() -> Iterator[None]:
    """The loggers as they were, afterwards."""
    root, ours = logging.getLogger(), logging.getLogger("handtouch")
    handlers, level, our_level = root.handlers[:], root.level, ours.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    ours.setLevel(our_level)


@pytest.mark.usefixtures("untouched")
def test_the_level_is_what_the_deployment_says_and_changes_at_run_time() -> None:
    said = logs.start("warning", {})
    assert not logging.getLogger("handtouch.health").isEnabledFor(logging.INFO)
    logs.set_level("debug")
    assert logging.getLogger("handtouch.health").isEnabledFor(logging.DEBUG)
    with pytest.raises(ValueError, match="must be one of debug, info, warning, error"):
        logs.set_level("loud")
    said.close()


def test_a_stream_is_the_journals_only_if_systemd_says_so_of_this_very_one() -> None:
    status = os.fstat(2)
    assert logs._is_journal(2, f"{status.st_dev}:{status.st_ino}")
    assert not logs._is_journal(2, f"{status.st_dev}:{status.st_ino + 1}")
    assert not logs._is_journal(2, "")


def test_causes_without_end_take_no_memory_without_end_and_are_limited_together() -> None:
    limit = Limit(burst=3, window_ns=10 * SECOND)
    passed = sum(limit.passes(("bus", "node %d", str(number)), 0) for number in range(100_000))
    assert passed <= 1003
    assert limit.over(11 * SECOND) == [(("bus", "node %d", ""), 99_000 - 3)]
