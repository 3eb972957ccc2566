"""Control endpoint: request-reply with one msgpack map each way; no request can block or stop the tick.

Public names: `ControlServer`, `Command`, `JobCommand`, `Job`, `RefusedError`, `format_value`,
`open_control_socket`.
"""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import msgpack
import zmq

from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.endpoints import bind_endpoint, is_readable
from handtouch.wire import SCHEMA_VERSION

MAX_REQUEST_BYTES = 65_536
"""Largest request: decoding a larger one would delay a tick"""
MAX_JOBS = 8
"""Jobs in progress at a time"""
MAX_JOBS_PER_CLIENT = 2
"""Jobs of one connection in progress at a time"""
MAX_REPLY_BYTES = 65_536
"""Longest reply for the paper's hand; for more pads longer, see `core.scene.scaled_limit`"""
LOOP_FRACTION = 0.05
"""Largest fraction of time for answering requests, on average"""
_MAX_SAVED_NS = 500_000
"""Time for requests that a poll may use at once, after polls without any; one request may exceed it"""
_MAX_REQUESTS_PER_POLL = 8
_QUEUED_REQUESTS = 4
"""Requests that wait in ZeroMQ for each connection; further ones wait in the client"""
_QUEUED_REPLIES = 16
"""Replies that wait for each connection; further ones are lost"""
_PARTS_OF_REQUEST = 3
"""Connection, empty part and request"""
_MAX_PARTS_PER_POLL = 100
_MAX_VALUE_CHARACTERS = 60
_COMMANDS_FOR_READERS = ("status", "snapshot")
_log = logging.getLogger("handtouch.control")

Reply = dict[str, Any]


class Job(Protocol):
    """A command that needs more than one poll."""

    def poll(self, now_ns: int) -> Reply | None:
        """Continue without blocking; return the reply when done, else None. May raise as a command does."""


Command = Callable[[dict[str, Any], int], Reply]
"""Takes arguments and the present [ns]; returns the reply. Raises RefusedError."""
JobCommand = Callable[[dict[str, Any], int], Job]
"""Takes arguments and the present [ns]; returns a job that makes the reply. Raises RefusedError."""


class RefusedError(Exception):
    """A request that can't be carried out; the text has the reason and a remedy."""


def format_value(value: object) -> str:
    """Return a value of a request as JSON, shortened: "binary" and "extension type" for what JSON lacks."""
    try:
        text = json.dumps(value, default=_type_without_json, ensure_ascii=False)
    except (RecursionError, TypeError):  # nested deeper than Python's stack, or a map with binary keys
        text = "a map" if isinstance(value, dict) else "a nested list"
    return text if len(text) <= _MAX_VALUE_CHARACTERS else text[: _MAX_VALUE_CHARACTERS - 3] + "..."


class _RunningJob(NamedTuple):
    client: bytes
    command: str
    job: Job


class ControlServer:
    """Answers requests {"v", "command", arguments...} without blocking. Created by `open`.

    ZeroMQ hands over requests in turn of the connections. On average, requests take `LOOP_FRACTION` of the
    time at most, so a client that sends them without pause slows down itself, and others by one of its
    requests. Jobs have places of their own, so quick commands never wait for them.

    `commands` and `jobs` (name -> command), `refused` (number of requests that were malformed, unknown or
    refused). `clock` returns the CPU time [ns] of this thread, by which the work on requests is measured.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        endpoint: str,
        authenticator: Authenticator,
        commands: Mapping[str, Command] | None = None,
        jobs: Mapping[str, JobCommand] | None = None,
        clock: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self.endpoint = endpoint
        self.commands: dict[str, Command] = dict(commands or {})
        self.jobs: dict[str, JobCommand] = dict(jobs or {})
        self.refused = 0
        self._authenticator, self._socket, self._clock = authenticator, socket, clock
        self._running: list[_RunningJob] = []
        self._parts: list[zmq.Frame] = []  # parts of the message that is being read
        self._saved_ns = float(_MAX_SAVED_NS)
        self._saved_at_ns = 0

    @classmethod
    def open(
        cls,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        authenticator: Authenticator,
        clock: Callable[[], int] = time.thread_time_ns,
    ) -> ControlServer:
        """Bind the endpoint. Raises OSError naming it and a remedy."""
        return cls(*open_control_socket(context, endpoint, authenticator), authenticator, clock=clock)

    def poll(self, now_ns: int) -> None:
        """Answer waiting requests, as far as their time allows, and continue the jobs in progress."""
        passed_ns, self._saved_at_ns = now_ns - self._saved_at_ns, now_ns
        self._saved_ns = min(_MAX_SAVED_NS, self._saved_ns + LOOP_FRACTION * passed_ns)
        for _ in range(_MAX_REQUESTS_PER_POLL):
            if self._saved_ns <= 0 or not is_readable(self._socket):
                break
            begin_ns = self._clock()
            self._answer_next(now_ns)
            self._saved_ns -= self._clock() - begin_ns
        if self._running:
            self._poll_jobs(now_ns)

    def _answer_next(self, now_ns: int) -> None:
        if not self._read_parts():
            return
        (client, *parts), self._parts = self._parts, []
        # a REP socket would handle the envelope, but malformed parts make it misroute all later replies
        if not parts or parts[0].bytes:
            self.refused += 1  # not from a REQ socket: it couldn't read a reply
            return
        may_control = self._authenticator.authorise(parts[-1], "control", self.endpoint, now_ns)
        # anything but two parts gets the reply for malformed requests
        request = parts[1].bytes if len(parts) == 2 else b""
        command, reply = self.start_request(request, now_ns, client.bytes, may_control)
        if isinstance(reply, dict):
            self._send_reply(client.bytes, reply)
        else:
            self._running.append(_RunningJob(client.bytes, command, reply))

    def _read_parts(self) -> bool:
        """Read the parts of a message, as many as a poll may; return True if it is complete."""
        for _ in range(_MAX_PARTS_PER_POLL):
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
            if len(self._parts) <= _PARTS_OF_REQUEST:  # one more shows that there are too many
                self._parts.append(frame)
            if not frame.more:
                return True
        return False

    def start_request(
        self, request: bytes, now_ns: int, client: bytes = b"", may_control: bool = True
    ) -> tuple[str, Reply | Job]:
        """Decode a request and start its command; return the command's name and its reply or job."""
        try:
            command, arguments = _decode_request(request)
            if command not in self.commands and command not in self.jobs:
                names = ", ".join(sorted({**self.commands, **self.jobs}))
                raise RefusedError(f"unknown command {format_value(command)}; the commands are {names}")
            if not may_control and command not in _COMMANDS_FOR_READERS:
                raise RefusedError(f'{command}: this key has the right "read"; the command needs "control"')
            if command in self.jobs:
                self._check_job_places(client)
        except RefusedError as error:
            return "", self._error_reply(str(error))
        work = self.commands.get(command) or self.jobs[command]
        return command, self._call_command(command, lambda: work(arguments, now_ns))

    def close(self) -> None:
        """Reply to the requests in progress that the daemon stops, and close the endpoint."""
        for running in self._running:
            self._send_reply(running.client, self._error_reply(f"{running.command}: the daemon is stopping"))
        self._running.clear()
        self._socket.close()

    def _check_job_places(self, client: bytes) -> None:
        clients = Counter(running.client for running in self._running)
        if clients[client] >= MAX_JOBS_PER_CLIENT:
            raise RefusedError(
                f"{MAX_JOBS_PER_CLIENT} requests of this client are in progress; wait for their answers"
            )
        if len(self._running) >= MAX_JOBS:
            names = ", ".join(sorted({running.command for running in self._running}))
            raise RefusedError(f"{MAX_JOBS} requests that take longer are in progress ({names}); retry later")

    def _poll_jobs(self, now_ns: int) -> None:
        in_progress, self._running = self._running, []
        for running in in_progress:
            reply = self._call_command(running.command, lambda job=running.job: job.poll(now_ns))  # type: ignore[misc]
            if reply is None:
                self._running.append(running)
            else:
                self._send_reply(running.client, reply)

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
        except zmq.ZMQError as error:  # the client has disconnected, or doesn't read its replies
            _log.debug("control: reply not sent: %s", error.strerror)

    def _error_reply(self, why: str) -> Reply:
        self.refused += 1
        return {"v": SCHEMA_VERSION, "ok": False, "error": why}


def open_control_socket(
    context: zmq.Context[zmq.Socket[bytes]], endpoint: str, authenticator: Authenticator
) -> tuple[zmq.Socket[bytes], str]:
    """Bind a socket for a `ControlServer`; return it with its endpoint. Raises OSError."""
    socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 200)  # replies are still sent at shutdown
    socket.setsockopt(zmq.RCVHWM, _QUEUED_REQUESTS)
    socket.setsockopt(zmq.SNDHWM, _QUEUED_REPLIES)
    socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # report a reply that can't be sent
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
