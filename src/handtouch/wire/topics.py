"""The table of topics: payload, keys and rate of each; everything else about topics is derived from it.

Public names: `Topic`, `TOPICS`, `INTERNAL_TOPICS`, `COLUMNS`, `HEALTH`, `JOINTS`, `SERVICE`, `topic_of`,
`topics_of`, `EncodedMessage`, `Message`, `OutgoingMessage`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple, cast

from handtouch.wire.columns import Column, columns_of
from handtouch.wire.contact import ACTION_REQUEST, PERCEPT_KINDS, Contact, Percept
from handtouch.wire.hand_frame import HandFrame
from handtouch.wire.health import Health, JointPositions
from handtouch.wire.percept_input import PerceptInput
from handtouch.wire.recording import Config, Raw, StateSnapshot, TickInputs
from handtouch.wire.service import Service
from handtouch.wire.status import MAX_SILENT_PERIODS


class EncodedMessage(NamedTuple):
    """A message whose payload is encoded already; decode(encode(message)) returns its typed form."""

    topic: str
    payload: bytes


Message = (
    Contact
    | HandFrame
    | Health
    | Percept
    | PerceptInput
    | Raw
    | JointPositions
    | Service
    | TickInputs
    | StateSnapshot
    | Config
)
OutgoingMessage = Message | EncodedMessage


@dataclass(frozen=True)
class Topic:
    """A row of the table of topics."""

    prefix: str
    payload: type[Any]
    keys: tuple[str, ...]
    """payload fields whose values follow the prefix, separated by slashes; two at most"""
    published: str
    """when messages are sent"""
    period_s: float = math.inf
    """longest time between two messages"""
    min_period_s: float = 0.0
    """shortest time between two messages; 0: limited by the tick only"""

    @property
    def pattern(self) -> str:
        """Subscription pattern of all topics of this row, e.g. contact/*/*."""
        return "/".join([self.prefix, *["*"] * len(self.keys)])

    @property
    def timeout_s(self) -> float:
        """Time without a message after which its publisher counts as disconnected: three periods."""
        return MAX_SILENT_PERIODS * self.period_s

    def formatter(self) -> Callable[[Any], str]:
        """Return a function that returns the topic of a payload."""
        prefix, getters = self.prefix, [attrgetter(key) for key in self.keys]
        if not getters:
            return lambda _: prefix
        if len(getters) == 1:
            (only,) = getters
            return lambda message: f"{prefix}/{only(message)}"
        first, second = getters
        return lambda message: f"{prefix}/{first(message)}/{second(message)}"


HEALTH = Topic("health", Health, ("hand", "link"), "at every change, and once a second", period_s=1.0)
JOINTS = Topic(
    "joints", JointPositions, ("hand",), "at most 30 a second, while the hand has a URDF", min_period_s=0.033
)
SERVICE = Topic("service", Service, (), "twice a second; timeout 1.5 s", period_s=0.5, min_period_s=0.5)
TOPICS = (
    Topic(
        "contact",
        Contact,
        ("hand", "link"),
        "at begin and end of a contact; in between per tick, or at the scene's rate",
    ),
    Topic("hand", HandFrame, ("hand",), "per tick"),
    HEALTH,
    Topic("percept", Percept, ("hand", "kind"), "at every change, and while a contact lasts"),
    Topic("raw", Raw, ("hand",), "per tick"),
    JOINTS,
    SERVICE,
    Topic("tick", TickInputs, (), "per tick"),
    Topic("state", StateSnapshot, (), "on subscription"),
    Topic("config", Config, (), "on subscription, and on reload"),
)
INTERNAL_TOPICS = (
    Topic("percept_input", PerceptInput, ("hand",), "per tick with contacts, else 20 times a second"),
)
"""Topics between processes of the daemon; no client can subscribe to them."""
COLUMNS: dict[type[Any], dict[str, Column]] = {
    topic.payload: columns for topic in (*TOPICS, *INTERNAL_TOPICS) if (columns := columns_of(topic.payload))
}
"""Payload -> its columns by name."""
_FORMATTERS = {topic.payload: topic.formatter() for topic in (*TOPICS, *INTERNAL_TOPICS)}


def topics_of(hands: Mapping[str, Sequence[str]]) -> list[str]:
    """Return all topics of a daemon with these hands (name -> its links)."""
    values: dict[tuple[str, ...], list[tuple[str, ...]]] = {
        (): [()],
        ("hand",): [(hand,) for hand in hands],
        ("hand", "link"): [(hand, link) for hand, links in hands.items() for link in links],
        ("hand", "kind"): [(hand, kind) for hand in hands for kind in (*PERCEPT_KINDS, ACTION_REQUEST)],
    }
    return ["/".join([topic.prefix, *keys]) for topic in TOPICS for keys in values[topic.keys]]


def topic_of(message: OutgoingMessage) -> str:
    """Return the topic of a message."""
    formatter = _FORMATTERS.get(type(message))
    if formatter is None:
        return cast(EncodedMessage, message).topic
    return formatter(message)
