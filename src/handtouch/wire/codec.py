"""Encoding and decoding of two-part messages: [topic, msgpack map]; what was lost by their sequence.

A typed decoder (msgspec 0.22) was tried instead of the checks here. Of a contact of 838 bytes, in user us on
one machine: `decode` 32, of which unpacking 5.4, checks 14, the dataclass 9.7; msgspec 7.7 into
the dataclass with another 1.2 for numbers that aren't finite, which it accepts. It refuses maps with unknown
keys that aren't text and values that a later version may add, so that every payload would need a second class
for it, and `v` a check of its own.
"""

from __future__ import annotations

import math
import types
import typing
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import MISSING, fields
from functools import cache
from operator import attrgetter
from typing import Any, Literal, NamedTuple, TypeVar, Union

import msgpack

from handtouch.wire.columns import is_array
from handtouch.wire.topics import (
    COLUMNS,
    INTERNAL_TOPICS,
    TOPICS,
    EncodedMessage,
    Message,
    OutgoingMessage,
    Topic,
    topic_of,
)

M = TypeVar("M")
SCHEMA_VERSION = 1
"""Rules for raising it: docs/wire.md, "Versions"."""


class WireError(ValueError):
    """A message that violates the wire contract; the text names topic and key."""


class UnknownTopicError(WireError):
    """A message of no known topic; the text lists the topics."""


_ALL_TOPICS = (*TOPICS, *INTERNAL_TOPICS)
_TOPIC_OF_PREFIX = {topic.prefix: topic for topic in _ALL_TOPICS}
_DEFAULTS = {
    topic.payload: {f.name: f.default for f in fields(topic.payload) if f.default is not MISSING}
    for topic in _ALL_TOPICS
}
_FIELDS = {
    kind: (names := [f.name for f in fields(kind) if f.name not in defaults], attrgetter(*names))
    for kind, defaults in _DEFAULTS.items()
}


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return an attrgetter that always returns a tuple, for a single name too."""
    get = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


_OPTIONAL = {
    kind: (names := list(defaults), _getter(names), tuple(defaults.values()))
    for kind, defaults in _DEFAULTS.items()
    if defaults
}
_PACKER = msgpack.Packer()


def encode(message: OutgoingMessage) -> list[bytes]:
    """Return the two parts of a message, for a ZeroMQ multipart send."""
    if isinstance(message, EncodedMessage):
        return [message.topic.encode(), message.payload]
    return [topic_of(message).encode(), _PACKER.pack(to_map(message))]


def from_map(kind: type[M], payload: Mapping[str, Any], where: str = "") -> M:
    """Return the message of a map, of any layout that has its fields.

    Raises WireError, naming `where` it came from, by default its kind.
    """
    return kind(**check_fields(where or kind.__name__, payload, kind))


def to_map(message: OutgoingMessage) -> dict[str, Any]:
    """Return the map that is sent for a message."""
    if isinstance(message, EncodedMessage):
        return dict(msgpack.unpackb(message.payload))
    kind = type(message)
    names, values = _FIELDS[kind]
    payload = dict(zip(names, values(message), strict=True))
    if kind in _OPTIONAL:
        names, get, defaults = _OPTIONAL[kind]
        if (optional := get(message)) != defaults:
            pairs = zip(names, optional, defaults, strict=True)
            payload.update((name, value) for name, value, default in pairs if value != default)
    return payload


def decode(parts: Sequence[bytes]) -> Message:
    """Decode the two parts of a ZeroMQ message; unknown keys of the map are ignored.

    Raises WireError naming the violation, for any bytes.
    """
    received = unpack(parts, _TOPIC_OF_PREFIX)
    topic, payload = received.topic, received.payload
    message = from_map(topic.payload, payload, received.name)
    if "links" in payload:
        _check_columns(received.name, message)
    if topic_of(message) != received.name:
        raise WireError(f"{received.name}: payload belongs to {topic_of(message)}")
    return typing.cast(Message, message)


def to_datagram(message: OutgoingMessage) -> bytes:
    """Return both parts of a message in one, for a pipe between processes."""
    return b"\0".join(encode(message))


def from_datagram(data: bytes) -> Message:
    """Return the message that `to_datagram` made the bytes of. Raises WireError, for any bytes."""
    return decode(data.split(b"\0", 1))


class Received(NamedTuple):
    """A received message whose fields aren't checked yet."""

    name: str
    """full topic"""
    topic: Topic
    keys: list[str]
    """parts of the topic after the prefix"""
    payload: dict[Any, Any]


def unpack(parts: Sequence[bytes], topics: Mapping[str, Topic]) -> Received:
    """Look up the topic of a message by its prefix and unpack its map. Raises WireError, for any bytes."""
    if len(parts) != 2:
        raise WireError(f"{len(parts)} parts instead of [topic, payload]")
    name = parts[0].decode("utf-8", "replace")
    prefix, *keys = name.split("/")
    topic = topics.get(prefix)
    if topic is None or len(keys) != len(topic.keys) or not all(keys):
        known = ", ".join(t.pattern for t in topics.values() if t not in INTERNAL_TOPICS)
        raise UnknownTopicError(f"unknown topic {name[:80]!r}; the topics are {known}")
    try:
        payload = msgpack.unpackb(parts[1], strict_map_key=False)  # keys of unknown fields may be anything
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"{name}: payload isn't msgpack: {error}") from error
    if not isinstance(payload, dict):
        raise WireError(f"{name}: payload isn't a map")
    version = payload.get("v")
    if type(version) is not int or version != SCHEMA_VERSION:
        shown = version if type(version) is int else _describe(version)
        raise WireError(f"{name}: schema version v is {shown}; this reader supports {SCHEMA_VERSION}")
    return Received(name, topic, keys, payload)


def check_fields(name: str, payload: Mapping[Any, Any], kind: type[Any]) -> dict[str, Any]:
    """Check a map against the fields of a payload class; return its constructor's arguments.

    Raises WireError naming the first key that is missing or has the wrong type.
    """
    values = {}
    for key, check, expected, optional in _field_checkers(typing.cast(Hashable, kind)):
        if key not in payload:
            if optional:
                continue
            raise WireError(f"{name}: {key} is missing")
        try:
            values[key] = check(payload[key])
        except (TypeError, ValueError, OverflowError):
            raise WireError(f"{name}: {key} must be {expected}, not {_describe(payload[key])}") from None
    return values


def _check_columns(name: str, message: Any) -> None:
    rows = len(message.links)
    for key, column in COLUMNS[type(message)].items():
        size = len(getattr(message, key))
        if size == 0 and key in _DEFAULTS[type(message)]:
            continue
        if not column.fits(size, rows):
            raise WireError(
                f"{name}: {key} must have one row of {column.elements} {column.dtype} for each of "
                f"{rows} links, {rows * column.row_bytes} bytes, not {size}"
            )


@cache
def _field_checkers(kind: Hashable) -> tuple[tuple[str, Callable[[Any], Any], str, bool], ...]:
    """Return key, check, expected type and whether it may be left out, of each field of a payload class."""
    hints = typing.get_type_hints(kind)
    return tuple(
        (f.name, _checker(hints[f.name]), _expected(hints[f.name]), f.default is not MISSING)
        for f in fields(typing.cast(Any, kind))
    )


_TYPE_NAMES = {
    int: "an integer",
    float: "a number",
    str: "a string",
    bool: "true or false",
    bytes: "binary",
    dict: "a map",
}


def _expected(hint: Any) -> str:
    """Describe an annotated type by the types of JSON and msgpack."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:  # a later version may add values
        return _TYPE_NAMES[str]
    if origin in (Union, types.UnionType):
        inner = next(argument for argument in arguments if argument is not type(None))
        return f"{_expected(inner)} or nil"
    if is_array(hint):
        return "a list of numbers"
    if origin is tuple:
        item = _expected(arguments[0]).split(" ", 1)[1]
        plural = "values true or false" if arguments[0] is bool else f"{item.split(' ')[0]}s"
        return f"a list of {'' if arguments[-1] is Ellipsis else f'{len(arguments)} '}{plural}"
    return _TYPE_NAMES[dict if typing.is_typeddict(hint) else origin or hint]


def _describe(value: Any) -> str:
    """Describe a received value by its type; not by its content, which may be nested too deeply to print."""
    if value is None:
        return "nil"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return _TYPE_NAMES.get(type(value), type(value).__name__)


def _checker(hint: Any) -> Callable[[Any], Any]:
    """Return a function that returns a value of the annotated type, or raises TypeError or ValueError."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return _checker(str)
    if origin in (Union, types.UnionType):
        inner = next(_checker(argument) for argument in arguments if argument is not type(None))
        return lambda value: None if value is None else inner(value)
    if is_array(hint):
        return _check_array
    if origin is tuple:
        item = _checker(arguments[0])
        length = None if arguments[-1] is Ellipsis else len(arguments)
        return lambda value: _check_tuple(value, item, length)
    if typing.is_typeddict(hint):
        return _checker(dict)
    return _check_number if hint is float else _type_checker(origin or hint)


def _check_array(value: Any) -> Any:
    """Return an array of numbers that may be infinite or NaN: a payload decides which it accepts."""
    import numpy as np

    if not isinstance(value, list) or not all(type(item) is float or type(item) is int for item in value):
        raise TypeError
    return np.array(value, dtype=np.float64)


_FLOATS = {float}


def _check_tuple(value: Any, item: Callable[[Any], Any], length: int | None) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or (length is not None and len(value) != length):
        raise TypeError
    if item is _check_number and set(map(type, value)) == _FLOATS and math.isfinite(sum(value)):
        return tuple(value)
    return tuple(map(item, value))


def _check_number(value: Any) -> float:
    if type(value) is not float:
        if not isinstance(value, float | int) or isinstance(value, bool):
            raise TypeError
        value = float(value)
    if not math.isfinite(value):
        raise ValueError
    return typing.cast(float, value)


def _type_checker(accepted: type) -> Callable[[Any], Any]:
    """Return a function that returns an instance of a type; true and false are no integers."""

    def check(value: Any) -> Any:
        if type(value) is not accepted and (not isinstance(value, accepted) or isinstance(value, bool)):
            raise TypeError
        return value

    return check


class SequenceTracker:
    """Follows `session` and `seq` of every topic and counts the messages that were lost."""

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        """topic -> messages lost, by the gaps in its seq"""
        self._session: int | None = None
        self._last_seq: dict[str, int] = {}

    def accept(self, topic: str, session: int, seq: int, retained: bool) -> bool:
        """Register a received message; return False for a retained one that was received before.

        With another session than before, the seq of every topic starts over.
        """
        if session != self._session:
            self._session = session
            self._last_seq.clear()
        last = self._last_seq.get(topic)
        if last is not None:
            if retained and seq <= last:
                return False
            if (gap := seq - last - 1) > 0:
                self.lost[topic] += gap
        self._last_seq[topic] = seq
        return True
