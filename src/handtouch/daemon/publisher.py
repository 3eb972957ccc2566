"""Publisher of the live and the complete stream; encodes only topics that have a subscriber.

Public names: `Publisher`, `RetainedMessages`; `SubscriptionTable` (which topics have one),
`SubscriptionLimits` and `SUBSCRIPTION_CAUSES` (what one connection may ask for).
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import zmq

from handtouch import wire
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.cause_counter import CauseCounter
from handtouch.daemon.connections import block_connection, close_connection, connection_of
from handtouch.daemon.endpoints import bind_endpoint, is_readable

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


LIVE_QUEUE_MESSAGES = 64
"""Messages queued for a slow subscriber of the live stream: a few ticks, as the newest matter most."""
COMPLETE_QUEUE_MESSAGES = 20_000
"""Messages queued on the complete stream: several seconds."""
_MAX_SUBSCRIPTIONS_PER_POLL = 100
_QUEUED_SUBSCRIPTIONS = 4
"""Subscriptions that ZeroMQ takes from a connection at a time, within a call of the hot thread"""
_RECEIVE_BUFFER_BYTES = 2048
"""Kernel's buffer of a connection for subscriptions: what a closed connection leaves to be read"""
_MAX_BLOCKED = 64
"""Connections that are blocked for a flood of subscriptions within `_BLOCKED_NS`; others are closed"""
_BLOCKED_NS = 10_000_000_000
"""Longest time for which a blocked connection holds a descriptor"""
_MAX_RETAINED_PER_POLL = 16
"""Retained messages sent per poll, so that many late subscribers don't delay a tick."""
_REFRESH_PERIOD_NS = 20_000_000
"""Least time between two evaluations of changed subscriptions; the first change is evaluated at once."""
_RETAINED_PERIOD_NS = 100_000_000
"""Least time between two retained messages of a topic, which every late subscriber in between receives."""
_NOT_LAST, _LAST = int(zmq.SNDMORE | zmq.NOBLOCK), int(zmq.NOBLOCK)  # an enum's operators cost 0.5 us
_log = logging.getLogger("handtouch.publisher")

RetainedMessages = dict[str, Callable[[int], wire.OutgoingMessage | None]]
"""topic -> function that returns its retained message at a time [ns], None if there is none"""


class Publisher:
    """Two XPUB sockets with the same topics; never blocks, counts how often a queue was found full.

    `endpoints` (stream -> endpoint as bound, with its real port), `congestion_episodes` (stream -> times
    that a message found the queue of a subscriber full), `session` (identifies this session of the daemon in
    every message), `retained_messages` (sent to late subscribers; the owner of the mapping may add topics).
    Created by `open`.
    """

    def __init__(
        self,
        sockets: Mapping[str, zmq.Socket[bytes]],
        endpoints: Mapping[str, str],
        topics: Iterable[str],
        authenticator: Authenticator,
        session: int,
        retained_messages: RetainedMessages | None = None,
    ) -> None:
        self.session = session
        self.retained_messages: RetainedMessages = {} if retained_messages is None else retained_messages
        self.congestion_episodes: Counter[str] = Counter(live=0, complete=0)
        self.endpoints = dict(endpoints)
        self._sockets = dict(sockets)
        self._authenticator = authenticator
        self._table = SubscriptionTable(topics, sockets)
        self._limits = SubscriptionLimits(len(self._table.topics))
        self._refusals = CauseCounter(_log, "subscription refused", SUBSCRIPTION_CAUSES)
        self._blocked_ns: deque[int] = deque()
        self._refreshed_ns: int | None = None
        self._new_prefixes: dict[tuple[str, bytes], None] = {}  # since the last refresh
        self._pending_retained: dict[tuple[str, str], None] = {}  # (stream, topic), in order of subscription
        self._retained_ns: dict[tuple[str, str], int] = {}
        self._held: list[list[bytes]] | None = None

    @classmethod
    def open(
        cls,
        context: zmq.Context[zmq.Socket[bytes]],
        live: str,
        complete: str,
        topics: Iterable[str],
        authenticator: Authenticator,
        session: int = 0,
        retained_messages: RetainedMessages | None = None,
    ) -> Publisher:
        """Bind both streams, for all `topics` that will be sent.

        Raises OSError naming the endpoint that can't be bound and a remedy.
        """
        sockets: dict[str, zmq.Socket[bytes]] = {}
        endpoints: dict[str, str] = {}
        for stream, endpoint, queue in (
            ("live", live, LIVE_QUEUE_MESSAGES),
            ("complete", complete, COMPLETE_QUEUE_MESSAGES),
        ):
            socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
            socket.setsockopt(zmq.SNDHWM, queue)
            socket.setsockopt(zmq.RCVHWM, _QUEUED_SUBSCRIPTIONS)
            socket.setsockopt(zmq.RCVBUF, _RECEIVE_BUFFER_BYTES)
            socket.setsockopt(zmq.LINGER, 200)  # the ends of contacts are still sent at shutdown
            socket.setsockopt(zmq.XPUB_NODROP, 1)
            socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # every new subscriber gets the retained messages
            try:
                endpoints[stream] = bind_endpoint(
                    socket, endpoint, f"the {stream} stream", authenticator, "read"
                )
            except OSError:
                for bound in sockets.values():
                    bound.close()
                raise
            sockets[stream] = socket
        return cls(sockets, endpoints, topics, authenticator, session, retained_messages)

    @property
    def subscriptions(self) -> frozenset[bytes]:
        """Subscribed prefixes of the daemon's topics."""
        return self._table.prefixes

    @property
    def refused(self) -> Counter[str]:
        """Refused subscriptions by cause."""
        return self._refusals.counts

    def poll_subscriptions(self, now_ns: int) -> None:
        """Read subscription changes; send retained messages to new subscribers, from the next poll on."""
        if self._pending_retained:  # by now a tick has computed what nothing was subscribed to before
            self._send_retained(now_ns)
        for stream, socket in self._sockets.items():
            if is_readable(socket):
                self._read_subscriptions(stream, socket, now_ns)
        if not (self._table.changed or self._new_prefixes):
            return
        if self._refreshed_ns is None or now_ns - self._refreshed_ns >= _REFRESH_PERIOD_NS:
            self._refreshed_ns = now_ns
            self._refresh()

    def has_subscriber(self, topic: str) -> bool:
        """Return True if any client subscribed to a prefix of the topic."""
        return self._table.has_subscriber(topic)

    def send(self, message: wire.OutgoingMessage) -> None:
        """Send a message if its topic has a subscriber."""
        if not self.has_subscriber(wire.topic_of(message)):
            return
        parts = wire.encode(message)
        if self._held is None:
            self._send_all([parts])
        else:
            self._held.append(parts)

    def hold(self) -> None:
        """Queue messages until `release`, so that ZeroMQ's thread is woken once and not by every message."""
        if self._held is None:
            self._held = []

    def release(self) -> bool:
        """Send the held messages, on the live stream first; return True if there were any."""
        held, self._held = self._held, None
        if held:
            self._send_all(held)
        return bool(held)

    def close(self) -> None:
        """Close both streams; queued messages have 0.2 s to be sent."""
        for socket in self._sockets.values():
            socket.close()

    def _read_subscriptions(self, stream: str, socket: zmq.Socket[bytes], now_ns: int) -> None:
        for _ in range(_MAX_SUBSCRIPTIONS_PER_POLL):  # a flood of requests must not stop the tick
            try:
                frame = socket.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            request = frame.bytes
            kind, prefix = request[:1], request[1:]
            if kind == b"\x01":
                self._subscribe(stream, prefix, frame, now_ns)
            elif kind == b"\x00":  # by the last subscriber to the prefix
                self._table.remove(stream, prefix)

    def _subscribe(self, stream: str, prefix: bytes, frame: zmq.Frame, now_ns: int) -> None:
        endpoint = self.endpoints[stream]
        if not self._authenticator.authorise(frame, "read", endpoint, now_ns):
            return
        known, connection = self._table.is_known(prefix), connection_of(frame)
        if known:
            self._table.add(stream, prefix)
            self._new_prefixes[stream, prefix] = None
        else:
            self._refusals.add("unknown_topic", f"{prefix!r:.80}", now_ns)
        if not self._limits.allow(connection, known, now_ns) and self._cut_off(connection, endpoint, now_ns):
            self._refusals.add("subscription_flood", f"{stream}, last prefix {prefix!r:.80}", now_ns)

    def _cut_off(self, connection: int, endpoint: str, now_ns: int) -> bool:
        """Block or close the connection of a flood; return False if it is closed already.

        A client whose connection is closed would be back within milliseconds, and the flood would go on.
        """
        while self._blocked_ns and now_ns - self._blocked_ns[0] > _BLOCKED_NS:
            self._blocked_ns.popleft()
        if len(self._blocked_ns) < _MAX_BLOCKED and block_connection(connection, endpoint):
            self._blocked_ns.append(now_ns)
            return True
        return close_connection(connection, endpoint)

    def _refresh(self) -> None:
        """Evaluate the changes of subscriptions, and note what late subscribers are to receive."""
        if self._table.changed:
            self._table.refresh()
        for stream, prefix in self._new_prefixes:
            for topic in self._table.topics_under(prefix):
                if topic in self.retained_messages:
                    self._pending_retained[stream, topic] = None
        self._new_prefixes.clear()

    def _send_all(self, messages: list[list[bytes]]) -> None:
        for stream, socket in self._sockets.items():
            for parts in messages:
                if self._table.has_subscriber_on(stream, parts[0]):
                    self._try_send(stream, socket, parts)

    def _send_retained(self, now_ns: int) -> None:
        due = [key for key in self._pending_retained if self._is_retained_due(key, now_ns)]
        sent = 0
        for stream, topic in due:
            if sent == _MAX_RETAINED_PER_POLL:
                return
            del self._pending_retained[stream, topic]
            if (message := self.retained_messages[topic](now_ns)) is not None:
                self._retained_ns[stream, topic] = now_ns
                self._try_send(stream, self._sockets[stream], wire.encode(message))
                sent += 1

    def _is_retained_due(self, key: tuple[str, str], now_ns: int) -> bool:
        sent_ns = self._retained_ns.get(key)
        return sent_ns is None or now_ns - sent_ns >= _RETAINED_PERIOD_NS

    def _try_send(self, stream: str, socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
        try:
            _send_parts(socket, parts)
        except zmq.Again:
            # XPUB_NODROP reports that one queue is full, but sends to no subscriber: send again without it.
            # That subscriber gets nothing more, and causes no more reports, until half of its queue is sent
            self.congestion_episodes[stream] += 1
            socket.setsockopt(zmq.XPUB_NODROP, 0)
            _send_parts(socket, parts)
            socket.setsockopt(zmq.XPUB_NODROP, 1)


def _send_parts(socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
    """Send topic and payload, in a third of the time of `send_multipart`; zmq.Again: nothing was sent."""
    topic, payload = parts
    socket.send(topic, _NOT_LAST)
    socket.send(payload, _LAST)
