"""What goes into a recording: every message once and in order, losses counted, files that stand alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import pytest
from mcap.reader import make_reader

from handtouch import wire
from handtouch.record.read import Recording
from handtouch.record.recorder import Limits, Recorder
from handtouch.record.schemas import FOXGLOVE, schema_of

from .conftest import RUN, WALL_NS, Session, health, service

SECOND_NS = 1_000_000_000


def test_every_message_is_kept_as_it_was_sent_in_its_order(session: Session) -> None:
    session.hand.stroke(60)
    session.recorder.finish()
    sent = [(wire.topic_of(m), msgpack.unpackb(wire.encode(m)[1])) for m in session.hand.taken.messages]
    assert any(topic.startswith("contact/") for topic, _ in sent)
    kept = [(topic, payload) for topic, _, payload in Recording(session.paths[0]) if topic != "service"]
    assert kept == sent


def test_times_are_the_daemons_in_utc(recorded: Path) -> None:
    for _, t_ns, payload in Recording(recorded):
        assert t_ns == payload["t_ns"] + WALL_NS


class Names:
    """A file of which only the topics and times are of interest."""

    size = 0

    def __init__(self) -> None:
        self.written: list[tuple[str, int]] = []

    def write(self, topic: str, data: bytes, t_ns: int, seq: int = 0, foxglove: str = "") -> None:
        assert data
        assert seq >= 0
        if not foxglove:
            self.written.append((topic, t_ns))

    def flush(self) -> None:
        """Nothing."""

    def finish(self, summary: dict[str, str]) -> None:
        assert summary


def test_messages_before_the_time_is_known_are_kept_once_it_is() -> None:
    file = Names()
    recorder = Recorder(lambda _: file, Limits())
    recorder.take(health(1, 5), 0)
    assert file.written == []
    recorder.take(service(1, 6), 0)
    assert file.written == [("health/h/plane", 5 + WALL_NS), ("service", 6 + WALL_NS)]


def test_gaps_are_counted_by_topic_and_told_in_the_file(session: Session) -> None:
    ticks = iter(range(10**6))
    session.lose = lambda topic: topic == b"tick" and next(ticks) in (10, 11, 30)
    session.hand.stroke(50)
    session.recorder.finish()
    assert session.recorder.lost == Counter({"tick": 3})
    recording = Recording(session.paths[0])
    assert sum(topic == "tick" for topic, *_ in recording) == 47
    assert json.loads(recording.summary["lost"]) == {"tick": 3}


def test_the_state_is_asked_for_anew_where_ticks_are_missing(session: Session) -> None:
    session.hand.stroke(5)
    session.recorder.poll(10 * SECOND_NS)
    assert not session.recorder.asks
    session.lose = lambda topic: topic == b"tick"
    session.hand.stroke(3)
    session.lose = lambda _: False
    session.hand.stroke(3)
    session.recorder.poll(20 * SECOND_NS)
    assert session.recorder.asks


def test_what_is_repeated_for_others_is_not_kept_twice(session: Session) -> None:
    session.take(health(1, 5))
    message = wire.decode(health(1, 5))
    session.take(wire.encode(replace(message, repeat=True)))
    assert session.recorder.messages["health"] == 1
    assert not session.recorder.lost


def test_another_run_of_the_daemon_is_no_loss_and_has_its_own_time(session: Session) -> None:
    session.take(service(9, 50, run=RUN + 1))
    session.take(service(10, 60, run=RUN + 1))
    session.recorder.finish()
    assert not session.recorder.lost


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [b"tick"],
        [b"tick", b"\xc1"],
        [b"tick", msgpack.packb([1])],
        [b"nothing/known", msgpack.packb({"v": 1})],
        [b"tick", msgpack.packb({"v": 2, "run": 1, "seq": 1, "t_ns": 1, "repeat": False})],
        [b"tick", msgpack.packb({"v": 1, "run": 1, "seq": "1", "t_ns": 1, "repeat": False})],
        [b"service", msgpack.packb({"v": 1, "run": 1, "seq": 1, "t_ns": 1, "repeat": False})],
    ],
)
def test_what_does_not_keep_the_contract_is_counted_and_dropped(session: Session, parts: list[bytes]) -> None:
    session.take(parts)
    assert session.recorder.malformed == 1


def test_a_contact_that_lacks_what_foxglove_shows_is_kept_and_counted(session: Session) -> None:
    about = {"v": 1, "run": RUN, "seq": 1, "t_ns": 1, "repeat": False}
    session.take([b"contact/h/plane", msgpack.packb({**about, "event": "begin"})])
    assert session.recorder.malformed == 1
    session.recorder.finish()
    assert [topic for topic, *_ in Recording(session.paths[0])][-1] == "contact/h/plane"


def test_a_full_file_is_followed_by_one_that_stands_alone(
    make_hand: Callable[..., Any], tmp_path: Path
) -> None:
    session = Session(make_hand, tmp_path, Limits(ns=SECOND_NS))
    session.take(health(1, session.hand.t_ns))
    session.hand.stroke(150)
    session.recorder.poll(session.hand.t_ns)
    assert not session.recorder.asks
    session.hand.stroke(100)
    session.recorder.poll(session.hand.t_ns)
    assert session.recorder.asks
    session.tell_state()
    session.hand.stroke(50)
    session.recorder.finish()
    first, second = ([topic for topic, *_ in Recording(path)] for path in session.paths)
    assert first.count("tick") == 250
    assert second.count("tick") == 50
    before_ticks = set(second[: second.index("tick")])
    assert {"config", "state", "service", "health/h/plane"} <= before_ticks


def test_foxglove_finds_schemas_of_its_own_and_ours_in_every_channel(recorded: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        schemas = {
            channel.topic: (summary.schemas[channel.schema_id], channel.message_encoding)
            for channel in summary.channels.values()
        }
        for schema, _ in schemas.values():
            assert schema.encoding == "jsonschema"
            assert json.loads(schema.data)["type"] == "object"
        assert {schema.name for schema, _ in schemas.values()} >= set(FOXGLOVE)
        assert schemas["contact/h/plane"][1] == "json"
        assert schemas["tick"][1] == "msgpack"
        made = [
            (s.name, json.loads(m.data))
            for s, c, m in make_reader(file).iter_messages()
            if s and c.topic[0] == "/"
        ]
    for name, message in made:
        assert message.keys() == FOXGLOVE[name]["properties"].keys()
    words = [message["message"] for name, message in made if name == "foxglove.Log"]
    assert any("begin" in text for text in words)
    assert "lost: its heartbeat timed out" in words
    scenes = [message for name, message in made if name == "foxglove.SceneUpdate"]
    entity = next(scene["entities"][0] for scene in scenes if scene["entities"])
    assert entity["frame_id"] in {"plane", "round"}
    assert entity["arrows"][0]["shaft_length"] > 0
    assert scenes[-1]["deletions"] or not scenes[-1]["entities"]


def test_a_schema_describes_every_key_of_its_payload() -> None:
    for topic in wire.TOPICS:
        schema = schema_of(topic.payload)
        assert schema["title"] == f"handtouch.{topic.payload.__name__}"
        assert set(schema["properties"]) == set(topic.payload.__dataclass_fields__)
    assert schema_of(wire.Raw)["properties"]["counts"]["description"] == "column: 4 x <i8 in each row"
