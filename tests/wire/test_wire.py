"""The wire contract: messages are decoded as encoded, and no received bytes are fatal."""

from __future__ import annotations

import contextlib
import math
import typing
from dataclasses import MISSING, fields, replace
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import columns, wire
from handtouch.wire import status

names = st.from_regex(r"[a-z][a-z0-9_]{0,12}", fullmatch=True)
finite = st.floats(allow_nan=False, allow_infinity=False)
integers = st.integers(-(2**62), 2**62)


def _values(hint: Any) -> st.SearchStrategy[Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if typing.get_origin(hint) is typing.Literal:
        return st.sampled_from(typing.get_args(hint))
    if hint in (int, float, str, bool, bytes):
        return {int: integers, float: finite, str: names, bool: st.booleans(), bytes: st.binary(max_size=40)}[
            hint
        ]
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return st.lists(_values(arguments[0]), max_size=4).map(tuple)
        return st.tuples(*map(_values, arguments))
    if origin is list:
        return st.lists(_values(arguments[0]), max_size=4)
    if typing.is_typeddict(hint):
        items = {name: _values(inner) for name, inner in typing.get_type_hints(hint).items()}
        optional = {name: items.pop(name) for name in hint.__optional_keys__}
        return st.fixed_dictionaries(items, optional=optional)
    if origin is dict:
        return st.dictionaries(names, st.one_of(integers, finite, names), max_size=3)
    return st.one_of(st.none(), *(_values(argument) for argument in arguments if argument is not type(None)))


@st.composite
def _messages(draw: st.DrawFn, kind: type[Any]) -> Any:
    hints = typing.get_type_hints(kind)
    values = {name: draw(_values(hint)) for name, hint in hints.items()}
    for name, column in wire.COLUMNS.get(kind, {}).items():
        size = len(values.get("links", ())) * column.row_bytes
        values[name] = draw(st.binary(min_size=size, max_size=size))
    return kind(**{**values, "v": wire.SCHEMA_VERSION})


any_message = st.one_of(*(_messages(topic.payload) for topic in (*wire.TOPICS, *wire.INTERNAL_TOPICS)))


@given(any_message)
def test_every_payload_is_decoded_as_encoded(message: wire.Message) -> None:
    assert wire.decode(wire.encode(message)) == message


@given(any_message, st.data())
def test_a_missing_field_or_one_of_the_wrong_type_is_rejected_by_name(
    message: wire.Message, data: st.DataObject
) -> None:
    topic, payload = wire.encode(message)
    content = msgpack.unpackb(payload)
    name = data.draw(st.sampled_from([field for field in content if field != "v"]))
    content[name] = [["not this"]]
    with pytest.raises(wire.WireError, match=name):
        wire.decode([topic, msgpack.packb(content)])
    del content[name]
    optional = {field.name: field.default for field in fields(message) if field.default is not MISSING}
    if name in optional:
        left_out = replace(message, **{name: optional[name]})
        assert wire.decode([topic, msgpack.packb(content)]) == left_out
        return
    with pytest.raises(wire.WireError, match=name):
        wire.decode([topic, msgpack.packb(content)])


@given(_messages(wire.Contact), _messages(wire.HandFrame))
def test_outputs_that_no_scene_requests_take_no_bytes(contact: wire.Contact, frame: wire.HandFrame) -> None:
    for message in (contact, frame):
        defaults = {f.name: f.default for f in fields(message) if f.default is not MISSING}
        sent = msgpack.unpackb(wire.encode(replace(message, **defaults))[1])
        assert {"palm_status", "base_position_m", "group"} <= defaults.keys()
        assert not defaults.keys() & sent.keys()


@given(any_message, names.map("x_{}".format), integers)
def test_keys_of_a_later_version_are_ignored(message: wire.Message, key: str, value: int) -> None:
    topic, payload = wire.encode(message)
    assert wire.decode([topic, msgpack.packb({**msgpack.unpackb(payload), key: value})]) == message


@given(st.lists(st.binary(max_size=60), max_size=3))
def test_arbitrary_bytes_raise_only_a_wire_error(parts: list[bytes]) -> None:
    with pytest.raises(wire.WireError):
        wire.decode(parts)


@given(st.sampled_from([t.prefix + "/x" * len(t.keys) for t in wire.TOPICS]), st.binary(max_size=60))
def test_an_arbitrary_payload_on_a_known_topic_is_rejected(topic: str, payload: bytes) -> None:
    with pytest.raises(wire.WireError):
        wire.decode([topic.encode(), payload])


@given(any_message)
def test_another_schema_version_is_rejected(message: wire.Message) -> None:
    with pytest.raises(wire.WireError, match="version"):
        wire.decode(wire.encode(replace(message, v=wire.SCHEMA_VERSION + 1)))


@given(_messages(wire.Contact))
def test_a_payload_on_the_topic_of_another_link_is_rejected(contact: wire.Contact) -> None:
    _, payload = wire.encode(contact)
    with pytest.raises(wire.WireError, match="belongs"):
        wire.decode([f"contact/{contact.hand}/{contact.link}_other".encode(), payload])


def test_an_error_names_the_key_the_expected_and_the_received_type() -> None:
    topic, payload = wire.encode(HEALTH)
    content = msgpack.unpackb(payload)
    for key, value, text in (
        ("rate_hz", "fast", "rate_hz must be a number, not a string"),
        ("serial", 1.5, "serial must be an integer or nil, not a number"),
        ("emergencies", [1], "emergencies must be a list of maps, not a list of 1"),
        ("retained", None, "retained must be true or false, not nil"),
    ):
        with pytest.raises(wire.WireError, match=f"health/h/x: {text}"):
            wire.decode([topic, msgpack.packb({**content, key: value})])


def test_a_topic_that_is_missed_for_three_periods_times_out() -> None:
    assert (wire.SERVICE.period_s, wire.SERVICE.timeout_s) == (0.5, 1.5)
    assert math.isinf(next(t for t in wire.TOPICS if t.prefix == "contact").timeout_s)


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9), st.booleans()), max_size=30))
def test_lost_messages_are_the_gaps_within_a_session(received: list[tuple[int, int, bool]]) -> None:
    tracker, lost, last, latest = wire.SequenceTracker(), 0, None, None
    for session, seq, retained in received:
        if session != latest:
            latest, last = session, None
        duplicate = last is not None and retained and seq <= last
        assert tracker.accept("t", session, seq, retained) is not duplicate
        if not duplicate:
            lost += max(0, seq - last - 1) if last is not None else 0
            last = seq
    assert tracker.lost.total() == lost


@given(any_message, st.data())
def test_a_corrupt_message_is_decoded_or_raises_a_wire_error(
    message: wire.Message, data: st.DataObject
) -> None:
    parts = [bytearray(part) for part in wire.encode(message)]
    for _ in range(data.draw(st.integers(1, 4))):
        part = data.draw(st.sampled_from(parts))
        at = data.draw(st.integers(0, max(0, len(part) - 1)))
        how = data.draw(st.sampled_from(["change", "insert", "cut", "end"]))
        if how == "change" and part:
            part[at] = data.draw(st.integers(0, 255))
        elif how == "insert":
            part[at:at] = data.draw(st.binary(min_size=1, max_size=9))
        elif how == "cut":
            del part[at : at + data.draw(st.integers(1, 9))]
        else:
            del part[at:]
    with contextlib.suppress(wire.WireError):
        wire.decode([bytes(part) for part in parts])


anything = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(max_size=5),
        st.binary(max_size=9), st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=9)),
        st.builds(msgpack.Timestamp, st.integers(0, 2**33), st.integers(0, 10**9 - 1)),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@given(any_message, st.data())
def test_any_value_in_any_field_is_decoded_or_raises_a_wire_error(
    message: wire.Message, data: st.DataObject
) -> None:
    topic, payload = wire.encode(message)
    content = msgpack.unpackb(payload)
    for name in data.draw(st.sets(st.sampled_from(sorted(content)), min_size=1, max_size=3)):
        content[name] = data.draw(anything)
    with contextlib.suppress(wire.WireError):
        wire.decode([topic, msgpack.packb(content)])


@pytest.mark.parametrize("depth", [100, 500, 900, 1010, 1100, 100_000])
@pytest.mark.parametrize("name", [b"v", b"seq", b"emergencies", b"more"])
def test_deep_nesting_is_not_fatal(depth: int, name: bytes) -> None:
    deep = bytes([0x81, 0xA0 + len(name)]) + name + b"\x91" * depth + b"\xc0"
    with pytest.raises(wire.WireError):
        wire.decode([b"health/h/x", deep])
    good = wire.encode(HEALTH)[1]
    size = msgpack.unpackb(good)
    extended = b"\xde" + (len(size) + 1).to_bytes(2, "big") + good[3:] + deep[1:]
    with contextlib.suppress(wire.WireError):
        wire.decode([b"health/h/x", extended])


@given(_messages(wire.Contact), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_a_non_finite_number_is_rejected(contact: wire.Contact, number: float) -> None:
    with pytest.raises(wire.WireError, match="force_n"):
        wire.decode(wire.encode(replace(contact, force_n=number)))


@given(_messages(wire.HandFrame), st.sampled_from(sorted(wire.COLUMNS[wire.HandFrame])))
def test_a_column_with_a_surplus_row_is_rejected(frame: wire.HandFrame, name: str) -> None:
    longer = replace(frame, **{name: getattr(frame, name) + bytes(36)})
    with pytest.raises(wire.WireError, match=name):
        wire.decode(wire.encode(longer))


@given(_messages(wire.HandFrame))
def test_columns_are_arrays_with_a_row_for_each_link(frame: wire.HandFrame) -> None:
    found = columns(frame)
    assert list(found) == list(wire.COLUMNS[wire.HandFrame])
    for name, array in found.items():
        assert len(array) == len(frame.links)
        assert array.tobytes() == getattr(frame, name)
        assert not array.flags.writeable
    assert found["covariance_m2"].shape == (len(frame.links), 9)


HEALTH = wire.Health(
    wire.SCHEMA_VERSION, 1, 1, 1, "h", "x", "can0", 1, "clear", "operational",
    0, "sync", "", None, 0.0, 0, 0, None, 0, 0, (), False,
)  # fmt: skip


@pytest.mark.parametrize(
    ("codes", "names"),
    [
        (status.PadState, status.PadStateName),
        (status.PositionStatus, status.PositionStatusName),
        (status.ForceStatus, status.ForceStatusName),
        (status.FrameStatus, status.FrameStatusName),
    ],
)
def test_the_type_of_a_status_lists_the_names_of_its_codes(codes: Any, names: Any) -> None:
    assert tuple(code.text for code in codes) == typing.get_args(names)


@given(contact=_messages(wire.Contact))
def test_a_value_of_a_later_version_is_accepted(contact: wire.Contact) -> None:
    later = {**wire.to_map(contact), "end_reason": "a later reason"}
    read = wire.decode([wire.topic_of(contact).encode(), msgpack.packb(later)])
    assert isinstance(read, wire.Contact)
    assert str(read.end_reason) == "a later reason"
