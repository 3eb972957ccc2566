"""What a client that waits for what isn't there learns: no daemon, no such hand or link, another endpoint."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable
from typing import Any

import pytest
import zmq

import handtouch
from handtouch import wire
from handtouch.client import connection
from handtouch.client.names import unknown_name
from tests.client.hand_messages import make_contact, make_frame, make_service

HANDS = {"right": ["thumb_tip", "index_tip"], "left": ["palm"]}


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [
        ("contact/*/*", ""),
        ("contact/right/thumb_*", ""),
        ("contact/*/palm", ""),
        ("health/l?ft/palm", ""),
        ("hand/left", ""),
        ("percept/left/motion", ""),
        ("service", ""),
        ("*/right/*", ""),
        ("contact/rigth/*", "the daemon has no hand 'rigth'; it has right, left"),
        ("hand/middle", "the daemon has no hand 'middle'; it has right, left"),
        ("percept/middle/*", "the daemon has no hand 'middle'; it has right, left"),
        ("contact/right/palm", "no link 'palm' on right; the links are thumb_tip, index_tip"),
        ("contact/right/tumb_tip", "no link 'tumb_tip' on right; did you mean 'thumb_tip'?"),
    ],
)
def test_what_the_daemon_lacks_is_named_with_what_it_has(pattern: str, reason: str) -> None:
    assert unknown_name(pattern, HANDS) == reason


def _send_service(publisher: Any, subscriptions: int, **values: Any) -> None:
    for _ in range(subscriptions):
        assert publisher.poll(5000)
        publisher.recv()
    publisher.send_multipart(wire.encode(make_service(**values)))


def test_an_unknown_hand_raises_an_error_that_names_those_of_the_daemon(
    publisher: Any, endpoints: dict[str, str]
) -> None:
    with handtouch.Hand("rigth", endpoint=endpoints["live"]) as hand:
        _send_service(publisher, 3)
        with pytest.raises(handtouch.UnknownNameError, match="no hand 'rigth'; it has right"):
            hand.wait(5)
        with pytest.raises(handtouch.UnknownNameError):
            hand.latest()


def test_a_hand_that_the_daemon_has_after_a_restart_is_found(
    publisher: Any, endpoints: dict[str, str]
) -> None:
    with handtouch.Hand("right", endpoint=endpoints["live"], max_age_s=1e9) as hand:
        _send_service(publisher, 3, hands={"left": ["palm"]})
        with pytest.raises(handtouch.UnknownNameError):
            hand.wait(5)
        publisher.send_multipart(wire.encode(make_service(session=2)))
        publisher.send_multipart(wire.encode(make_frame(session=2)))
        assert _until(lambda: _frame_or_none(hand) is not None)


def _frame_or_none(hand: handtouch.Hand) -> object:
    try:
        return hand.wait(0.1)
    except handtouch.UnknownNameError:
        return None


def _until(condition: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + 10
    while not (met := condition()) and time.monotonic() < end_s:
        pass
    return met


def test_a_subscription_to_an_unknown_link_raises_in_every_call(
    publisher: Any, endpoints: dict[str, str]
) -> None:
    with handtouch.connect("contact/right/tumb_tip", endpoint=endpoints["live"]) as contacts:
        _send_service(publisher, 2)
        for seq in (2, 3):  # `service` comes twice a second
            publisher.send_multipart(wire.encode(make_service(seq)))
        for _ in range(2):
            with pytest.raises(handtouch.UnknownNameError, match="did you mean 'thumb_tip'"):
                contacts.recv(5)
        with pytest.raises(handtouch.UnknownNameError):
            asyncio.run(contacts.arecv(5))


def test_a_subscription_to_a_link_that_the_daemon_has_after_a_restart_receives(
    publisher: Any, endpoints: dict[str, str]
) -> None:
    with handtouch.connect("contact/right/thumb_tip", endpoint=endpoints["live"]) as contacts:
        _send_service(publisher, 2, hands={"left": ["palm"]})
        with pytest.raises(handtouch.UnknownNameError):
            contacts.recv(5)
        publisher.send_multipart(wire.encode(make_service(session=2)))
        publisher.send_multipart(wire.encode(make_contact("thumb_tip", "begin", 1, session=2)))
        contact = contacts.recv(5)
    assert contact is not None
    assert contact.link == "thumb_tip"


@pytest.fixture(autouse=True)
def _short_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "SILENCE_S", 0.1)


def _warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


@pytest.mark.parametrize("way", ["hand", "latest", "subscriber", "asyncio"])
def test_the_absence_of_a_daemon_is_logged_once(
    way: str, endpoints: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = endpoints["live"]
    with handtouch.Hand("right", endpoint=endpoint) as hand, handtouch.connect(endpoint=endpoint) as contacts:
        match way:
            case "hand":
                assert hand.wait(0.3) is None
                assert hand.wait(0.1) is None
            case "latest":
                assert _until(lambda: hand.latest() is not None or bool(_warnings(caplog)))
            case "subscriber":
                assert _until(lambda: contacts.recv(0.1) is not None or bool(_warnings(caplog)))
            case "asyncio":
                assert asyncio.run(contacts.arecv(0.3)) is None
    assert _warnings(caplog) == [f"no daemon at {endpoint}; start `handtouch run FILE`"]


def test_another_kind_of_endpoint_is_named(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "SILENCE_S", 1.0)  # until then, a busy machine has refused the connection
    with zmq.Context() as context, context.socket(zmq.ROUTER) as control, context.socket(zmq.XPUB) as live:
        ports = [socket.bind_to_random_port("tcp://127.0.0.1") for socket in (control, live)]
        with handtouch.connect(endpoint=f"tcp://127.0.0.1:{ports[0]}") as contacts:
            assert _until(lambda: contacts.recv(0.1) is not None or bool(_warnings(caplog)))

        def answer() -> str:  # on a busy machine the connection isn't refused yet
            with pytest.raises(TimeoutError) as raised:
                handtouch.request("status", endpoint=f"tcp://127.0.0.1:{ports[1]}", timeout_s=0.5)
            return str(raised.value)

        assert _until(lambda: "takes no requests, perhaps it is a stream" in answer())
    assert [re.findall(r"is no stream of messages", text) for text in _warnings(caplog)] == [
        ["is no stream of messages"]
    ]


def test_a_daemon_that_answers_is_not_reported(
    publisher: Any, endpoints: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    with handtouch.Hand("right", endpoint=endpoints["live"], max_age_s=1e9) as hand:
        _send_service(publisher, 3)
        assert hand.wait(0.3) is None
    assert not _warnings(caplog)
