"""Access to a CAN bus from one thread: send, and wait for the next frame.

Public names: `Line`, a protocol; `PortLine`, a real bus in real time.
"""

from __future__ import annotations

import select
import time
from collections import deque
from typing import Protocol

from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import CanFrame


class Line(Protocol):
    """A bus and its time [ns]."""

    @property
    def echoes(self) -> bool:
        """Sent frames are received, too."""

    def now_ns(self) -> int:
        """Return the present time."""

    def send(self, can_id: int, data: bytes = b"", remote: bool = False) -> None:
        """Send a frame."""

    def receive(self, until_ns: int) -> CanFrame | None:
        """Return the next frame, None if none arrives before `until_ns`."""


class PortLine:
    """A real bus; frames carry their arrival stamps."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self._frames: deque[CanFrame] = deque()

    @property
    def echoes(self) -> bool:
        """Sent frames are received, too."""
        return self.port.echoes

    def now_ns(self) -> int:
        """Return the host's monotonic time."""
        return time.monotonic_ns()

    def send(self, can_id: int, data: bytes = b"", remote: bool = False) -> None:
        """Send a frame; retried while the transmit queue is full."""
        self.port.send_patiently(can_id, data, remote)

    def receive(self, until_ns: int) -> CanFrame | None:
        """Wait for the next frame."""
        while not self._frames:
            self._frames.extend(self.port.drain())
            if self._frames:
                break
            left_s = (until_ns - time.monotonic_ns()) * 1e-9
            if left_s <= 0:
                return None
            select.select([self.port.fileno()], [], [], left_s)
        return self._frames.popleft()
