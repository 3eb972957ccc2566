"""A thread that calls a function for what a connection receives.

Public names: `Listener`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, Self, TypeVar

T = TypeVar("T")
_POLL_S = 0.05
"""Longest time until `close` is noticed"""
_log = logging.getLogger("handtouch.client")


class Listener(Generic[T]):
    """Calls a function in a thread until `close`, or until the function raises.

    What it raises is logged at once, kept in `error`, and raised again by `close`. `receive` takes a timeout
    [s] and returns None after it; `disconnect` is called in the same thread at the end.
    """

    def __init__(
        self,
        receive: Callable[[float], T | None],
        disconnect: Callable[[], None],
        callback: Callable[[T], object],
        name: str,
    ) -> None:
        self.error: Exception | None = None
        self._receive, self._disconnect, self._callback = receive, disconnect, callback
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """True until it is closed or has failed."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the thread; raise what the function raised. From the function itself: without waiting."""
        self._closed.set()
        if threading.current_thread() is self._thread:
            return
        self._thread.join()
        if self.error is not None:
            error, self.error = self.error, None
            raise error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                if (received := self._receive(_POLL_S)) is not None:
                    self._callback(received)
        except Exception as error:  # noqa: BLE001 - the caller gets it from `close`
            _log.exception("%s failed; it is called no more", self._thread.name)
            self.error = error
        finally:
            self._disconnect()
