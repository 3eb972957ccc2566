"""Timing of ticks: one per SYNC, when every expected sample has arrived or the sample window has passed.

Time is an argument, from the clock or from a recording.
"""

from __future__ import annotations

_NO_LIMIT_NS = 1 << 62
_SMOOTHING_CYCLES = 8


class Cycle:
    """The present SYNC period: `sync_ns` is its SYNC, `previous_sync_ns` the one before.

    Exactly one tick falls due between two calls of `begin_cycle`. Without a SYNC (none on this bus, or a dead
    producer) the timer takes over at `sync_overdue_ns`, so that silence is detected too.
    """

    def __init__(self, period_ns: int, window: float) -> None:
        self.period_ns = period_ns
        self.window_ns = round(period_ns * window)
        self.sync_ns = self.previous_sync_ns = 0
        self.ticked = True

    def begin_cycle(self, sync_ns: int) -> None:
        """Begin a cycle at a SYNC, sent or received."""
        self.previous_sync_ns, self.sync_ns = self.sync_ns, sync_ns
        self.ticked = False

    def is_tick_due(self, now_ns: int, complete: bool) -> bool:
        """Return True when the tick is due; `complete`: every expected sample has arrived."""
        return not self.ticked and (complete or now_ns - self.sync_ns >= self.window_ns)

    @property
    def sync_overdue_ns(self) -> int:
        """Time at which the timer replaces a missing SYNC of another producer."""
        return self.sync_ns + self.period_ns + self.period_ns // 2


class BusyPoll:
    """Busy waiting around the usual arrival of the last sample, which saves the wake-up latency.

    `busy_ns`: busy time before the usual arrival, and after it if the sample is late; 0: never. Times in ns.
    """

    def __init__(self, busy_ns: int) -> None:
        self._busy_ns = busy_ns
        self._usual_latency_ns = 0  # from SYNC to its last sample

    def update_usual_latency(self, sync_ns: int, last_ns: int) -> None:
        """Update the usual latency after a tick; `last_ns`: arrival of its last sample, before `sync_ns` if
        none came.

        Arrival stamps, not the time of the tick: that includes oversleeping, which would reinforce itself.
        """
        if last_ns > sync_ns:
            self._usual_latency_ns += (last_ns - sync_ns - self._usual_latency_ns) // _SMOOTHING_CYCLES

    def max_sleep_ns(self, sync_ns: int, now_ns: int) -> int:
        """Return the longest permitted sleep while samples of this SYNC are missing."""
        left_ns = sync_ns + self._usual_latency_ns - now_ns
        if not self._busy_ns or left_ns <= -self._busy_ns:
            return _NO_LIMIT_NS
        return max(0, left_ns - self._busy_ns)
