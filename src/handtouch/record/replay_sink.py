"""Outlet of replayed messages: contacts to a callback, all messages to a publisher if there is one.

Public names: `ReplaySink`, `ReplayPublisher`, `ContactCallback`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from handtouch import wire
from handtouch.core.tick_messages import MessageSink

_CONTACTS = "contact/"
ContactCallback = Callable[[wire.Contact], None]


class ReplayPublisher(MessageSink, Protocol):
    """Publisher of replayed messages; `retained_messages`: topic -> function that makes its retained one."""

    retained_messages: dict[str, Callable[[int], wire.OutgoingMessage | None]]


class ReplaySink:
    """Sink of a replayed pipeline; contacts are computed whether they have a subscriber or not."""

    def __init__(self, on_contact: ContactCallback, publisher: MessageSink | None = None) -> None:
        self._on_contact, self._publisher = on_contact, publisher

    def has_subscriber(self, topic: str) -> bool:
        """Return True for contacts, and for topics that the publisher has a subscriber of."""
        if topic.startswith(_CONTACTS):
            return True
        return self._publisher is not None and self._publisher.has_subscriber(topic)

    def send(self, message: wire.OutgoingMessage) -> None:
        """Pass a message on."""
        if wire.topic_of(message).startswith(_CONTACTS):
            contact = wire.decode(wire.encode(message))
            assert isinstance(contact, wire.Contact)
            self._on_contact(contact)
        if self._publisher is not None:
            self._publisher.send(message)
