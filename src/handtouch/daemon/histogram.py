"""Durations in buckets of powers of two, and a clock that tells which part of the loop took the time.

Public names: `Histogram`, `StageClock`, `STAGES`.

Both only ever count up, so whoever reads them now and then loses nothing in between.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

UNIT_NS = 1024
"""Upper end of the first bucket; the k-th ends at UNIT_NS * 2**k."""
_BUCKETS = 64  # more than an int64 of nanoseconds can need, so that adding never has to look

STAGES = (
    *("sync", "wait", "receive", "tick", "send", "perceive", "settle", "supervise"),
    *("nodes", "report", "requests", "rehearse"),
)
"""Parts of a period, in their order: SYNC is sent; for the bus; frames; samples to contacts; messages; what
is felt above contacts; what makes the next tick quick; from and for the slow half; nodes and buses; health
and service; requests, subscriptions and handshakes; what has the next tick find its caches warm."""
(SYNC, WAIT, RECEIVE, TICK, SEND, PERCEIVE, SETTLE, SUPERVISE, NODES, REPORT, REQUESTS, REHEARSE) = range(
    len(STAGES)
)
MACHINE = "machine"
"""The name for time that no stage took: the machine let the loop wait longer than it asked to."""
_PARTS = (*STAGES, MACHINE)


class Histogram:
    """Counts of durations, by powers of two; to add one costs 0.2 us."""

    __slots__ = ("counts", "sum_ns")

    def __init__(self) -> None:
        self.counts = [0] * _BUCKETS
        self.sum_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count a duration in ns, at least 0."""
        self.counts[(duration_ns // UNIT_NS).bit_length()] += 1
        self.sum_ns += duration_ns

    def figures(self) -> dict[str, Any]:
        """`sum_s`, and `counts` up to the last bucket in use: the k-th below 1.024 us * 2**k."""
        used = max((k for k, count in enumerate(self.counts) if count), default=-1) + 1
        return {"sum_s": self.sum_ns * 1e-9, "counts": self.counts[:used]}


class StageClock:
    """Where the time of every period went, and which part of the loop made a tick late.

    The loop calls `lap` at the end of each part, `slept` after waiting, `begin` at each SYNC and `ticked`
    once messages are out. Times in ns. A tick is late when its messages leave more than a period after its
    SYNC, or not before the next one; a period without any tick counts too.

    `histograms`: stage -> time per period, and `latency`: from the last sample read to the last message out;
    `late`: name of the part that took longest -> late ticks.
    """

    def __init__(self, now_ns: int) -> None:
        self.histograms = {stage: Histogram() for stage in STAGES}
        self.latency = Histogram()
        self.late: Counter[str] = Counter()
        self._not_taken: dict[str, tuple[int, int]] = {}
        self._spent = [0] * len(_PARTS)
        self._before = self._spent
        self._adders = [histogram.add for histogram in self.histograms.values()]
        self._last_ns = now_ns
        self._skipped = 0
        self._is_late = False
        self._worst = MACHINE, 0

    def figures(self) -> dict[str, Any]:
        """All of it as plain values: `latency`, `stages` (name -> histogram), `late` (part -> ticks)."""
        return {
            "latency": self.latency.figures(),
            "stages": {stage: histogram.figures() for stage, histogram in self.histograms.items()},
            "late": dict(self.late),
        }

    def take_late(self) -> list[tuple[str, int, int]]:
        """Late ticks since the last call: part, how many, the longest that it took in ns; the worst first."""
        late = [(name, count, most_ns) for name, (count, most_ns) in self._not_taken.items()]
        self._not_taken = {}
        return sorted(late, key=lambda row: row[2], reverse=True)

    def start(self, now_ns: int) -> None:
        """The loop begins: what was before is nobody's time."""
        self._last_ns = now_ns

    def lap(self, stage: int, now_ns: int) -> None:
        """The time since the last call went into this stage."""
        self._spent[stage] += now_ns - self._last_ns
        self._last_ns = now_ns

    def slept(self, wake_ns: int, now_ns: int) -> None:
        """The loop waited, until `wake_ns` at the latest as it had asked."""
        self._spent[WAIT] += now_ns - self._last_ns
        self._last_ns = now_ns
        if now_ns > wake_ns:
            self._spent[-1] += now_ns - wake_ns

    def ticked(self, sync_ns: int, period_ns: int, from_ns: int, now_ns: int) -> None:
        """The tick of this SYNC is out; its last sample was read at `from_ns`."""
        self.latency.add(now_ns - from_ns)
        if now_ns - sync_ns > period_ns:
            self._is_late = True

    def begin(self, skipped: int, unticked: bool) -> None:
        """A SYNC: the period before it ends. `skipped` periods in all had none; `unticked`: nor a tick."""
        spent = self._spent
        for add, duration_ns in zip(self._adders, spent, strict=False):
            add(duration_ns)
        late = max(skipped - self._skipped, 1 if unticked or self._is_late else 0)
        if late:
            self._blame(late)
            self._skipped, self._is_late = skipped, False
        elif self._worst[1]:
            self._worst = MACHINE, 0
        self._before, self._spent = spent, [0] * len(_PARTS)

    def _blame(self, late: int) -> None:
        """Name what took longest, in this period or the one before, which SYNCs of the kernel may have ended.

        Several late ticks in a row have one cause.
        """
        for spent in (self._before, self._spent):
            busy = [0 if part == WAIT else spent_ns for part, spent_ns in enumerate(spent)]
            longest_ns = max(busy)
            if longest_ns > self._worst[1]:
                self._worst = _PARTS[busy.index(longest_ns)], longest_ns
        name, took_ns = self._worst
        self.late[name] += late
        count, most_ns = self._not_taken.get(name, (0, 0))
        self._not_taken[name] = count + late, max(most_ns, took_ns)
