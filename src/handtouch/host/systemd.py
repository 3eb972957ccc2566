"""Service readiness, watchdog and status for systemd (sd_notify protocol).

Public names: `SystemdNotifier`, `ServiceWatchdog`.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

_STATUS_PERIOD_NS = 1_000_000_000


class SystemdNotifier:
    """Sends states such as READY=1 and WATCHDOG=1; does nothing without a socket. `open` creates it."""

    def __init__(self, sender: socket.socket | None = None, address: str = "") -> None:
        self._socket, self._address = sender, address
        self.failures = 0
        """states that could not be sent"""

    @classmethod
    def open(cls, address: str | None = None) -> SystemdNotifier:
        """Open a socket to `address` (default: NOTIFY_SOCKET); an empty address disables notification."""
        address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        if not address:
            return cls()
        sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sender.setblocking(False)
        return cls(sender, "\0" + address[1:] if address[0] == "@" else address)

    def send(self, *states: str) -> None:
        """Send the states without blocking; count failures instead of raising."""
        if self._socket is None:
            return
        try:
            self._socket.sendto("\n".join(states).encode(), self._address)
        except OSError:
            self.failures += 1

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


class ServiceWatchdog:
    """Notifies systemd after ticks only: READY=1 after the first, then WATCHDOG=1 and STATUS= regularly.

    `watchdog_ns`: systemd's watchdog timeout, 0 for none. Times in ns.
    """

    def __init__(self, notifier: SystemdNotifier, watchdog_ns: int, status: Callable[[], str]) -> None:
        self._notifier, self._status = notifier, status
        self._watchdog_period_ns = watchdog_ns // 3
        self._last_watchdog_ns = self._last_status_ns = 0
        self._sent_status = ""

    def notify_tick(self, now_ns: int) -> None:
        """Send the notifications that are due after a tick."""
        if self._watchdog_period_ns and now_ns - self._last_watchdog_ns >= self._watchdog_period_ns:
            self._last_watchdog_ns = now_ns
            self._notifier.send("WATCHDOG=1")
        if self._sent_status and now_ns - self._last_status_ns < _STATUS_PERIOD_NS:
            return
        self._last_status_ns = now_ns
        status = self._status()
        if status != self._sent_status:
            self._notifier.send(*([] if self._sent_status else ["READY=1"]), f"STATUS={status}")
            self._sent_status = status
