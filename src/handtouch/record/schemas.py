"""Formats of recorded channels, and JSON schemas of the wire's payloads.

Public names: `MessageFormat`, `SceneMessage`, `wire_format`, `ENCODING`, `MARK`, `MARK_FORMAT`.

Payloads with binary columns are stored as received, in msgpack; the others as JSON, which Foxglove plots and
lists without conversion. Both have JSON schemas; in those of msgpack, a "string" with `contentEncoding`
"binary" is msgpack's bin.
"""

from __future__ import annotations

import json
import typing
from functools import cache
from typing import NamedTuple

from handtouch import wire
from handtouch.wire.schema import payload_schema

_BINARY_PREFIXES = {
    topic.prefix
    for topic in wire.TOPICS
    if any(bytes in (hint, *typing.get_args(hint)) for hint in typing.get_type_hints(topic.payload).values())
}
ENCODING = {
    topic.prefix: "msgpack"
    if topic.prefix in _BINARY_PREFIXES | {"config"}
    else "json"  # it has files, as bytes
    for topic in wire.TOPICS
}
"""Prefix of a topic -> encoding of its messages."""

_PAYLOAD_OF_PREFIX = {topic.prefix: topic.payload for topic in wire.TOPICS}


class MessageFormat(NamedTuple):
    """Encoding of the messages of a channel, and their schema."""

    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


class SceneMessage(NamedTuple):
    """A message made from the wire's for Foxglove's scenes and logs."""

    topic: str
    format: MessageFormat
    data: bytes


MARK = "mark"
"""Topic of a mark, which `handtouch record --marks` takes from standard input"""
_MARK_KEYS = {"t_ns": {"type": "integer"}, "text": {"type": "string"}}
MARK_FORMAT = MessageFormat(
    "json",
    "handtouch.Mark",
    "jsonschema",
    json.dumps({"type": "object", "properties": _MARK_KEYS, "required": [*_MARK_KEYS]}).encode(),
)


@cache
def wire_format(prefix: str) -> MessageFormat:
    """Return the format in which messages of a topic's prefix are stored. Raises KeyError."""
    payload = _PAYLOAD_OF_PREFIX[prefix]
    schema = json.dumps(payload_schema(payload), separators=(",", ":")).encode()
    return MessageFormat(ENCODING[prefix], f"handtouch.{payload.__name__}", "jsonschema", schema)
