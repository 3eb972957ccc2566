"""The publisher serves whoever subscribed, and nobody can hold it up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from handtouch import wire
from handtouch.client import connect
from handtouch.daemon.publisher import LIVE_QUEUE, Publisher


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with zmq.Context() as context:
        made = Publisher(context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
        yield made
        made.close()


def _health(publisher: Publisher, link: str, text: str = "") -> wire.Health:
    topic = f"health/h/{link}"
    return wire.Health(
        wire.SCHEMA_VERSION, publisher.run, publisher.next_seq(topic), 1, "h", link, "can0", 1, "clear", "operational",
        0, "sync", text, None, 0.0, 0, 0, None, 0, 0, (), False,
    )  # fmt: skip


def _until(publisher: Publisher, topic: str, wanted: bool = True) -> None:
    for _ in range(2000):
        publisher.take_subscriptions(0)
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


def test_a_late_joiner_gets_the_lasting_state_as_a_repeat_and_others_do_not_see_it_twice(
    publisher: Publisher,
) -> None:
    with connect("health/*/*", endpoint=publisher.endpoints["live"]) as early:
        _until(publisher, "health/h/thumb")
        publisher.send(_health(publisher, "thumb", "first"), lasting=True)
        first = early.recv()
        assert (first.reason, first.repeat) == ("first", False)
        with connect("health/h/*", endpoint=publisher.endpoints["live"]) as late:
            for _ in range(1000):
                publisher.take_subscriptions(0)
                repeat = late.recv(0.01)
                if repeat is not None:
                    break
            assert repeat is not None
            assert (repeat.reason, repeat.repeat, repeat.seq) == ("first", True, first.seq)
        publisher.send(_health(publisher, "thumb", "second"), lasting=True)
        assert early.recv().reason == "second"
        assert early.gaps == 0


def test_a_subscriber_that_stalls_loses_messages_and_nobody_else_does(publisher: Publisher) -> None:
    endpoint = publisher.endpoints["live"]
    text = "x" * 50_000  # kernel buffers fill after some dozens of these
    count = 20 * LIVE_QUEUE
    with connect("health/*/*", endpoint=endpoint, queue=1), connect("health/*/*", endpoint=endpoint) as awake:
        _until(publisher, "health/h/thumb")
        for _ in range(200):  # both have joined when the second subscription has been taken, too
            publisher.take_subscriptions(0)
            publisher._sockets["live"].poll(1)
        got = []
        for _ in range(count):
            publisher.send(_health(publisher, "thumb", text))
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
