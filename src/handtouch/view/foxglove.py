"""The hand in Foxglove, live: a subscriber that serves the topics of a recording over Foxglove's WebSocket.

Public names: `FoxgloveServer`, `open_server`, `serve`, `PATTERNS`; `OriginGate`, `allows` (connections to a
server that checks no Origin, unless they come from another website). Needs the extra `foxglove`.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Self
from urllib.parse import quote, urlsplit

import foxglove

from handtouch.client import Subscriber
from handtouch.host.endpoints import is_loopback
from handtouch.record.foxglove import FoxgloveConverter
from handtouch.record.recorder import MessageRecorder, RotationLimits
from handtouch.record.schemas import MessageFormat, wire_format

PORT = 8765
"""The port that Foxglove proposes."""
PATTERNS = ("config", "service", "health/*/*", "contact/*/*", "joints/*")
QUEUE_MESSAGES = 20_000
_POLL_S = 0.2


class FoxgloveServer:
    """A WebSocket server for Foxglove, whose channels begin with their first message; a `MessageFile`.

    A client that doesn't keep up loses the oldest messages. Pages of other websites are refused. Raises
    RuntimeError if the address can't be used.
    """

    size = 0

    def __init__(self, host: str, port: int) -> None:
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        inner = _hidden_address()
        self._server = foxglove.start_server(name="handtouch", host=inner, port=0, context=self._context)
        try:
            self._gate = OriginGate(host, port, (inner, self._server.port))
        except RuntimeError:
            self._server.stop()
            raise
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.port}"
        self.app_url = f"https://app.foxglove.dev?ds=foxglove-websocket&ds.url={quote(self.url, safe='')}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._gate.__exit__()
        self._server.stop()

    def write(
        self,
        topic: str,
        data: bytes,
        t_ns: int,
        seq: int = 0,  # noqa: ARG002
        form: MessageFormat | None = None,
    ) -> None:
        """Send a message to the clients that subscribe to its topic; without `form` one of the wire's."""
        encoding, name, schema_encoding, text = form or wire_format(topic.split("/")[0])
        if encoding == "msgpack":  # which Foxglove doesn't read
            return
        channel = self._channels.get(topic)
        if channel is None:
            schema = foxglove.Schema(name=name, encoding=schema_encoding, data=text)
            channel = foxglove.Channel(topic, schema=schema, message_encoding=encoding, context=self._context)
            self._channels[topic] = channel
        channel.log(data, log_time=t_ns)

    def flush(self) -> None:
        """Do nothing: messages are sent at once."""

    def finish(self, summary: dict[str, str]) -> None:
        """Do nothing: the server stops at the end of its context."""


def _hidden_address() -> str:
    """Return a loopback address for Foxglove's own server, which checks no Origin: a page can't guess it."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


def open_server(host: str, port: int, percepts: bool) -> FoxgloveServer:  # noqa: ARG001
    """Listen at an address. Raises RuntimeError if it can't be used."""
    return FoxgloveServer(host, port)


def serve(messages: Subscriber[Any], server: FoxgloveServer, stop: threading.Event, end_s: float) -> None:
    """Forward messages until `stop` or the monotonic time `end_s`.

    Raises PermissionError when the daemon rejects this client.
    """
    recorder = MessageRecorder(lambda _: server, RotationLimits(), FoxgloveConverter)
    while not stop.is_set() and time.monotonic() < end_s:
        parts = messages.recv_unchecked(_POLL_S)
        if parts is not None:
            recorder.add_message(parts, time.monotonic_ns())


APPS = frozenset({"app.foxglove.dev", "studio.foxglove.dev"})
"""Hosts of Foxglove's own pages"""
APP_SCHEMES = frozenset({"app", "file", "foxglove"})
"""Of pages in the desktop application, which no website has"""
MAX_HEAD_BYTES, HEAD_TIMEOUT_S = 16_384, 5.0
MAX_CONNECTIONS = 64
_CHUNK_BYTES = 65_536
_REFUSED = (
    b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Type: text/plain\r\n\r\n"
    b"handtouch: pages of this website may not read the hand\n"
)


def allows(origin: str) -> bool:
    """Return True for pages of Foxglove's application and site, and of this machine."""
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
    except ValueError:
        return False
    if parts.scheme == "https" and host in APPS:
        return True
    return parts.scheme in APP_SCHEMES or (parts.scheme in ("http", "https") and is_loopback(host))


class OriginGate:
    """Listens at an address, and joins allowed connections with the server at `inner` (host, port).

    A thread serves all of them; a connection is slowed down to what its reader takes. Raises RuntimeError if
    the address can't be used.
    """

    def __init__(self, host: str, port: int, inner: tuple[str, int]) -> None:
        self._inner = inner
        self._connections = 0
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, port), family=family)
        except (OSError, OverflowError) as error:
            raise RuntimeError(getattr(error, "strerror", None) or str(error)) from error
        self.port = int(self._listener.getsockname()[1])
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="foxglove gate", daemon=True)
        self._thread.start()
        self._server = self._run(asyncio.start_server(self._join, sock=self._listener, limit=MAX_HEAD_BYTES))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._run(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _close(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections <= MAX_CONNECTIONS:
                await self._serve(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # it has gone, or is no HTTP client
        finally:
            self._connections -= 1
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(HEAD_TIMEOUT_S):
            head = await reader.readuntil(b"\r\n\r\n")
        if not all(map(allows, _origins(head))):  # programs send none
            writer.write(_REFUSED)
            await writer.drain()
            return
        inner_reader, inner_writer = await asyncio.open_connection(*self._inner)
        try:
            inner_writer.write(head)
            ways = [_copy(reader, inner_writer), _copy(inner_reader, writer)]
            tasks = [asyncio.ensure_future(way) for way in ways]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
        finally:
            inner_writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_CHUNK_BYTES):
            writer.write(data)
            await writer.drain()


def _origins(head: bytes) -> list[str]:
    """Return the values of all Origin headers of a request."""
    lines = [line.partition(b":") for line in head.splitlines()[1:]]
    return [value.strip().decode("latin-1") for name, _, value in lines if name.strip().lower() == b"origin"]
