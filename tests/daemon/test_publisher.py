"""The publisher serves whoever subscribed, and nobody can hold it up."""

from __future__ import annotations

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
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.publisher import LIVE_QUEUE, Publisher
from handtouch.wire import PadState

NOW_NS = 10**9
PERIOD_NS = 5_000_000


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with zmq.Context() as context:
        made = Publisher(context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
        yield made
        made.close()


def _health(publisher: Publisher, link: str, text: str = "", seq: int = 1) -> wire.Health:
    return wire.Health(
        wire.SCHEMA_VERSION, publisher.run, seq, 1, "h", link, "can0", 1, "clear",
        "operational", 0, "sync", text, None, 0.0, 0, 0, None, 0, 0, (), False,
    )  # fmt: skip


def _until(publisher: Publisher, topic: str, wanted: bool = True) -> None:
    for _ in range(2000):
        publisher.take_subscriptions(NOW_NS)
        if publisher.wants(topic) == wanted:
            return
        for socket in publisher._sockets.values():
            socket.poll(5)
    raise AssertionError(f"nobody subscribed to {topic}")


def test_a_message_reaches_those_who_subscribed_and_only_whole_matches(publisher: Publisher) -> None:
    with connect("health/h/thumb", endpoint=publisher.endpoints["live"]) as subscriber:
        _until(publisher, "health/h/thumb")
        publisher.send(_health(publisher, "thumb_tip"))
        publisher.send(_health(publisher, "thumb"))
        message = subscriber.recv()
        assert message.link == "thumb"
        assert subscriber.recv(0) is None


def test_nothing_is_encoded_for_nobody(publisher: Publisher, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: wire.Message) -> list[bytes]:
        raise AssertionError("encoded without a subscriber")

    monkeypatch.setattr(wire, "encode", refuse)
    publisher.send(_health(publisher, "thumb"))
    assert not publisher.wants("health/h/thumb")


def _all_that_comes(publisher: Publisher, subscriber: Subscriber[Any], least: int) -> list[Any]:
    """What reaches a subscriber: at least so many messages, and until nothing more comes."""
    got: list[Any] = []
    for _ in range(1000):
        publisher.take_subscriptions(NOW_NS)
        if (message := subscriber.recv(0.01)) is not None:
            got.append(message)
        elif len(got) >= least:
            return got
    raise AssertionError(f"only {got}")


def test_a_late_joiner_gets_the_lasting_state_as_a_repeat_and_others_do_not_see_it_twice(
    publisher: Publisher,
) -> None:
    with connect("health/*/*", endpoint=publisher.endpoints["live"]) as early:
        _until(publisher, "health/h/thumb")
        told = _health(publisher, "thumb", "first")
        publisher.present["health/h/thumb"] = lambda _: replace(told, repeat=True)
        publisher.send(told)
        first = early.recv()
        assert (first.reason, first.repeat) == ("first", False)
        with connect("health/*/*", endpoint=publisher.endpoints["live"]) as late:  # the very same prefix
            (repeat,) = _all_that_comes(publisher, late, 1)
            assert (repeat.reason, repeat.repeat, repeat.seq) == ("first", True, first.seq)
        publisher.send(_health(publisher, "thumb", "second", 2))
        assert early.recv().reason == "second"
        assert early.gaps == 0


@pytest.mark.parametrize("stream", ["live", "complete"])
def test_a_late_joiner_gets_contacts_under_way_and_the_hand_at_once(
    publisher: Publisher, bench: Any, stream: str
) -> None:
    pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, publisher, publisher.run)
    pipeline.node_state[:] = PadState.CLEAR
    publisher.present.update(pipeline.messages.present())
    touch = bench.counts(0, 0.3, 0.6, 1e-3).tobytes()

    def cycle(number: int, samples: bytes) -> None:
        t_ns = NOW_NS + number * PERIOD_NS
        pipeline.begin(t_ns, t_ns)
        for pad in range(3):
            pipeline.slab.write(pad, samples if pad == 0 else bytes(8), t_ns + 1000)
        pipeline.advance(t_ns + 4_000_000)

    endpoint, patterns = publisher.endpoints[stream], ("contact/*/*", "hand/*", "raw/*")
    for number in range(5):  # touched, and told to nobody
        cycle(number, touch)
    with connect(*patterns, endpoint=endpoint) as late:
        contact, frame = _all_that_comes(publisher, late, 2)
        assert (contact.event, contact.id, contact.link, contact.repeat) == ("update", 1, "plane", True)
        assert (contact.run, contact.age_s) == (publisher.run, pytest.approx(-0.02))  # NOW_NS is before it
        row = columns(frame)
        assert frame.repeat
        assert row["state"].tolist() == [1, 0, 0]
        assert row["contact"].tolist() == [1, 0, 0]
        assert row["position_m"][0] == pytest.approx(contact.position_m)
        assert row["covariance_m2"][0] == pytest.approx(contact.covariance_m2)
        assert row["pad_m"][0] == pytest.approx(contact.pad_m)
        assert [row[name][0] for name in ("force_n", "force_std_n", "residual_std")] == pytest.approx(
            [contact.force_n, contact.force_std_n, contact.residual_std], rel=1e-6
        )
        assert np.isnan(row["position_m"][1:]).all()
        cycle(5, touch)
        with connect(*patterns, endpoint=endpoint) as later:
            assert {type(message) for message in _all_that_comes(publisher, later, 2)} >= {
                wire.Contact,
                wire.HandFrame,
            }
        cycle(6, touch)
        news = _all_that_comes(publisher, late, 6)
        assert [m.seq - contact.seq for m in news if isinstance(m, wire.Contact)] == [1, 2]
        assert [m.seq - frame.seq for m in news if isinstance(m, wire.HandFrame)] == [1, 2]
        assert not any(message.repeat for message in news)
        assert late.gaps == 0
    for number in range(7, 10):  # released while nobody listens
        cycle(number, bytes(8))
    with connect("contact/*/*", "hand/*", endpoint=endpoint) as last:
        (frame,) = _all_that_comes(publisher, last, 1)
        assert columns(frame)["state"].tolist() == [0, 0, 0]
        assert np.isnan(columns(frame)["force_n"]).all()


def test_who_was_away_sees_by_the_gap_how_much_there_was_to_tell(publisher: Publisher, bench: Any) -> None:
    pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, publisher)
    endpoint = publisher.endpoints["live"]
    socket: zmq.Socket[bytes]
    with connect("hand/h", endpoint=endpoint) as messages:
        _until(publisher, "hand/h")
        pipeline.tick_now(NOW_NS)
        assert messages.recv().seq == 1
        socket = messages._socket
        socket.disconnect(endpoint)
        while publisher.wants("hand/h"):
            assert messages.recv(0.001) is None
            publisher.take_subscriptions(NOW_NS)
        for number in range(1, 8):
            pipeline.tick_now(NOW_NS + number * PERIOD_NS)
        socket.connect(endpoint)
        _until(publisher, "hand/h")
        pipeline.tick_now(NOW_NS + 8 * PERIOD_NS)
        assert messages.recv().seq == 9
        assert messages.gaps == 7


def test_late_joiners_cost_a_tick_no_more_than_a_few_messages(
    publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(100):
        health = replace(_health(publisher, f"link_{number}"), repeat=True)
        publisher.present[wire.topic_of(health)] = lambda _, health=health: health  # type: ignore[misc]
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
        told: list[set[str]] = [set() for _ in subscribers]
        most = 0
        while min(map(len, told)) < 100:
            before = encoded
            publisher.take_subscriptions(NOW_NS)
            most = max(most, encoded - before)
            for subscriber, links in zip(subscribers, told, strict=True):
                while (message := subscriber.recv(0.001)) is not None:
                    links.add(message.link)
    assert 0 < most <= 16


def test_a_subscriber_that_stalls_loses_messages_and_nobody_else_does(publisher: Publisher) -> None:
    endpoint = publisher.endpoints["live"]
    text = "x" * 50_000  # kernel buffers fill after some dozens of these
    count = 20 * LIVE_QUEUE
    with connect("health/*/*", endpoint=endpoint, queue=1), connect("health/*/*", endpoint=endpoint) as awake:
        _until(publisher, "health/h/thumb")
        for _ in range(200):  # both have joined when the second subscription has been taken, too
            publisher.take_subscriptions(NOW_NS)
            publisher._sockets["live"].poll(1)
        got = []
        for number in range(count):
            publisher.send(_health(publisher, "thumb", text, 1 + number))
            got.append(awake.recv().seq)
        assert got == list(range(1, count + 1))
    assert publisher.drops["live"] > 0


def test_a_subscriber_that_leaves_is_forgotten(publisher: Publisher) -> None:
    with connect("health/*/*", endpoint=publisher.endpoints["live"]):
        _until(publisher, "health/h/thumb")
    _until(publisher, "health/h/thumb", wanted=False)


def test_a_taken_port_is_named_with_its_remedy(publisher: Publisher) -> None:
    taken = publisher.endpoints["live"]
    with zmq.Context() as context, pytest.raises(OSError, match=taken):
        Publisher(context, taken, "tcp://127.0.0.1:*")


def test_an_ipc_endpoint_is_not_taken_away_from_a_daemon_that_has_it(
    endpoints: dict[str, str], tmp_path: Path
) -> None:
    with zmq.Context() as others, zmq.Context() as context:
        first = Publisher(others, endpoints["live"], endpoints["complete"])
        with pytest.raises(OSError, match="another daemon has it"):
            Publisher(context, endpoints["live"], "tcp://127.0.0.1:*")
        first.close()
    with zmq.Context() as context:
        Publisher(
            context, endpoints["live"], endpoints["complete"]
        ).close()  # what is left of it is no matter
        with pytest.raises(OSError, match="create it"):
            Publisher(context, f"ipc://{tmp_path}/absent/live", "tcp://127.0.0.1:*")
