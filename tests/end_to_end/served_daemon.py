"""A daemon in the test's own process, and the messages that it has published."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from handtouch import wire
from handtouch.client import connect
from handtouch.daemon.daemon import HandtouchDaemon

MAX_WAIT_S = 90.0
"""Upper limit of every wait."""


class ServedDaemon:
    """A running daemon; `listen` collects its messages of some topics, in the order of arrival."""

    def __init__(self, daemon: HandtouchDaemon, *topics: str) -> None:
        self.daemon = daemon
        self.contacts: list[wire.Contact] = []
        self.health: list[wire.Health] = []
        self.percepts: list[wire.Percept] = []
        self.malformed = 0
        self._topics = topics or ("contact/*/*", "health/*/*")

    def listen(self, stop: threading.Event) -> None:
        endpoint = self.daemon.publisher.endpoints["complete"]
        with connect(*self._topics, endpoint=endpoint, key="", queue=100_000) as messages:
            while not stop.is_set():
                message = messages.recv(0.1)
                if isinstance(message, wire.Contact):
                    self.contacts.append(message)
                elif isinstance(message, wire.Health):
                    self.health.append(message)
                elif isinstance(message, wire.Percept):
                    self.percepts.append(message)
                self.malformed = messages.malformed_messages

    def wait(self, what: str, met: Callable[[], Any]) -> Any:
        """Wait until a function returns something true, and return that."""
        end_s = time.monotonic() + MAX_WAIT_S
        while not (found := met()):
            assert time.monotonic() < end_s, (
                f"never {what}: {self.daemon.reporter.status(time.monotonic_ns())}"
            )
            time.sleep(0.02)
        return found
