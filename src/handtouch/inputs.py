"""What a robot tells the daemon: joint states and forces, as two-part messages [topic, msgpack map].

Public names: `JointState`, `JointCommand`, `LinkForces`, `encode`, `decode`, `InputError`. `docs/wire.md`,
"Inputs", has every key, for writers in other languages. SI units; `t_ns` is of the host's monotonic clock, as
of samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch.wire import SCHEMA_VERSION

FloatArray = NDArray[np.float64]
LARGEST_BYTES = 65_536
"""of a message: some thousand joints"""
_MOST_NAMES = 1000
_LONGEST_NAME = 200


class InputError(ValueError):
    """A message that doesn't keep the contract; the text names topic and key."""


@dataclass(frozen=True, slots=True)
class JointState:
    """`joints/<hand>`: where joints are; some or all of the hand's, and others besides."""

    hand: str
    t_ns: int | None
    """when they were there; None: when the daemon gets to hear of it"""
    names: tuple[str, ...]
    position_rad: FloatArray
    """(m,) as `names`, as are the others; metres for a joint that slides"""
    velocity_rad_s: FloatArray | None = None
    effort_nm: FloatArray | None = None
    position_std_rad: FloatArray | None = None
    """standard deviations of position_rad: they enter the covariances in palm and base frame"""
    gravity: FloatArray | None = None
    """(3,) unit: which way gravity points in the frame of the hand's base, where the base itself moves"""


@dataclass(frozen=True, slots=True)
class JointCommand:
    """`command/<hand>`: where joints were told to go, for hands that don't know where they are."""

    hand: str
    t_ns: int | None
    """from when on"""
    names: tuple[str, ...]
    position_rad: FloatArray
    """(m,) as `names`; metres for a joint that slides"""


@dataclass(frozen=True, slots=True)
class LinkForces:
    """`force/<hand>`: forces on links as another sensor has them, a wrist's or those of the joint torques."""

    hand: str
    t_ns: int | None
    links: tuple[str, ...]
    """that carry pads"""
    force_n: FloatArray
    std_n: FloatArray


Input = JointState | JointCommand | LinkForces
_KEYS: dict[str, tuple[type[Any], str, tuple[str, ...], tuple[str, ...]]] = {
    "joints": (JointState, "names", ("position_rad",), ("velocity_rad_s", "effort_nm", "position_std_rad")),
    "command": (JointCommand, "names", ("position_rad",), ()),
    "force": (LinkForces, "links", ("force_n", "std_n"), ()),
}
"""Topic -> payload, key of the names, keys that must be there, keys that may be."""


def encode(message: Input) -> list[bytes]:
    """The two parts of a message, ready for a ZeroMQ multipart send."""
    prefix = next(prefix for prefix, (kind, *_) in _KEYS.items() if isinstance(message, kind))
    _, names, required, optional = _KEYS[prefix]
    payload: dict[str, Any] = {"v": SCHEMA_VERSION, "t_ns": message.t_ns, names: getattr(message, names)}
    for key in (*required, *optional, "gravity"):
        if (column := getattr(message, key, None)) is not None:
            payload[key] = np.asarray(column, np.float64).tolist()
    return [f"{prefix}/{message.hand}".encode(), bytes(msgpack.packb(payload))]


def decode(parts: Sequence[bytes]) -> Input:
    """The message in the two parts; unknown keys are ignored. Raises InputError, whatever the bytes."""
    if len(parts) != 2:
        raise InputError(f"{len(parts)} parts instead of [topic, payload]")
    topic = parts[0].decode("utf-8", "replace")
    prefix, _, hand = topic.partition("/")
    if prefix not in _KEYS or not hand or "/" in hand:
        raise InputError(f"unknown topic {topic[:80]!r}; there are joints/HAND, command/HAND and force/HAND")
    try:
        payload = msgpack.unpackb(parts[1])
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise InputError(f"{prefix}: payload isn't msgpack") from error
    if not isinstance(payload, dict):
        raise InputError(f"{prefix}: payload isn't a map")
    if payload.get("v") != SCHEMA_VERSION or type(payload["v"]) is not int:
        raise InputError(f"{prefix}: v must be {SCHEMA_VERSION}")
    t_ns = payload.get("t_ns")
    if t_ns is not None and (type(t_ns) is not int or not 0 <= t_ns < 2**63):
        raise InputError(f"{prefix}: t_ns must be an integer, nanoseconds of the monotonic clock, or nil")
    kind, key, required, optional = _KEYS[prefix]
    names = _names(payload.get(key), f"{prefix}: {key}")
    given = [name for name in optional if payload.get(name) is not None]
    columns = {
        name: _column(payload.get(name), len(names), f"{prefix}: {name}") for name in (*required, *given)
    }
    if kind is JointState and payload.get("gravity") is not None:
        columns["gravity"] = _direction(payload["gravity"], f"{prefix}: gravity")
    found: Input = kind(hand, t_ns, names, **columns)
    return found


def _direction(given: Any, place: str) -> FloatArray:
    way = _column(given, 3, place)
    largest = np.abs(way).max()
    if largest == 0:
        raise InputError(f"{place} must point somewhere")
    way /= largest  # so that no square is beyond what floats hold
    return np.asarray(way / np.linalg.norm(way))


def _names(given: Any, place: str) -> tuple[str, ...]:
    if not isinstance(given, list) or not 0 < len(given) <= _MOST_NAMES:
        raise InputError(f"{place} must be a list of 1 to {_MOST_NAMES} names")
    if not all(isinstance(name, str) and len(name) <= _LONGEST_NAME for name in given):
        raise InputError(f"{place} must hold names")
    if len(set(given)) < len(given):
        raise InputError(f"{place} must hold each name once")
    return tuple(given)


def _column(given: Any, size: int, place: str) -> FloatArray:
    if not isinstance(given, list) or len(given) != size:
        raise InputError(f"{place} must be a list of {size} numbers")
    if not all(type(value) is float or type(value) is int for value in given):
        raise InputError(f"{place} must hold numbers")
    try:
        column = np.array(given, dtype=np.float64)
    except OverflowError as error:
        raise InputError(f"{place} must hold numbers of some size") from error
    if not np.isfinite(column).all():
        raise InputError(f"{place} must be finite")
    if "std_" in place and (column < 0).any():
        raise InputError(f"{place} must not be negative")
    return column
