"""Histograms of durations, and a timer that attributes each period's time to the stages of the loop.

Public names: `Histogram`, `StageTimer`, `STAGES`.

Both only count up, so reading them at intervals loses nothing.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

FIRST_BUCKET_NS = 1024
"""Upper end of the first bucket; the k-th ends at FIRST_BUCKET_NS * 2**k."""
_BUCKET_COUNT = 64  # enough for any int64 of nanoseconds, so that adding needs no check

STAGES = (
    "sync",
    "wait",
    "receive",
    "tick",
    "send",
    "percepts",
    "settle",
    "supervise",
    "nodes",
    "report",
    "requests",
)
"""Stages of a period, in order: send SYNC; wait for the bus; receive frames; compute contacts; send messages;
compute percepts; prepare the next tick; exchange data with the supervisor process; poll nodes and buses;
publish health and service; handle requests, subscriptions and handshakes."""
(SYNC, WAIT, RECEIVE, TICK, SEND, PERCEIVE, SETTLE, SUPERVISE, NODES, REPORT, REQUESTS) = range(len(STAGES))
WAKE_UP_DELAY = "wake_up_delay"
"""Name for time spent in no stage: the operating system woke the loop later than requested."""
_PARTS = (*STAGES, WAKE_UP_DELAY)


class Histogram:
    """Counts of durations in buckets of powers of two; adding one costs 0.2 us."""

    __slots__ = ("counts", "sum_ns")

    def __init__(self) -> None:
        self.counts = [0] * _BUCKET_COUNT
        self.sum_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count a duration in ns, at least 0."""
        self.counts[(duration_ns // FIRST_BUCKET_NS).bit_length()] += 1
        self.sum_ns += duration_ns

    def statistics(self) -> dict[str, Any]:
        """Return `sum_s`, and `counts` up to the last bucket in use: the k-th ends at 1.024 us * 2**k."""
        used = _BUCKET_COUNT
        while used and not self.counts[used - 1]:
            used -= 1
        return {"sum_s": self.sum_ns * 1e-9, "counts": self.counts[:used]}


class StageTimer:
    """Measures the time of each stage in every period, and which stage caused a late tick.

    The loop calls `lap` at the end of each part, `record_wait` after waiting, `begin_period` at each SYNC and
    `record_tick` once messages are out. Times in ns. A tick is late when its messages leave more than a
    period after its SYNC, or not before the next one; a period without any tick counts too.

    `histograms`: stage -> time per period, and `latency`: from the last sample read to the last message out;
    `late_ticks`: name of the longest part -> late ticks.
    """

    def __init__(self, now_ns: int) -> None:
        self.histograms = {stage: Histogram() for stage in STAGES}
        self.latency = Histogram()
        self.late_ticks: Counter[str] = Counter()
        self._unreported_late: dict[str, tuple[int, int]] = {}
        self._spent_ns = [0] * len(_PARTS)
        self._previous_spent_ns = self._spent_ns
        self._adders = [histogram.add for histogram in self.histograms.values()]
        self._last_ns = now_ns
        self._skipped_periods = 0
        self._is_late = False
        self._longest_part = WAKE_UP_DELAY, 0

    def statistics(self) -> dict[str, Any]:
        """Return plain values: `latency`, `stages` (name -> histogram), `late_ticks` (part -> ticks)."""
        return {
            "latency": self.latency.statistics(),
            "stages": {stage: histogram.statistics() for stage, histogram in self.histograms.items()},
            "late": dict(self.late_ticks),
        }

    def take_late_ticks(self) -> list[tuple[str, int, int]]:
        """Return late ticks since the last call: part, number, its longest time in ns; the worst first."""
        late = [(name, count, max_ns) for name, (count, max_ns) in self._unreported_late.items()]
        self._unreported_late = {}
        return sorted(late, key=lambda row: row[2], reverse=True)

    def start(self, now_ns: int) -> None:
        """Start timing: the loop begins."""
        self._last_ns = now_ns

    def lap(self, stage: int, now_ns: int) -> None:
        """Add the time since the last call to a stage."""
        self._spent_ns[stage] += now_ns - self._last_ns
        self._last_ns = now_ns

    def record_wait(self, wake_ns: int, now_ns: int) -> None:
        """Record the end of a wait that was to last until `wake_ns`; a later end counts as wake-up delay."""
        self._spent_ns[WAIT] += now_ns - self._last_ns
        self._last_ns = now_ns
        if now_ns > wake_ns:
            self._spent_ns[-1] += now_ns - wake_ns

    def record_tick(self, sync_ns: int, period_ns: int, from_ns: int, now_ns: int) -> None:
        """Record a tick whose messages are sent; its last sample was read at `from_ns`."""
        self.latency.add(now_ns - from_ns)
        if now_ns - sync_ns > period_ns:
            self._is_late = True

    def begin_period(self, skipped: int, unticked: bool) -> None:
        """End a period at a SYNC. `skipped`: periods without SYNC so far; `unticked`: no tick in this one."""
        spent = self._spent_ns
        for add, duration_ns in zip(self._adders, spent, strict=False):
            add(duration_ns)
        late = max(skipped - self._skipped_periods, 1 if unticked or self._is_late else 0)
        if late:
            self._attribute_late_ticks(late)
            self._skipped_periods, self._is_late = skipped, False
        elif self._longest_part[1]:
            self._longest_part = WAKE_UP_DELAY, 0
        self._previous_spent_ns, self._spent_ns = spent, [0] * len(_PARTS)

    def _attribute_late_ticks(self, late: int) -> None:
        """Attribute late ticks to the longest part of this period or the one before.

        A kernel SYNC may end a period before its tick. Consecutive late ticks have one cause.
        """
        for spent in (self._previous_spent_ns, self._spent_ns):
            busy = [0 if part == WAIT else spent_ns for part, spent_ns in enumerate(spent)]
            longest_ns = max(busy)
            if longest_ns > self._longest_part[1]:
                self._longest_part = _PARTS[busy.index(longest_ns)], longest_ns
        name, took_ns = self._longest_part
        self.late_ticks[name] += late
        count, max_ns = self._unreported_late.get(name, (0, 0))
        self._unreported_late[name] = count + late, max(max_ns, took_ns)
