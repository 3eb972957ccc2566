"""Subscribe to a handtouch daemon from Python, blocking or with asyncio.

    with handtouch.connect("contact/*/thumb_*") as messages:
        for contact in messages:
            print(contact.link, contact.event, contact.force_n)

Public names: `connect`, `Subscriber`, `request`; `columns` reads a hand frame as arrays.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypedDict, TypeVar, Unpack, cast, overload

import msgpack
import zmq
from zmq.utils.monitor import parse_monitor_message

from handtouch import wire
from handtouch.keys import ClientKey, load_client

if TYPE_CHECKING:
    from numpy.typing import NDArray

LIVE = "tcp://127.0.0.1:5580"
CONTROL = "tcp://127.0.0.1:5581"
SILENCE_S = 1.5
"""The daemon says `service` twice a second; three missed ones mean that it is gone."""


M = TypeVar("M", bound=wire.Message, covariant=True)


class _Options(TypedDict, total=False):
    endpoint: str
    key: Path | str | None
    queue: int


@overload
def connect(**options: Unpack[_Options]) -> Subscriber[wire.Contact]: ...
@overload
def connect(pattern: Literal["contact/*/*"], /, **options: Unpack[_Options]) -> Subscriber[wire.Contact]: ...
@overload
def connect(pattern: Literal["hand/*"], /, **options: Unpack[_Options]) -> Subscriber[wire.HandFrame]: ...
@overload
def connect(pattern: Literal["health/*/*"], /, **options: Unpack[_Options]) -> Subscriber[wire.Health]: ...
@overload
def connect(pattern: Literal["percept/*/*"], /, **options: Unpack[_Options]) -> Subscriber[wire.Percept]: ...
@overload
def connect(pattern: Literal["raw/*"], /, **options: Unpack[_Options]) -> Subscriber[wire.Raw]: ...
@overload
def connect(pattern: Literal["service"], /, **options: Unpack[_Options]) -> Subscriber[wire.Service]: ...
@overload
def connect(*patterns: str, **options: Unpack[_Options]) -> Subscriber[Any]: ...
def connect(
    *patterns: str, endpoint: str = LIVE, key: Path | str | None = None, queue: int = 1000
) -> Subscriber[Any]:
    """Subscribe to the topics that match any of the patterns.

    A pattern is a topic whose parts may hold the wildcards * and ?: "contact/*/*" (the default),
    "contact/left/thumb_tip", "hand/*", "health/*/index_*", "percept/left/motion", "service". What comes is
    `wire.Contact`, `HandFrame`, `Health`, `Percept`, `Raw` or `Service`, as a type checker knows for the
    patterns of a whole topic. On joining, the present state comes first, with `repeat` set: contacts under
    way as an update, the latest hand frame, health and service. `queue` bounds the messages kept
    while this side is busy; beyond it the newest are lost, and counted as gaps. The connection comes back
    by itself when a daemon restarts. `key` is the file of this client's key for a daemon that asks for one
    (`handtouch keys`); left out: the file that the environment variable HANDTOUCH_KEY names; "" for none.

    Raises ValueError for a pattern that no topic could match, an endpoint that is none, or a key file that
    can't be used. Receiving raises PermissionError when the daemon doesn't let this client in.
    """
    return Subscriber(patterns or ("contact/*/*",), endpoint, queue, key)


class Subscriber(Generic[M]):
    """Messages of a daemon as typed objects: an iterator and a context manager, blocking or for asyncio.

        async with handtouch.connect("hand/*") as frames:
            async for frame in frames:
                force_n = handtouch.columns(frame)["force_n"]

    For one thread, or one task, at a time. A daemon that restarts is followed: its `run` is another, and
    nothing of the one before counts as a gap.
    """

    def __init__(
        self, patterns: tuple[str, ...], endpoint: str, queue: int, key: Path | str | None = None
    ) -> None:
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
        self._run: int | None = None
        self._last_seq: dict[str, int] = {}
        self._heard_s = time.monotonic()
        self._ever = False
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, queue)
        self._socket.setsockopt(zmq.LINGER, 0)
        _stay_connected(self._socket)
        for prefix in {_literal_prefix(pattern) for pattern in patterns} | {"service"}:
            self._socket.subscribe(prefix)
        self._door = _Door(self._socket, endpoint, key)

    @overload
    def recv(self) -> M: ...
    @overload
    def recv(self, timeout_s: float | None) -> M | None: ...
    def recv(self, timeout_s: float | None = None) -> M | None:
        """The next message that matches, or None after `timeout_s` seconds without one.

        Raises PermissionError when the daemon doesn't let this client in.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (message := self._take()) is None:
            wait_ms = None if end_s is None else max(0, round((end_s - time.monotonic()) * 1000))
            if not self._door.poll(wait_ms):
                return None
        return message

    @overload
    async def arecv(self) -> M: ...
    @overload
    async def arecv(self, timeout_s: float | None) -> M | None: ...
    async def arecv(self, timeout_s: float | None = None) -> M | None:
        """As `recv`, for asyncio. Cancelling it loses no message."""
        await asyncio.sleep(0)  # a stream without a pause leaves the loop's other tasks their turn
        try:
            async with asyncio.timeout(timeout_s):
                while (message := self._take()) is None:
                    await self._door.wait()
        except TimeoutError:
            return None
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

    def __iter__(self) -> Iterator[M]:
        while True:
            yield self.recv()

    async def __aiter__(self) -> AsyncIterator[M]:
        while True:
            yield await self.arecv()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave; the daemon notices within milliseconds."""
        self._door.close()
        self._socket.close()

    def _take(self) -> M | None:
        """The next message that is here already."""
        while True:
            try:
                parts = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return None
            if (message := self._accept(parts)) is not None:
                return cast(M, message)

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
        if message.run != self._run:
            self._run = message.run
            self._last_seq.clear()
        last = self._last_seq.get(topic)
        if last is not None:
            if message.repeat and message.seq <= last:
                return None  # for a late joiner; this subscriber has had it
            self.gaps += max(0, message.seq - last - 1)
        self._last_seq[topic] = message.seq
        return message


def columns(frame: wire.HandFrame | wire.Raw) -> dict[str, NDArray[Any]]:
    """The columns of a frame as arrays by name, read only: (n,) or (n, elements), rows as `frame.links`.

    Columns of what no scene asks for (palm and base frame) aren't there.
    """
    import numpy as np

    return {
        name: np.frombuffer(getattr(frame, name), dtype=kind).reshape((-1, elements) if elements > 1 else -1)
        for name, (kind, elements) in wire.COLUMNS[type(frame)].items()
        if getattr(frame, name) or not frame.links
    }


def request(
    command: str,
    *,
    endpoint: str = CONTROL,
    key: Path | str | None = None,
    timeout_s: float = 2.0,
    **arguments: Any,
) -> dict[str, Any]:
    """Send a command to the daemon's control endpoint and return its answer; `key` as for `connect`.

    Raises TimeoutError when no daemon answers, PermissionError when it doesn't let this client in,
    RuntimeError with its words when it refuses, ValueError for an endpoint that is none or a key file that
    can't be used.
    """
    door = None
    end_s = time.monotonic() + timeout_s
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        door = _Door(socket, endpoint, key)
        socket.send(msgpack.packb({"v": wire.SCHEMA_VERSION, "command": command, **arguments}))
        ready: set[zmq.Socket[bytes]] = set()
        while socket not in ready:
            ready = door.poll(max(0, round((end_s - time.monotonic()) * 1000)))
            if not ready:
                raise TimeoutError(
                    f"no daemon answers at {endpoint} within {timeout_s} s; is handtouch run up?"
                )
        answer = msgpack.unpackb(socket.recv())
    finally:
        if door is not None:
            door.close()
        socket.close()
    if not isinstance(answer, dict) or not answer.get("ok"):
        raise RuntimeError(answer.get("error", "refused") if isinstance(answer, dict) else "malformed answer")
    return answer


def _stay_connected(socket: zmq.Socket[bytes]) -> None:
    """Notice within 1.5 s that the other end is gone, and look for it at least once a second."""
    socket.setsockopt(zmq.HEARTBEAT_IVL, 500)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1500)
    socket.setsockopt(zmq.RECONNECT_IVL, 50)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)


class _Door:
    """Connects a socket, with a key over TCP, and hears when it isn't let in."""

    def __init__(self, socket: zmq.Socket[bytes], endpoint: str, key: Path | str | None) -> None:
        self._endpoint = endpoint
        self._socket = socket
        self._failures = 0
        self._key: ClientKey | None = None
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        file = os.environ.get("HANDTOUCH_KEY", "") if key is None else key
        try:
            if file and endpoint.startswith("tcp://"):
                self._key = load_client(Path(file))
                socket.setsockopt(zmq.CURVE_SERVERKEY, self._key.server_key.encode())
                socket.setsockopt(zmq.CURVE_PUBLICKEY, self._key.public_key.encode())
                socket.setsockopt(zmq.CURVE_SECRETKEY, self._key.secret_key.encode())
            self._monitor = socket.get_monitor_socket(_HANDSHAKES)
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            getattr(self, "_monitor", socket).close()
            socket.close()
            raise ValueError(
                f"{endpoint!r} is no ZeroMQ endpoint ({error.strerror}); one looks like tcp://127.0.0.1:5580"
            ) from error
        except ValueError:
            socket.close()
            raise
        self._poller.register(self._monitor, zmq.POLLIN)

    def poll(self, wait_ms: int | None) -> set[zmq.Socket[bytes]]:
        """What is ready, nothing after `wait_ms`. Raises PermissionError."""
        ready = {socket for socket, _ in self._poller.poll(wait_ms)}
        if self._monitor in ready and self._socket not in ready:
            self._hear(self._monitor.recv_multipart())
        return ready

    async def wait(self) -> None:
        """Until there may be something to take. Raises PermissionError."""
        loop, woken = asyncio.get_running_loop(), asyncio.Event()
        descriptors = [int(socket.getsockopt(zmq.FD)) for socket in (self._socket, self._monitor)]
        for descriptor in descriptors:
            loop.add_reader(descriptor, woken.set)
        try:
            while self._socket not in (ready := self.poll(0)):
                if not ready:  # ZeroMQ tells its descriptors once of what is new, so ask it first
                    await woken.wait()
                    woken.clear()
        finally:
            for descriptor in descriptors:
                loop.remove_reader(descriptor)

    def close(self) -> None:
        """Hear no more."""
        if self._monitor.closed:
            return
        self._poller.unregister(self._monitor)
        self._socket.disable_monitor()
        self._monitor.close()

    def _hear(self, parts: list[bytes]) -> None:
        event = parse_monitor_message(parts)["event"]
        self._failures = 0 if event == zmq.Event.HANDSHAKE_SUCCEEDED else self._failures + 1
        if event == zmq.Event.HANDSHAKE_FAILED_AUTH and self._key is not None:
            raise PermissionError(
                f"{self._endpoint} doesn't let {self._key.name} in: its key is not known there, or has no "
                "right to this endpoint; `handtouch keys list FOLDER` on the daemon's machine tells"
            )
        if self._failures < _FAILURES and event != zmq.Event.HANDSHAKE_FAILED_PROTOCOL:
            return  # a daemon that goes down while we connect looks the same once; ZeroMQ tries again
        if self._key is None:
            raise PermissionError(
                f"{self._endpoint} lets nobody in without a key: `handtouch keys client FOLDER NAME` on the "
                "daemon's machine makes one; give its file by --key, key= or HANDTOUCH_KEY"
            )
        raise PermissionError(
            f"{self._endpoint} can't be spoken to with the key of {self._key.name} for {self._key.server}: "
            "this is another daemon, or it has new keys, or none"
        )


_HANDSHAKES = (
    zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
)
_FAILURES = 3
"""Failed handshakes in a row after which it is no accident."""


def _literal_prefix(pattern: str) -> str:
    for position, character in enumerate(pattern):
        if character in "*?[":
            return pattern[:position]
    return pattern


def _matches(pattern: str, topic: str) -> bool:
    """Whether a topic matches part by part: a wildcard doesn't cross a slash."""
    asked, got = pattern.split("/"), topic.split("/")
    return len(asked) == len(got) and all(map(fnmatchcase, got, asked))
