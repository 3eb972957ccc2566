"""Sends messages on the live and the complete stream, to whoever subscribed; encodes nothing for nobody."""

from __future__ import annotations

import socket as stdlib_socket
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import zmq

from handtouch import wire
from handtouch.daemon.security import Gate, ready

LIVE_QUEUE = 64
"""Messages kept for a slow subscriber of the live stream: a few ticks, the newest matter."""
COMPLETE_QUEUE = 20_000
"""Messages kept on the complete stream: seconds."""
_SUBSCRIPTIONS_PER_POLL = 100
_REPEATS_PER_POLL = 16
"""Late joiners, however many, cost a tick no more than that."""


class Publisher:
    """Two XPUB sockets with the same topics; never blocks, counts what a full queue drops.

    `endpoints` (stream -> endpoint as bound, with its real port), `drops` (stream -> messages that a full
    queue of some subscriber couldn't take), `subscriptions` (prefixes that somebody asked for), `run` (tells
    this publisher's life from others: when it began, in seconds since 1970), `present` (topic -> a function
    that makes, at a time in ns, what to repeat of it for those who subscribe late, if anything).

    Whoever connects passes the `gate`. Raises OSError naming the endpoint when it can't be bound.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], live: str, complete: str, gate: Gate | None = None
    ) -> None:
        gate = gate or Gate(context)
        self.run = int(time.time())
        self.present: dict[str, Callable[[int], wire.Outgoing | None]] = {}
        self.drops: Counter[str] = Counter(live=0, complete=0)
        self.subscriptions: frozenset[bytes] = frozenset()
        self.endpoints: dict[str, str] = {}
        self._sockets: dict[str, zmq.Socket[bytes]] = {}
        self._asked: dict[str, set[bytes]] = {}
        self._repeats: dict[tuple[str, str], None] = {}  # (stream, topic) that somebody waits for, in order
        self._wanted: dict[str, bool] = {}
        self._held: list[list[bytes]] | None = None
        for stream, endpoint, queue in (("live", live, LIVE_QUEUE), ("complete", complete, COMPLETE_QUEUE)):
            socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
            self._sockets[stream] = socket
            self._asked[stream] = set()
            socket.setsockopt(zmq.SNDHWM, queue)
            socket.setsockopt(zmq.LINGER, 200)  # so that the ends of contacts still leave at shutdown
            socket.setsockopt(zmq.XPUB_NODROP, 1)
            socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # who asks for what others have wants the present, too
            socket.setsockopt(zmq.HEARTBEAT_IVL, 500)
            socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1500)
            try:
                self.endpoints[stream] = bind(socket, endpoint, f"the {stream} stream", gate, "read")
            except OSError:
                self.close()
                raise

    def take_subscriptions(self, now_ns: int) -> None:
        """Read what subscribers asked for or gave up; repeat the present for those who come late."""
        if self._repeats:  # asked for at the tick before: what nobody heard until then is computed by now
            self._repeat(now_ns)
        for stream, socket in self._sockets.items():
            for _ in range(_SUBSCRIPTIONS_PER_POLL):  # who asks without end must not stop the tick
                if not ready(socket):
                    break
                request = socket.recv(zmq.NOBLOCK)
                if request[:1] == b"\x01":
                    self._asked[stream].add(request[1:])
                    self._repeats.update(
                        {
                            (stream, topic): None
                            for topic in self.present
                            if topic.encode().startswith(request[1:])
                        }
                    )
                elif request[:1] == b"\x00":
                    self._asked[stream].discard(request[1:])
                else:
                    continue  # not a subscription: nobody has anything else to say here
                self.subscriptions = frozenset().union(*self._asked.values())
                self._wanted.clear()

    def wants(self, topic: str) -> bool:
        """Whether anybody subscribed to a prefix of the topic."""
        wanted = self._wanted.get(topic)
        if wanted is None:
            wanted = any(topic.encode().startswith(prefix) for prefix in self.subscriptions)
            self._wanted[topic] = wanted
        return wanted

    def send(self, message: wire.Outgoing) -> None:
        """Send to those who subscribed."""
        if not self.wants(wire.topic_of(message)):
            return
        parts = wire.encode(message)
        if self._held is None:
            self._send_all([parts])
        else:
            self._held.append(parts)

    def hold(self) -> None:
        """Keep what is sent until `release`: ZeroMQ's thread is woken once, not for every message."""
        if self._held is None:
            self._held = []

    def release(self) -> bool:
        """Send what was held, on the live stream first; whether there was anything."""
        held, self._held = self._held, None
        if held:
            self._send_all(held)
        return bool(held)

    def close(self) -> None:
        """Close both streams; what is queued has 0.2 s to leave."""
        for socket in self._sockets.values():
            socket.close()

    def _send_all(self, messages: list[list[bytes]]) -> None:
        for stream, socket in self._sockets.items():
            asked = tuple(self._asked[stream])
            for parts in messages:
                if parts[0].startswith(asked):
                    self._try_send(stream, socket, parts)

    def _repeat(self, now_ns: int) -> None:
        sent = 0
        while self._repeats and sent < _REPEATS_PER_POLL:
            stream, topic = next(iter(self._repeats))
            del self._repeats[stream, topic]
            if (message := self.present[topic](now_ns)) is not None:
                self._try_send(stream, self._sockets[stream], wire.encode(message))
                sent += 1

    def _try_send(self, stream: str, socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
        try:
            socket.send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:
            # XPUB_NODROP tells that one queue is full, but then sends to nobody: the others still get theirs
            self.drops[stream] += 1
            socket.setsockopt(zmq.XPUB_NODROP, 0)
            socket.send_multipart(parts, zmq.NOBLOCK)
            socket.setsockopt(zmq.XPUB_NODROP, 1)


def bind(socket: zmq.Socket[bytes], endpoint: str, purpose: str, gate: Gate, right: str) -> str:
    """Bind and return the endpoint with its real port; OSError names purpose, endpoint and remedy.

    The gate lets in those with the right ("read", "control"; "inputs" asks for control, too).
    """
    _check_file(endpoint, purpose)
    gate.guard(socket, endpoint, right)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        raise OSError(
            f"{purpose} can't be opened at {endpoint}: {error.strerror}; is another daemon running there? "
            "`handtouch doctor CONFIG` tells, and [daemon] in the deployment sets another endpoint"
        ) from error
    return socket.getsockopt_string(zmq.LAST_ENDPOINT)


def _check_file(endpoint: str, purpose: str) -> None:
    """ZeroMQ takes an ipc endpoint away from whoever has it, and doesn't say that its folder is missing."""
    if not endpoint.startswith("ipc:///"):
        return
    path = Path(endpoint.removeprefix("ipc://"))
    if not path.parent.is_dir():
        raise OSError(f"{purpose} can't be opened at {endpoint}: there is no folder {path.parent}; create it")
    with stdlib_socket.socket(stdlib_socket.AF_UNIX) as probe:
        if probe.connect_ex(str(path)) == 0:
            raise OSError(
                f"{purpose} can't be opened at {endpoint}: another daemon has it; stop that one, or set "
                "another endpoint in [daemon] of the deployment"
            )
