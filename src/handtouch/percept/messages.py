"""Messages of percepts: published ones, and those between the daemon and its percept process.

The daemon sends `wire.PerceptInput`; the process returns `wire.Percept`, whose `session` and `seq` the daemon
sets, and `PerceptStatus`. Each is one datagram: the two parts of a message of the wire, joined.
`unpack_output` accepts any bytes and raises PerceptMessageError.

Public names: `make_percept_message`, `make_message`, `pack_message`, `unpack_input`, `pack_status`,
`unpack_output`, `PerceptStatus`, `PerceptMessageError`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgpack

from handtouch import wire
from handtouch.percept.samples import PerceptEstimate

_SEPARATOR = b"\0"
_STATUS = b"status"
_MAX_TEXT = 4000
_MAX_ENTRIES = 100


class PerceptMessageError(ValueError):
    """Bytes that are no message of the percept process."""


class PerceptStatus(NamedTuple):
    """Heartbeat of the percept process, which has processed the stream up to `processed_ns`."""

    processed_ns: int


def make_percept_message(percept: PerceptEstimate, hand: str, link: str) -> wire.Percept:
    """Return the message about an estimate; `seq` and `session` are 0."""
    return make_message(
        percept.kind,
        t_ns=percept.estimate_ns,
        hand=hand,
        link=link,
        contact_id=percept.contact,
        state=percept.state,
        label=percept.label,
        confidence=percept.probabilities.get(percept.label),
        probabilities=dict(percept.probabilities),
        values=dict(percept.values),
        evidence=dict(percept.evidence),
        reason=percept.reason,
        poses=percept.poses,
    )


def make_message(kind: Any, **fields: Any) -> wire.Percept:
    """Return a message of a kind of percept; `seq` and `session` are 0."""
    experimental = kind in wire.EXPERIMENTAL_PERCEPTS
    header: dict[str, Any] = {"v": wire.SCHEMA_VERSION, "session": 0, "seq": 0, "retained": False}
    return wire.Percept(**header, kind=kind, experimental=experimental, **fields)


def pack_message(message: wire.PerceptInput | wire.Percept) -> bytes:
    """Return a message as one datagram."""
    return _SEPARATOR.join(wire.encode(message))


def unpack_input(data: bytes) -> wire.PerceptInput:
    """Return the message of the daemon in a datagram. Raises WireError."""
    message = wire.decode(data.split(_SEPARATOR, 1))
    assert isinstance(message, wire.PerceptInput)
    return message


def pack_status(status: PerceptStatus) -> bytes:
    """Return a heartbeat as one datagram."""
    packed: bytes = msgpack.packb(status.processed_ns)
    return _SEPARATOR.join([_STATUS, packed])


def unpack_output(data: bytes) -> wire.Percept | PerceptStatus:
    """Return the message of the percept process in a datagram. Raises PerceptMessageError."""
    parts = data.split(_SEPARATOR, 1)
    if parts[0] == _STATUS and len(parts) == 2:
        return _unpack_status(parts[1])
    try:
        message = wire.decode(parts)
    except wire.WireError as error:
        raise PerceptMessageError(str(error)) from error
    if not isinstance(message, wire.Percept):
        raise PerceptMessageError(f"not a percept: {wire.topic_of(message)}")
    _check_map("probabilities", message.probabilities, _is_probability)
    _check_map("evidence", message.evidence, _is_number)
    _check_map("values", message.values, _is_value)
    if len(message.poses) > wire.MAX_POSES or not all(map(_is_pose, message.poses)):
        raise PerceptMessageError("a pose is invalid")
    if max(map(len, (message.label, message.reason, message.question))) > _MAX_TEXT:
        raise PerceptMessageError("a text is too long")
    return message


def _unpack_status(data: bytes) -> PerceptStatus:
    try:
        processed_ns = msgpack.unpackb(data)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise PerceptMessageError(f"malformed status: {error}") from error
    if type(processed_ns) is not int:
        raise PerceptMessageError("malformed status")
    return PerceptStatus(processed_ns)


def _check_map(name: str, entries: Mapping[Any, Any], check: Any) -> None:
    if len(entries) > _MAX_ENTRIES:
        raise PerceptMessageError(f"{name} has {len(entries)} entries")
    for key, value in entries.items():
        if type(key) is not str or not check(value):
            raise PerceptMessageError(f"{name}: {key!r:.80} is invalid")


def _is_pose(pose: Mapping[Any, Any]) -> bool:
    """Return whether a pose has its required keys, and as many finite numbers in each as it must."""
    lengths = {"position_m": 3, "quaternion": 4, "covariance": 36}
    keys = {f"{frame}_{name}": n for frame in ("palm", "base") for name, n in lengths.items()}
    return (
        wire.ObjectPose.__required_keys__ <= pose.keys() <= {"weight", *keys}
        and _is_probability(pose["weight"])
        and all(len(pose[key]) == keys[key] and all(map(_is_number, pose[key])) for key in pose.keys() & keys)
    )


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def _is_probability(value: object) -> bool:
    return _is_number(value) and -1e-9 <= value <= 1 + 1e-9  # type: ignore[operator]


def _is_value(value: object) -> bool:
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return len(value) <= _MAX_ENTRIES and all(map(_is_number, value))
    return value is None or _is_number(value) or type(value) in (bool, str)
