"""Schemas of recorded channels: JSON schemas of the wire's payloads, and Foxglove's.

Public names: `schema_of`, `FOXGLOVE_SCHEMAS`, `ENCODING`.

Payloads with binary columns are stored as received, in msgpack; the others as JSON, which Foxglove plots and
lists without conversion. Both have JSON schemas; in those of msgpack, a "string" with `contentEncoding`
"binary" is msgpack's bin.
"""

from __future__ import annotations

import types
import typing
from dataclasses import fields
from typing import Any, Union

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


def _object(title: str = "", **properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties} | ({"title": title} if title else {})


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _TEXT, _BOOLEAN = _SCALAR_SCHEMAS[float], _SCALAR_SCHEMAS[str], _SCALAR_SCHEMAS[bool]
_TIME = _object("time", sec={"type": "integer", "minimum": 0}, nsec={"type": "integer", "minimum": 0})
_DURATION = _object("duration", sec={"type": "integer"}, nsec={"type": "integer", "minimum": 0})
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_ARROW = _object(
    "foxglove.ArrowPrimitive",
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOR,
)
_SPHERE = _object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)
_CUBE = _object("foxglove.CubePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)
_CYLINDER = _object(
    "foxglove.CylinderPrimitive",
    pose=_POSE,
    size=_VECTOR,
    bottom_scale=_NUMBER,
    top_scale=_NUMBER,
    color=_COLOR,
)
_TEXT_PRIMITIVE = _object(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_BOOLEAN,
    font_size=_NUMBER,
    scale_invariant=_BOOLEAN,
    color=_COLOR,
    text=_TEXT,
)
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_BOOLEAN,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list(_ARROW),
    cubes=_list(_CUBE),
    spheres=_list(_SPHERE),
    cylinders=_list(_CYLINDER),
    lines=_list(_object()),
    triangles=_list(_object()),
    texts=_list(_TEXT_PRIMITIVE),
    models=_list(_object()),
)
_DELETION = _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type={"type": "integer"}, id=_TEXT)
_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)

FOXGLOVE_SCHEMAS = {
    "foxglove.SceneUpdate": _object(
        "foxglove.SceneUpdate", deletions=_list(_DELETION), entities=_list(_ENTITY)
    ),
    "foxglove.FrameTransforms": _object("foxglove.FrameTransforms", transforms=_list(_TRANSFORM)),
    "foxglove.Log": _object(
        "foxglove.Log",
        timestamp=_TIME,
        level={"type": "integer"},
        message=_TEXT,
        name=_TEXT,
        file=_TEXT,
        line={"type": "integer", "minimum": 0},
    ),
}
"""Name -> JSON schema with the public fields of Foxglove's schemas."""
