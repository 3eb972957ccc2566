"""State of a pipeline between two ticks: saved from one, restored into another of the same deployment.

Public names: `save`, `restore`, `pack`, `unpack`.

A walk over the attributes of the pipeline and its parts finds every array and number, so that new state is
saved without registration here. A value of unknown type is an error; nothing is left out silently.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import msgpack
import numpy as np

from handtouch.core.contact_solver import ContactSolver
from handtouch.core.slab import Slab
from handtouch.core.stages.slip import SlipStage
from handtouch.field import LocatorBank
from handtouch.field.contact_law import ContactLaw
from handtouch.hand import PadGeometry
from handtouch.hand.robot_models import RobotModels

_IMMUTABLE_TYPES = (
    slice,
    range,
    frozenset,
    type,
    memoryview,
    FunctionType,
    MethodType,
    BuiltinFunctionType,
    partial,
)
_DERIVED_TYPES = (
    *(LocatorBank, ContactSolver, SlipStage),
    *(PadGeometry, ContactLaw, RobotModels),
)
"""Follow from the deployment."""
_INPUT_TYPES = (Slab,)
"""Filled in every tick."""
_EXCLUDED_ATTRIBUTES = {
    ("Pipeline", "_sink"), ("Pipeline", "journal"), ("Pipeline", "external_inputs"),
    ("ContactTransforms", "_robots"), ("TickMessages", "_encoders"),
    ("PadModel", "networks"), ("PadModel", "forward_tables"), ("PadModel", "surface_tables"),
    ("PadModel", "_parts"),
}  # fmt: skip
"""Message output and its encoding, inputs not applied yet, robots, which are optional, and what follows from
the deployment: no state."""
_SCALAR_TYPES = (bool, int, float, str, type(None))
_NOT_STATE_TYPES = _IMMUTABLE_TYPES + _DERIVED_TYPES + _INPUT_TYPES
_LEAF_TYPES = {*_SCALAR_TYPES, np.ndarray}


def save(pipeline: object) -> dict[str, Any]:
    """Return path -> value of all state; arrays as [type, shape, bytes].

    Raises TypeError naming an attribute of unknown type.
    """
    return {
        path: _serialised(getattr(owner, name), path) for path, owner, name in _state_attributes(pipeline)
    }


def restore(pipeline: object, saved: dict[str, Any]) -> None:
    """Restore state saved from a pipeline of the same deployment; arrays keep their identity.

    Raises ValueError naming attributes that only one of the two has: they are of different builds.
    """
    attributes = list(_state_attributes(pipeline))
    paths = {path for path, _, _ in attributes}
    if differing := sorted(paths ^ saved.keys()):
        raise ValueError(f"the state is of another build: it differs in {', '.join(differing[:5])}")
    for path, owner, name in attributes:
        before = getattr(owner, name)
        after = _deserialised(before, saved[path], path)
        if after is not before:
            object.__setattr__(owner, name, after)  # some are frozen


def pack(saved: dict[str, Any]) -> bytes:
    """Encode what `save` returned."""
    return bytes(msgpack.packb(saved))


def unpack(data: bytes) -> dict[str, Any]:
    """Decode what `pack` returned. Raises ValueError for malformed bytes."""
    try:
        saved = msgpack.unpackb(data, strict_map_key=False)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise ValueError(f"malformed state: {error}") from error
    if not isinstance(saved, dict):
        raise ValueError("malformed state: not a map")
    return saved


def _state_attributes(root: object) -> Iterator[tuple[str, Any, str]]:
    """Yield path, owner and name of every attribute that holds values, visiting each object once."""
    seen = {id(root)}
    waiting: list[tuple[str, Any]] = [("", root)]
    while waiting:
        prefix, owner = waiting.pop()
        for name in _attribute_names(owner):
            value = getattr(owner, name)
            path = f"{prefix}{name}"
            if (type(owner).__name__, name) in _EXCLUDED_ATTRIBUTES:
                continue
            if type(value) in _LEAF_TYPES:  # most of them: this runs in the hot thread
                yield path, owner, name
                continue
            if isinstance(value, _NOT_STATE_TYPES):
                continue
            if isinstance(value, dict) and all(isinstance(item, _IMMUTABLE_TYPES) for item in value.values()):
                continue
            inside = _nested_objects(value)
            if inside is None:
                yield path, owner, name
                continue
            for suffix, item in inside:
                if id(item) not in seen:
                    seen.add(id(item))
                    waiting.append((f"{path}{suffix}.", item))


def _attribute_names(owner: object) -> list[str]:
    slots = [name for kind in type(owner).__mro__ for name in getattr(kind, "__slots__", ())]
    return [*getattr(owner, "__dict__", {}), *slots]


def _nested_objects(value: Any) -> list[tuple[str, Any]] | None:
    """Return the objects to walk into, by path from the attribute; None for a plain value."""
    if _is_walked(value):
        return [("", value)]
    pairs: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        pairs = list(value.items())
    elif isinstance(value, list) or type(value) is tuple:
        pairs = list(enumerate(value))
    objects = [(f"[{key!r}]", item) for key, item in pairs if _is_walked(item)]
    return (
        objects if objects and len(objects) + sum(item is None for _, item in pairs) == len(pairs) else None
    )


def _is_walked(value: object) -> bool:
    """Return True for mutable objects of handtouch; named tuples, enums and frozen dataclasses are values."""
    if isinstance(value, (tuple, Enum, *_NOT_STATE_TYPES)) or not _is_ours(value):
        return False
    frozen_values = is_dataclass(value) and not any(
        _holds_array(getattr(value, part.name)) for part in fields(value)
    )
    return not (frozen_values and type(value).__setattr__ is not object.__setattr__)


def _holds_array(value: object) -> bool:
    return isinstance(value, np.ndarray) or _is_ours(value)


def _is_ours(value: object) -> bool:
    return type(value).__module__.startswith("handtouch.")


def _serialised(value: Any, path: str) -> Any:
    if type(value) is np.ndarray and not value.dtype.hasobject:
        return [value.dtype.str, value.shape, value.tobytes()]
    if type(value) in _SCALAR_TYPES:
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, _SCALAR_TYPES):
        return value
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return [value.dtype.str, value.shape, value.tobytes()]
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    if isinstance(value, list | tuple):
        return [_serialised(item, f"{path}[{number}]") for number, item in enumerate(value)]
    if isinstance(value, dict):
        pairs = (
            (_serialised(key, path), _serialised(item, f"{path}[{key!r}]")) for key, item in value.items()
        )
        return [list(pair) for pair in pairs]
    if is_dataclass(value) and _is_ours(value):
        return {
            part.name: _serialised(getattr(value, part.name), f"{path}.{part.name}") for part in fields(value)
        }
    raise TypeError(f"{path}: no rule in state.py for saving a {type(value).__name__}")


def _deserialised(before: Any, saved: Any, path: str) -> Any:
    """Return the saved value, written into the existing object where that is mutable."""
    if _is_array(saved):
        array = np.frombuffer(saved[2], dtype=_dtype_of(before, saved[0])).reshape(saved[1])
        if isinstance(before, np.ndarray) and before.shape == array.shape and before.flags.writeable:
            before[...] = array
            return before
        return array.copy()
    if isinstance(before, bytearray):
        before[:] = saved
        return before
    if isinstance(before, list):
        before[:] = _deserialised_items(before, saved, path)
        return before
    if isinstance(before, tuple):
        items = _deserialised_items(before, saved, path)
        return type(before)(*items) if hasattr(before, "_fields") else tuple(items)
    if isinstance(before, dict):
        pairs = {key: _deserialised(before.get(key), item, path) for key, item in saved}
        before.clear()
        before.update(pairs)
        return before
    if isinstance(before, Enum):
        return type(before)(saved)
    if is_dataclass(before) and not isinstance(before, type):
        parts = {name: _deserialised(getattr(before, name), item, path) for name, item in saved.items()}
        return replace(before, **parts)
    return saved


def _deserialised_items(before: Any, saved: Any, path: str) -> list[Any]:
    if not isinstance(saved, list):
        raise ValueError(f"the state is of another build: {path} is no sequence in it")
    known = [*before, *[None] * len(saved)]
    return [_deserialised(old, new, path) for old, new in zip(known, saved, strict=False)]


def _is_array(saved: Any) -> bool:
    return (
        isinstance(saved, list)
        and len(saved) == 3
        and isinstance(saved[0], str)
        and isinstance(saved[2], bytes)
    )


def _dtype_of(before: Any, name: str) -> np.dtype[Any]:
    """Return a dtype by name; structured ones have none, so they are taken from the existing array."""
    if isinstance(before, np.ndarray) and before.dtype.str == name:
        return np.dtype(before.dtype)
    known: np.dtype[Any] = np.dtype(name)
    return known
