"""SIGINT and SIGTERM handling: stop a service, or interrupt a guided procedure at a safe point.

Public names: `stop_on_signals`, `InterruptGuard`.
"""

from __future__ import annotations

import signal
import threading

_SIGNALS = signal.SIGINT, signal.SIGTERM


def stop_on_signals() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    for number in _SIGNALS:
        signal.signal(number, lambda *_: stop.set())
    return stop


class InterruptGuard:
    """Record SIGINT and SIGTERM until `check` is called.

    A KeyboardInterrupt raised at an arbitrary point is occasionally lost inside C calls that ignore errors.
    """

    def __init__(self) -> None:
        self._received = False

    def __enter__(self) -> InterruptGuard:
        self._previous_handlers = {number: signal.signal(number, self._record_signal) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous_handlers.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self._received:
            raise KeyboardInterrupt

    def _record_signal(self, *_: object) -> None:
        self.check()
        self._received = True
