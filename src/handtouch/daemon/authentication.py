"""Access control of the daemon's endpoints: CURVE keys over TCP, limits on message sizes and new connections.

Public names: `Authenticator`, `REFUSAL_CAUSES`, `ConnectionLimit`.

The hot thread answers the handshakes itself, a few per poll: they are rare, and a flood of them waits. A
thread for them would compete with the tick for the interpreter lock. ZeroMQ needs 25 us for each connection
that a client opens and breaks off, in a thread beside the hot one. The kernel drops requests at random before
ZeroMQ sees them: half of them first, which is enough for a client that opens one after another, as it waits a
second for each that is lost.
"""

from __future__ import annotations

import errno
import logging
import os
import struct
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import zmq
from zmq.utils import z85

from handtouch.client import keys
from handtouch.client.socket_options import KEEPALIVE_OPTIONS
from handtouch.daemon.cause_counter import CauseCounter
from handtouch.daemon.connections import (
    client_key_of,
    close_connection,
    connection_of,
    drop_connection_requests,
    dropped_connection_requests,
)
from handtouch.daemon.endpoints import is_readable
from handtouch.host.closing import Closing

REFUSAL_CAUSES = {
    "no_key": "client has no key",
    "wrong_server_key": "client has the key of another daemon",
    "unknown_key": "client key is unknown",
    "no_right": 'client has the right "read", but not "control"',
    "malformed": "peer doesn't speak ZMTP, or disconnected during the handshake",
    "revoked": "client is no longer authorised, or has other rights; its connection is closed",
    "connection_flood": "clients connect too fast; requests to connect are dropped at random, which delays "
    "new connections by seconds; find the process that opens one after another",
}
"""Causes of refused connections: name of the counter -> description."""

_ZAP_ENDPOINT = "inproc://zeromq.zap.01"
_POLL_PERIOD_NS = 10_000_000
_CLIENT_FILES_PERIOD_NS = 1_000_000_000
"""Time after which a revoked client is disconnected at the latest"""
_MAX_HANDSHAKES_PER_POLL = 2
_MAX_EVENTS_PER_POLL = 100
_NO_DESCRIPTOR_LEFT = (errno.EMFILE, errno.ENFILE)  # this says nothing about the clients
_MAX_UNACKNOWLEDGED_MS = 10_000
"""Time after which a connection is closed whose peer takes no data"""
_HANDSHAKE_TIMEOUT_MS = 5000
"""A connection that isn't authenticated by then is closed."""
_MAX_MESSAGE_BYTES = {"read": 1024, "control": 200_000, "inputs": 65_536}
"""Largest message that a client may send; on the streams clients send subscriptions only."""
_LISTENING, _ACCEPTED = int(zmq.Event.LISTENING), int(zmq.Event.ACCEPTED)
_HANDSHAKE_FAILURE_EVENTS = int(
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
)  # failures of authentication are counted by `_answer_zap_request`
_EVENT_FORMAT = "=Hi"  # ZeroMQ's first frame about an event: which, value
_HANDSHAKE_CAUSES = {0x11000002: "no_key", 0x11000001: "wrong_server_key"}
"""With keys: what ZeroMQ reports as a mismatch of mechanisms, and as a cryptographic failure"""

_log = logging.getLogger("handtouch.security")


class Authenticator(Closing):
    """Controls access to the sockets of one context; `poll` it after every tick.

    `refused` counts connections by cause (`REFUSAL_CAUSES`). Without keys (`open` without a folder) any
    client that speaks ZMTP 3 may connect, and only the size limits apply. Client files are read again when
    they change, and the connections of clients that are no longer authorised closed.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        folder: Path | None = None,
        zap: zmq.Socket[bytes] | None = None,
    ) -> None:
        self._refusals = CauseCounter(_log, "connection refused", REFUSAL_CAUSES)
        self._context, self._folder, self._zap = context, folder, zap
        self._monitors: list[_Monitor] = []
        self._last_poll_ns = self._client_files_read_ns = 0
        self._connections: dict[int, tuple[keys.AuthorisedClient, str]] = {}  # descriptor -> client, endpoint
        self._clients: dict[str, keys.AuthorisedClient] = {}
        self._folder_fingerprint: object = None
        if folder is not None:
            self._key = keys.load_server(folder)
            self._reload_clients(0)

    @classmethod
    def open(cls, context: zmq.Context[zmq.Socket[bytes]], folder: Path | None = None) -> Authenticator:
        """Answer ZeroMQ's authentication requests with the keys in `folder`. Raises KeyFileError."""
        if folder is None:
            return cls(context)
        if not zmq.has("curve"):
            raise keys.KeyFileError("this pyzmq was built without CURVE; pip install --force-reinstall pyzmq")
        zap: zmq.Socket[bytes] = context.socket(zmq.REP)
        try:
            opened = cls(context, folder, zap)
            zap.setsockopt(zmq.LINGER, 0)
            zap.bind(_ZAP_ENDPOINT)
        except BaseException:
            zap.close()
            raise
        return opened

    @property
    def refused(self) -> Counter[str]:
        """Refused connections by cause."""
        return self._refusals.counts

    def secure_socket(self, socket: zmq.Socket[bytes], endpoint: str, right: str) -> None:
        """Limit message sizes of a socket before it is bound; over TCP, require ZMTP 3 and any keys."""
        socket.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE_BYTES[right])
        socket.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_TIMEOUT_MS)
        if not endpoint.startswith("tcp://"):
            return
        for option, value in {**KEEPALIVE_OPTIONS, zmq.TCP_MAXRT: _MAX_UNACKNOWLEDGED_MS}.items():
            socket.setsockopt(option, value)
        # with a domain, ZeroMQ refuses the protocol before ZMTP 3, as which it would accept any bytes
        socket.setsockopt(zmq.ZAP_DOMAIN, right.encode())
        if self._folder is not None:
            socket.setsockopt(zmq.CURVE_SERVER, 1)
            socket.setsockopt(zmq.CURVE_SECRETKEY, self._key.secret_key.encode())
        number = len(self._monitors)
        self._monitors.append(_Monitor(self._context, socket, number, self._folder is not None))

    def poll(self, now_ns: int) -> None:
        """Answer handshakes, count connections and refusals; every 10 ms, as polling costs microseconds."""
        if now_ns - self._last_poll_ns < _POLL_PERIOD_NS:
            return
        self._last_poll_ns = now_ns
        for monitor in self._monitors:
            monitor.poll(self._refusals, now_ns)
        if self._zap is None:
            return
        if now_ns - self._client_files_read_ns >= _CLIENT_FILES_PERIOD_NS:
            self._reload_clients(now_ns)
        for _ in range(_MAX_HANDSHAKES_PER_POLL):
            if not is_readable(self._zap):
                break
            self._zap.send_multipart(
                self._answer_zap_request(self._zap.recv_multipart(zmq.NOBLOCK), now_ns), zmq.NOBLOCK
            )

    def authorise(self, frame: zmq.Frame, right: str, endpoint: str, now_ns: int) -> bool:
        """Return True if the sender of a frame that was received at an endpoint has a right.

        A client without keys, where none are required, has every right. The connection of a client whose key
        is no longer authorised is closed.
        """
        if self._folder is None or not endpoint.startswith("tcp://"):
            return True
        key, connection = client_key_of(frame), connection_of(frame)
        if key is None:
            return False
        client = self._clients.get(key)
        if client is None:
            self._close_revoked(connection, f"key {key}", endpoint, now_ns)
            return False
        self._connections[connection] = client, endpoint
        return right == "read" or client.rights == "control"

    def close(self) -> None:
        """Close the authentication sockets; call it after the secured sockets are closed."""
        for monitor in self._monitors:
            monitor.close()
        if self._zap is not None:
            self._zap.close()

    def _answer_zap_request(self, request: list[bytes], now_ns: int) -> list[bytes]:
        """Return the reply to a request of ZeroMQ's authentication protocol (RFC 27)."""
        version, number, right, address, _, mechanism, *credentials = request
        self._reload_clients(now_ns)
        key = z85.encode(credentials[0]).decode() if mechanism == b"CURVE" else ""
        client = self._clients.get(key)
        user, origin = b"", f"from {address.decode('ascii', 'replace')}"
        if client is None:
            self._refusals.add("unknown_key", f"{key} {origin}", now_ns)
        elif right == b"inputs" and client.rights != "control":
            self._refusals.add("no_right", f"{client.name} {origin}", now_ns)
        else:
            user = key.encode()
            _log.debug("client %s: connected %s to %s", client.name, origin, right.decode())
        status = (b"200", b"OK") if user else (b"400", b"NO ACCESS")
        return [version, number, *status, user, b""]

    def _close_revoked(self, connection: int, client: str, endpoint: str, now_ns: int) -> None:
        self._connections.pop(connection, None)
        if close_connection(connection, endpoint):
            self._refusals.add("revoked", f"{client} at {endpoint}", now_ns)

    def _reload_clients(self, now_ns: int) -> None:
        """Read the client files again if any of them changed; disconnect clients that are revoked."""
        assert self._folder is not None
        self._client_files_read_ns = now_ns
        fingerprint = _fingerprint_folder(self._folder)
        if fingerprint == self._folder_fingerprint or fingerprint in _NO_DESCRIPTOR_LEFT:
            return
        self._folder_fingerprint = fingerprint
        self._clients, problems = keys.load_clients(self._folder)
        for connection, (client, endpoint) in list(self._connections.items()):
            if self._clients.get(client.public_key) != client:  # with other rights it may connect again
                self._close_revoked(connection, client.name, endpoint, now_ns)
        for problem in problems:
            _log.error("client key rejected: %s", problem)
        if not self._clients:
            _log.warning(
                "no client is authorised; create a client key with handtouch keys client %s NAME",
                self._folder,
            )


class _Monitor:
    """Reads what ZeroMQ reports about the connections of one socket, and limits their rate."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        socket: zmq.Socket[bytes],
        number: int,
        needs_keys: bool,
    ) -> None:
        self._causes = _HANDSHAKE_CAUSES if needs_keys else {}
        address = f"inproc://connections-{number}"
        socket.monitor(address, _LISTENING | _ACCEPTED | _HANDSHAKE_FAILURE_EVENTS)
        self._events: zmq.Socket[bytes] = context.socket(zmq.PAIR)
        self._events.setsockopt(zmq.LINGER, 0)
        self._events.setsockopt(zmq.RCVHWM, 0)  # a full queue would block ZeroMQ's own thread
        self._events.connect(address)
        self._listener, self._endpoint, self._dropped = -1, "", 0
        self._limit = ConnectionLimit(lambda _: False)

    def poll(self, refusals: CauseCounter, now_ns: int) -> None:
        """Count connections and refusals since the last call; adapt the share of dropped requests."""
        accepted = 0
        for _ in range(_MAX_EVENTS_PER_POLL):
            if not is_readable(self._events):
                break
            description, endpoint = self._events.recv_multipart(zmq.NOBLOCK)
            event, value = struct.unpack(_EVENT_FORMAT, description)
            if event == _ACCEPTED:
                accepted += 1
            elif event == _LISTENING:
                self._listener, self._endpoint = value, endpoint.decode()
                self._limit = ConnectionLimit(partial(drop_connection_requests, value, self._endpoint))
            else:
                refusals.add(self._causes.get(value, "malformed"), "", now_ns)
        self._limit.count(accepted, now_ns)
        if self._limit.halvings:
            dropped = dropped_connection_requests(self._listener, self._endpoint)
            if dropped is not None and dropped != self._dropped:
                refusals.add(
                    "connection_flood", self._endpoint, now_ns, (dropped - self._dropped) % (1 << 32)
                )
                self._dropped = dropped

    def close(self) -> None:
        self._events.close()


def _fingerprint_folder(folder: Path) -> object:
    """Return a value that changes whenever a client file changes."""
    try:
        with os.scandir(folder / keys.CLIENTS_FOLDER) as entries:
            files = sorted((entry.name, *_fingerprint_file(entry.stat())) for entry in entries)
        folders = (
            _fingerprint_file(os.stat(folder)),
            _fingerprint_file(os.stat(folder / keys.CLIENTS_FOLDER)),
        )
        return (*folders, files)
    except OSError as error:
        return error.errno


def _fingerprint_file(status: os.stat_result) -> tuple[int, int, int, int]:
    return status.st_ctime_ns, status.st_size, status.st_mode, status.st_uid


MAX_BURST = 500
"""Connections at once: 100 clients with all endpoints each connect again after the daemon was restarted"""
MAX_PER_S = 50.0
"""Connections per second, continuously"""
_EXCESS_PER_HALVING = 50
_MAX_HALVINGS = 8
_SETTLING_NS = 100_000_000
"""Time after a change in which connections from before it are still reported"""
_HELD_NS = 10_000_000_000


class ConnectionLimit:
    """Sets the share of requests to connect that an endpoint takes, by the rate of its connections.

    `set_halvings(n)` makes the kernel let one request of 2^n through; `halvings` is the present n. It grows
    while connections come faster than allowed, and falls by one in 10 s when they don't.
    """

    def __init__(self, set_halvings: Callable[[int], bool]) -> None:
        self.halvings = 0
        self._set_halvings = set_halvings
        self._excess = 0.0
        self._since_ns = self._changed_ns = 0

    def count(self, connections: int, now_ns: int) -> None:
        """Count the new connections since the last call; call it without any, too."""
        elapsed_s, self._since_ns = (now_ns - self._since_ns) * 1e-9, now_ns
        if self.halvings and now_ns - self._changed_ns < _SETTLING_NS:
            return
        self._excess = max(0.0, self._excess - elapsed_s * MAX_PER_S) + connections
        if self._excess > MAX_BURST and self.halvings < _MAX_HALVINGS:
            self._excess = MAX_BURST - _EXCESS_PER_HALVING
            self._change(self.halvings + 1, now_ns)
        elif self.halvings and now_ns - self._changed_ns >= _HELD_NS:
            self._change(self.halvings - 1, now_ns)

    def _change(self, halvings: int, now_ns: int) -> None:
        self._changed_ns = now_ns
        if self._set_halvings(halvings):
            self.halvings = halvings
