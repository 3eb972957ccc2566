"""The percept process' worker in this process, so that a run is repeatable and as fast as it can be.

Public name: `InlineProcess`.
"""

from __future__ import annotations

from handtouch.config import Deployment
from handtouch.daemon.child_process import ChildProcess
from handtouch.percept.messages import pack_message, unpack_input
from handtouch.percept.worker import PerceptWorker


class InlineProcess(ChildProcess):
    """Exchanges the same messages as the process, which it never starts."""

    def __init__(self, deployment: Deployment) -> None:
        super().__init__("", "percept", lambda: b"")
        self.worker = PerceptWorker(deployment)
        self.waiting: list[bytes] = []

    @property
    def pid(self) -> int | None:
        """Any number while it is enabled."""
        return 1 if self.enabled else None

    def start(self, now_ns: int) -> None:  # noqa: ARG002
        """Enable it."""
        self.enabled = True

    def poll(self, now_ns: int) -> bool:  # noqa: ARG002
        """Return False: there is nothing to start."""
        return False

    def send(self, message: bytes) -> bool:
        """Process a message at once."""
        self.waiting += map(pack_message, self.worker.process_input(unpack_input(message)))
        return True

    def receive(self, now_ns: int, max_messages: int = 8) -> list[bytes]:  # noqa: ARG002
        """Return what the worker has sent."""
        received, self.waiting = self.waiting[:max_messages], self.waiting[max_messages:]
        return received
