"""Who may connect: CURVE on every TCP endpoint of a daemon that has keys; bounds on what anybody may send.

Public names: `Gate`, `ready`, `CAUSES`.

The hot thread answers the handshakes itself, a few at a time. They are rare, and a flood of them waits in
line; a thread for them would fight the tick for the interpreter, and under a flood win too often.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from pathlib import Path

import zmq
from zmq.utils import z85
from zmq.utils.monitor import recv_monitor_message

from handtouch import keys

CAUSES = {
    "no_key": "a client without a key",
    "wrong_server_key": "a client with the key of another daemon",
    "unknown_key": "a client whose key is not known here",
    "no_right": "a client that may read, but not control",
    "garbage": "something that doesn't speak as a client does, or hung up too early to tell",
}
"""Why a connection was refused: name of the counter -> words."""

_ZAP = "inproc://zeromq.zap.01"
_POLL_NS = 10_000_000
_HANDSHAKES_PER_POLL = 2
_EVENTS_PER_POLL = 100
_HANDSHAKE_MS = 5000
"""A connection that hasn't shown by then who it is, is closed."""
_LARGEST_BYTES = {"read": 4096, "control": 1_000_000, "inputs": 65_536}
"""Largest message that a client may send; of the streams it only ever asks for topics."""
_TOLD_AGAIN_NS = 10_000_000_000
_FAILURES = (
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
)  # those by key are counted where they are decided
_MECHANISM_MISMATCH = 0x11000002
_CRYPTOGRAPHIC = 0x11000001
_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)  # to look up members of an enumeration costs more

_log = logging.getLogger("handtouch.security")


class Gate:
    """Guards the sockets of one context; `poll` it after every tick.

    `refused` counts connections by cause (`CAUSES`). Without a folder of keys nobody is asked for one,
    and only the bounds hold. Clients are read again when their files change. Raises KeysError.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], folder: Path | None = None) -> None:
        self.refused: Counter[str] = Counter()
        self._context = context
        self._folder = folder
        self._monitors: list[zmq.Socket[bytes]] = []
        self._polled_ns = 0
        self._told: dict[str, tuple[int, int]] = {}
        self._clients: dict[str, keys.Client] = {}
        self._seen: object = None
        if folder is None:
            return
        if not zmq.has("curve"):
            raise keys.KeysError("this pyzmq was built without CURVE; pip install --force-reinstall pyzmq")
        self._key = keys.load_server(folder)
        self._refresh()
        self._zap: zmq.Socket[bytes] = context.socket(zmq.REP)
        self._zap.setsockopt(zmq.LINGER, 0)
        self._zap.bind(_ZAP)

    def guard(self, socket: zmq.Socket[bytes], endpoint: str, right: str) -> None:
        """Before a socket is bound: bound what it takes and, over TCP, let in only those with the right."""
        socket.setsockopt(zmq.MAXMSGSIZE, _LARGEST_BYTES[right])
        socket.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        if self._folder is None or not endpoint.startswith("tcp://"):
            return
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._key.secret_key.encode())
        socket.setsockopt(zmq.ZAP_DOMAIN, right.encode())
        address = f"inproc://refused-{len(self._monitors)}"
        socket.monitor(address, _FAILURES)
        monitor: zmq.Socket[bytes] = self._context.socket(zmq.PAIR)
        monitor.setsockopt(zmq.LINGER, 0)
        monitor.setsockopt(zmq.RCVHWM, 0)  # ZeroMQ's own thread would wait for us when it is full
        monitor.connect(address)
        self._monitors.append(monitor)

    def poll(self, now_ns: int) -> None:
        """Answer handshakes and count refusals, every 10 ms: to look for them costs microseconds."""
        if self._folder is None or now_ns - self._polled_ns < _POLL_NS:
            return
        self._polled_ns = now_ns
        for _ in range(_HANDSHAKES_PER_POLL):
            if not ready(self._zap):
                break
            self._answer(self._zap.recv_multipart(zmq.NOBLOCK), now_ns)
        for monitor in self._monitors:
            for _ in range(_EVENTS_PER_POLL):
                if not ready(monitor):
                    break
                value = recv_monitor_message(monitor, zmq.NOBLOCK)["value"]
                cause = {_MECHANISM_MISMATCH: "no_key", _CRYPTOGRAPHIC: "wrong_server_key"}
                self._refuse(cause.get(value, "garbage"), "", now_ns)

    def close(self) -> None:
        """After the sockets that it guards."""
        for monitor in self._monitors:
            monitor.close()
        if self._folder is not None:
            self._zap.close()

    def _answer(self, request: list[bytes], now_ns: int) -> None:
        """One request of ZeroMQ's authentication protocol (RFC 27)."""
        version, number, right, address, _, mechanism, *credentials = request
        self._refresh()
        key = z85.encode(credentials[0]).decode() if mechanism == b"CURVE" else ""
        client = self._clients.get(key)
        who, where = b"", f"from {address.decode('ascii', 'replace')}"
        if client is None:
            self._refuse("unknown_key", f"{key} {where}", now_ns)
        elif right in (b"control", b"inputs") and client.rights != "control":
            self._refuse("no_right", f"{client.name} {where}", now_ns)
        else:
            who = client.name.encode()
            _log.debug("%s connected %s, to %s", client.name, where, right.decode())
        answer = (b"200", b"OK") if who else (b"400", b"NO ACCESS")
        self._zap.send_multipart([version, number, *answer, who, b""], zmq.NOBLOCK)

    def _refuse(self, cause: str, detail: str, now_ns: int) -> None:
        """Count, and tell: the first at once, then from time to time with the number since."""
        self.refused[cause] += 1
        last_ns, last_count = self._told.get(cause, (now_ns - _TOLD_AGAIN_NS, 0))
        if now_ns - last_ns >= _TOLD_AGAIN_NS:
            more = self.refused[cause] - last_count - 1
            _log.warning(
                "refused %s%s%s", CAUSES[cause], f": {detail}" if detail else "",
                f"; {more} more since it was last told" if more else "",
            )  # fmt: skip
            self._told[cause] = now_ns, self.refused[cause]

    def _refresh(self) -> None:
        """Read the clients again if any of their files changed."""
        assert self._folder is not None
        seen = _state(self._folder)
        if seen == self._seen:
            return
        self._seen = seen
        self._clients, problems = keys.clients_in(self._folder)
        for problem in problems:
            _log.error("not let in: %s", problem)
        if not self._clients:
            _log.warning("nobody is let in: handtouch keys client %s NAME makes a client's key", self._folder)


def ready(socket: zmq.Socket[bytes]) -> bool:
    """Whether a message waits: a third of a `recv` in vain, and it keeps the interpreter's lock."""
    return bool(int(socket.getsockopt(_EVENTS)) & _POLLIN)


def _state(folder: Path) -> object:
    """Something that changes whenever a file of a client does."""
    try:
        with os.scandir(folder / keys.CLIENTS) as entries:
            files = sorted((entry.name, *_stamp(entry.stat())) for entry in entries)
        return (_stamp(os.stat(folder)), _stamp(os.stat(folder / keys.CLIENTS)), files)
    except OSError as error:
        return str(error)


def _stamp(status: os.stat_result) -> tuple[int, int, int, int]:
    return status.st_ctime_ns, status.st_size, status.st_mode, status.st_uid
