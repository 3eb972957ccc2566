"""When to tick: once per SYNC, as soon as every expected sample is there, or when its window has passed.

The same rules serve a live bus and a recorded one: time comes in as an argument, from the clock or the log.
"""

from __future__ import annotations

_FOREVER_NS = 1 << 62
_SMOOTHING = 8  # cycles


class Cycle:
    """One SYNC period after another; `t_ns` is the present one's SYNC, `previous_ns` the one before.

    Between two `begin`s exactly one tick falls due. Without a SYNC (none sent on this bus, or a producer
    that died) `overdue_ns` says when to go on by the timer, so that silence is noticed too.
    """

    def __init__(self, period_ns: int, window: float) -> None:
        self.period_ns = period_ns
        self.window_ns = round(period_ns * window)
        self.t_ns = self.previous_ns = 0
        self.ticked = True

    def begin(self, t_ns: int) -> None:
        """A SYNC was sent or seen."""
        self.previous_ns, self.t_ns = self.t_ns, t_ns
        self.ticked = False

    def tick_due(self, t_ns: int, complete: bool) -> bool:
        """Whether to tick now; `complete` says that every expected sample has arrived."""
        return not self.ticked and (complete or t_ns - self.t_ns >= self.window_ns)

    @property
    def overdue_ns(self) -> int:
        """When a foreign SYNC is so late that the timer has to take its place."""
        return self.t_ns + self.period_ns + self.period_ns // 2


class BusyPoll:
    """When to wait for samples awake, which spares the wake-up: around the time the last one usually comes.

    `busy_ns`: for how long before that time, and after it where the last one is late; 0: never. Times in ns.
    """

    def __init__(self, busy_ns: int) -> None:
        self._busy_ns = busy_ns
        self._usual_ns = 0  # from SYNC to its last sample

    def ticked(self, sync_ns: int, last_ns: int) -> None:
        """The tick of this SYNC was, and the last sample had arrived at `last_ns`; before, if none came.

        When the tick was tells nothing: who sleeps is late, and would learn to sleep so long.
        """
        if last_ns > sync_ns:
            self._usual_ns += (last_ns - sync_ns - self._usual_ns) // _SMOOTHING

    def expected_ns(self, sync_ns: int) -> int:
        """When the last sample of this SYNC is likely to come."""
        return sync_ns + self._usual_ns

    def sleep_ns(self, sync_ns: int, now_ns: int) -> int:
        """How long to sleep at most while samples of this SYNC are missing."""
        left_ns = sync_ns + self._usual_ns - now_ns
        if not self._busy_ns or left_ns <= -self._busy_ns:
            return _FOREVER_NS
        return max(0, left_ns - self._busy_ns)
