"""Messages to and from the two parts that are sent, [topic, msgpack map]."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, fields
from operator import attrgetter
from typing import Any, Union

import msgpack

from handtouch.wire.topics import COLUMNS, TOPICS, Message, Outgoing, Packed, topic_of

SCHEMA_VERSION = 1
"""When it goes up: docs/wire.md, "Versions"."""


class WireError(ValueError):
    """A message that doesn't keep the contract."""


_BY_PREFIX = {topic.prefix: topic for topic in TOPICS}
_DEFAULTS = {
    topic.payload: {f.name: f.default for f in fields(topic.payload) if f.default is not MISSING}
    for topic in TOPICS
}
_FIELDS = {
    kind: (names := [f.name for f in fields(kind) if f.name not in defaults], attrgetter(*names))
    for kind, defaults in _DEFAULTS.items()
}


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Of several attributes, or of one: `attrgetter` makes a tuple of several only."""
    get = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


_OPTIONAL = {
    kind: (names := list(defaults), _getter(names), tuple(defaults.values()))
    for kind, defaults in _DEFAULTS.items()
    if defaults
}
_PACKER = msgpack.Packer()


def encode(message: Outgoing) -> list[bytes]:
    """The two parts of a message, ready for a ZeroMQ multipart send."""
    if isinstance(message, Packed):
        return [message.topic.encode(), message.payload]
    return [topic_of(message).encode(), _PACKER.pack(plain(message))]


def plain(message: Outgoing) -> dict[str, Any]:
    """The map that a message is sent as."""
    if isinstance(message, Packed):
        return dict(msgpack.unpackb(message.payload))
    kind = type(message)
    names, values = _FIELDS[kind]
    told = dict(zip(names, values(message), strict=True))
    if kind in _OPTIONAL:
        names, get, defaults = _OPTIONAL[kind]
        if (optional := get(message)) != defaults:
            pairs = zip(names, optional, defaults, strict=True)
            told.update((name, value) for name, value, default in pairs if value != default)
    return told


def decode(parts: typing.Sequence[bytes]) -> Message:
    """The message in the two parts of a ZeroMQ message; unknown keys of the map are ignored.

    Raises WireError naming what is wrong with a malformed message, whatever its bytes.
    """
    if len(parts) != 2:
        raise WireError(f"{len(parts)} parts instead of [topic, payload]")
    name = parts[0].decode("utf-8", "replace")
    prefix, *rest = name.split("/")
    row = _BY_PREFIX.get(prefix)
    if row is None or len(rest) != row.parts:
        raise WireError(f"unknown topic {name[:80]!r}")
    try:
        payload = msgpack.unpackb(parts[1])
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"{name}: payload isn't msgpack: {error}") from error
    if not isinstance(payload, dict):
        raise WireError(f"{name}: payload isn't a map")
    if payload.get("v") != SCHEMA_VERSION:
        raise WireError(f"{name}: schema version {payload.get('v')!r}, this reader knows {SCHEMA_VERSION}")
    message = row.payload(**_checked(name, payload, row.payload))
    for column, (kind, elements) in COLUMNS.get(row.payload, {}).items():
        size = len(getattr(message, column))
        if size == 0 and column in _DEFAULTS[row.payload]:
            continue
        if size != len(message.links) * elements * int(kind[-1]):
            raise WireError(f"{name}: {column} doesn't have one row of {elements} {kind} per link")
    if topic_of(message) != name:
        raise WireError(f"{name}: payload belongs to {topic_of(message)}")
    return typing.cast(Message, message)


def _checked(topic: str, payload: dict[Any, Any], kind: type[Any]) -> dict[str, Any]:
    values = {}
    for name, check in _CHECKS[kind]:
        if name not in payload:
            if name in _DEFAULTS[kind]:
                continue
            raise WireError(f"{topic}: {name} is missing")
        try:
            values[name] = check(payload[name])
        except (TypeError, ValueError):
            given = type(payload[name]).__name__  # not the value: it may be nested too deeply to be told
            raise WireError(f"{topic}: {name} can't be this {given}") from None
    return values


def _check(kind: Any) -> Callable[[Any], Any]:
    """A function that returns a value of the annotated type or raises TypeError."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        inner = next(_check(argument) for argument in arguments if argument is not type(None))
        return lambda value: None if value is None else inner(value)
    if origin is tuple:
        item = _check(arguments[0])
        length = None if arguments[-1] is Ellipsis else len(arguments)
        return lambda value: _tuple(value, item, length)
    accepted = {float: (float, int)}.get(kind, (origin or kind,))
    return lambda value: _scalar(value, accepted, kind is bool)


def _tuple(value: Any, item: Callable[[Any], Any], length: int | None) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or (length is not None and len(value) != length):
        raise TypeError
    return tuple(item(element) for element in value)


def _scalar(value: Any, accepted: tuple[type, ...], boolean: bool) -> Any:
    if not isinstance(value, accepted) or (isinstance(value, bool) and not boolean):
        raise TypeError
    if accepted[0] is not float:
        return value
    number = float(typing.cast(float, value))
    if not math.isfinite(number):
        raise ValueError
    return number


_CHECKS = {
    payload: tuple((name, _check(hint)) for name, hint in typing.get_type_hints(payload).items())
    for payload in _FIELDS
}
