"""A thread that calls a function for what a connection receives.

Public names: `Listener`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from handtouch.host.closing import Closing

T = TypeVar("T")
_POLL_S = 0.02
"""Longest time until `close` or the loss of the daemon is noticed"""
_log = logging.getLogger("handtouch.client")


class Listener(Closing, Generic[T]):
    """Calls a function in a thread until `close`, or until the function raises.

    What it raises is logged at once, kept in `error`, and raised again by `close`. `receive` takes a timeout
    [s] and returns None after it; `disconnect` is called in the same thread at the end. `is_lost` says
    whether the daemon is gone, which is logged, and `on_lost` called, once each time.
    """

    def __init__(
        self,
        receive: Callable[[float], T | None],
        disconnect: Callable[[], None],
        callback: Callable[[T], object],
        name: str,
        is_lost: Callable[[], bool] = lambda: False,
        on_lost: Callable[[], object] | None = None,
    ) -> None:
        self.error: Exception | None = None
        self._receive, self._disconnect, self._callback = receive, disconnect, callback
        self._is_lost, self._on_lost = is_lost, on_lost
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

    def _run(self) -> None:
        try:
            told = False
            while not self._closed.is_set():
                if (received := self._receive(_POLL_S)) is not None:
                    told = False
                    self._callback(received)
                elif not told and self._is_lost():
                    told = True
                    _log.warning("%s: the daemon is gone; called again once it is back", self._thread.name)
                    if self._on_lost is not None:
                        self._on_lost()
        except Exception as error:  # noqa: BLE001 - the caller gets it from `close`
            _log.exception("%s failed; it is called no more", self._thread.name)
            self.error = error
        finally:
            self._disconnect()
