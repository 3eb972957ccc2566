"""The wire contract: what is encoded is decoded, and nothing that arrives can do harm."""

from __future__ import annotations

import re
import typing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire

names = st.from_regex(r"[a-z][a-z0-9_]{0,12}", fullmatch=True)
finite = st.floats(allow_nan=False, allow_infinity=False)
integers = st.integers(-(2**62), 2**62)


def _values(hint: Any) -> st.SearchStrategy[Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in (int, float, str, bool, bytes):
        return {int: integers, float: finite, str: names, bool: st.booleans(), bytes: st.binary(max_size=40)}[
            hint
        ]
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return st.lists(_values(arguments[0]), max_size=4).map(tuple)
        return st.tuples(*map(_values, arguments))
    if origin is dict:
        return st.dictionaries(names, st.one_of(integers, finite, names), max_size=3)
    return st.one_of(st.none(), *(_values(argument) for argument in arguments if argument is not type(None)))


def _messages(kind: type[Any]) -> st.SearchStrategy[Any]:
    hints = typing.get_type_hints(kind)
    return st.builds(kind, **{name: _values(hint) for name, hint in hints.items()}).map(
        lambda message: replace(message, v=wire.SCHEMA_VERSION)
    )


any_message = st.one_of(*(_messages(topic.payload) for topic in wire.TOPICS))


@given(any_message)
def test_every_payload_survives_the_wire(message: wire.Message) -> None:
    assert wire.decode(wire.encode(message)) == message


@given(any_message, st.data())
def test_a_field_of_the_wrong_type_or_a_missing_one_is_refused_by_name(
    message: wire.Message, data: st.DataObject
) -> None:
    topic, payload = wire.encode(message)
    content = msgpack.unpackb(payload)
    name = data.draw(st.sampled_from([field for field in content if field != "v"]))
    content[name] = [{"not": "this"}]
    with pytest.raises(wire.WireError, match=name):
        wire.decode([topic, msgpack.packb(content)])
    del content[name]
    with pytest.raises(wire.WireError, match=name):
        wire.decode([topic, msgpack.packb(content)])


@given(any_message, names.map("x_{}".format), integers)
def test_keys_of_a_later_version_are_ignored(message: wire.Message, key: str, value: int) -> None:
    topic, payload = wire.encode(message)
    assert wire.decode([topic, msgpack.packb({**msgpack.unpackb(payload), key: value})]) == message


@given(st.lists(st.binary(max_size=60), max_size=3))
def test_any_bytes_are_decoded_or_refused_but_never_fatal(parts: list[bytes]) -> None:
    with pytest.raises(wire.WireError):
        wire.decode(parts)


@given(st.sampled_from([t.prefix + "/x" * t.parts for t in wire.TOPICS]), st.binary(max_size=60))
def test_any_payload_on_a_real_topic_is_refused(topic: str, payload: bytes) -> None:
    with pytest.raises(wire.WireError):
        wire.decode([topic.encode(), payload])


@given(any_message)
def test_another_schema_version_is_refused(message: wire.Message) -> None:
    with pytest.raises(wire.WireError, match="version"):
        wire.decode(wire.encode(replace(message, v=wire.SCHEMA_VERSION + 1)))


@given(_messages(wire.Contact))
def test_a_payload_on_a_topic_of_another_link_is_refused(contact: wire.Contact) -> None:
    _, payload = wire.encode(contact)
    with pytest.raises(wire.WireError, match="belongs"):
        wire.decode([f"contact/{contact.hand}/{contact.link}_other".encode(), payload])


def test_the_documentation_describes_every_field_of_every_topic() -> None:
    text = (Path(__file__).parents[1] / "docs" / "wire.md").read_text()
    sections = dict(re.findall(r"^## `(\w+)[^\n]*\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S))
    for topic in wire.TOPICS:
        described = set(re.findall(r"^\| `(\w+)`", sections[topic.prefix], flags=re.M))
        envelope = {"v", "seq", "t_ns", "repeat"}
        assert described | envelope == {field.name for field in fields(topic.payload)}, topic.prefix
