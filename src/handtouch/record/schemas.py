"""What the channels of a recording hold: JSON schemas of our payloads, and those of Foxglove's that fit.

Public names: `schema_of`, `FOXGLOVE`, `ENCODING`.

Payloads with binary columns are kept as they came, in msgpack; the others as JSON, which Foxglove plots and
lists by itself. A schema of either is a JSON schema; where the message is msgpack, a "string" with
`contentEncoding` "binary" is msgpack's bin.
"""

from __future__ import annotations

import types
import typing
from dataclasses import fields
from typing import Any, Union

from handtouch import wire

_BINARY = {
    topic.prefix
    for topic in wire.TOPICS
    if any(bytes in (hint, *typing.get_args(hint)) for hint in typing.get_type_hints(topic.payload).values())
}
ENCODING = {
    topic.prefix: "msgpack" if topic.prefix in _BINARY | {"config"} else "json"  # it has files, as bytes
    for topic in wire.TOPICS
}
"""First part of a topic -> how its messages are kept."""

_PLAIN: dict[Any, dict[str, Any]] = {
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    bool: {"type": "boolean"},
    bytes: {"type": "string", "contentEncoding": "binary"},
}


def schema_of(payload: type[Any]) -> dict[str, Any]:
    """JSON schema of a payload of the wire; columns say the type of their elements and how many a row has."""
    columns = wire.INPUTS if payload is wire.TickInputs else wire.COLUMNS.get(payload, {})
    hints = typing.get_type_hints(payload)
    properties = {}
    for field in fields(payload):
        properties[field.name] = told = _of(hints[field.name])
        if field.name in columns:
            kind, elements = columns[field.name]
            told["description"] = f"column: {elements} x {kind} in each row"
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"handtouch.{payload.__name__}",
        "description": (payload.__doc__ or "").split("\n", 1)[0],
        "type": "object",
        "properties": properties,
    }


def _of(hint: Any) -> dict[str, Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        inner = next(_of(argument) for argument in arguments if argument is not type(None))
        return {"anyOf": [inner, {"type": "null"}]}
    if origin is tuple:
        told: dict[str, Any] = {"type": "array", "items": _of(arguments[0])}
        if arguments[-1] is not Ellipsis:
            told |= {"minItems": len(arguments), "maxItems": len(arguments)}
        return told
    if origin is dict:
        return {"type": "object"}
    return dict(_PLAIN[hint])


def _object(title: str = "", **properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties} | ({"title": title} if title else {})


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _TEXT, _TRUTH = _PLAIN[float], _PLAIN[str], _PLAIN[bool]
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
_WORDS = _object(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_TRUTH,
    font_size=_NUMBER,
    scale_invariant=_TRUTH,
    color=_COLOR,
    text=_TEXT,
)
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_TRUTH,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list(_ARROW),
    cubes=_list(_CUBE),
    spheres=_list(_SPHERE),
    cylinders=_list(_CYLINDER),
    lines=_list(_object()),
    triangles=_list(_object()),
    texts=_list(_WORDS),
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

FOXGLOVE = {
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
