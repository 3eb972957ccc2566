"""Tells systemd how the service fares (sd_notify protocol); does nothing where nobody listens."""

from __future__ import annotations

import os
import socket


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
