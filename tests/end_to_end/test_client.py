"""Subscribers of the real daemon: no contact, a stale sensor and a disconnected daemon differ."""

from __future__ import annotations

import os
import signal
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest

from handtouch import wire
from handtouch.client import Subscriber, columns, connect
from handtouch.client.hand import Hand

LONGEST_S = 60.0
EVERYTHING = ("contact/*/*", "hand/*", "health/*/*", "service")


def _until(
    rig: Any,
    messages: Subscriber[Any],
    met: Callable[[Any], bool],
    each: Callable[[Any], None] = lambda _: None,
) -> Any:
    """The first message that meets a condition; `each` gets all of them."""
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        if (message := messages.recv(0.1)) is not None:
            each(message)
            if met(message):
                return message
    raise AssertionError(f"never came\n{rig.all_printed()}")


def _is(kind: type[Any], **values: Any) -> Callable[[Any], bool]:
    return lambda m: isinstance(m, kind) and all(getattr(m, name) == value for name, value in values.items())


def test_no_contact_a_stale_sensor_and_a_disconnected_daemon_differ(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    states: dict[str, int] = {}

    def note(message: Any) -> None:
        if isinstance(message, wire.HandFrame):
            states.update(zip(message.links, columns(message)["state"].tolist(), strict=True))

    with rig.subscribe(*EVERYTHING) as messages:
        # no contact: it was released, its pad is sampled, and the daemon is alive
        ended = _until(rig, messages, _is(wire.Contact, event="end"), note)
        assert ended.end_reason == "released"
        frame = _until(
            rig, messages, lambda m: isinstance(m, wire.HandFrame) and m.seq > 0 and m.t_ns >= ended.t_ns
        )
        assert columns(frame)["state"][frame.links.index(ended.link)] == wire.PadState.CLEAR
        assert messages.alive

        # stale sensor: pads of stopped nodes become stale, then lost, their contacts end, the daemon is alive
        _until(rig, messages, _is(wire.Contact, event="begin"), note)
        rig.processes["simulate"].send_signal(signal.SIGSTOP)
        try:
            ended = _until(rig, messages, _is(wire.Contact, event="end"), note)
            if ended.end_reason == "released":  # just before the nodes stopped
                ended = None
            _until(rig, messages, _is(wire.Health, state="stale"), note)
            _until(rig, messages, _is(wire.Health, state="lost"), note)
            _until(rig, messages, lambda _: set(states.values()) == {int(wire.PadState.LOST)}, note)
            assert ended is None or ended.end_reason in ("stale", "lost")
            _until(rig, messages, _is(wire.Service), note)
            assert messages.alive
        finally:
            rig.processes["simulate"].send_signal(signal.SIGCONT)
        session = _until(rig, messages, _is(wire.Contact, event="begin"), note).session  # recovered

        # disconnected daemon: no messages, not even its heartbeat, and no end of the contact
        rig.end("run", signal.SIGKILL)
        end_s = time.monotonic() + LONGEST_S
        while messages.alive:
            assert time.monotonic() < end_s
            messages.recv(0.1)
        assert messages.recv(0) is None

        for endpoint in rig.endpoints.values():
            if os.path.exists(path := endpoint.removeprefix("ipc://")):
                os.unlink(path)
        rig.start("run")
        back = _until(rig, messages, _is(wire.Contact, event="update"), note)
        assert messages.alive
        assert back.session != session
        assert messages.lost_messages == 0
        assert messages.malformed_messages == 0


@pytest.mark.parametrize("stream", ["live", "complete"])
def test_a_late_subscriber_gets_the_current_state_once(working: Any, stream: str) -> None:
    endpoint = working.endpoints[stream]
    received, retained = set[type[Any]](), set[type[Any]]()
    with connect(*EVERYTHING, endpoint=endpoint, queue=100_000) as early:
        seen: dict[str, list[int]] = defaultdict(list)

        def note(message: Any) -> None:
            seen[wire.topic_of(message)].append(message.seq)

        end_s = time.monotonic() + LONGEST_S
        # of a topic with a message per tick, the next one mostly precedes the retained one
        while not (received >= {wire.Contact, wire.HandFrame} and retained >= {wire.Health, wire.Service}):
            assert time.monotonic() < end_s, (received, retained)
            _until(working, early, lambda m: isinstance(m, wire.Contact) and m.event != "end", note)
            with connect(*EVERYTHING, endpoint=endpoint) as late:  # the same prefixes
                first: dict[str, Any] = {}
                while len([topic for topic in first if topic.startswith("health/")]) < 15:
                    message = late.recv(LONGEST_S)
                    assert message is not None, working.all_printed()
                    first.setdefault(wire.topic_of(message), message)
                    received.add(type(message))
                    if message.retained:
                        assert not isinstance(message, wire.Contact) or message.event == "update"
                        retained.add(type(message))
                assert late.lost_messages == 0
        _until(working, early, _is(wire.Service), note)
        assert early.lost_messages == 0
    for topic, seqs in seen.items():
        assert seqs == list(range(seqs[0], seqs[0] + len(seqs))), topic


def test_congestion_episodes_of_both_streams_are_named_in_service(rig: Any) -> None:
    rig.start("run")
    with rig.subscribe("service") as messages:
        assert messages.recv().congestion_episodes == {"live": 0, "complete": 0}


def test_a_hand_has_the_state_that_its_messages_have(working: Any) -> None:
    endpoints = working.endpoints
    seen: dict[int, Any] = {}
    end_s = time.monotonic() + LONGEST_S
    with (
        Hand("right", endpoint=endpoints["live"], control=endpoints["control"]) as hand,
        connect("hand/right", endpoint=endpoints["live"], queue=100_000) as frames,
    ):
        began, ended = set[int](), False
        while len(seen) < 50 or not ended:
            assert time.monotonic() < end_s, working.all_printed()
            arrays = hand.wait(LONGEST_S)
            assert arrays is not None
            seen[arrays.frame.seq] = arrays
            for link, contact in hand.contacts.items():
                assert (contact.hand, contact.link) == ("right", link)
                assert contact.event != "end"
                began.add(contact.id)
            active = {contact.id for contact in hand.contacts.values()}
            ended = bool(began - active)
        compared = 0
        while (frame := frames.recv(LONGEST_S)) is not None:
            if frame.seq in seen:
                compared += 1
                for name, array in columns(frame).items():
                    assert seen[frame.seq].column(name).array.tobytes() == array.tobytes()
            if frame.seq >= max(seen):
                break
        assert compared > 40
        assert hand.malformed_messages == 0


def test_requests_are_methods_with_typed_results(working: Any) -> None:
    endpoints = working.endpoints
    with Hand("right", endpoint=endpoints["live"], control=endpoints["control"]) as hand:
        status = hand.control.status()
        assert status.service.hands == {"right": [pad.link for pad in status.pads]}
        snapshot = hand.control.snapshot()
        assert snapshot.hands["right"].links == tuple(pad.link for pad in status.pads)
        scenes = hand.scene(outputs=["position", "force"], name="a test", lease_s=1.0)
        assert any(scene["owner"] == "client a test" for scene in scenes["scenes"])
        assert hand.disable("thumb_*", name="a test")
        assert hand.enable("thumb_*") == {}
        (tared,) = hand.tare("ring_distal")
        assert (tared["hand"], tared["link"]) == ("right", "ring_distal")
        assert tared["tared"] is (tared["reason"] == "")  # too few samples where the machine stalls
        calibration = hand.control.calibrate("right/ring_distal")
        assert calibration["calibration_id"] == calibration["previous_calibration_id"]
        assert len(calibration["gains"]) == 4
        with pytest.raises(RuntimeError, match='no pad is named "right/ring_tip"'):
            hand.tare("ring_tip")
        with pytest.raises(ValueError, match="give a list"):
            hand.scene(outputs="force")  # type: ignore[arg-type]
