"""One client connection to an endpoint of a daemon: CURVE key, reconnection, authentication errors.

Public names: `Connection`.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Mapping
from math import ceil
from pathlib import Path
from typing import Self

import zmq
from zmq.utils.monitor import parse_monitor_message

from handtouch.client.keys import ClientKey, load_client
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

_HANDSHAKE_EVENTS = (
    zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
)
_EVENTS = _HANDSHAKE_EVENTS | zmq.Event.DISCONNECTED
SILENCE_S = 2.0
"""Time without any message after which a subscription logs why; `service` comes four times in it"""
_log = logging.getLogger("handtouch.client")
_MAX_HANDSHAKE_FAILURES = 3
"""Consecutive failed handshakes that are put down to a daemon that restarts."""


class Connection:
    """A connected socket and the monitor of its disconnections and rejected handshakes; made by `open`."""

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        monitor: zmq.Socket[bytes],
        endpoint: str,
        key: ClientKey | None,
    ) -> None:
        self.socket = socket
        self.endpoint = endpoint
        self._monitor = monitor
        self._key = key
        self.disconnects = 0
        """times that the connection was lost, as noticed by `poll` and `check`"""
        self._failures = 0
        self._is_open = self._is_refused = False
        """after the handshake; closed by the other side before it"""
        self._warn_at_s = time.monotonic() + SILENCE_S if socket.type == zmq.SUB else float("inf")
        self._waiting: set[asyncio.Future[None]] = set()
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        self._poller.register(monitor, zmq.POLLIN)

    @classmethod
    def open(
        cls, socket_type: int, endpoint: str, key: Path | str | None, options: Mapping[int, int]
    ) -> Self:
        """Connect a new socket with these options to an endpoint.

        `key` is a client's key file, None: the file named by HANDTOUCH_KEY, "": none; used over TCP only.
        Raises ValueError for an invalid endpoint or an unusable key file.
        """
        file = os.environ.get("HANDTOUCH_KEY", "") if key is None else key
        client_key = load_client(Path(file)) if file and endpoint.startswith("tcp://") else None
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(socket_type)
        monitor: zmq.Socket[bytes] | None = None
        try:
            for option, value in options.items():
                socket.setsockopt(option, value)
            if client_key is not None:
                socket.setsockopt(zmq.CURVE_SERVERKEY, client_key.server_key.encode())
                socket.setsockopt(zmq.CURVE_PUBLICKEY, client_key.public_key.encode())
                socket.setsockopt(zmq.CURVE_SECRETKEY, client_key.secret_key.encode())
            monitor = socket.get_monitor_socket(_EVENTS)
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            if monitor is not None:
                monitor.close()
            socket.close()
            raise ValueError(
                f"{endpoint!r} is no ZeroMQ endpoint ({error.strerror}); use the form tcp://127.0.0.1:5580"
            ) from error
        return cls(socket, monitor, endpoint, client_key)

    def poll(self, wait_ms: int | None) -> bool:
        """Wait for a message or a connection event; return False after `wait_ms` without one.

        Raises PermissionError when the daemon rejects this client.
        """
        end_s = float("inf") if wait_ms is None else time.monotonic() + 1e-3 * wait_ms
        while True:
            until_s = min(end_s, self._warn_at_s)
            left_ms = None if until_s == float("inf") else max(0, ceil(1e3 * (until_s - time.monotonic())))
            ready = {socket for socket, _ in self._poller.poll(left_ms)}
            if self._monitor in ready and self.socket not in ready:  # what it sent before comes first
                self.check()
            self.warn_of_silence()
            if ready or until_s == end_s:
                return bool(ready)

    def note_message(self) -> None:
        """Note that a message was received, so that silence needs no warning."""
        self._warn_at_s = float("inf")

    def warn_of_silence(self) -> None:
        """Log once that no message has come, and why, where a subscription is SILENCE_S old."""
        if time.monotonic() >= self._warn_at_s and not self.readable:
            self._warn_at_s = float("inf")
            _log.warning("%s", self.reason_of_silence)

    @property
    def reason_of_silence(self) -> str:
        """Why nothing is received, with a remedy."""
        if self._is_refused and self.socket.type == zmq.SUB:
            return (
                f"{self.endpoint} is no stream of messages, perhaps a control endpoint; "
                f"the live stream is by default {LIVE_ENDPOINT}"
            )
        if self._is_refused:
            return (
                f"{self.endpoint} takes no requests, perhaps it is a stream of messages; "
                f"the control endpoint is by default {CONTROL_ENDPOINT}"
            )
        return f"no daemon at {self.endpoint}; start `handtouch run FILE`"

    def check(self) -> None:
        """Count disconnections that have happened. Raises PermissionError when the daemon rejects us."""
        while int(self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            self._handle_monitor_event(self._monitor.recv_multipart())

    @property
    def items(self) -> list[tuple[zmq.Socket[bytes], int]]:
        """What `zmq_poll` needs to find a message or an event."""
        return [(self.socket, int(zmq.POLLIN)), (self._monitor, int(zmq.POLLIN))]

    @property
    def readable(self) -> bool:
        """True if a message can be received now."""
        return bool(int(self.socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)

    async def wait(self) -> None:
        """Return when a message may have arrived, or another task has received one: receive again then.

        Several tasks may wait at once. Raises PermissionError, in all of them, when the daemon rejects us.
        """
        try:
            if self.readable or self.poll(0):
                return  # the descriptors are edge-triggered: poll before waiting on them
        except PermissionError as error:
            self.wake_waiting(error)
            raise
        loop = asyncio.get_running_loop()
        woken: asyncio.Future[None] = loop.create_future()
        left_s = self._warn_at_s - time.monotonic()
        timer = loop.call_later(left_s, self.warn_of_silence) if left_s < float("inf") else None
        if not self._waiting:
            for descriptor in self._descriptors():
                loop.add_reader(descriptor, self.wake_waiting)
        self._waiting.add(woken)
        try:
            await woken
        finally:
            if timer is not None:
                timer.cancel()
            self._waiting.discard(woken)
            if not self._waiting:
                for descriptor in self._descriptors():
                    loop.remove_reader(descriptor)

    def wake_waiting(self, error: PermissionError | None = None) -> None:
        """Make every `wait` return, or raise the error. Call it after receiving: that may hide messages."""
        for woken in self._waiting:
            if not woken.done():
                if error is None:
                    woken.set_result(None)
                else:
                    woken.set_exception(PermissionError(*error.args))

    def _descriptors(self) -> list[int]:
        return [int(socket.getsockopt(zmq.FD)) for socket in (self.socket, self._monitor)]

    def close(self) -> None:
        """Close the socket and its monitor; the daemon notices within milliseconds."""
        if not self._monitor.closed:
            self._poller.unregister(self._monitor)
            self.socket.disable_monitor()
            self._monitor.close()
        self.socket.close()

    def _handle_monitor_event(self, parts: list[bytes]) -> None:
        event = parse_monitor_message(parts)["event"]
        if event == zmq.Event.DISCONNECTED:
            self.disconnects += 1
            # a socket of another type closes the connection without a failed handshake
            self._is_refused = not self._is_open and self._failures == 0
            self._is_open = False
            return
        self._is_open = event == zmq.Event.HANDSHAKE_SUCCEEDED
        self._failures = 0 if event == zmq.Event.HANDSHAKE_SUCCEEDED else self._failures + 1
        if event == zmq.Event.HANDSHAKE_FAILED_AUTH and self._key is not None:
            raise PermissionError(
                f"{self.endpoint} rejects the key of {self._key.name}: unknown there, or without the right "
                "to this endpoint; check `handtouch keys list FOLDER` on the daemon's machine"
            )
        if self._failures < _MAX_HANDSHAKE_FAILURES and event != zmq.Event.HANDSHAKE_FAILED_PROTOCOL:
            return  # a daemon that shuts down during the handshake looks the same; ZeroMQ retries
        if self._key is None:
            raise PermissionError(
                f"{self.endpoint} requires a key: make one with `handtouch keys client FOLDER NAME` on the "
                "daemon's machine; pass its file by --key, key= or HANDTOUCH_KEY"
            )
        raise PermissionError(
            f"{self.endpoint}: CURVE handshake failed with the key of {self._key.name} for "
            f"{self._key.server}: this is another daemon, or it has new keys, or none"
        )
