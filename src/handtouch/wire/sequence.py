"""Sequence rules of a subscriber: sessions, gaps and retained messages, as in docs/wire.md.

Public names: `SequenceTracker`.
"""

from __future__ import annotations

from collections import Counter


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
