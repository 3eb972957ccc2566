"""Tells systemd how the service fares (sd_notify protocol); does nothing where nobody listens.

Public names: `Notifier`, `Pulse`.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

_STATUS_NS = 1_000_000_000


class Notifier:
    """Sends states such as READY=1 and WATCHDOG=1 to the socket that systemd names in NOTIFY_SOCKET."""

    def __init__(self, address: str | None = None) -> None:
        address = os.environ.get("NOTIFY_SOCKET") if address is None else address
        self._address = "\0" + address[1:] if address and address[0] == "@" else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        if self._socket:
            self._socket.setblocking(False)
        self.failures = 0
        """states that nobody took"""

    def send(self, *states: str) -> None:
        """Send the states; never waits, and counts instead of raising."""
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto("\n".join(states).encode(), self._address)
        except OSError:
            self.failures += 1

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()


class Pulse:
    """What systemd hears after ticks, and only then: READY after the first, its watchdog's food, the status.

    `watchdog_ns`: how long systemd waits for a sign of life, 0 if it doesn't. Times in ns.
    """

    def __init__(self, notifier: Notifier, watchdog_ns: int, status: Callable[[], str]) -> None:
        self._notifier, self._status = notifier, status
        self._every_ns = watchdog_ns // 3
        self._fed_ns = self._looked_ns = 0
        self._told = ""

    def ticked(self, now_ns: int) -> None:
        """A tick is done."""
        if self._every_ns and now_ns - self._fed_ns >= self._every_ns:
            self._fed_ns = now_ns
            self._notifier.send("WATCHDOG=1")
        if self._told and now_ns - self._looked_ns < _STATUS_NS:
            return
        self._looked_ns = now_ns
        status = self._status()
        if status != self._told:
            self._notifier.send(*([] if self._told else ["READY=1"]), f"STATUS={status}")
            self._told = status
