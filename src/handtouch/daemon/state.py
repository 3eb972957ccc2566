"""All that is kept from tick to tick: taken out of a pipeline and put into another of the same deployment.

Public names: `save`, `restore`, `pack`, `unpack`.

A walk over the attributes of the pipeline and of what it is made of finds every array and number, so that
state which is added to the tick is kept without a word here. What the walk doesn't know is an error, not
left out.
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

from handtouch.canbus.bus.slab import Slab
from handtouch.daemon.pipeline import Pipeline
from handtouch.field import LocatorBank
from handtouch.field.strength import ContactLaw
from handtouch.hand import Placement
from handtouch.hand.robot import Robots

_FIXED = (slice, range, frozenset, type, memoryview, FunctionType, MethodType, BuiltinFunctionType, partial)
_MADE = (LocatorBank, Placement, ContactLaw, Robots)
"""Follow from the deployment alone."""
_FED = (Slab,)
"""Filled anew for every tick."""
_OTHERS = {
    ("Pipeline", "_outlet"), ("Pipeline", "journal"), ("Pipeline", "told"),
    ("Frames", "_robots"), ("Messages", "_writers"),
}  # fmt: skip
"""Where messages go and how they are written is no state of the pipeline's, nor what it is yet to be given,
nor are robots, which there may be none of."""
_PLAIN = (bool, int, float, str, type(None))
_CONSTANT = _FIXED + _MADE + _FED
_SIMPLE = {*_PLAIN, np.ndarray}


def save(pipeline: Pipeline) -> dict[str, Any]:
    """Path -> value of everything that is kept; arrays as [type, shape, bytes].

    Raises TypeError naming the attribute whose kind is not known here.
    """
    return {path: _saved(getattr(owner, name), path) for path, owner, name in _places(pipeline)}


def restore(pipeline: Pipeline, saved: dict[str, Any]) -> None:
    """Go on from what was saved of a pipeline for the same deployment; arrays keep their identity.

    Raises ValueError naming an attribute that only one of the two has: they are of different builds.
    """
    places = list(_places(pipeline))
    paths = {path for path, _, _ in places}
    if differing := sorted(paths ^ saved.keys()):
        raise ValueError(f"the state is of another build: it differs in {', '.join(differing[:5])}")
    for path, owner, name in places:
        before = getattr(owner, name)
        after = _restored(before, saved[path], path)
        if after is not before:
            object.__setattr__(owner, name, after)  # some are frozen


def pack(saved: dict[str, Any]) -> bytes:
    """What `save` returned, as bytes."""
    return bytes(msgpack.packb(saved))


def unpack(data: bytes) -> dict[str, Any]:
    """What was packed. Raises ValueError for bytes that aren't."""
    try:
        saved = msgpack.unpackb(data, strict_map_key=False)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise ValueError(f"the state can't be read: {error}") from error
    if not isinstance(saved, dict):
        raise ValueError("the state can't be read: it is no map")
    return saved


def _places(root: object) -> Iterator[tuple[str, Any, str]]:
    """Path, owner and name of every attribute that holds values, each object visited once."""
    seen = {id(root)}
    waiting: list[tuple[str, Any]] = [("", root)]
    while waiting:
        prefix, owner = waiting.pop()
        for name in _attributes(owner):
            value = getattr(owner, name)
            path = f"{prefix}{name}"
            if (type(owner).__name__, name) in _OTHERS:
                continue
            if type(value) in _SIMPLE:  # most of them: the hot thread waits for this
                yield path, owner, name
                continue
            if isinstance(value, _CONSTANT):
                continue
            if isinstance(value, dict) and all(isinstance(item, _FIXED) for item in value.values()):
                continue
            inside = _inside(value)
            if inside is None:
                yield path, owner, name
                continue
            for suffix, item in inside:
                if id(item) not in seen:
                    seen.add(id(item))
                    waiting.append((f"{path}{suffix}.", item))


def _attributes(owner: object) -> list[str]:
    slots = [name for kind in type(owner).__mro__ for name in getattr(kind, "__slots__", ())]
    return [*getattr(owner, "__dict__", {}), *slots]


def _inside(value: Any) -> list[tuple[str, Any]] | None:
    """Objects to walk into, by what leads to them from the attribute; None for what is a value itself."""
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
    """Whether it is an object of ours that changes; named tuples, enumerations, frozen facts are values."""
    if isinstance(value, (tuple, Enum, *_CONSTANT)) or not _is_ours(value):
        return False
    facts = is_dataclass(value) and not any(_holds_array(getattr(value, part.name)) for part in fields(value))
    return not (facts and type(value).__setattr__ is not object.__setattr__)


def _holds_array(value: object) -> bool:
    return isinstance(value, np.ndarray) or _is_ours(value)


def _is_ours(value: object) -> bool:
    return type(value).__module__.startswith("handtouch.")


def _saved(value: Any, path: str) -> Any:
    if type(value) is np.ndarray and not value.dtype.hasobject:
        return [value.dtype.str, value.shape, value.tobytes()]
    if type(value) in _PLAIN:
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return [value.dtype.str, value.shape, value.tobytes()]
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    if isinstance(value, list | tuple):
        return [_saved(item, f"{path}[{number}]") for number, item in enumerate(value)]
    if isinstance(value, dict):
        pairs = ((_saved(key, path), _saved(item, f"{path}[{key!r}]")) for key, item in value.items())
        return [list(pair) for pair in pairs]
    if is_dataclass(value) and _is_ours(value):
        return {part.name: _saved(getattr(value, part.name), f"{path}.{part.name}") for part in fields(value)}
    raise TypeError(f"{path} is a {type(value).__name__}: state.py has to be told how to keep it")


def _restored(before: Any, saved: Any, path: str) -> Any:
    """The saved value, in the place of the one before where that can be changed."""
    if _is_array(saved):
        array = np.frombuffer(saved[2], dtype=_kind(before, saved[0])).reshape(saved[1])
        if isinstance(before, np.ndarray) and before.shape == array.shape and before.flags.writeable:
            before[...] = array
            return before
        return array.copy()
    if isinstance(before, bytearray):
        before[:] = saved
        return before
    if isinstance(before, list):
        before[:] = _items(before, saved, path)
        return before
    if isinstance(before, tuple):
        items = _items(before, saved, path)
        return type(before)(*items) if hasattr(before, "_fields") else tuple(items)
    if isinstance(before, dict):
        pairs = {key: _restored(before.get(key), item, path) for key, item in saved}
        before.clear()
        before.update(pairs)
        return before
    if isinstance(before, Enum):
        return type(before)(saved)
    if is_dataclass(before) and not isinstance(before, type):
        parts = {name: _restored(getattr(before, name), item, path) for name, item in saved.items()}
        return replace(before, **parts)
    return saved


def _items(before: Any, saved: Any, path: str) -> list[Any]:
    if not isinstance(saved, list):
        raise ValueError(f"the state is of another build: {path} is no sequence there")
    known = [*before, *[None] * len(saved)]
    return [_restored(old, new, path) for old, new in zip(known, saved, strict=False)]


def _is_array(saved: Any) -> bool:
    return (
        isinstance(saved, list)
        and len(saved) == 3
        and isinstance(saved[0], str)
        and isinstance(saved[2], bytes)
    )


def _kind(before: Any, name: str) -> np.dtype[Any]:
    """Structured types have no name that tells their parts: those are of the array that is there."""
    if isinstance(before, np.ndarray) and before.dtype.str == name:
        return np.dtype(before.dtype)
    known: np.dtype[Any] = np.dtype(name)
    return known
