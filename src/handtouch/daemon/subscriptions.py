"""Subscriptions of all clients: which topics have a subscriber, and what one connection may ask for.

Public names: `SubscriptionTable`, `SubscriptionLimits`, `SUBSCRIPTION_CAUSES`.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass

SUBSCRIPTION_CAUSES = {
    "unknown_topic": "subscription to a prefix of no topic of this deployment; docs/wire.md lists them",
    "subscription_flood": "connection cut off because of too many subscriptions; subscribe to a common "
    "prefix, such as contact/, and keep it",
}
"""Causes of refused subscriptions: name of the counter -> description and remedy."""

MAX_UNKNOWN_PREFIXES = 32
"""Subscriptions without a topic on one connection"""
MAX_CHANGES = 1000
"""Subscriptions on one connection at once; twice the number of topics if that is more"""
CHANGES_PER_S = 50.0
"""Subscriptions per second on one connection, continuously"""
_CLOSING_NS = 100_000_000
"""Time in which what a closed connection has sent already is still being read"""


class SubscriptionTable:
    """Subscribed prefixes of each stream, matched against the topics that the daemon publishes.

    A prefix of no topic isn't stored, so the number of prefixes is bounded. `prefixes` and the matches are
    those of the last `refresh`, so a burst of changes is evaluated once.
    """

    def __init__(self, topics: Iterable[str], streams: Iterable[str]) -> None:
        self.topics = sorted(topics)
        self.prefixes: frozenset[bytes] = frozenset()
        self.changed = False
        self._encoded_topics = [topic.encode() for topic in self.topics]
        self._by_stream: dict[str, set[bytes]] = {stream: set() for stream in streams}
        self._matches: dict[tuple[str, bytes], bool] = {}
        self._subscribed: dict[str, bool] = {}

    def topics_under(self, prefix: bytes) -> list[str]:
        """Return the topics that begin with a prefix."""
        first = bisect_left(self._encoded_topics, prefix)
        last = bisect_left(self._encoded_topics, prefix + b"\xff")  # no byte of UTF-8
        return self.topics[first:last]

    def is_known(self, prefix: bytes) -> bool:
        """Return True if a topic begins with a prefix."""
        index = bisect_left(self._encoded_topics, prefix)
        return index < len(self._encoded_topics) and self._encoded_topics[index].startswith(prefix)

    def add(self, stream: str, prefix: bytes) -> None:
        """Add a prefix of a topic."""
        if prefix not in self._by_stream[stream]:
            self._by_stream[stream].add(prefix)
            self.changed = True

    def remove(self, stream: str, prefix: bytes) -> None:
        """Remove a prefix, known or not."""
        if prefix in self._by_stream[stream]:
            self._by_stream[stream].remove(prefix)
            self.changed = True

    def refresh(self) -> None:
        """Apply all changes since the last call."""
        self.prefixes = frozenset().union(*self._by_stream.values())
        self._matches.clear()
        self._subscribed.clear()
        self.changed = False

    def has_subscriber(self, topic: str) -> bool:
        """Return True if a prefix of the topic is subscribed on any stream."""
        subscribed = self._subscribed.get(topic)
        if subscribed is None:
            subscribed = self._subscribed[topic] = _any_prefix(topic.encode(), self.prefixes)
        return subscribed

    def has_subscriber_on(self, stream: str, topic: bytes) -> bool:
        """Return True if a prefix of the topic is subscribed on a stream."""
        matches = self._matches.get((stream, topic))
        if matches is None:
            matches = self._matches[stream, topic] = _any_prefix(topic, self._by_stream[stream])
        return matches


def _any_prefix(topic: bytes, prefixes: set[bytes] | frozenset[bytes]) -> bool:
    """Return True if a prefix of the topic is in a set; its size doesn't matter."""
    return bool(prefixes) and any(topic[:length] in prefixes for length in range(len(topic) + 1))


@dataclass(slots=True)
class _Usage:
    unknown_prefixes: int
    changes: float
    since_ns: int
    closed_ns: int | None = None


class SubscriptionLimits:
    """Limits for each connection: prefixes without a topic, and the rate of subscriptions.

    ZeroMQ stores whatever clients subscribe to and searches all of it when one of them disconnects, so a
    connection beyond its limits has to be closed.
    """

    def __init__(self, topics: int) -> None:
        self._max_changes = max(MAX_CHANGES, 2 * topics)
        self._usage: dict[int, _Usage] = {}

    def allow(self, connection: int, known: bool, now_ns: int) -> bool:
        """Count a subscription; return False if its connection has to be closed for it.

        `connection` is a descriptor, which ZeroMQ uses again: a new client may inherit the counts of a
        well-behaved one, but none of one that was closed.
        """
        usage = self._usage.get(connection)
        if usage is None or (usage.closed_ns is not None and now_ns - usage.closed_ns > _CLOSING_NS):
            usage = self._usage[connection] = _Usage(0, 0.0, now_ns)
        if usage.closed_ns is not None:
            return True
        usage.changes = max(0.0, usage.changes - (now_ns - usage.since_ns) * 1e-9 * CHANGES_PER_S) + 1.0
        usage.since_ns = now_ns
        usage.unknown_prefixes += not known
        if usage.unknown_prefixes <= MAX_UNKNOWN_PREFIXES and usage.changes <= self._max_changes:
            return True
        usage.closed_ns = now_ns
        return False
