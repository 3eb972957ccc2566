"""Newest state of one hand from its messages; needs no socket.

Public names: `HandState`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from handtouch import wire
from handtouch.client.hand_arrays import HandArrays


class _OrderedContact(NamedTuple):
    order: int
    contact: wire.Contact


class HandState:
    """Newest frame, contacts and service message of one hand; `feed` updates it.

    `arrays`: None before the first frame of a session.
    """

    def __init__(self) -> None:
        self.arrays: HandArrays | None = None
        self.service: wire.Service | None = None
        self.period_s = 0.0
        """of the hand's frames, as `service` states it; 0 before the first"""
        self.is_replay = False
        self.frame_order = self._newest_order = -1
        """number of the newest frame in the order of reception"""
        self._live_order = -1
        self.session: int | None = None
        self._contacts: dict[str, _OrderedContact] = {}
        self._rows: tuple[tuple[str, ...], Mapping[str, int]] = ((), {})

    def feed(self, message: wire.Message, order: int) -> None:
        """Update the state by a message of the hand; `order`: its number in the order of reception.

        Messages that a newer one of the same topic replaces may be left out, and those of different topics
        fed in any order. One of another session voids the state, unless it was received earlier.
        """
        if message.session != self.session:
            if order < self._newest_order:
                return
            self.arrays, self.service, self.session = None, None, message.session
            self.period_s, self.is_replay = 0.0, False
            self._contacts.clear()
        self._newest_order = max(order, self._newest_order)
        match message:
            case wire.HandFrame() if self.arrays is None or message.seq > self.arrays.frame.seq:
                self.arrays = HandArrays(message, self._rows_of(message.links))
                self.frame_order = order
                if not message.retained:  # a retained one may be older than a contact received before
                    self._live_order = order
            case wire.Contact(event="end"):
                self._contacts.pop(message.link, None)
            case wire.Contact():
                self._contacts[message.link] = _OrderedContact(order, message)
            case wire.Service():
                self.service, self.is_replay = message, message.replay
                self.period_s = message.frame_period_s or message.period_s

    @property
    def contacts(self) -> Mapping[str, wire.Contact]:
        """Active contacts by link; also without the message of an end, once a frame shows it."""
        active_ids = {} if self.arrays is None else self.arrays.contact_id
        return MappingProxyType(
            {
                link: contact
                for link, (order, contact) in self._contacts.items()
                if order > self._live_order or active_ids.get(link) == contact.id
            }
        )

    def _rows_of(self, links: tuple[str, ...]) -> Mapping[str, int]:
        if links != self._rows[0]:
            self._rows = links, {link: row for row, link in enumerate(links)}
        return self._rows[1]
