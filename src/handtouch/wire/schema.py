"""JSON Schema of every message, from the topic table and its payload classes.

Public names: `json_schema`, whose result is docs/wire.schema.json, and `payload_schema`.

An instance is a message as a map {"topic", "payload"}, with binary values in base64. `#/$defs/published` are
the messages that the daemon publishes, `#/$defs/inputs` those that it receives.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from enum import Enum
from typing import Any, Union

from handtouch.wire.codec import SCHEMA_VERSION
from handtouch.wire.columns import is_array
from handtouch.wire.declarations import (
    FieldDeclaration,
    declared_fields,
    inner_fields,
    input_fields,
)
from handtouch.wire.inputs import INPUT_TOPICS
from handtouch.wire.topics import TOPICS, Topic

_SCALARS = {int: "integer", float: "number", str: "string", bool: "boolean"}


def json_schema() -> dict[str, Any]:
    """Return the schema (JSON Schema, draft 2020-12), as values of JSON."""
    definitions: dict[str, Any] = {}
    published = [_message(topic, definitions) for topic in TOPICS]
    inputs = [_message(topic, definitions) for topic in INPUT_TOPICS]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"handtouch wire contract, schema version {SCHEMA_VERSION}",
        "description": "A message as {topic, payload}; binary values in base64. The meaning: docs/wire.md",
        "$ref": "#/$defs/published",
        "$defs": {"published": {"oneOf": published}, "inputs": {"oneOf": inputs}, **definitions},
    }


def payload_schema(payload: type[Any]) -> dict[str, Any]:
    """Return the schema of one payload as recorded: without references, and with binary values as such."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"handtouch.{payload.__name__}",
        "description": (payload.__doc__ or "").split("\n", 1)[0],
        **_map(declared_fields(payload), None),
    }


def _message(topic: Topic, definitions: dict[str, Any]) -> dict[str, Any]:
    published = topic in TOPICS
    fields = declared_fields(topic.payload) if published else input_fields(topic.payload)
    definitions[topic.payload.__name__] = _map(fields, definitions)
    return {
        "title": topic.pattern,
        "description": f"{'published' if published else 'sent by a robot'} {topic.published}",
        "type": "object",
        "properties": {
            "topic": {
                "type": "string",
                "pattern": "/".join(["^" + topic.prefix, *["[^/]+"] * len(topic.keys)]) + "$",
            },
            "payload": {"$ref": f"#/$defs/{topic.payload.__name__}"},
        },
        "required": ["topic", "payload"],
    }


def _map(fields: Sequence[FieldDeclaration], definitions: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {field.name: _field(field, definitions) for field in fields},
        "required": [field.name for field in fields if not field.is_optional],
    }


def _field(field: FieldDeclaration, definitions: dict[str, Any] | None) -> dict[str, Any]:
    if field.name == "v":
        return {"const": SCHEMA_VERSION}
    schema = _type(field.hint, definitions)
    if field.column is not None:
        schema["column"] = {"type": field.column.type_name, "elements": field.column.elements}
    names = field.values.names if field.values else tuple(code.name.lower() for code in field.codes or ())
    if names and field.column is None:
        schema["enum" if field.values and field.values.closed else "examples"] = list(names)
    elif names:
        schema["column"]["codes"] = list(names)
    if field.is_nilable:
        schema = {"anyOf": [schema, {"type": "null"}]}
    if field.meaning:
        schema["description"] = field.meaning
    return schema


def _type(hint: Any, definitions: dict[str, Any] | None) -> dict[str, Any]:
    """Return the schema of a type; classes are added to the definitions, or inlined without any."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in _SCALARS:
        return {"type": _SCALARS[hint]}
    if hint is bytes:
        return {"type": "string", "contentEncoding": "binary" if definitions is None else "base64"}
    if hint is Any:
        return {}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_type(argument, definitions) for argument in arguments]}
    if hint is type(None):
        return {"type": "null"}
    if is_array(hint):
        return {"type": "array", "items": {"type": "number"}}
    if origin in (tuple, list):
        length = None if origin is list or arguments[-1] is Ellipsis else len(arguments)
        bounds = {} if length is None else {"minItems": length, "maxItems": length}
        return {"type": "array", "items": _type(arguments[0], definitions), **bounds}
    if origin is dict:
        values = _type(arguments[1], definitions)
        return {"type": "object", "additionalProperties": values} if values else {"type": "object"}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {"type": "string", "examples": [member.value for member in hint]}
    if definitions is None:
        return _map(inner_fields(hint), None)
    if hint.__name__ not in definitions:
        definitions[hint.__name__] = _map(inner_fields(hint), definitions)
    return {"$ref": f"#/$defs/{hint.__name__}"}
