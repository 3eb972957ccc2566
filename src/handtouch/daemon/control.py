"""The control endpoint: request-reply, one msgpack map each way; nothing that comes in can stop the tick.

Public names: `Control`, `Command`, `Job`, `RefusedError`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Protocol

import msgpack
import zmq

from handtouch.daemon.publisher import bind
from handtouch.daemon.security import Gate, ready
from handtouch.wire import SCHEMA_VERSION

LARGEST_BYTES = 65_536
"""of a request: what takes longer to read than a tick has is refused unread"""
MOST_JOBS = 8
"""Requests that may be under way at once."""
_REQUESTS_PER_POLL = 2
_log = logging.getLogger("handtouch.control")

Reply = dict[str, Any]


class Job(Protocol):
    """A command that takes longer than the hot loop may wait."""

    def poll(self, now_ns: int) -> Reply | None:
        """Work on, briefly; the answer once there is one. May raise as a command does."""


Command = Callable[[dict[str, Any], int], "Reply | Job"]
"""From arguments and the time [ns] to an answer, at once or later. Raises RefusedError."""


class RefusedError(Exception):
    """A request that can't be done; the text says why and what helps."""


class Control:
    """Answers requests {"v", "command", arguments...} from `commands`, a few per tick, without ever waiting.

    `refused` counts those that were malformed, unknown or couldn't be done. Whoever connects passes the
    `gate`. Raises OSError naming the endpoint when it can't be bound.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, gate: Gate | None = None
    ) -> None:
        self.commands: dict[str, Command] = {}
        self.refused = 0
        self._jobs: list[tuple[bytes, str, Job]] = []
        self._socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 200)  # so that answers still leave at shutdown
        try:
            gate = gate or Gate(context)
            self.endpoint = bind(self._socket, endpoint, "the control endpoint", gate, "control")
        except OSError:
            self._socket.close()
            raise

    def poll(self, now_ns: int) -> None:
        """Answer what waits, and go on with what takes longer."""
        for _ in range(_REQUESTS_PER_POLL):
            if not ready(self._socket):
                break
            client, *parts = self._socket.recv_multipart(zmq.NOBLOCK)
            # a REP socket would do this by itself, but malformed parts make it send answers astray for ever
            if parts[:1] != [b""]:
                self.refused += 1  # not from a REQ socket: no answer would be understood
                continue
            request = parts[1] if len(parts) == 2 else b""  # else answered as malformed
            command, answer = self.begin(request, now_ns)
            if isinstance(answer, dict):
                self._send(client, answer)
            else:
                self._jobs.append((client, command, answer))
        if self._jobs:
            self._go_on(now_ns)

    def begin(self, request: bytes, now_ns: int) -> tuple[str, Reply | Job]:
        """The command in a request, whatever its bytes, with its answer, or the job that will give one."""
        try:
            command, arguments = _read(request)
            if command not in self.commands:
                names = ", ".join(sorted(self.commands))
                raise RefusedError(f"unknown command {command!r:.60}; there are {names}")
            if len(self._jobs) >= MOST_JOBS:
                raise RefusedError(f"{MOST_JOBS} requests are under way already; ask again later")
        except RefusedError as error:
            return "", self._refuse(str(error))
        return command, self._try(command, lambda: self.commands[command](arguments, now_ns))

    def close(self) -> None:
        """Tell those who still wait for an answer, and close the endpoint."""
        for client, command, _ in self._jobs:
            self._send(client, self._refuse(f"{command}: the daemon stops"))
        self._jobs.clear()
        self._socket.close()

    def _go_on(self, now_ns: int) -> None:
        under_way, self._jobs = self._jobs, []
        for client, command, job in under_way:
            answer = self._try(command, lambda job=job: job.poll(now_ns))  # type: ignore[misc]
            if answer is None:
                self._jobs.append((client, command, job))
            else:
                self._send(client, answer)

    def _try(self, command: str, work: Callable[[], Any]) -> Any:
        """What a command says; a map becomes an answer."""
        try:
            said = work()
        except RefusedError as error:
            return self._refuse(f"{command}: {error}")
        except Exception as error:  # noqa: BLE001 - a failing command is answered, and the tick goes on
            _log.exception("command %s failed", command)
            return self._refuse(f"{command} failed: {error}")
        return {"v": SCHEMA_VERSION, "ok": True, **said} if isinstance(said, dict) else said

    def _send(self, client: bytes, answer: Reply) -> None:
        try:
            packed = msgpack.packb(answer)
        except (TypeError, ValueError, OverflowError):
            _log.exception("an answer can't be packed")
            packed = msgpack.packb(self._refuse("the answer can't be packed; please report this"))
        try:
            self._socket.send_multipart([client, b"", packed], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # a client that takes no answers
            _log.warning("an answer was not taken: %s", error.strerror)

    def _refuse(self, why: str) -> Reply:
        self.refused += 1
        return {"v": SCHEMA_VERSION, "ok": False, "error": why}


def _read(request: bytes) -> tuple[str, dict[str, Any]]:
    """Command and arguments of a request. Raises RefusedError."""
    if len(request) > LARGEST_BYTES:
        raise RefusedError(f"request of {len(request)} bytes; at most {LARGEST_BYTES} are read")
    try:
        asked = msgpack.unpackb(request)
    except Exception as error:
        raise RefusedError("malformed request: send a msgpack map with v and command") from error
    if not isinstance(asked, dict) or not all(isinstance(key, str) for key in asked):
        raise RefusedError("malformed request: send a msgpack map with v and command")
    version, command = asked.pop("v", None), asked.pop("command", None)
    if type(version) is not int or version != SCHEMA_VERSION:
        raise RefusedError(f"request of version v = {version!r:.20}; this daemon speaks v = {SCHEMA_VERSION}")
    if not isinstance(command, str):
        raise RefusedError(f"malformed request: command = {command!r:.60} is not a string")
    return command, asked
