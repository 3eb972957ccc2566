"""What is to be done later, in the order of its time."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

Job = Callable[[int, int], int | None]
"""(when it was due, what time it is) [ns] -> when it is due again, None for never."""


class Agenda:
    """Jobs by their time; `run` does those that are due."""

    def __init__(self) -> None:
        self._jobs: list[tuple[int, int, Job]] = []
        self._numbers = itertools.count()

    @property
    def next_ns(self) -> int | None:
        """When the next job is due."""
        return self._jobs[0][0] if self._jobs else None

    def at(self, due_ns: int, job: Job) -> None:
        """Do `job` at `due_ns`; of two at one time the first that was put down comes first."""
        heapq.heappush(self._jobs, (due_ns, next(self._numbers), job))

    def run(self, t_ns: int) -> None:
        """Do what is due at `t_ns`."""
        while self._jobs and self._jobs[0][0] <= t_ns:
            due_ns, _, job = heapq.heappop(self._jobs)
            again_ns = job(due_ns, t_ns)
            if again_ns is not None:
                self.at(again_ns, job)
