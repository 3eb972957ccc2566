"""The table of topics, what columns hold, and to which topic a message belongs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from handtouch.wire.condition import Health, Joints, Service
from handtouch.wire.source import Config, Raw, State, TickInputs
from handtouch.wire.touch import Contact, HandFrame, Percept


@dataclass(frozen=True, slots=True)
class Packed:
    """A message whose payload is encoded already; `decode(encode(it))` tells what it is."""

    topic: str
    payload: bytes


Message = Contact | HandFrame | Health | Percept | Raw | Joints | Service | TickInputs | State | Config
Outgoing = Message | Packed

_F4 = ("<f4", 1)
COLUMNS: dict[type[Any], dict[str, tuple[str, int]]] = {
    HandFrame: {
        "state": ("<u1", 1),
        "contact": ("<u4", 1),
        "sample_ns": ("<i8", 1),
        "current_a": _F4,
        "position_m": ("<f4", 3),
        "normal": ("<f4", 3),
        "covariance_m2": ("<f4", 9),
        "pad_m": ("<f4", 2),
        "force_n": _F4,
        "force_std_n": _F4,
        "saturated": ("<u1", 1),
        "residual": _F4,
        "residual_std": _F4,
        "group": ("<u4", 1),
        "palm": ("<u1", 1),
        "palm_position_m": ("<f4", 3),
        "palm_normal": ("<f4", 3),
        "palm_covariance_m2": ("<f4", 9),
        "base": ("<u1", 1),
        "base_position_m": ("<f4", 3),
        "base_normal": ("<f4", 3),
        "base_covariance_m2": ("<f4", 9),
        "joints_age_s": _F4,
        "unestimated": ("<u1", 1),
        "doubtful": ("<u1", 1),
    },
    Raw: {"counts": ("<i8", 4), "sample_ns": ("<i8", 1), "fresh": ("<u1", 1)},
}
"""Payload -> column -> (type of its elements: order, kind, bytes; elements per row)."""

INPUTS = {
    "counts": ("<i8", 4),
    "arrived_ns": ("<i8", 1),
    "fresh": ("<u1", 1),
    "node_state": ("<u1", 1),
    "synchronous": ("<u1", 1),
    "period_ns": ("<i8", 1),
    "paced_ns": ("<i8", 1),
}
"""Columns of `TickInputs`, as in COLUMNS."""


@dataclass(frozen=True)
class Topic:
    """A row of the table: how a topic starts, how many parts follow, what it carries."""

    prefix: str
    parts: int
    payload: type[Any]
    rate: str


TOPICS = (
    Topic("contact", 2, Contact, "at each tick while touched, and at begin and end"),
    Topic("hand", 1, HandFrame, "one per tick"),
    Topic("health", 2, Health, "at every change, and once a second"),
    Topic("percept", 2, Percept, "at every change, and while there is something to tell"),
    Topic("raw", 1, Raw, "one per tick"),
    Topic("joints", 1, Joints, "thirty a second, where the hand has a URDF"),
    Topic("service", 0, Service, "twice a second"),
    Topic("tick", 0, TickInputs, "one per tick"),
    Topic("state", 0, State, "to who subscribes, and when something other than a tick changes it"),
    Topic("config", 0, Config, "to who subscribes, and when it is read again"),
)
_ALONE: dict[type[Any], str] = {topic.payload: topic.prefix for topic in TOPICS if not topic.parts}


def topic_of(message: Outgoing) -> str:
    """Topic that a message belongs to."""
    if isinstance(message, Packed):
        return message.topic
    if isinstance(message, Contact):
        return f"contact/{message.hand}/{message.link}"
    if isinstance(message, Health):
        return f"health/{message.hand}/{message.link}"
    if isinstance(message, HandFrame):
        return f"hand/{message.hand}"
    if isinstance(message, Percept):
        return f"percept/{message.hand}/{message.kind}"
    if isinstance(message, Joints):
        return f"joints/{message.hand}"
    return f"raw/{message.hand}" if isinstance(message, Raw) else _ALONE[type(message)]
