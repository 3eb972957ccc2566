"""How many new connections a second an endpoint takes; beyond that, requests to connect are dropped.

Public name: `ConnectionLimit`.

ZeroMQ needs 25 us for each connection that a client opens and breaks off, in a thread beside the hot one. The
kernel drops requests at random before ZeroMQ sees them: half of them first, which is enough for a client that
opens one after another, as it waits a second for each that is lost.
"""

from __future__ import annotations

from collections.abc import Callable

MAX_BURST = 500
"""Connections at once: 100 clients with all endpoints each connect again after the daemon was restarted"""
MAX_PER_S = 50.0
"""Connections per second, continuously"""
_EXCESS_PER_HALVING = 50
_MAX_HALVINGS = 8
_SETTLING_NS = 100_000_000
"""Time after a change in which connections from before it are still reported"""
_HELD_NS = 10_000_000_000


class ConnectionLimit:
    """Sets the share of requests to connect that an endpoint takes, by the rate of its connections.

    `set_halvings(n)` makes the kernel let one request of 2^n through; `halvings` is the present n. It grows
    while connections come faster than allowed, and falls by one in 10 s when they don't.
    """

    def __init__(self, set_halvings: Callable[[int], bool]) -> None:
        self.halvings = 0
        self._set_halvings = set_halvings
        self._excess = 0.0
        self._since_ns = self._changed_ns = 0

    def count(self, connections: int, now_ns: int) -> None:
        """Count the new connections since the last call; call it without any, too."""
        elapsed_s, self._since_ns = (now_ns - self._since_ns) * 1e-9, now_ns
        if self.halvings and now_ns - self._changed_ns < _SETTLING_NS:
            return
        self._excess = max(0.0, self._excess - elapsed_s * MAX_PER_S) + connections
        if self._excess > MAX_BURST and self.halvings < _MAX_HALVINGS:
            self._excess = MAX_BURST - _EXCESS_PER_HALVING
            self._change(self.halvings + 1, now_ns)
        elif self.halvings and now_ns - self._changed_ns >= _HELD_NS:
            self._change(self.halvings - 1, now_ns)

    def _change(self, halvings: int, now_ns: int) -> None:
        self._changed_ns = now_ns
        if self._set_halvings(halvings):
            self.halvings = halvings
