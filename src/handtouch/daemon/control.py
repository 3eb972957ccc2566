"""The control endpoint: request-reply, one msgpack map each way; nothing that comes in can stop the tick."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from handtouch.daemon.publisher import bind
from handtouch.daemon.security import Gate
from handtouch.wire import SCHEMA_VERSION

_REQUESTS_PER_POLL = 2
_log = logging.getLogger("handtouch.control")

Command = Callable[[], dict[str, Any]]


class Control:
    """Answers requests {"v", "command"} from `commands`, a few per tick, without ever waiting.

    Whoever connects passes the `gate`. Raises OSError naming the endpoint when it can't be bound.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, gate: Gate | None = None
    ) -> None:
        self.commands: dict[str, Command] = {}
        self.refused = 0
        """requests that were malformed or unknown"""
        self._socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            gate = gate or Gate(context)
            self.endpoint = bind(self._socket, endpoint, "the control endpoint", gate, "control")
        except OSError:
            self._socket.close()
            raise

    def poll(self) -> None:
        """Answer what waits."""
        for _ in range(_REQUESTS_PER_POLL):
            try:
                client, *parts = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            # a REP socket would do this by itself, but malformed parts make it send answers astray for ever
            if parts[:1] != [b""]:
                self.refused += 1  # not from a REQ socket: no answer would be understood
                continue
            request = parts[1] if len(parts) == 2 else b""  # else answered as malformed
            self._socket.send_multipart([client, b"", msgpack.packb(self.answer(request))], zmq.NOBLOCK)

    def answer(self, request: bytes) -> dict[str, Any]:
        """The answer to one request, whatever its bytes."""
        try:
            asked = msgpack.unpackb(request)
            command = asked["command"]
            known = asked["v"] == SCHEMA_VERSION and command in self.commands
        except (ValueError, TypeError, KeyError, RecursionError, msgpack.exceptions.UnpackException):
            return self._refuse("malformed request: send a msgpack map with v and command")
        if not known:
            names = ", ".join(sorted(self.commands))
            return self._refuse(
                f"unknown command {command!r:.40} or version; v = {SCHEMA_VERSION} knows: {names}"
            )
        try:
            return {"v": SCHEMA_VERSION, "ok": True, **self.commands[command]()}
        except Exception as error:  # noqa: BLE001 - a failing command is answered, and the tick goes on
            _log.exception("command %s failed", command)
            return self._refuse(f"{command} failed: {error}")

    def close(self) -> None:
        """Close the endpoint."""
        self._socket.close()

    def _refuse(self, why: str) -> dict[str, Any]:
        self.refused += 1
        return {"v": SCHEMA_VERSION, "ok": False, "error": why}
