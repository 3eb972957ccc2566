"""Subscribe to a handtouch daemon from Python, blocking or with asyncio.

    with handtouch.connect("contact/*/thumb_*") as messages:
        for contact in messages:
            print(contact.link, contact.event, contact.force_n)

Public names: `connect`, `Subscriber`, `request`.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Iterator
from fnmatch import fnmatchcase
from typing import Any, Self

import msgpack
import zmq
import zmq.asyncio

from handtouch import wire

LIVE = "tcp://127.0.0.1:5580"
CONTROL = "tcp://127.0.0.1:5581"
SILENCE_S = 1.5
"""The daemon says `service` twice a second; three missed ones mean that it is gone."""


def connect(*patterns: str, endpoint: str = LIVE, queue: int = 1000) -> Subscriber:
    """Subscribe to the topics that match any of the patterns.

    A pattern is a topic whose parts may hold the wildcards * and ?: "contact/*/*" (the default),
    "contact/left/thumb_tip", "hand/*", "health/*/index_*", "service". `queue` bounds the messages kept
    while this side is busy; beyond it the newest are lost, and counted as gaps. The connection comes back
    by itself when a daemon restarts.

    Raises ValueError for a pattern that no topic could match, or an endpoint that is none.
    """
    return Subscriber(patterns or ("contact/*/*",), endpoint, queue)


class Subscriber:
    """Messages of a daemon as typed objects: an iterator, an asynchronous iterator and a context manager."""

    def __init__(self, patterns: tuple[str, ...], endpoint: str, queue: int) -> None:
        known = {topic.prefix: topic for topic in wire.TOPICS}
        for pattern in patterns:
            parts = pattern.split("/")
            if not any(fnmatchcase(p, parts[0]) and known[p].parts == len(parts) - 1 for p in known):
                rows = ", ".join("/".join([t.prefix, *["*"] * t.parts]) for t in wire.TOPICS)
                raise ValueError(f"no topic matches the pattern {pattern!r}; the topics are {rows}")
        self.patterns = patterns
        self.endpoint = endpoint
        self.gaps = 0
        """messages known to be lost, by the gaps in their seq"""
        self.malformed = 0
        """messages dropped because they don't keep the contract"""
        self._last_seq: dict[str, int] = {}
        self._heard_s = time.monotonic()
        self._ever = False
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, queue)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, 500)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1500)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        for prefix in {_literal_prefix(pattern) for pattern in patterns} | {"service"}:
            self._socket.subscribe(prefix)
        _connect(self._socket, endpoint)

    def recv(self, timeout_s: float | None = None) -> Any:
        """The next message that matches, or None after `timeout_s` seconds without one."""
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            wait_ms = None if end_s is None else max(0, round((end_s - time.monotonic()) * 1000))
            if not self._socket.poll(wait_ms):
                return None
            message = self._accept(self._socket.recv_multipart())
            if message is not None:
                return message

    @property
    def heard(self) -> bool:
        """Whether anything ever came from the daemon, its heartbeat at least."""
        return self._ever

    @property
    def alive(self) -> bool:
        """Whether anything, its heartbeat at least, came from the daemon within SILENCE_S.

        True only while messages are being received: it looks at what this subscriber has taken in.
        """
        return time.monotonic() - self._heard_s < SILENCE_S

    def __iter__(self) -> Iterator[Any]:
        while True:
            yield self.recv()

    async def __aiter__(self) -> AsyncIterator[Any]:
        socket = zmq.asyncio.Socket.shadow(self._socket)
        while True:
            message = self._accept(await socket.recv_multipart())
            if message is not None:
                yield message

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave; the daemon notices within milliseconds."""
        self._socket.close()

    def _accept(self, parts: list[bytes]) -> wire.Message | None:
        self._heard_s, self._ever = time.monotonic(), True
        topic = parts[0].decode("utf-8", "replace") if parts else ""
        wanted = any(_matches(pattern, topic) for pattern in self.patterns)
        if not wanted:
            return None  # another topic under the same prefix, or the heartbeat
        try:
            message = wire.decode(parts)
        except wire.WireError:
            self.malformed += 1
            return None
        last = self._last_seq.get(topic)
        if last is not None and message.seq > last + 1:
            self.gaps += message.seq - last - 1
        if not message.repeat or last is None or message.seq > last:
            self._last_seq[topic] = message.seq
            return message
        return None  # a repeat for a late joiner that this subscriber has had


def request(
    command: str, *, endpoint: str = CONTROL, timeout_s: float = 2.0, **arguments: Any
) -> dict[str, Any]:
    """Send a command to the daemon's control endpoint and return its answer.

    Raises TimeoutError when no daemon answers, RuntimeError with its words when it refuses, ValueError for an
    endpoint that is none.
    """
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        _connect(socket, endpoint)
        socket.send(msgpack.packb({"v": wire.SCHEMA_VERSION, "command": command, **arguments}))
        if not socket.poll(round(timeout_s * 1000)):
            raise TimeoutError(f"no daemon answers at {endpoint} within {timeout_s} s; is handtouch run up?")
        answer = msgpack.unpackb(socket.recv())
    finally:
        socket.close()
    if not isinstance(answer, dict) or not answer.get("ok"):
        raise RuntimeError(answer.get("error", "refused") if isinstance(answer, dict) else "malformed answer")
    return answer


def _connect(socket: zmq.Socket[bytes], endpoint: str) -> None:
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        socket.close()
        raise ValueError(
            f"{endpoint!r} is no ZeroMQ endpoint ({error.strerror}); one looks like tcp://127.0.0.1:5580"
        ) from error


def _literal_prefix(pattern: str) -> str:
    for position, character in enumerate(pattern):
        if character in "*?[":
            return pattern[:position]
    return pattern


def _matches(pattern: str, topic: str) -> bool:
    """Whether a topic matches part by part: a wildcard doesn't cross a slash."""
    asked, got = pattern.split("/"), topic.split("/")
    return len(asked) == len(got) and all(map(fnmatchcase, got, asked))
