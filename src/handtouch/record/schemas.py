"""Formats of recorded channels, and JSON schemas of the wire's payloads.

Public names: `MessageFormat`, `SceneMessage`, `wire_format`, `schema_of`, `ENCODING`.

Payloads with binary columns are stored as received, in msgpack; the others as JSON, which Foxglove plots and
lists without conversion. Both have JSON schemas; in those of msgpack, a "string" with `contentEncoding`
"binary" is msgpack's bin.
"""

from __future__ import annotations

import json
import types
import typing
from dataclasses import fields
from functools import cache
from typing import Any, NamedTuple, Union

from handtouch import wire

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


@cache
def wire_format(prefix: str) -> MessageFormat:
    """Return the format in which messages of a topic's prefix are stored. Raises KeyError."""
    payload = _PAYLOAD_OF_PREFIX[prefix]
    schema = json.dumps(schema_of(payload), separators=(",", ":")).encode()
    return MessageFormat(ENCODING[prefix], f"handtouch.{payload.__name__}", "jsonschema", schema)


_SCALAR_SCHEMAS: dict[Any, dict[str, Any]] = {
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    bool: {"type": "boolean"},
    bytes: {"type": "string", "contentEncoding": "binary"},
}


def schema_of(payload: type[Any]) -> dict[str, Any]:
    """Return the JSON schema of a payload; a column's description has its type and elements per row."""
    columns = wire.COLUMNS.get(payload, {})
    hints = typing.get_type_hints(payload)
    properties = {}
    for field in fields(payload):
        properties[field.name] = schema = _schema_of_type(hints[field.name])
        if field.name in columns:
            column = columns[field.name]
            schema["description"] = f"column: {column.elements} x {column.dtype} in each row"
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"handtouch.{payload.__name__}",
        "description": (payload.__doc__ or "").split("\n", 1)[0],
        "type": "object",
        "properties": properties,
    }


def _schema_of_type(hint: Any) -> dict[str, Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        inner = next(_schema_of_type(argument) for argument in arguments if argument is not type(None))
        return {"anyOf": [inner, {"type": "null"}]}
    if origin is tuple:
        schema: dict[str, Any] = {"type": "array", "items": _schema_of_type(arguments[0])}
        if arguments[-1] is not Ellipsis:
            schema |= {"minItems": len(arguments), "maxItems": len(arguments)}
        return schema
    if origin is dict:
        return {"type": "object"}
    if origin is typing.Literal:
        return {"type": "string", "enum": list(arguments)}
    return dict(_SCALAR_SCHEMAS[hint])
