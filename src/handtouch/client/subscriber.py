"""Subscribe to a handtouch daemon from Python, blocking or with asyncio; send it requests.

    with handtouch.connect("contact/*/thumb_*") as messages:
        for contact in messages:
            print(contact.link, contact.event, contact.force_n)

Public names: `connect`, `Subscriber`, `request`; `columns` reads a hand frame as arrays.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypedDict, TypeVar, Unpack, cast, overload

import msgpack
import zmq

from handtouch import wire
from handtouch.client.connection import Connection
from handtouch.client.names import UnknownNameError, topics_of_pattern, unknown_name
from handtouch.client.socket_options import RECONNECT_OPTIONS
from handtouch.host.closing import AsyncClosing
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

if TYPE_CHECKING:
    from numpy.typing import NDArray

SERVICE_TIMEOUT_S = wire.SERVICE.timeout_s
"""A daemon counts as disconnected after this time without any message; `service` comes more often."""


M = TypeVar("M", bound=wire.Message, covariant=True)


class _ConnectOptions(TypedDict, total=False):
    endpoint: str
    key: Path | str | None
    queue: int


@overload
def connect(**options: Unpack[_ConnectOptions]) -> Subscriber[wire.Contact]: ...
@overload
def connect(
    pattern: Literal["contact/*/*", "contact/left/*", "contact/right/*"],
    /,
    **options: Unpack[_ConnectOptions],
) -> Subscriber[wire.Contact]: ...
@overload
def connect(
    pattern: Literal["hand/*", "hand/left", "hand/right"], /, **options: Unpack[_ConnectOptions]
) -> Subscriber[wire.HandFrame]: ...
@overload
def connect(
    pattern: Literal["health/*/*", "health/left/*", "health/right/*"], /, **options: Unpack[_ConnectOptions]
) -> Subscriber[wire.Health]: ...
@overload
def connect(
    pattern: Literal["percept/*/*", "percept/left/*", "percept/right/*"],
    /,
    **options: Unpack[_ConnectOptions],
) -> Subscriber[wire.Percept]: ...
@overload
def connect(
    pattern: Literal["raw/*", "raw/left", "raw/right"], /, **options: Unpack[_ConnectOptions]
) -> Subscriber[wire.Raw]: ...
@overload
def connect(
    pattern: Literal["service"], /, **options: Unpack[_ConnectOptions]
) -> Subscriber[wire.Service]: ...
@overload
def connect(*patterns: str, kind: type[M], **options: Unpack[_ConnectOptions]) -> Subscriber[M]: ...
@overload
def connect(*patterns: str, **options: Unpack[_ConnectOptions]) -> Subscriber[Any]: ...
def connect(
    *patterns: str,
    kind: type[Any] | None = None,
    endpoint: str = LIVE_ENDPOINT,
    key: Path | str | None = None,
    queue: int = 1000,
) -> Subscriber[Any]:
    """Subscribe to the topics that match any of the patterns.

    A pattern is a topic whose parts may contain the wildcards * and ?: "contact/*/*" (the default),
    "contact/left/thumb_tip", "hand/*", "health/*/index_*", "percept/left/motion", "service". Messages are
    `wire.Contact`, `HandFrame`, `Health`, `Percept`, `Raw` or `Service`; a type checker knows which for the
    patterns of a whole topic, of the hands `left` and `right`, and where `kind` names it:
    `connect("hand/gripper", kind=wire.HandFrame)`.

    On joining, the current state is received first, with `retained` set: active contacts as an update, the
    latest hand frame, health and service. `queue` bounds the messages that wait in this process; when it is
    full, the newest are lost and counted in `lost_messages`. The connection is restored when a daemon
    restarts. Nothing received for 2 s is logged once, with the reason.

    `key` is this client's key file, for a daemon that requires one (`handtouch keys`). Default: the file
    named by the environment variable HANDTOUCH_KEY; "" for none.

    Raises ValueError for a pattern that matches no topic, or one of another `kind`, an invalid endpoint or an
    unusable key file. Receiving raises PermissionError when the daemon rejects this client, and
    UnknownNameError, twice a second, while a pattern matches none of its hands or links.
    """
    for pattern in patterns:
        if kind is not None and _check_pattern(pattern) != [kind]:
            raise ValueError(f"messages of {pattern!r} are no {kind.__name__}")
    return Subscriber.open(patterns or ("contact/*/*",), endpoint, queue, key)


class Subscriber(AsyncClosing, Generic[M]):
    """Messages of a daemon as typed objects: an iterator and a context manager, blocking or for asyncio.

        async with handtouch.connect("hand/*") as frames:
            async for frame in frames:
                force_n = handtouch.columns(frame)["force_n"]

    Not thread-safe: use it in one thread; there, several asyncio tasks may receive. After a restart of the
    daemon it continues with the new `session`; messages of the previous one don't count as lost.
    """

    def __init__(self, patterns: tuple[str, ...], connection: Connection) -> None:
        self.patterns = patterns
        self.malformed_messages = 0
        """messages dropped because they violate the wire contract"""
        self.connection = connection
        self._sequence = wire.SequenceTracker()
        self._last_receive_s = time.monotonic()
        self._has_received = False
        self._disconnects = 0  # before the last message

    @classmethod
    def open(
        cls, patterns: tuple[str, ...], endpoint: str, queue: int, key: Path | str | None = None
    ) -> Self:
        """Connect to an endpoint and subscribe; arguments and errors as for `connect`."""
        for pattern in patterns:
            _check_pattern(pattern)
        options = {zmq.RCVHWM: queue, zmq.LINGER: 0, **RECONNECT_OPTIONS}
        connection = Connection.open(zmq.SUB, endpoint, key, options)
        for prefix in dict.fromkeys((*map(_literal_prefix, patterns), "service")):
            connection.socket.subscribe(prefix)
        return cls(patterns, connection)

    @property
    def endpoint(self) -> str:
        """The endpoint it is connected to."""
        return self.connection.endpoint

    @property
    def lost_messages(self) -> int:
        """Messages known to be lost, by the gaps in their seq."""
        return self._sequence.lost.total()

    @property
    def has_received(self) -> bool:
        """True once any message, the daemon's heartbeat at least, was received."""
        return self._has_received

    @property
    def alive(self) -> bool:
        """True if any message, the daemon's heartbeat at least, was received within SERVICE_TIMEOUT_S, and
        the connection wasn't lost since.

        Valid only while messages are being received: it refers to the last call of `recv` and its variants.
        """
        is_connected = self._disconnects == self.connection.disconnects
        return is_connected and time.monotonic() - self._last_receive_s < SERVICE_TIMEOUT_S

    @overload
    def recv(self) -> M: ...
    @overload
    def recv(self, timeout_s: float | None) -> M | None: ...
    def recv(self, timeout_s: float | None = None) -> M | None:
        """Return the next matching message, or None after `timeout_s` seconds without one.

        Raises PermissionError when the daemon rejects this client.
        """
        received = self._recv(timeout_s)
        return None if received is None else received[0]

    def recv_parts(self, timeout_s: float | None = None) -> list[bytes] | None:
        """Return the next matching message as its two parts; valid, counted and timed out as for `recv`."""
        received = self._recv(timeout_s)
        return None if received is None else received[1]

    def recv_unchecked(self, timeout_s: float) -> list[bytes] | None:
        """Return the parts of the next message under the subscribed prefixes, neither checked nor counted."""
        while True:
            try:
                parts = self.connection.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                if not self.connection.poll(round(timeout_s * 1000)):
                    return None
                continue
            self._note_reception()
            return list(parts)

    @overload
    async def arecv(self) -> M: ...
    @overload
    async def arecv(self, timeout_s: float | None) -> M | None: ...
    async def arecv(self, timeout_s: float | None = None) -> M | None:
        """Do as `recv`, for asyncio. Cancelling it loses no message.

        Several tasks may receive at once; each message goes to one of them.
        """
        await asyncio.sleep(0)  # let other tasks run even while the stream never pauses
        try:
            async with asyncio.timeout(timeout_s):
                while (received := self._receive_nowait()) is None:
                    await self.connection.wait()
        except TimeoutError:
            return None
        self.connection.wake_waiting()
        return received[0]

    def resubscribe(self, prefix: str) -> None:
        """Unsubscribe from a prefix and subscribe again, so that the daemon sends its current state."""
        self.connection.socket.unsubscribe(prefix)
        self.connection.socket.subscribe(prefix)

    def close(self) -> None:
        """Disconnect; the daemon notices within milliseconds."""
        self.connection.close()

    def __iter__(self) -> Iterator[M]:
        while True:
            yield self.recv()

    async def __aiter__(self) -> AsyncIterator[M]:
        while True:
            yield await self.arecv()

    def _recv(self, timeout_s: float | None) -> tuple[M, list[bytes]] | None:
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (received := self._receive_nowait()) is None:
            wait_ms = None if end_s is None else max(0, round((end_s - time.monotonic()) * 1000))
            if not self.connection.poll(wait_ms):
                return None
        return received

    def _receive_nowait(self) -> tuple[M, list[bytes]] | None:
        """Return the next matching message that was received already, and its parts."""
        while True:
            try:
                parts = self.connection.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return None
            if (message := self._decode_matching(parts)) is not None:
                return cast(M, message), parts

    def _note_reception(self) -> None:
        self._last_receive_s, self._has_received = time.monotonic(), True
        self.connection.note_message()
        self._disconnects = self.connection.disconnects

    def _decode_matching(self, parts: list[bytes]) -> wire.Message | None:
        """Decode a message, None unless it matches a pattern, is valid and new."""
        self._note_reception()
        topic = parts[0].decode("utf-8", "replace") if parts else ""
        if topic == "service":
            self._check_names(parts)
        if not any(_topic_matches(pattern, topic) for pattern in self.patterns):
            return None  # another topic under the same prefix, or the heartbeat
        try:
            message = wire.decode(parts)
        except wire.WireError:
            self.malformed_messages += 1
            return None
        is_new = self._sequence.accept(topic, message.session, message.seq, message.retained)
        return message if is_new else None

    def _check_names(self, parts: list[bytes]) -> None:
        """Raise UnknownNameError if a pattern matches nothing that the daemon has, by its `service`."""
        try:
            service = wire.decode(parts)
        except wire.WireError:
            return  # counted where it was subscribed
        for pattern in self.patterns:
            if isinstance(service, wire.Service) and (text := unknown_name(pattern, service.hands)):
                raise UnknownNameError(text)


def columns(frame: wire.HandFrame | wire.Raw) -> dict[str, NDArray[Any]]:
    """Return the columns of a frame as read-only arrays by name, (n,) or (n, elements).

    Rows are in the order of `frame.links`. Columns that no scene requests (palm and base frame) are absent.
    """
    return {
        name: column.to_array(getattr(frame, name), len(frame.links) if column.is_least else None)
        for name, column in wire.COLUMNS[type(frame)].items()
        if getattr(frame, name) or not frame.links
    }


def request(
    command: str,
    *,
    endpoint: str = CONTROL_ENDPOINT,
    key: Path | str | None = None,
    timeout_s: float = 2.0,
    **arguments: Any,
) -> dict[str, Any]:
    """Send a command to the daemon's control endpoint and return its answer; `key` as for `connect`.

    Raises TimeoutError when no daemon answers, PermissionError when it rejects this client, RuntimeError with
    the daemon's error text when it refuses the request, ValueError for an invalid endpoint or an unusable
    key file.
    """
    end_s = time.monotonic() + timeout_s
    connection = Connection.open(zmq.REQ, endpoint, key, {zmq.LINGER: 0})
    try:
        connection.socket.send(msgpack.packb({"v": wire.SCHEMA_VERSION, "command": command, **arguments}))
        while not connection.readable:
            if not connection.poll(max(0, round((end_s - time.monotonic()) * 1000))):
                raise TimeoutError(f"no answer in {timeout_s} s: {connection.reason_of_silence}")
        answer = msgpack.unpackb(connection.socket.recv())
    finally:
        connection.close()
    if not isinstance(answer, dict) or not answer.get("ok"):
        raise RuntimeError(answer.get("error", "refused") if isinstance(answer, dict) else "malformed answer")
    return answer


def _check_pattern(pattern: str) -> list[type[Any]]:
    """Return the types of messages that a pattern matches. Raises ValueError if there is none."""
    kinds: list[type[Any]] = [topic.payload for topic, _ in topics_of_pattern(pattern)]
    if not kinds:
        rows = ", ".join(topic.pattern for topic in wire.TOPICS)
        raise ValueError(f"no topic matches the pattern {pattern!r}; the topics are {rows}")
    return kinds


def _literal_prefix(pattern: str) -> str:
    for position, character in enumerate(pattern):
        if character in "*?[":
            return pattern[:position]
    return pattern


def _topic_matches(pattern: str, topic: str) -> bool:
    """Compare part by part: a wildcard doesn't match a slash."""
    patterns, parts = pattern.split("/"), topic.split("/")
    return len(patterns) == len(parts) and all(map(fnmatchcase, parts, patterns))
