"""Content of recordings: every message once and in order, losses counted, files complete in themselves."""

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
from handtouch.record.recorder import MessageRecorder, RotationLimits
from handtouch.record.recording import Recording
from handtouch.record.schemas import MessageFormat, wire_format

from .conftest import SESSION, WALL_NS, RecordingSession, health, service
from .foxglove_messages import decode

SECOND_NS = 1_000_000_000


def test_every_message_is_recorded_as_sent_and_in_order(session: RecordingSession) -> None:
    session.hand.stroke(60)
    session.recorder.finish()
    messages = [m for m in session.hand.sink.messages if not m.retained]  # config is known
    sent = [(wire.topic_of(m), msgpack.unpackb(wire.encode(m)[1])) for m in messages]
    assert any(topic.startswith("contact/") for topic, _ in sent)
    recorded = [(topic, payload) for topic, _, payload in Recording(session.paths[0]) if topic != "service"]
    assert recorded == sent


def test_times_are_converted_to_utc(recorded: Path) -> None:
    for _, t_ns, payload in Recording(recorded):
        assert t_ns == payload["t_ns"] + WALL_NS


class TopicFile:
    """A file that collects topics and times only."""

    size = 0

    def __init__(self) -> None:
        self.written: list[tuple[str, int]] = []

    def write(
        self, topic: str, data: bytes, t_ns: int, seq: int = 0, form: MessageFormat | None = None
    ) -> None:
        assert data
        assert seq >= 0
        if form is None:
            self.written.append((topic, t_ns))

    def flush(self) -> None:
        """Do nothing."""

    def finish(self, summary: dict[str, str]) -> None:
        assert summary


def test_messages_before_the_wall_clock_offset_are_recorded_later() -> None:
    file = TopicFile()
    recorder = MessageRecorder(lambda _: file, RotationLimits())
    recorder.add_message(health(1, 5), 0)
    assert file.written == []
    recorder.add_message(service(1, 6), 0)
    assert file.written == [("health/h/plane", 5 + WALL_NS), ("service", 6 + WALL_NS)]


def test_losses_are_counted_by_topic_and_in_the_file(session: RecordingSession) -> None:
    ticks = iter(range(10**6))
    session.lose = lambda topic: topic == b"tick" and next(ticks) in (10, 11, 30)
    session.hand.stroke(50)
    session.recorder.finish()
    assert session.recorder.lost == Counter({"tick": 3})
    recording = Recording(session.paths[0])
    assert sum(topic == "tick" for topic, *_ in recording) == 47
    assert json.loads(recording.summary["lost"]) == {"tick": 3}


def test_the_state_is_requested_after_missing_ticks(session: RecordingSession) -> None:
    session.hand.stroke(5)
    session.recorder.poll(10 * SECOND_NS)
    assert not session.recorder.state_requested
    session.lose = lambda topic: topic == b"tick"
    session.hand.stroke(3)
    session.lose = lambda _: False
    session.hand.stroke(3)
    session.recorder.poll(20 * SECOND_NS)
    assert session.recorder.state_requested


def test_a_retained_message_is_not_recorded_twice(session: RecordingSession) -> None:
    session.take(health(1, 5))
    message = wire.decode(health(1, 5))
    session.take(wire.encode(replace(message, retained=True)))
    assert session.recorder.messages["health"] == 1
    assert not session.recorder.lost


def test_another_session_of_the_daemon_is_no_loss(session: RecordingSession) -> None:
    session.take(service(9, 50, session=SESSION + 1))
    session.take(service(10, 60, session=SESSION + 1))
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
        [b"tick", msgpack.packb({"v": 2, "session": 1, "seq": 1, "t_ns": 1, "retained": False})],
        [b"tick", msgpack.packb({"v": 1, "session": 1, "seq": "1", "t_ns": 1, "retained": False})],
        [b"service", msgpack.packb({"v": 1, "session": 1, "seq": 1, "t_ns": 1, "retained": False})],
    ],
)
def test_a_malformed_message_is_counted_and_dropped(session: RecordingSession, parts: list[bytes]) -> None:
    session.take(parts)
    assert session.recorder.malformed == 1


def test_a_contact_without_keys_for_foxglove_is_recorded_and_counted(session: RecordingSession) -> None:
    about = {"v": 1, "session": SESSION, "seq": 1, "t_ns": 1, "retained": False}
    session.take([b"contact/h/plane", msgpack.packb({**about, "event": "begin"})])
    assert session.recorder.malformed == 1
    session.recorder.finish()
    assert [topic for topic, *_ in Recording(session.paths[0])][-1] == "contact/h/plane"


def test_a_full_file_is_followed_by_one_complete_in_itself(
    make_hand: Callable[..., Any], tmp_path: Path
) -> None:
    session = RecordingSession(make_hand, tmp_path, RotationLimits(max_duration_ns=SECOND_NS))
    session.take(health(1, session.hand.t_ns))
    session.hand.stroke(150)
    session.recorder.poll(session.hand.t_ns)
    assert not session.recorder.state_requested
    session.hand.stroke(100)
    session.recorder.poll(session.hand.t_ns)
    assert session.recorder.state_requested
    session.send_retained()
    session.hand.stroke(50)
    session.recorder.finish()
    first, second = ([topic for topic, *_ in Recording(path)] for path in session.paths)
    assert first.count("tick") == 250
    assert second.count("tick") == 50
    before_ticks = set(second[: second.index("tick")])
    assert {"config", "state", "service", "health/h/plane"} <= before_ticks


def test_every_channel_has_a_schema_for_foxglove(recorded: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        schemas = {
            channel.topic: (summary.schemas[channel.schema_id], channel.message_encoding)
            for channel in summary.channels.values()
        }
        for topic, (schema, encoding) in schemas.items():
            if topic.startswith("/"):
                assert (schema.encoding, encoding) == ("protobuf", "protobuf")
            else:
                assert schema.encoding == "jsonschema"
                assert json.loads(schema.data)["type"] == "object"
        names = {schema.name for schema, _ in schemas.values()}
        assert names >= {"foxglove.SceneUpdate", "foxglove.FrameTransforms", "foxglove.Log"}
        assert schemas["contact/h/plane"][1] == "json"
        assert schemas["tick"][1] == "msgpack"
        made = [
            (s.name, decode(s.name, s.data, m.data))
            for s, c, m in make_reader(file).iter_messages()
            if s and c.topic[0] == "/"
        ]
    lines = [message["message"] for name, message in made if name == "foxglove.Log"]
    assert any("begin" in text for text in lines)
    assert "lost: its heartbeat timed out" in lines
    scenes = [message for name, message in made if name == "foxglove.SceneUpdate"]
    entity = next(scene["entities"][0] for scene in scenes if scene["entities"])
    assert entity["frame_id"] in {"plane", "round"}
    assert entity["arrows"][0]["shaft_length"] > 0
    for entity in scenes[-1]["entities"]:  # lost while touched: where it was, without a force
        assert entity["spheres"]
        assert not entity["arrows"]


def test_a_schema_describes_every_key_of_its_payload() -> None:
    for topic in wire.TOPICS:
        schema = json.loads(wire_format(topic.prefix).schema)
        assert schema["title"] == f"handtouch.{topic.payload.__name__}"
        assert set(schema["properties"]) == set(topic.payload.__dataclass_fields__)
    counts = json.loads(wire_format("raw").schema)["properties"]["counts"]
    assert (counts["column"], counts["contentEncoding"]) == ({"type": "int64", "elements": 4}, "binary")
