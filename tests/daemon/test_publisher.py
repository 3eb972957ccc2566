"""The publisher serves every subscriber and is never blocked by one."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from handtouch import wire
from handtouch.client import Subscriber, columns, connect
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import LIVE_QUEUE_MESSAGES, Publisher
from handtouch.wire import PadState

NOW_NS = 10**9
PERIOD_NS = 5_000_000
LINKS = ["plane", "round", "cone", "thumb", "thumb_tip", *(f"link_{number}" for number in range(100))]
TOPICS = wire.topics_of({"h": LINKS})


class Clock:
    """Time that passes at every poll."""

    now_ns = NOW_NS

    def poll(self, publisher: Publisher) -> None:
        self.now_ns += 10 * PERIOD_NS
        publisher.poll_subscriptions(self.now_ns)


CLOCK = Clock()


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with zmq.Context() as context, Authenticator(context) as guard:
        made = Publisher.open(context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*", TOPICS, guard)
        yield made
        made.close()


def _health(publisher: Publisher, link: str, text: str = "", seq: int = 1) -> wire.Health:
    return wire.Health(
        wire.SCHEMA_VERSION, publisher.session, seq, 1, "h", link, "can0", 1, "clear",
        "operational", 0, "sync", text, None, 0.0, 0, 0, None, 0, 0, (), False,
    )  # fmt: skip


def _until(publisher: Publisher, topic: str, subscribed: bool = True) -> None:
    for _ in range(2000):
        CLOCK.poll(publisher)
        if publisher.has_subscriber(topic) == subscribed:
            return
        time.sleep(0.005)
    raise AssertionError(f"no subscription to {topic}")


def test_message_reaches_subscribers_of_its_whole_topic_only(publisher: Publisher) -> None:
    with connect("health/h/thumb", endpoint=publisher.endpoints["live"]) as subscriber:
        _until(publisher, "health/h/thumb")
        publisher.send(_health(publisher, "thumb_tip"))
        publisher.send(_health(publisher, "thumb"))
        message = subscriber.recv()
        assert message.link == "thumb"
        assert subscriber.recv(0) is None


def test_nothing_is_encoded_without_a_subscriber(
    publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: wire.Message) -> list[bytes]:
        raise AssertionError("encoded without a subscriber")

    monkeypatch.setattr(wire, "encode", refuse)
    publisher.send(_health(publisher, "thumb"))
    assert not publisher.has_subscriber("health/h/thumb")


def _receive_all(publisher: Publisher, subscriber: Subscriber[Any], least: int) -> list[Any]:
    """Return messages until no more arrive, at least `least`."""
    got: list[Any] = []
    for _ in range(1000):
        CLOCK.poll(publisher)
        if (message := subscriber.recv(0.01)) is not None:
            got.append(message)
        elif len(got) >= least:
            return got
    raise AssertionError(f"only {got}")


def test_late_subscriber_gets_retained_state_and_others_do_not_get_it_twice(
    publisher: Publisher,
) -> None:
    with connect("health/*/*", endpoint=publisher.endpoints["live"]) as early:
        _until(publisher, "health/h/thumb")
        sent = _health(publisher, "thumb", "first")
        publisher.retained_messages["health/h/thumb"] = lambda _: replace(sent, retained=True)
        publisher.send(sent)
        first = early.recv()
        assert (first.reason, first.retained) == ("first", False)
        with connect("health/*/*", endpoint=publisher.endpoints["live"]) as late:  # the very same prefix
            (retained,) = _receive_all(publisher, late, 1)
            assert (retained.reason, retained.retained, retained.seq) == ("first", True, first.seq)
        publisher.send(_health(publisher, "thumb", "second", 2))
        assert early.recv().reason == "second"
        assert early.lost_messages == 0


@pytest.mark.parametrize("stream", ["live", "complete"])
def test_late_subscriber_gets_active_contacts_and_the_hand_at_once(
    publisher: Publisher, bench: Any, stream: str
) -> None:
    pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, publisher, publisher.session)
    pipeline.node_state[:] = PadState.CLEAR
    publisher.retained_messages.update(pipeline.messages.retained_messages())
    touch = bench.counts(0, 0.3, 0.6, 1e-3).tobytes()

    def cycle(number: int, samples: bytes) -> None:
        t_ns = NOW_NS + number * PERIOD_NS
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in range(3):
            pipeline.slab.write_pdo(pad, samples if pad == 0 else bytes(8), t_ns + 1000)
        pipeline.tick_if_due(t_ns + 4_000_000)

    endpoint, patterns = publisher.endpoints[stream], ("contact/*/*", "hand/*", "raw/*")
    for number in range(5):  # touched, without a subscriber
        cycle(number, touch)
    with connect(*patterns, endpoint=endpoint) as late:
        contact, frame = _receive_all(publisher, late, 2)
        assert (contact.event, contact.id, contact.link, contact.retained) == ("update", 1, "plane", True)
        assert contact.session == publisher.session
        row = columns(frame)
        assert frame.retained
        assert row["state"].tolist() == [1, 0, 0]
        assert row["contact_id"].tolist() == [1, 0, 0]
        assert row["position_m"][0] == pytest.approx(contact.position_m)
        assert row["covariance_m2"][0] == pytest.approx(contact.covariance_m2)
        assert row["pad_m"][0] == pytest.approx(contact.pad_m)
        assert [row[name][0] for name in ("force_n", "force_std_n", "residual_std")] == pytest.approx(
            [contact.force_n, contact.force_std_n, contact.residual_std], rel=1e-6
        )
        assert np.isnan(row["position_m"][1:]).all()
        cycle(5, touch)
        with connect(*patterns, endpoint=endpoint) as later:
            assert {type(message) for message in _receive_all(publisher, later, 2)} >= {
                wire.Contact,
                wire.HandFrame,
            }
        cycle(6, touch)
        later_messages = _receive_all(publisher, late, 6)
        assert [m.seq - contact.seq for m in later_messages if isinstance(m, wire.Contact)] == [1, 2]
        assert [m.seq - frame.seq for m in later_messages if isinstance(m, wire.HandFrame)] == [1, 2]
        assert not any(message.retained for message in later_messages)
        assert late.lost_messages == 0
    for number in range(7, 10):  # released without a subscriber
        cycle(number, bytes(8))
    with connect("contact/*/*", "hand/*", endpoint=endpoint) as last:
        (frame,) = _receive_all(publisher, last, 1)
        assert columns(frame)["state"].tolist() == [0, 0, 0]
        assert np.isnan(columns(frame)["force_n"]).all()


def test_seq_gap_counts_messages_published_while_disconnected(publisher: Publisher, bench: Any) -> None:
    pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, publisher)
    endpoint = publisher.endpoints["live"]
    socket: zmq.Socket[bytes]
    with connect("hand/h", endpoint=endpoint) as messages:
        _until(publisher, "hand/h")
        pipeline.tick_without_sync(NOW_NS)
        assert messages.recv().seq == 1
        socket = messages.connection.socket
        socket.disconnect(endpoint)
        while publisher.has_subscriber("hand/h"):
            assert messages.recv(0.001) is None
            CLOCK.poll(publisher)
        for number in range(1, 8):
            pipeline.tick_without_sync(NOW_NS + number * PERIOD_NS)
        socket.connect(endpoint)
        _until(publisher, "hand/h")
        pipeline.tick_without_sync(NOW_NS + 8 * PERIOD_NS)
        assert messages.recv().seq == 9
        assert messages.lost_messages == 7


def test_retained_messages_per_poll_are_bounded(
    publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(100):
        health = replace(_health(publisher, f"link_{number}"), retained=True)
        publisher.retained_messages[wire.topic_of(health)] = lambda _, health=health: health  # type: ignore[misc]
    encoded = 0
    encode = wire.encode

    def counted(message: wire.Message) -> list[bytes]:
        nonlocal encoded
        encoded += 1
        return encode(message)

    monkeypatch.setattr(wire, "encode", counted)
    with ExitStack() as stack:
        endpoint = publisher.endpoints["live"]
        subscribers = [stack.enter_context(connect("health/*/*", endpoint=endpoint)) for _ in range(5)]
        received: list[set[str]] = [set() for _ in subscribers]
        max_sent = 0
        while min(map(len, received)) < 100:
            before = encoded
            CLOCK.poll(publisher)
            max_sent = max(max_sent, encoded - before)
            for subscriber, links in zip(subscribers, received, strict=True):
                while (message := subscriber.recv(0.001)) is not None:
                    links.add(message.link)
    assert 0 < max_sent <= 16


def test_stalled_subscriber_loses_messages_and_others_do_not(publisher: Publisher) -> None:
    endpoint = publisher.endpoints["live"]
    text = "x" * 50_000  # kernel buffers fill after some dozens of these
    count = 20 * LIVE_QUEUE_MESSAGES
    with connect("health/*/*", endpoint=endpoint, queue=1), connect("health/*/*", endpoint=endpoint) as awake:
        _until(publisher, "health/h/thumb")
        for _ in range(200):  # both have joined when the second subscription has been taken, too
            CLOCK.poll(publisher)
            time.sleep(0.001)
        got = []
        for number in range(count):
            publisher.send(_health(publisher, "thumb", text, 1 + number))
            got.append(awake.recv().seq)
        assert got == list(range(1, count + 1))
    assert publisher.congestion_episodes["live"] > 0


def test_subscription_flood_is_cut_off_and_disturbs_no_other_subscriber(publisher: Publisher) -> None:
    endpoint = publisher.endpoints["live"]
    with (
        connect("health/*/*", endpoint=endpoint) as other,
        zmq.Context() as context,
        context.socket(zmq.SUB) as flood,
    ):
        _until(publisher, "health/h/thumb")
        flood.setsockopt(zmq.LINGER, 0)
        flood.setsockopt(zmq.SNDHWM, 0)
        flood.connect(endpoint)
        for number in range(5000):
            flood.subscribe(f"contact/no_such_hand/{number}")
        sent = 0
        while sent < 500 or not publisher.refused["subscription_flood"]:
            flood.poll(0)
            CLOCK.poll(publisher)
            sent += 1
            publisher.send(_health(publisher, "thumb", seq=sent))
            assert other.recv().seq == sent
        assert publisher.subscriptions == {b"health/", b"service"}
        assert other.lost_messages == 0
        assert publisher.refused["unknown_topic"] < 2000


def test_flood_of_subscriptions_leaves_nothing_to_read_when_it_ends(publisher: Publisher) -> None:
    endpoint = publisher.endpoints["live"]
    with connect("health/*/*", endpoint=endpoint) as other:
        _until(publisher, "health/h/thumb")
        with zmq.Context() as context:
            floods = [context.socket(zmq.SUB) for _ in range(4)]
            for flood in floods:
                flood.setsockopt(zmq.LINGER, 0)
                flood.setsockopt(zmq.SNDHWM, 0)
                flood.setsockopt(zmq.RECONNECT_IVL, 1)
                flood.connect(endpoint)
            for number in range(200):
                for flood in floods:
                    for k in range(100):
                        flood.subscribe(f"contact/no_such_hand/{number}/{k}")
                    flood.poll(0)
                CLOCK.poll(publisher)
                for _ in range(20):  # ZeroMQ takes subscriptions from its connections whenever it sends
                    publisher.send(_health(publisher, "thumb"))
            for flood in floods:
                flood.close()
        for _ in range(50):
            CLOCK.poll(publisher)
        read = publisher.refused["unknown_topic"]
        for _ in range(50):
            CLOCK.poll(publisher)
        assert publisher.refused["unknown_topic"] == read
        assert other.recv() is not None


FLOOD_WITH_HEARTBEATS = """
import contextlib, socket, sys, threading, time
import zmq
from handtouch import wire
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import Publisher

greeting = b"\\xff" + bytes(8) + b"\\x7f\\x03\\x01" + b"NULL".ljust(20, b"\\0") + b"\\0" + bytes(31)
ready = b"\\x04\\x19\\x05READY\\x0bSocket-Type\\0\\0\\0\\x03SUB"
ping = b"\\x04\\x07\\x04PING\\0\\0"
flood = (b"\\0\\x05\\x01none" + ping) * 5000

def attack(port):
    while True:
        with socket.create_connection(("127.0.0.1", port)) as connection, contextlib.suppress(OSError):
            connection.sendall(greeting + ready)
            connection.recv(92, socket.MSG_WAITALL)  # the daemon's greeting and READY
            connection.sendall(flood)
            connection.settimeout(0.2)
            while connection.recv(1000):
                pass

with zmq.Context() as context:
    topics = wire.topics_of({"h": ["x"]})
    guard = Authenticator(context)
    publisher = Publisher.open(context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*", topics, guard)
    port = int(publisher.endpoints["live"].rpartition(":")[2])
    for _ in range(8):
        threading.Thread(target=attack, args=(port,), daemon=True).start()
    end_s, now_ns = time.monotonic() + 60, 0
    while publisher.refused["subscription_flood"] < 84 and time.monotonic() < end_s:
        publisher.poll_subscriptions(now_ns)
        now_ns += 20_000_000
        time.sleep(0.001)
    print(publisher.refused["subscription_flood"] >= 84)
    publisher.close()
    sys.stdout.flush()
    import os; os._exit(0)
"""


def test_closing_a_flooding_connection_with_heartbeats_does_not_abort_the_daemon() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FLOOD_WITH_HEARTBEATS], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


STALLED_READER = """
import sys, time
from handtouch.client import connect

with connect("health/*/*", endpoint=sys.argv[1], queue=1) as reader:
    assert reader.recv(60) is not None
    time.sleep(4)
    for _ in range(20):
        assert reader.recv(60) is not None
"""


def test_reader_survives_a_pause_with_a_full_queue(publisher: Publisher) -> None:
    command = [sys.executable, "-c", STALLED_READER, publisher.endpoints["live"]]
    with subprocess.Popen(command) as reader:
        seq = 0
        while reader.poll() is None:
            CLOCK.poll(publisher)
            seq += 1
            publisher.send(_health(publisher, "thumb", "x" * 50_000, seq))
            time.sleep(0.001)
    assert reader.returncode == 0


def test_subscriber_that_subscribes_over_and_over_is_closed(publisher: Publisher) -> None:
    with connect("service", endpoint=publisher.endpoints["live"]) as restless:
        while not publisher.refused["subscription_flood"]:
            restless.resubscribe("hand/")
            restless.recv(0.0001)
            publisher.poll_subscriptions(CLOCK.now_ns)
    assert publisher.refused == {"subscription_flood": 1}


def test_retained_message_is_sent_once_for_all_who_join_within_its_period(publisher: Publisher) -> None:
    sent = 0

    def retained(_: int) -> wire.Health:
        nonlocal sent
        sent += 1
        return replace(_health(publisher, "thumb"), retained=True)

    publisher.retained_messages["health/h/thumb"] = retained
    with ExitStack() as stack:
        for _ in range(20):
            joining = stack.enter_context(connect("health/h/thumb", endpoint=publisher.endpoints["live"]))
            while joining.recv(0.001) is None:
                CLOCK.now_ns += 10_000_000
                publisher.poll_subscriptions(CLOCK.now_ns)
        begin_ns, before = CLOCK.now_ns, sent
        for _ in range(200):
            CLOCK.now_ns += 1_000_000
            joining.resubscribe("health/h/thumb")
            publisher.poll_subscriptions(CLOCK.now_ns)
        assert sent - before <= 1 + (CLOCK.now_ns - begin_ns) / 100e6


def test_unsubscribing_ends_encoding(publisher: Publisher) -> None:
    with connect("health/*/*", endpoint=publisher.endpoints["live"]):
        _until(publisher, "health/h/thumb")
    _until(publisher, "health/h/thumb", subscribed=False)


def test_port_in_use_is_reported_with_a_remedy(publisher: Publisher) -> None:
    taken = publisher.endpoints["live"]
    with zmq.Context() as context, Authenticator(context) as guard, pytest.raises(OSError, match=taken):
        Publisher.open(context, taken, "tcp://127.0.0.1:*", TOPICS, guard)


def test_ipc_endpoint_in_use_is_not_taken_over(endpoints: dict[str, str], tmp_path: Path) -> None:
    with (
        zmq.Context() as others,
        zmq.Context() as context,
        Authenticator(others) as theirs,
        Authenticator(context) as guard,
    ):
        first = Publisher.open(others, endpoints["live"], endpoints["complete"], TOPICS, theirs)
        with pytest.raises(OSError, match="another daemon is using it"):
            Publisher.open(context, endpoints["live"], "tcp://127.0.0.1:*", TOPICS, guard)
        first.close()
    with zmq.Context() as context, Authenticator(context) as guard:
        Publisher.open(
            context, endpoints["live"], endpoints["complete"], TOPICS, guard
        ).close()  # a stale socket file is no obstacle
        with pytest.raises(OSError, match="create it"):
            Publisher.open(context, f"ipc://{tmp_path}/absent/live", "tcp://127.0.0.1:*", TOPICS, guard)
