"""Inputs of the daemon from a robot: joint states and reference forces.

Public names: `JointState`, `LinkForces`, `encode`, `decode`, `INPUT_TOPICS`, `hands_prefix`,
`hands_in_prefix`, `joints_prefix`, `joints_in_prefix`. The keys are in docs/wire.md, "Inputs". SI units;
`t_ns` is of the host's monotonic clock, as that of samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import msgpack
import numpy as np

from handtouch.arrays import FloatArray
from handtouch.wire.codec import SCHEMA_VERSION, WireError, check_fields, unpack
from handtouch.wire.topics import Topic

_MAX_NAMES = 1000
_MAX_NAME_CHARACTERS = 200
_MAX_T_NS = 2**63 - 1
_MAX_NEGATIVE_SIGMA = 3
_HANDS_PREFIX, _JOINTS_PREFIX = "hands/", "hand_joints/"
"""Of subscriptions; ZeroMQ sends them in alphabetical order, so that joints are known once the hands are"""


@dataclass(frozen=True, slots=True)
class JointState:
    """`joints/<hand>`: measured joint positions; any subset of the hand's joints, and other joints too.

    Arrays are (m,), `gravity` is (3,), `orientation` (4,). Raises ValueError for values that violate the
    contract.
    """

    hand: str
    t_ns: int | None
    """time of the measurement, on the monotonic clock of the daemon's machine (`CLOCK_MONOTONIC`); nil: when
    the daemon reads it"""
    names: tuple[str, ...]
    """joints, as named in the URDF or as the deployment names them for joint states; any subset, unknown ones
    are ignored"""
    position_rad: FloatArray
    """in the order of `names`; metres for a prismatic joint. A joint whose position isn't finite, or beyond
    its limits in the URDF by more than 0.2 rad (0.02 m), is left out. The message is dropped, and its sender
    held back for 10 s, if two are beyond them, or one by 5 times the range between them, as degrees are"""
    velocity_rad_s: FloatArray | None = None
    """used to extrapolate beyond the newest state, where it agrees with the positions; one that isn't finite
    counts as not given"""
    effort_nm: FloatArray | None = None
    """torque in newton metres, for a prismatic joint newtons; not used"""
    position_std_rad: FloatArray | None = None
    """standard deviations, above 0; included in `palm_covariance_m2` and `base_covariance_m2` instead of the
    deployment's values"""
    gravity: FloatArray | None = None
    """x, y, z: direction of gravity in the frame of the hand's base, of any length; for a base that moves,
    instead of the deployment's `gravity`"""
    orientation: FloatArray | None = None
    """x, y, z, w: quaternion of the hand's base in a frame fixed to the ground, of any length; for a base
    that moves, by which zeros of magnetic pads are compensated"""

    def __post_init__(self) -> None:
        _check_time(self.t_ns)
        _check_names("names", self.names)
        for key in ("position_rad", "velocity_rad_s", "effort_nm"):
            _check_length(key, getattr(self, key), "names", self.names)
        _check_column("position_std_rad", self.position_std_rad, "names", self.names)
        _check_std("position_std_rad", self.position_std_rad)
        for key, length in (("gravity", 3), ("orientation", 4)):
            if (vector := getattr(self, key)) is not None:
                object.__setattr__(self, key, _unit_vector(key, vector, length))


@dataclass(frozen=True, slots=True)
class LinkForces:
    """`force/<hand>`: reference forces (m,) on links, from another sensor or from joint torques.

    Raises ValueError for values that violate the contract.
    """

    hand: str
    t_ns: int | None
    """time of the measurement, as above"""
    links: tuple[str, ...]
    """links that carry pads"""
    force_n: FloatArray
    """normal force on each; at most 3 `std_n` below 0"""
    std_n: FloatArray
    """its standard deviation, above 0"""

    def __post_init__(self) -> None:
        _check_time(self.t_ns)
        _check_names("links", self.links)
        _check_column("force_n", self.force_n, "links", self.links)
        _check_column("std_n", self.std_n, "links", self.links)
        _check_std("std_n", self.std_n)
        if (self.force_n < -_MAX_NEGATIVE_SIGMA * self.std_n).any():
            raise ValueError(
                f"force_n must not be below 0 by more than {_MAX_NEGATIVE_SIGMA} std_n: a pad can't be pulled"
            )


InputMessage = JointState | LinkForces
INPUT_TOPICS = (
    Topic("joints", JointState, ("hand",), "at the rate of the robot's joint states"),
    Topic("force", LinkForces, ("hand",), "at the rate of the reference sensor"),
)
_TOPIC_OF_PREFIX = {topic.prefix: topic for topic in INPUT_TOPICS}
_FORMATTERS = {topic.payload: topic.formatter() for topic in INPUT_TOPICS}


def encode(message: InputMessage) -> list[bytes]:
    """Return the two parts of a message, for a ZeroMQ multipart send; fields that are None are left out."""
    payload: dict[str, Any] = {"v": SCHEMA_VERSION, "t_ns": message.t_ns}
    for field in fields(message):
        value = getattr(message, field.name)
        if field.name == "hand" or value is None:
            continue
        payload[field.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return [_FORMATTERS[type(message)](message).encode(), bytes(msgpack.packb(payload))]


def decode(parts: Sequence[bytes]) -> InputMessage:
    """Decode the two parts of a message; unknown keys are ignored. Raises WireError, for any bytes."""
    received = unpack(parts, _TOPIC_OF_PREFIX)
    payload = {"t_ns": None, **received.payload, **dict(zip(received.topic.keys, received.keys, strict=True))}
    values = check_fields(received.name, payload, received.topic.payload)
    try:
        return cast(InputMessage, received.topic.payload(**values))
    except ValueError as error:
        raise WireError(f"{received.name}: {error}") from None


def hands_prefix(hands: Iterable[str]) -> str:
    """Return the subscription by which a daemon names its hands to the sender, which sees it on its XPUB."""
    return _HANDS_PREFIX + "/".join(sorted(set(hands)))


def hands_in_prefix(prefix: str) -> frozenset[str]:
    """Return the hands that such a subscription names; empty for any other."""
    return frozenset(prefix[len(_HANDS_PREFIX) :].split("/") if prefix.startswith(_HANDS_PREFIX) else ())


def joints_prefix(hand: str, joints: Iterable[str]) -> str:
    """Return the subscription by which a daemon names the joints of a hand in their order."""
    return _JOINTS_PREFIX + "\0".join((hand, *joints))


def joints_in_prefix(prefix: str) -> dict[str, tuple[str, ...]]:
    """Return the hand that such a subscription names, with its joints; empty for any other."""
    if not prefix.startswith(_JOINTS_PREFIX):
        return {}
    hand, *joints = prefix[len(_JOINTS_PREFIX) :].split("\0")
    return {hand: tuple(joints)}


def _check_time(t_ns: int | None) -> None:
    if t_ns is not None and not 0 <= t_ns <= _MAX_T_NS:
        raise ValueError("t_ns must be nanoseconds of the monotonic clock, from 0 to 2^63 - 1, or nil")


def _check_names(key: str, names: tuple[str, ...]) -> None:
    if not 0 < len(names) <= _MAX_NAMES:
        raise ValueError(f"{key} must be a list of 1 to {_MAX_NAMES} names, not {len(names)}")
    if any(len(name) > _MAX_NAME_CHARACTERS for name in names):
        raise ValueError(f"{key} must be names of at most {_MAX_NAME_CHARACTERS} characters")
    if len(set(names)) < len(names):
        raise ValueError(f"{key} must contain each name once")


def _check_length(key: str, column: FloatArray | None, names_key: str, names: tuple[str, ...]) -> None:
    if column is not None and column.shape != (len(names),):
        raise ValueError(f"{key} must be a list of {len(names)} numbers, one for each of {names_key}")


def _check_column(key: str, column: FloatArray | None, names_key: str, names: tuple[str, ...]) -> None:
    _check_length(key, column, names_key, names)
    if column is not None and not np.isfinite(column).all():
        wrong = [name for name, value in zip(names, column, strict=True) if not np.isfinite(value)]
        raise ValueError(f"{key} must be finite, but isn't for {', '.join(wrong)}; leave out unknown values")


def _check_std(key: str, column: FloatArray | None) -> None:
    if column is not None and not (column > 0).all():
        raise ValueError(f"{key} must be greater than 0")


def _unit_vector(key: str, vector: FloatArray, length: int) -> FloatArray:
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise ValueError(f"{key} must be a list of {length} finite numbers")
    largest = np.abs(vector).max()
    if largest == 0:
        raise ValueError(f"{key} must be a direction: not all components may be 0")
    scaled = vector / largest  # its squares neither overflow nor underflow
    return np.asarray(scaled / np.linalg.norm(scaled))
