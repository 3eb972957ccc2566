"""The Python client: typed messages, topic matching, lost messages, malformed messages, asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any, assert_type

import msgpack
import pytest
import zmq

import handtouch
from handtouch import wire
from handtouch.client import Subscriber


def _parts(seq: int, link: str = "thumb", retained: bool = False, session: int = 1) -> list[bytes]:
    return wire.encode(
        wire.Health(
            1, session, seq, 1, "h", link, "can0", 1, "clear", "operational",
            0, "sync", "", None, 0.0, 0, 0, None, 0, 0, (), retained,
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
        for _ in range(2):  # its topic and `service`
            assert publisher.poll(5000)
            publisher.recv()
        yield made


def test_gaps_in_seq_are_counted_as_lost_messages(publisher: Any, subscriber: Subscriber[Any]) -> None:
    for seq in (1, 2, 5, 6, 10):
        publisher.send_multipart(_parts(seq))
    assert [subscriber.recv().seq for _ in range(5)] == [1, 2, 5, 6, 10]
    assert subscriber.lost_messages == 2 + 3


def test_a_retained_message_is_received_once(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart(_parts(4, retained=True))
    publisher.send_multipart(_parts(4, retained=True))
    publisher.send_multipart(_parts(5))
    assert [subscriber.recv().seq for _ in range(2)] == [4, 5]
    assert subscriber.lost_messages == 0


@pytest.mark.parametrize("seqs", [(700, 1, 2), (3, 700, 701), (5, 5, 6)])
def test_a_new_session_restarts_seq_without_lost_messages(
    publisher: Any, subscriber: Subscriber[Any], seqs: tuple[int, int, int]
) -> None:
    publisher.send_multipart(_parts(seqs[0], session=1))
    publisher.send_multipart(
        _parts(seqs[1], session=2, retained=True)
    )  # for a subscriber that has just reconnected
    publisher.send_multipart(_parts(seqs[2], session=2))
    assert [subscriber.recv().seq for _ in range(3)] == list(seqs)
    assert subscriber.lost_messages == 0


def test_malformed_messages_are_counted_and_dropped(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart([b"health/h/thumb", b"\xc1"])
    publisher.send_multipart([b"health/h/thumb"])
    publisher.send_multipart([b"health/h/thumb", msgpack.packb({"v": 1})])
    publisher.send_multipart(_parts(1))
    assert subscriber.recv().seq == 1
    assert subscriber.malformed_messages == 3


def test_a_pattern_matches_whole_parts(publisher: Any, subscriber: Subscriber[Any]) -> None:
    publisher.send_multipart(_parts(1, link="index"))
    publisher.send_multipart(_parts(1, link="thumb_tip"))
    assert subscriber.recv().link == "thumb_tip"
    assert subscriber.recv(0) is None


def test_the_daemon_counts_as_disconnected_after_a_timeout(
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


def test_a_request_without_an_answer_times_out_naming_the_endpoint(endpoints: dict[str, str]) -> None:
    with pytest.raises(TimeoutError, match=endpoints["control"]):
        handtouch.request("status", endpoint=endpoints["control"], timeout_s=0.1)


def test_the_pattern_of_a_whole_topic_determines_the_static_type() -> None:
    def types() -> None:  # for mypy: never called
        assert_type(handtouch.connect().recv(), wire.Contact)
        assert_type(handtouch.connect("contact/*/*", queue=5).recv(1.0), wire.Contact | None)
        assert_type(next(iter(handtouch.connect("hand/*"))), wire.HandFrame)
        assert_type(handtouch.connect("service").recv(), wire.Service)
        assert_type(handtouch.connect("hand/*", "raw/*").recv(), Any)

    assert callable(types)


async def _receive(subscriber: Subscriber[Any], count: int) -> list[int]:
    got: list[int] = []
    async for message in subscriber:
        got.append(message.seq)
        if len(got) == count:
            break
    return got


def test_asyncio_receives_queued_and_new_messages(publisher: Any, subscriber: Subscriber[Any]) -> None:
    async def main() -> list[int]:
        async with subscriber:
            publisher.send_multipart(_parts(1))
            first = await _receive(subscriber, 1)
            waiting = asyncio.create_task(_receive(subscriber, 2))
            for seq in (2, 3):
                await asyncio.sleep(0)
                publisher.send_multipart(_parts(seq))
            return first + await waiting

    assert asyncio.run(main()) == [1, 2, 3]
    with pytest.raises(zmq.ZMQError):
        subscriber.recv(0)  # `async with` has closed it


def test_timeouts_and_cancellation_lose_no_message(publisher: Any, subscriber: Subscriber[Any]) -> None:
    async def main() -> list[int]:
        assert await subscriber.arecv(0) is None
        assert await subscriber.arecv(0.01) is None
        got: list[int] = []
        for seq in range(1, 201):
            task = asyncio.create_task(subscriber.arecv())
            for _ in range(seq % 4):
                await asyncio.sleep(0)
            publisher.send_multipart(_parts(seq))
            for _ in range(seq % 3):
                await asyncio.sleep(0)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                got.append((await task).seq)
        while (message := await subscriber.arecv(0.2)) is not None:
            got.append(message.seq)
        return got

    assert asyncio.run(main()) == list(range(1, 201))
    assert subscriber.lost_messages == 0


def test_each_message_goes_to_one_of_the_tasks(publisher: Any, subscriber: Subscriber[Any]) -> None:
    async def main() -> list[list[int]]:
        got: list[list[int]] = [[], [], []]

        async def read(seqs: list[int]) -> None:
            while True:
                seqs.append((await subscriber.arecv()).seq)

        tasks = [asyncio.create_task(read(seqs)) for seqs in got]
        for seq in range(1, 201):
            for _ in range(seq % 5):
                await asyncio.sleep(0)
            publisher.send_multipart(_parts(seq))
        async with asyncio.timeout(60):
            while sum(map(len, got)) < 200:
                await asyncio.sleep(0.01)
        for task in tasks:
            task.cancel()
        return got

    got = asyncio.run(main())
    assert sorted(seq for seqs in got for seq in seqs) == list(range(1, 201))


def test_a_task_that_waits_is_not_affected_by_the_timeout_of_another(
    publisher: Any, subscriber: Subscriber[Any]
) -> None:
    async def main() -> tuple[Any, Any]:
        waits = asyncio.create_task(subscriber.arecv(60.0))
        gives_up = await subscriber.arecv(0.01)
        publisher.send_multipart(_parts(1))
        return gives_up, await waits

    gives_up, message = asyncio.run(main())
    assert gives_up is None
    assert message.seq == 1


def test_a_stream_without_a_pause_lets_other_tasks_run(publisher: Any, subscriber: Subscriber[Any]) -> None:
    async def main() -> int:
        iterations = 0

        async def other() -> None:
            nonlocal iterations
            while True:
                iterations += 1
                await asyncio.sleep(0)

        for seq in range(1, 101):
            publisher.send_multipart(_parts(seq))
        task = asyncio.create_task(other())
        await _receive(subscriber, 100)
        task.cancel()
        return iterations

    assert asyncio.run(main()) >= 100


def test_a_closed_subscriber_leaves_no_reader_in_the_event_loop(
    publisher: Any, endpoints: dict[str, str]
) -> None:
    async def main() -> None:
        for _ in range(20):  # each reuses the file descriptors of the previous one
            async with handtouch.connect("health/*/*", endpoint=endpoints["live"]) as messages:
                seq = 0
                while await messages.arecv(0.01) is None:
                    seq += 1
                    publisher.send_multipart(_parts(seq))

    asyncio.run(main())


def test_the_public_names_are_listed_before_their_first_use() -> None:
    fresh = "import handtouch; assert set(dir(handtouch)) == set(handtouch.__all__)"
    subprocess.run([sys.executable, "-c", fresh], check=True, timeout=60)


SLOW = """
import sys, time
import handtouch
with handtouch.connect("hand/*", endpoint=sys.argv[1], queue=10):
    sys.stdin.readline()
    time.sleep(1.2)
"""


def test_slow_subscriber_survives_the_end_of_its_daemon(publisher: Any, endpoints: dict[str, str]) -> None:
    """Its queue is full then; with ZeroMQ's heartbeats libzmq would abort it."""
    command = [sys.executable, "-c", SLOW, endpoints["live"]]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as slow:
        for _ in range(2):  # its topic and `service`
            assert publisher.poll(20_000)
            publisher.recv()
        for _ in range(20_000):
            publisher.send_multipart([b"hand/h", bytes(1000)])
        time.sleep(0.2)
        publisher.close()
        _, printed = slow.communicate("\n", timeout=60)
    assert slow.returncode == 0, printed
