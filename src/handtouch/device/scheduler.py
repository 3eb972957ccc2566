"""Jobs of a simulated bus in the order of their due times, and the bus as its devices see it."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Protocol

import can

ScheduledJob = Callable[[int, int], int | None]
"""(due time, present time) [ns] -> next due time, None for never."""


class DeviceHost(Protocol):
    """Bus of a device: its lock, time, samples and transmission."""

    @property
    def lock(self) -> AbstractContextManager[bool]: ...

    @property
    def now_ns(self) -> int: ...

    @property
    def sample_count(self) -> int: ...

    def schedule(self, due_ns: int, job: ScheduledJob) -> None: ...

    def mark_changed(self) -> None: ...

    def electrode_counts(self, row: int) -> list[int]: ...

    def transmit(self, message: can.Message) -> None: ...


class JobGroup:
    """Jobs of a bus that `stop` voids."""

    def __init__(self, bus: DeviceHost) -> None:
        self._bus, self._stops = bus, 0

    def schedule(self, due_ns: int, job: ScheduledJob) -> None:
        """Add a job."""
        self._bus.schedule(due_ns, partial(self._run, self._stops, job))

    def stop(self) -> None:
        """Void the jobs added so far."""
        self._stops += 1

    def _run(self, stops: int, job: ScheduledJob, due_ns: int, now_ns: int) -> int | None:
        return job(due_ns, now_ns) if stops == self._stops else None


class Scheduler:
    """Queue of jobs by due time."""

    def __init__(self) -> None:
        self._jobs: list[tuple[int, int, ScheduledJob]] = []
        self._numbers = itertools.count()

    @property
    def next_ns(self) -> int | None:
        """Due time of the next job, None without jobs."""
        return self._jobs[0][0] if self._jobs else None

    def schedule(self, due_ns: int, job: ScheduledJob) -> None:
        """Add a job; jobs with the same due time run in the order of their addition."""
        heapq.heappush(self._jobs, (due_ns, next(self._numbers), job))

    def run_due(self, now_ns: int) -> None:
        """Run the jobs that are due at `now_ns`."""
        while self._jobs and self._jobs[0][0] <= now_ns:
            due_ns, _, job = heapq.heappop(self._jobs)
            again_ns = job(due_ns, now_ns)
            if again_ns is not None:
                self.schedule(again_ns, job)
