"""Type hashes of ROS 2 messages (RIHS01, REP 2016), by which ROS 2 from Iron on compares definitions.

Public names: `ros_type_name`, `type_hash`.
"""

from __future__ import annotations

import hashlib
import json
import typing
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, byte, sequence

_TYPE_IDS = {
    "uint8": 3,
    "int32": 6,
    "uint32": 7,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "byte": 16,
}
"""Type identifiers of type_description_interfaces/msg/FieldType."""
_NESTED_TYPE_ID, _BOOLEAN_TYPE_ID, _STRING_TYPE_ID = 1, 15, 17
_ARRAY_OFFSET, _UNBOUNDED_SEQUENCE_OFFSET = 48, 144


def ros_type_name(kind: type[IdlStruct]) -> str:
    """Return the name of a type in ROS, such as std_msgs/msg/Header."""
    package, _, _, name = kind.__idl_typename__.split("::")
    return f"{package}/msg/{name.removesuffix('_')}"


def type_hash(kind: type[IdlStruct]) -> str:
    """Return the hash of a message's definition."""
    nested: dict[str, dict[str, Any]] = {}
    description = _describe(kind, nested)
    text = json.dumps(
        {
            "type_description": description,
            "referenced_type_descriptions": [nested[name] for name in sorted(nested)],
        },
        separators=(", ", ": "),
    )
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def _describe(kind: type[IdlStruct], nested: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the description of a type, and add those of the types in its fields to `nested`."""
    hints = typing.get_type_hints(kind, include_extras=True)
    ros_bytes = getattr(kind, "ros_bytes", ())
    described = [
        {
            "name": name,
            "type": _describe_field(byte if name in ros_bytes else hints[name], nested),
        }
        for name in kind.__annotations__
    ]
    return {"type_name": ros_type_name(kind), "fields": described}


def _describe_field(hint: Any, nested: dict[str, dict[str, Any]]) -> dict[str, Any]:
    offset = capacity = 0
    extra = getattr(hint, "__metadata__", (None,))[0]
    if isinstance(extra, array):
        offset, capacity, hint = _ARRAY_OFFSET, extra.length, extra.subtype
    elif isinstance(extra, sequence):
        offset, hint = _UNBOUNDED_SEQUENCE_OFFSET, extra.subtype
    name = ""
    if isinstance(hint, type) and issubclass(hint, IdlStruct):
        number, name = _NESTED_TYPE_ID, ros_type_name(hint)
        if name not in nested:
            nested[name] = {}
            nested[name] = _describe(hint, nested)
    elif hint is bool:
        number = _BOOLEAN_TYPE_ID
    elif hint is str:
        number = _STRING_TYPE_ID
    else:
        number = _TYPE_IDS[hint.__metadata__[0]]
    return {
        "type_id": offset + number,
        "capacity": capacity,
        "string_capacity": 0,
        "nested_type_name": name,
    }
