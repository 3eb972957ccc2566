"""Busy waiting for samples, timed by when those of earlier ticks arrived. Time is an argument.

Public name: `BusyPoll`.
"""

from __future__ import annotations

_NO_LIMIT_NS = 1 << 62
_SMOOTHING_CYCLES = 8


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
