"""Control endpoint: request-reply with one msgpack map each way; no request can block or stop the tick.

Public names: `ControlServer`, `Command`, `Job`, `RefusedError`, `format_value`, `open_control_socket`.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import msgpack
import zmq

from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.endpoints import bind_endpoint, is_readable
from handtouch.wire import SCHEMA_VERSION

MAX_REQUEST_BYTES = 65_536
"""Largest request: decoding a larger one would delay a tick"""
MAX_JOBS = 8
"""Requests in progress at a time"""
_MAX_REQUESTS_PER_POLL = 2
_MAX_VALUE_CHARACTERS = 60
_log = logging.getLogger("handtouch.control")

Reply = dict[str, Any]


class Job(Protocol):
    """A command that needs more than one poll."""

    def poll(self, now_ns: int) -> Reply | None:
        """Continue without blocking; return the reply when done, else None. May raise as a command does."""


Command = Callable[[dict[str, Any], int], "Reply | Job"]
"""Takes arguments and the present [ns]; returns the reply or a job. Raises RefusedError."""


class RefusedError(Exception):
    """A request that can't be carried out; the text has the reason and a remedy."""


def format_value(value: object) -> str:
    """Return a value of a request as JSON, shortened: "binary" and "extension type" for what JSON lacks."""
    try:
        text = json.dumps(value, default=_type_without_json, ensure_ascii=False)
    except (RecursionError, TypeError):  # nested deeper than Python's stack, or a map with binary keys
        text = "a map" if isinstance(value, dict) else "a nested list"
    return text if len(text) <= _MAX_VALUE_CHARACTERS else text[: _MAX_VALUE_CHARACTERS - 3] + "..."


class ControlServer:
    """Answers requests {"v", "command", arguments...}, a few per poll, without blocking. Created by `open`.

    `commands` (name -> command), `refused` (number of requests that were malformed, unknown or refused).
    """

    def __init__(
        self, socket: zmq.Socket[bytes], endpoint: str, commands: Mapping[str, Command] | None = None
    ) -> None:
        self.endpoint = endpoint
        self.commands: dict[str, Command] = dict(commands or {})
        self.refused = 0
        self._jobs: list[tuple[bytes, str, Job]] = []
        self._socket = socket

    @classmethod
    def open(
        cls,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        authenticator: Authenticator | None = None,
        commands: Mapping[str, Command] | None = None,
    ) -> ControlServer:
        """Bind the endpoint. Raises OSError naming it and a remedy."""
        return cls(*open_control_socket(context, endpoint, authenticator or Authenticator(context)), commands)

    def poll(self, now_ns: int) -> None:
        """Answer waiting requests and continue the jobs in progress."""
        for _ in range(_MAX_REQUESTS_PER_POLL):
            if not is_readable(self._socket):
                break
            client, *parts = self._socket.recv_multipart(zmq.NOBLOCK)
            # a REP socket would handle the envelope, but malformed parts make it misroute all later replies
            if parts[:1] != [b""]:
                self.refused += 1  # not from a REQ socket: it couldn't read a reply
                continue
            request = (
                parts[1] if len(parts) == 2 else b""
            )  # anything else gets the reply for malformed requests
            command, reply = self.start_request(request, now_ns)
            if isinstance(reply, dict):
                self._send_reply(client, reply)
            else:
                self._jobs.append((client, command, reply))
        if self._jobs:
            self._poll_jobs(now_ns)

    def start_request(self, request: bytes, now_ns: int) -> tuple[str, Reply | Job]:
        """Decode a request and start its command; return the command's name and its reply or job."""
        try:
            command, arguments = _decode_request(request)
            if command not in self.commands:
                names = ", ".join(sorted(self.commands))
                raise RefusedError(f"unknown command {format_value(command)}; the commands are {names}")
            if len(self._jobs) >= MAX_JOBS:
                raise RefusedError(f"{MAX_JOBS} requests are in progress; retry later")
        except RefusedError as error:
            return "", self._error_reply(str(error))
        return command, self._call_command(command, lambda: self.commands[command](arguments, now_ns))

    def close(self) -> None:
        """Reply to the requests in progress that the daemon stops, and close the endpoint."""
        for client, command, _ in self._jobs:
            self._send_reply(client, self._error_reply(f"{command}: the daemon is stopping"))
        self._jobs.clear()
        self._socket.close()

    def _poll_jobs(self, now_ns: int) -> None:
        in_progress, self._jobs = self._jobs, []
        for client, command, job in in_progress:
            reply = self._call_command(command, lambda job=job: job.poll(now_ns))  # type: ignore[misc]
            if reply is None:
                self._jobs.append((client, command, job))
            else:
                self._send_reply(client, reply)

    def _call_command(self, command: str, work: Callable[[], Any]) -> Any:
        """Call a command or a job; turn its map or its error into a reply."""
        try:
            result = work()
        except RefusedError as error:
            return self._error_reply(f"{command}: {error}")
        except Exception as error:  # noqa: BLE001 - a failing command gets an error reply; the tick continues
            _log.exception("control: command %s failed", command)
            return self._error_reply(f"{command} failed: {error}")
        return {"v": SCHEMA_VERSION, "ok": True, **result} if isinstance(result, dict) else result

    def _send_reply(self, client: bytes, reply: Reply) -> None:
        try:
            packed = msgpack.packb(reply)
        except (TypeError, ValueError, OverflowError):
            _log.exception("control: reply can't be encoded")
            packed = msgpack.packb(self._error_reply("the reply can't be encoded; please report this"))
        try:
            self._socket.send_multipart([client, b"", packed], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # the client's queue is full
            _log.warning("control: reply not sent: %s", error.strerror)

    def _error_reply(self, why: str) -> Reply:
        self.refused += 1
        return {"v": SCHEMA_VERSION, "ok": False, "error": why}


def open_control_socket(
    context: zmq.Context[zmq.Socket[bytes]], endpoint: str, authenticator: Authenticator
) -> tuple[zmq.Socket[bytes], str]:
    """Bind a socket for a `ControlServer`; return it with its endpoint. Raises OSError."""
    socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 200)  # replies are still sent at shutdown
    return socket, bind_endpoint(socket, endpoint, "the control endpoint", authenticator, "control")


def _decode_request(request: bytes) -> tuple[str, dict[str, Any]]:
    """Return command and arguments of a request. Raises RefusedError."""
    if len(request) > MAX_REQUEST_BYTES:
        raise RefusedError(f"request of {len(request)} bytes; the limit is {MAX_REQUEST_BYTES}")
    try:
        arguments = msgpack.unpackb(request)
    except Exception as error:
        raise RefusedError("malformed request: send a msgpack map with v and command") from error
    if not isinstance(arguments, dict) or not all(isinstance(key, str) for key in arguments):
        raise RefusedError("malformed request: send a msgpack map with v and command")
    version, command = arguments.pop("v", None), arguments.pop("command", None)
    if type(version) is not int or version != SCHEMA_VERSION:
        raise RefusedError(
            f"v = {format_value(version)}: this daemon supports v = {SCHEMA_VERSION}, an integer"
        )
    if not isinstance(command, str):
        raise RefusedError(f"malformed request: command = {format_value(command)} is not a string")
    return command, arguments


def _type_without_json(value: object) -> str:
    return "binary" if isinstance(value, bytes) else "extension type"
