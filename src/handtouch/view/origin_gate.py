"""Passes WebSocket connections to a server that checks no Origin, unless they come from another website.

Public names: `OriginGate`, `allows`.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Self
from urllib.parse import urlsplit

from handtouch.host.endpoints import is_loopback

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
