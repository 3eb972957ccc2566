"""SYNC on all buses: produced by the kernel or by the loop, or followed; its jitter; somebody else's SYNC.

One SYNC time serves all buses. Where the kernel has a cyclic sender (SocketCAN) it sends, and the SYNC of
the first such bus, looped back with its stamp, begins the cycle; the loop sends on the others when it
sees that one. Without such a sender, or when its SYNC stays away, the loop's timer takes its place.

Public names: `Sync`, `Jitter`, `summary_us`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bus_state import Condition
from .port import Port
from .receivers import CyclicSender
from .router import SYNC_ID

_log = logging.getLogger("handtouch.sync")

_SECOND_NS = 1_000_000_000
_LATE = 1.5  # periods after which a cycle begins without the SYNC that should have come
_AWAY = 3.0  # periods after which the loop takes over from the kernel
_SOONEST = 0.25  # of a period; SYNCs that are closer are one cycle's, lest a flood of them be one of ticks
_RETRY_NS = 5 * _SECOND_NS  # until the kernel is tried again
_TOLERANCE = 2  # SYNCs in a window beyond what its length gives: one at either end
_MOST_INTERVALS = 4096  # in a second
_ANOTHER = 'another SYNC producer is on this bus: set sync = "consumer" to follow it, or switch it off'


class Jitter:
    """How far the intervals from SYNC to SYNC are from the period, over the last second."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._count = 0
        self._at_ns: NDArray[np.int64] = np.full(_MOST_INTERVALS, np.iinfo(np.int64).min)
        self._off_ns: NDArray[np.int64] = np.zeros(_MOST_INTERVALS, dtype=np.int64)

    def add(self, t_ns: int, period_ns: int) -> None:
        """A SYNC at this time."""
        if self._last_ns is not None:
            row = self._count % _MOST_INTERVALS
            self._at_ns[row], self._off_ns[row] = t_ns, abs(t_ns - self._last_ns - period_ns)
            self._count += 1
        self._last_ns = t_ns

    def skip(self) -> None:
        """The next interval tells nothing: the period has changed, or the sender."""
        self._last_ns = None

    def figures(self, now_ns: int) -> dict[str, float]:
        """`p50`, `p99` and `max` in microseconds; empty without two SYNCs within the last second."""
        return summary_us(self._off_ns[self._at_ns >= now_ns - _SECOND_NS])


def summary_us(durations_ns: NDArray[np.int64]) -> dict[str, float]:
    """`p50`, `p99` and `max` of durations, microseconds; empty of none. A tenth of `percentile`'s cost."""
    if not len(durations_ns):
        return {}
    last = len(durations_ns) - 1
    ranks = last // 2, round(0.99 * last), last
    found = np.partition(durations_ns, ranks)[list(ranks)] * 1e-3
    return dict(zip(("p50", "p99", "max"), found.tolist(), strict=True))


class Sync:
    """SYNC of a deployment's buses: `start`, `poll` when `wake_ns` has come, tell it what was `seen`, `stop`.

    Buses with sync = "producer", unless we only listen there, are driven; if there are none, the first bus's
    SYNC is followed. Times in ns of the host's monotonic clock. `overruns` counts the periods that passed
    without a SYNC because the loop was late.
    """

    def __init__(self, ports: Sequence[Port], period_ns: int) -> None:
        self.period_ns = period_ns
        self.overruns = 0
        self._buses = {port.name: _SyncBus(port) for port in ports}
        self._produced = [bus for bus in self._buses.values() if bus.ours]
        self._clock: _SyncBus | None = None  # whose SYNC begins the cycle; None: the loop's timer
        self._due_ns = self._begun_ns = 0
        self._has_looked = False  # for a late SYNC among what has been received

    def start(self, now_ns: int) -> None:
        """The first SYNC is due now, at the next `poll`."""
        for bus in self._produced:
            bus.open_window(now_ns)
        self._choose_clock()
        self._due_ns = now_ns

    def stop(self) -> None:
        """Nobody sends SYNC for us any more."""
        for bus in self._produced:
            bus.halt()
        self._choose_clock()

    @property
    def wake_ns(self) -> int:
        """When to `poll` at the latest."""
        return self._due_ns

    def set_period(self, period_ns: int, now_ns: int) -> None:
        """Change the period. The kernel sends a SYNC at once, the loop as soon as the new period is over."""
        if period_ns == self.period_ns:
            return
        self.period_ns = period_ns
        for bus in self._buses.values():
            bus.jitter.skip()
        for bus in self._produced:
            if not bus.set_period(period_ns, now_ns):
                self._take_over(bus, now_ns)
        self._due_ns = max(now_ns, self._next_due_ns(self._begun_ns))

    def poll(self, now_ns: int) -> int | None:
        """Send what is due; the time of a cycle that begins now, be its SYNC ours or one that is late."""
        if now_ns < self._due_ns:
            return None
        if self._clock is not None and not self._has_looked:
            self._has_looked = True  # after a pause of the loop the SYNC may be waiting to be received
            self._due_ns = now_ns
            return None
        for bus in self._produced:
            if bus.sender is not None and now_ns - bus.last_ns > _AWAY * self.period_ns:
                self._take_over(bus, now_ns)
        if self._clock is None:
            late = (now_ns - self._due_ns) // self.period_ns
            self.overruns += late
            self._begin(now_ns, self._due_ns + late * self.period_ns)
        else:
            self._begin(now_ns, now_ns)
        return now_ns

    def seen(self, bus_name: str, t_ns: int, now_ns: int) -> int | None:
        """A SYNC was received, with this stamp; its time if it begins a cycle."""
        bus = self._buses[bus_name]
        bus.received += 1
        if not bus.ours or bus.sender is not None:
            bus.last_ns = t_ns
            bus.jitter.add(t_ns, self.period_ns)
        if bus is not self._clock or t_ns - self._begun_ns < _SOONEST * self.period_ns:
            return None
        self._begin(now_ns, t_ns)
        return t_ns

    def figures(self, bus_name: str, now_ns: int) -> dict[str, Any]:
        """SYNC on a bus: sent by whom, jitter, how many were another producer's, what is wrong with it."""
        bus = self._buses[bus_name]
        return {
            "by": "another" if not bus.ours else "loop" if bus.sender is None else "kernel",
            "jitter_us": bus.jitter.figures(now_ns),
            "others": bus.others,
            "problem": bus.problem,
        }

    def _begin(self, now_ns: int, t_ns: int) -> None:
        """A cycle begins: SYNC by the loop wherever the kernel doesn't send it."""
        for bus in self._produced:
            if bus.sender is None:
                bus.send(now_ns, self.period_ns)
        for bus in self._produced:
            bus.judge(now_ns, self.period_ns)
        self._choose_clock()
        self._has_looked = False
        self._begun_ns = t_ns
        self._due_ns = self._next_due_ns(t_ns)

    def _next_due_ns(self, begun_ns: int) -> int:
        return begun_ns + round(self.period_ns * (1.0 if self._clock is None else _LATE))

    def _choose_clock(self) -> None:
        if self._produced:
            self._clock = next((bus for bus in self._produced if bus.sender is not None), None)
        else:
            self._clock = next(iter(self._buses.values()), None)

    def _take_over(self, bus: _SyncBus, now_ns: int) -> None:
        bus.halt()
        bus.retry_ns = now_ns + _RETRY_NS
        bus.open_window(now_ns, _TOLERANCE)
        bus.problem = "the kernel's SYNC stays away; the loop sends it, and tries the kernel again"
        _log.warning("bus %s: %s", bus.port.name, bus.problem)
        self._choose_clock()


class _SyncBus:
    """SYNC of one bus; `sender` is the kernel's, None where the loop or somebody else sends."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self.ours = port.bus.sync == "producer" and port.bus.role != "listener"
        self.sender: CyclicSender | None = None
        self.jitter = Jitter()
        self.last_ns = 0  # SYNC sent by us or seen
        self.retry_ns = 0
        self.received = self.others = 0
        self.problem = ""
        self._window_ns = self._sent = 0

    def send(self, now_ns: int, period_ns: int) -> None:
        """Send SYNC now, by the kernel, which then goes on by itself, if it is time to try that."""
        port, self.last_ns = self.port, now_ns
        self.jitter.add(now_ns, period_ns)
        if now_ns >= self.retry_ns:
            self.retry_ns = now_ns + _RETRY_NS
            if port.state.condition not in (Condition.DOWN, Condition.BUS_OFF):
                self.sender = port.send_cyclically(SYNC_ID, b"", period_ns * 1e-9)
                if self.sender is not None:
                    self.jitter.skip()
                    self.open_window(now_ns, self._sent)
                    return
        if port.send(SYNC_ID, b""):
            self._sent += 1

    def set_period(self, period_ns: int, now_ns: int) -> bool:
        """False if the kernel refuses."""
        self.open_window(now_ns, _TOLERANCE)
        if self.sender is None:
            return True
        try:
            self.sender.set_period(period_ns * 1e-9)
        except Exception:  # noqa: BLE001 - drivers raise anything; the loop takes over
            return False
        return True

    def halt(self) -> None:
        """The kernel sends no more."""
        sender, self.sender = self.sender, None
        self.jitter.skip()
        if sender is not None:
            try:
                sender.stop()
            except Exception as error:  # noqa: BLE001 - the interface may be gone, and the task with it
                _log.info("bus %s: the kernel's SYNC can't be stopped: %s", self.port.name, error)

    def open_window(self, now_ns: int, allowed: int = 0) -> None:
        """Count SYNCs from here; so many that were sent before may still come."""
        self._window_ns, self._sent, self.received = now_ns, 0, -allowed

    def judge(self, now_ns: int, period_ns: int) -> None:
        """Once a second: did more SYNCs come than there can be of ours?"""
        passed_ns = now_ns - self._window_ns
        if passed_ns < max(_SECOND_NS, 2 * period_ns):
            return
        ours = 0
        if self.sender is not None:
            ours = passed_ns // period_ns + _TOLERANCE
        elif self.port.echoes:
            ours = self._sent + _TOLERANCE
        others = max(0, self.received - ours)
        self.others += others
        if others and self.problem != _ANOTHER:
            _log.warning("bus %s: %s", self.port.name, _ANOTHER)
        if others or self.sender is not None or self.problem == _ANOTHER:
            self.problem = _ANOTHER if others else ""
        self.open_window(now_ns)
