"""The Python client: typed messages, whole matches, gaps counted, nothing malformed let through."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest
import zmq

import handtouch
from handtouch import wire
from handtouch.client import Subscriber


def _parts(seq: int, link: str = "thumb", repeat: bool = False, run: int = 1) -> list[bytes]:
    return wire.encode(
        wire.Health(
            1, run, seq, 1, "h", link, "can0", 1, "clear", "operational",
            0, "sync", "", None, 0.0, 0, 0, None, 0, 0, (), repeat,
        )
    )  # fmt: skip


@pytest.fixture
def publisher(endpoints: dict[str, str]) -> Iterator[Any]:
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(endpoints["live"])
        yield socket


@pytest.fixture
def subscriber(publisher: Any, endpoints: dict[str, str]) -> Iterator[Subscriber[Any]]:
    with handtouch.connect("health/*/thumb*", endpoint=endpoints["live"]) as made:
        for _ in range(2):  # its topic and the daemon's heartbeat
            assert publisher.poll(5000)
            publisher.recv()
        yield made


def test_gaps_in_seq_are_counted(publisher: Any, subscriber: Subscriber[Any]) -> None:
    for seq in (1, 2, 5, 6, 10):
        publisher.send_multipart(_parts(seq))
    assert [subscriber.recv().seq for _ in range(5)] == [1, 2, 5, 6, 10]
    assert subscriber.gaps == 2 + 3


def test_a_repeat_is_taken_once(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart(_parts(4, repeat=True))
    publisher.send_multipart(_parts(4, repeat=True))
    publisher.send_multipart(_parts(5))
    assert [subscriber.recv().seq for _ in range(2)] == [4, 5]
    assert subscriber.gaps == 0


def test_a_restarted_daemon_begins_to_count_again(publisher: Any, subscriber: Subscriber[Any]) -> None:
    for seq in (700, 1, 2):
        publisher.send_multipart(_parts(seq))
    assert [subscriber.recv().seq for _ in range(3)] == [700, 1, 2]
    assert subscriber.gaps == 0


def test_malformed_messages_are_counted_and_dropped(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart([b"health/h/thumb", b"\xc1"])
    publisher.send_multipart([b"health/h/thumb"])
    publisher.send_multipart([b"health/h/thumb", msgpack.packb({"v": 1})])
    publisher.send_multipart(_parts(1))
    assert subscriber.recv().seq == 1
    assert subscriber.malformed == 3


def test_a_pattern_matches_whole_parts(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart(_parts(1, link="index"))
    publisher.send_multipart(_parts(1, link="thumb_tip"))
    assert subscriber.recv().link == "thumb_tip"
    assert subscriber.recv(0) is None


def test_silence_tells_that_the_daemon_is_gone(
    publisher: Any, subscriber: Subscriber[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher.send_multipart(_parts(1))
    subscriber.recv()
    assert subscriber.alive
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 2.0)
    assert not subscriber.alive


@pytest.mark.parametrize("pattern", ["", "contact", "contacts/*/*", "hand/a/b", "contact/*"])
def test_a_pattern_that_no_topic_matches_is_refused(pattern: str) -> None:
    with pytest.raises(ValueError, match=r"contact/\*/\*"):
        handtouch.connect(pattern)


def test_request_names_the_endpoint_when_nobody_answers(endpoints: dict[str, str]) -> None:
    with pytest.raises(TimeoutError, match=endpoints["control"]):
        handtouch.request("status", endpoint=endpoints["control"], timeout_s=0.1)
