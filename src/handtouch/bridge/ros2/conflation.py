"""Messages of the daemon that wait to be relayed, of which newer ones replace older ones.

Public name: `Conflation`.
"""

from __future__ import annotations

from handtouch import wire


class Conflation:
    """Waiting messages in order; `replaced` counts those that a newer one has replaced.

    A contact's update, a hand frame and an object's pose replace the waiting one of their topic. Begins and
    ends of contacts, health and service are never replaced. So what waits is bounded by pads, begins and
    ends, however slow the relay is.
    """

    def __init__(self) -> None:
        self.replaced = 0
        self._waiting: dict[tuple[str, tuple[int, int] | None], wire.Message] = {}

    def add(self, message: wire.Message) -> None:
        """Add a message behind the others."""
        is_state = isinstance(message, wire.HandFrame) or (
            isinstance(message, wire.Contact) and message.event == "update"
        )
        is_state = is_state or (isinstance(message, wire.Percept) and message.kind == "object")
        key = wire.topic_of(message), None if is_state else (message.session, message.seq)
        if self._waiting.pop(key, None) is not None:
            self.replaced += 1
        self._waiting[key] = message

    def take(self) -> list[wire.Message]:
        """Return the waiting messages, which wait no longer."""
        messages = list(self._waiting.values())
        self._waiting.clear()
        return messages
