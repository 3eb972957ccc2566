"""Publisher of the live and the complete stream; encodes only topics that have a subscriber.

Public names: `Publisher`, `RetainedMessages`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import zmq

from handtouch import wire
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.endpoints import bind_endpoint, is_readable

LIVE_QUEUE_MESSAGES = 64
"""Messages queued for a slow subscriber of the live stream: a few ticks, as the newest matter most."""
COMPLETE_QUEUE_MESSAGES = 20_000
"""Messages queued on the complete stream: several seconds."""
_MAX_SUBSCRIPTIONS_PER_POLL = 100
_MAX_RETAINED_PER_POLL = 16
"""Retained messages sent per poll, so that many late subscribers don't delay a tick."""

RetainedMessages = dict[str, Callable[[int], wire.OutgoingMessage | None]]
"""topic -> function that returns its retained message at a time [ns], None if there is none"""


class Publisher:
    """Two XPUB sockets with the same topics; never blocks, counts how often a queue was found full.

    `endpoints` (stream -> endpoint as bound, with its real port), `congestion_episodes` (stream -> times
    that a message found the queue of a subscriber full), `subscriptions` (subscribed prefixes), `session`
    (identifies this session of the daemon in every message), `retained_messages` (sent to late subscribers;
    the owner of the mapping may add topics). Created by `open`.
    """

    def __init__(
        self,
        sockets: Mapping[str, zmq.Socket[bytes]],
        endpoints: Mapping[str, str],
        session: int,
        retained_messages: RetainedMessages | None = None,
    ) -> None:
        self.session = session
        self.retained_messages: RetainedMessages = {} if retained_messages is None else retained_messages
        self.congestion_episodes: Counter[str] = Counter(live=0, complete=0)
        self.subscriptions: frozenset[bytes] = frozenset()
        self.endpoints = dict(endpoints)
        self._sockets = dict(sockets)
        self._prefixes: dict[str, set[bytes]] = {stream: set() for stream in sockets}
        self._pending_retained: dict[tuple[str, str], None] = {}  # (stream, topic), in order of subscription
        self._is_subscribed: dict[str, bool] = {}
        self._held: list[list[bytes]] | None = None

    @classmethod
    def open(
        cls,
        context: zmq.Context[zmq.Socket[bytes]],
        live: str,
        complete: str,
        authenticator: Authenticator | None = None,
        session: int = 0,
        retained_messages: RetainedMessages | None = None,
    ) -> Publisher:
        """Bind both streams. Raises OSError naming the endpoint that can't be bound and a remedy."""
        authenticator = authenticator or Authenticator(context)
        sockets: dict[str, zmq.Socket[bytes]] = {}
        endpoints: dict[str, str] = {}
        for stream, endpoint, queue in (
            ("live", live, LIVE_QUEUE_MESSAGES),
            ("complete", complete, COMPLETE_QUEUE_MESSAGES),
        ):
            socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
            socket.setsockopt(zmq.SNDHWM, queue)
            socket.setsockopt(zmq.LINGER, 200)  # the ends of contacts are still sent at shutdown
            socket.setsockopt(zmq.XPUB_NODROP, 1)
            socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # every new subscriber gets the retained messages
            socket.setsockopt(zmq.HEARTBEAT_IVL, 500)
            socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1500)
            try:
                endpoints[stream] = bind_endpoint(
                    socket, endpoint, f"the {stream} stream", authenticator, "read"
                )
            except OSError:
                for bound in sockets.values():
                    bound.close()
                raise
            sockets[stream] = socket
        return cls(sockets, endpoints, session, retained_messages)

    def poll_subscriptions(self, now_ns: int) -> None:
        """Read subscription changes; send retained messages to new subscribers, from the next poll on."""
        if self._pending_retained:  # by now a tick has computed what nothing was subscribed to before
            self._send_retained(now_ns)
        for stream, socket in self._sockets.items():
            for _ in range(_MAX_SUBSCRIPTIONS_PER_POLL):  # a flood of requests must not stop the tick
                if not is_readable(socket):
                    break
                request = socket.recv(zmq.NOBLOCK)
                prefix = request[1:]
                if request[:1] == b"\x01":
                    self._prefixes[stream].add(prefix)
                    topics = (topic for topic in self.retained_messages if topic.encode().startswith(prefix))
                    self._pending_retained.update({(stream, topic): None for topic in topics})
                elif request[:1] == b"\x00":
                    self._prefixes[stream].discard(prefix)
                else:
                    continue  # not a subscription: subscribers can send nothing else
                self.subscriptions = frozenset().union(*self._prefixes.values())
                self._is_subscribed.clear()

    def has_subscriber(self, topic: str) -> bool:
        """Return True if any client subscribed to a prefix of the topic."""
        subscribed = self._is_subscribed.get(topic)
        if subscribed is None:
            subscribed = any(topic.encode().startswith(prefix) for prefix in self.subscriptions)
            self._is_subscribed[topic] = subscribed
        return subscribed

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

    def _send_all(self, messages: list[list[bytes]]) -> None:
        for stream, socket in self._sockets.items():
            prefixes = tuple(self._prefixes[stream])
            for parts in messages:
                if parts[0].startswith(prefixes):
                    self._try_send(stream, socket, parts)

    def _send_retained(self, now_ns: int) -> None:
        sent = 0
        while self._pending_retained and sent < _MAX_RETAINED_PER_POLL:
            stream, topic = next(iter(self._pending_retained))
            del self._pending_retained[stream, topic]
            if (message := self.retained_messages[topic](now_ns)) is not None:
                self._try_send(stream, self._sockets[stream], wire.encode(message))
                sent += 1

    def _try_send(self, stream: str, socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
        try:
            socket.send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:
            # XPUB_NODROP reports that one queue is full, but sends to no subscriber: send again without it.
            # That subscriber gets nothing more, and causes no more reports, until half of its queue is sent
            self.congestion_episodes[stream] += 1
            socket.setsockopt(zmq.XPUB_NODROP, 0)
            socket.send_multipart(parts, zmq.NOBLOCK)
            socket.setsockopt(zmq.XPUB_NODROP, 1)
