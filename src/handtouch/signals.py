"""What SIGINT and SIGTERM do: end a service, or wait until a session asks for them.

Public names: `stop_on_signals`, `Interrupts`.
"""

from __future__ import annotations

import signal
import threading

_NUMBERS = signal.SIGINT, signal.SIGTERM


def stop_on_signals() -> threading.Event:
    """Set once somebody wants this process to end."""
    stop = threading.Event()
    for number in _NUMBERS:
        signal.signal(number, lambda *_: stop.set())
    return stop


class Interrupts:
    """SIGINT and SIGTERM, kept until somebody asks: an exception out of nowhere is lost now and then, in
    calls from C whose errors nobody reads."""

    def __init__(self) -> None:
        self._came = False

    def __enter__(self) -> Interrupts:
        self._before = {number: signal.signal(number, self._take) for number in _NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if one came."""
        if self._came:
            raise KeyboardInterrupt

    def _take(self, *_: object) -> None:
        self.check()
        self._came = True
