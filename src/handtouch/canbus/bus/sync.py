"""SYNC of a deployment's buses: production by the kernel or the loop, consumption, jitter.

All buses share one SYNC time. Where the kernel has a cyclic sender (SocketCAN), it sends SYNC, and the SYNC
of the first such bus, looped back with its receive stamp, begins the cycle; the loop sends SYNC on the other
buses when it receives that one. Without a cyclic sender, or when its SYNC is missing, the loop's timer
replaces it.

Public names: `Sync`, `SyncJitter`, `percentiles_us`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus import cia301
from handtouch.canbus.bus.bus_state import ErrorState
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.receivers import CyclicSender

_log = logging.getLogger("handtouch.sync")

_SECOND_NS = 1_000_000_000
_LATE_SYNC_PERIODS = 1.5
"""Periods after which a cycle begins without its SYNC."""
_MAX_MISSING_SYNC_PERIODS = 3.0
"""Periods without a SYNC of the kernel after which the loop sends it."""
_MIN_CYCLE_PERIODS = 0.25
"""Shortest cycle; SYNCs that follow sooner belong to the same cycle, so that a flood of SYNCs causes no flood
of ticks.
"""
_MAX_CYCLES_PER_POLL = 2
_KERNEL_RETRY_NS = 5 * _SECOND_NS
_WINDOW_TOLERANCE_SYNCS = 2  # more SYNCs than a window's length allows: one at either end
_MAX_INTERVALS = 4096  # a second
_OTHER_PRODUCER_PROBLEM = (
    'another SYNC producer is on this bus; set sync = "consumer" to follow it, or switch it off'
)


class SyncJitter:
    """Deviations of the SYNC intervals from the period over the last second."""

    def __init__(self) -> None:
        self._last_sync_ns: int | None = None
        self._count = 0
        self._sync_ns: NDArray[np.int64] = np.full(_MAX_INTERVALS, np.iinfo(np.int64).min)
        self._deviation_ns: NDArray[np.int64] = np.zeros(_MAX_INTERVALS, dtype=np.int64)

    def add_sync(self, sync_ns: int, period_ns: int) -> None:
        """Add a SYNC sent or received at `sync_ns`."""
        if self._last_sync_ns is not None:
            row = self._count % _MAX_INTERVALS
            self._sync_ns[row] = sync_ns
            self._deviation_ns[row] = abs(sync_ns - self._last_sync_ns - period_ns)
            self._count += 1
        self._last_sync_ns = sync_ns

    def skip_interval(self) -> None:
        """Leave the next interval out, since the period or the sender has changed."""
        self._last_sync_ns = None

    def percentiles_us(self, now_ns: int) -> dict[str, float]:
        """Return `p50`, `p99` and `max` in microseconds; empty without two SYNCs within the last second."""
        return percentiles_us(self._deviation_ns[self._sync_ns >= now_ns - _SECOND_NS])


def percentiles_us(durations_ns: NDArray[np.int64]) -> dict[str, float]:
    """Return `p50`, `p99` and `max` of durations in microseconds, at a tenth of the cost of
    `numpy.percentile`.

    Empty if there are no durations.
    """
    if not len(durations_ns):
        return {}
    last = len(durations_ns) - 1
    ranks = last // 2, round(0.99 * last), last
    values = np.partition(durations_ns, ranks)[list(ranks)] * 1e-3
    return dict(zip(("p50", "p99", "max"), values.tolist(), strict=True))


class Sync:
    """SYNC of a deployment's buses: `start`; `handle_sync` per SYNC received, then `poll`, at the latest at
    `wake_ns`; `stop`.

    SYNC is produced on buses with sync = "producer" unless their role is "listener"; without such a bus the
    first bus's SYNC is followed. Times in ns of the host's monotonic clock. `overruns` counts the periods
    without a SYNC or a cycle because the loop was late. `counter_overflow`: by bus, the last value of the
    counter in its SYNC; the loop sends it there, as the kernel sends the same frame each time. Other buses
    have no counter.
    """

    def __init__(
        self, ports: Sequence[Port], period_ns: int, counter_overflow: Mapping[str, int] | None = None
    ) -> None:
        self.period_ns = period_ns
        self._other_period_ns = period_ns
        """period of other producers, which this host's rate doesn't change"""
        self.overruns = 0
        overflow = counter_overflow or {}
        self._buses = {port.name: _SyncBus(port, overflow.get(port.name, 0)) for port in ports}
        self._produced_buses = [bus for bus in self._buses.values() if bus.is_producer]
        self._reference_bus: _SyncBus | None = None  # its SYNC begins the cycle; None: the loop's timer does
        self._due_ns = self._cycle_sync_ns = 0
        self._received_ns: list[int] = []  # arrivals of SYNCs that begin cycles at the next poll

    def start(self, now_ns: int) -> None:
        """Schedule the first SYNC for the next `poll`."""
        for bus in self._produced_buses:
            bus.start_window(now_ns)
        self._select_reference_bus()
        self._due_ns = now_ns

    def stop(self) -> None:
        """Stop the kernel's cyclic senders."""
        for bus in self._produced_buses:
            bus.stop_kernel_sender()
        self._select_reference_bus()

    @property
    def is_timed(self) -> bool:
        """True while the loop's timer begins the cycles, not a received SYNC."""
        return self._reference_bus is None

    @property
    def wake_ns(self) -> int:
        """Latest time of the next `poll`."""
        return self._due_ns

    def set_period(self, period_ns: int, now_ns: int) -> None:
        """Change the period. The kernel sends a SYNC at once, the loop when the new period has passed."""
        if period_ns == self.period_ns:
            return
        self.period_ns = period_ns
        for bus in self._buses.values():
            bus.jitter.skip_interval()
        for bus in self._produced_buses:
            if not bus.set_period(period_ns, now_ns):
                self._fall_back_to_loop(bus, now_ns)
        self._due_ns = max(now_ns, self._next_due_ns(self._cycle_sync_ns))

    def excuse_pause(self, excused_ns: int) -> None:
        """Expect the next SYNC later, since the loop or the whole host paused for so long."""
        if self._reference_bus is not None:
            self._due_ns += excused_ns
        for bus in self._buses.values():
            bus.port.last_sync_ns += excused_ns if bus.port.last_sync_ns else 0

    def poll(self, now_ns: int, received_until_ns: int) -> Sequence[int]:
        """Send the SYNCs that are due; return the SYNC times of the cycles that begin now.

        After a pause of the loop several SYNCs are waiting: the two latest begin cycles, since the newest
        samples answer one of them. `received_until_ns`: all frames that arrived before were handled.
        """
        if received := self._received_ns:
            self._received_ns = []
            self.overruns += max(len(received) - _MAX_CYCLES_PER_POLL, 0)
            self._begin_cycle(now_ns, received[-1])
            return received[-_MAX_CYCLES_PER_POLL:]
        if (now_ns if self._reference_bus is None else received_until_ns) < self._due_ns:
            return ()
        for bus in self._produced_buses:
            silent_ns = received_until_ns - bus.port.last_sync_ns
            if bus.kernel_sender is not None and silent_ns > _MAX_MISSING_SYNC_PERIODS * self.period_ns:
                self._fall_back_to_loop(bus, now_ns)
        if self._reference_bus is None:
            late = (now_ns - self._due_ns) // self.period_ns
            self.overruns += late
            self._begin_cycle(now_ns, self._due_ns + late * self.period_ns)
        else:
            self._begin_cycle(now_ns, now_ns)
        return (now_ns,)

    def handle_sync(self, bus_name: str, arrival_ns: int) -> None:
        """Count a received SYNC; `poll` begins its cycle if it is the reference."""
        bus = self._buses[bus_name]
        bus.count_received(arrival_ns)
        period_ns = self.period_ns if bus.is_producer else self._other_period_ns
        if not bus.is_producer or bus.kernel_sender is not None:
            bus.port.last_sync_ns = max(arrival_ns, bus.port.last_sync_ns)
            bus.jitter.add_sync(arrival_ns, period_ns)
        previous_ns = self._received_ns[-1] if self._received_ns else self._cycle_sync_ns
        if bus is self._reference_bus and arrival_ns - previous_ns >= _MIN_CYCLE_PERIODS * period_ns:
            self._received_ns.append(arrival_ns)

    def report(self, bus_name: str, now_ns: int) -> dict[str, Any]:
        """Return a bus's SYNC producer, jitter, number of other producers' SYNCs and problem."""
        bus = self._buses[bus_name]
        return {
            "by": "other_producer"
            if not bus.is_producer
            else "loop"
            if bus.kernel_sender is None
            else "kernel",
            "jitter_us": bus.jitter.percentiles_us(now_ns),
            "other_syncs": bus.port.other_syncs,
            "problem": bus.problem,
        }

    def _begin_cycle(self, now_ns: int, sync_ns: int) -> None:
        """Begin a cycle; the loop sends SYNC on the buses on which the kernel doesn't."""
        for bus in self._produced_buses:
            if bus.kernel_sender is None:
                bus.send_sync(now_ns, self.period_ns)
        for bus in self._produced_buses:
            bus.detect_other_producer(now_ns, self.period_ns)
        self._select_reference_bus()
        self._cycle_sync_ns = sync_ns
        self._due_ns = self._next_due_ns(sync_ns)

    def _next_due_ns(self, sync_ns: int) -> int:
        return sync_ns + round(self.period_ns * (1.0 if self._reference_bus is None else _LATE_SYNC_PERIODS))

    def _select_reference_bus(self) -> None:
        if self._produced_buses:
            self._reference_bus = next(
                (bus for bus in self._produced_buses if bus.kernel_sender is not None), None
            )
        else:
            self._reference_bus = next(iter(self._buses.values()), None)

    def _fall_back_to_loop(self, bus: _SyncBus, now_ns: int) -> None:
        bus.stop_kernel_sender()
        bus.kernel_retry_ns = now_ns + _KERNEL_RETRY_NS
        bus.start_window(now_ns, _WINDOW_TOLERANCE_SYNCS)
        bus.problem = (
            "no SYNC from the kernel's cyclic sender; the loop sends SYNC and retries the kernel every 5 s"
        )
        _log.warning("bus %s: %s", bus.port.name, bus.problem)
        self._select_reference_bus()


class _SyncBus:
    """SYNC of one bus; `kernel_sender` is None where the loop or another producer sends."""

    def __init__(self, port: Port, counter_overflow: int = 0) -> None:
        self.port = port
        self._counter, self._counter_overflow = 0, counter_overflow
        self.is_producer = port.bus.sync == "producer" and port.bus.role != "listener"
        self.kernel_sender: CyclicSender | None = None
        self.jitter = SyncJitter()
        self.kernel_retry_ns = 0
        self.problem = ""
        self._window_start_ns = self._received_syncs = self._sent_syncs = 0

    def send_sync(self, now_ns: int, period_ns: int) -> None:
        """Send SYNC now; have the kernel send it cyclically from now on if a retry is due."""
        port = self.port
        port.last_sync_ns = now_ns
        self.jitter.add_sync(now_ns, period_ns)
        if now_ns >= self.kernel_retry_ns and not self._counter_overflow:
            self.kernel_retry_ns = now_ns + _KERNEL_RETRY_NS
            if port.bus_state.error_state not in (ErrorState.DOWN, ErrorState.BUS_OFF):
                self.kernel_sender = port.send_cyclically(cia301.SYNC, b"", period_ns * 1e-9)
                if self.kernel_sender is not None:
                    self.jitter.skip_interval()
                    self.start_window(now_ns, self._sent_syncs)
                    return
        data = b""
        if self._counter_overflow:
            self._counter = self._counter % self._counter_overflow + 1
            data = bytes((self._counter,))
        if port.send(cia301.SYNC, data):
            self._sent_syncs += 1

    def set_period(self, period_ns: int, now_ns: int) -> bool:
        """Change the period; return False if the kernel refuses."""
        self.start_window(now_ns, _WINDOW_TOLERANCE_SYNCS)
        if self.kernel_sender is None:
            return True
        try:
            self.kernel_sender.set_period(period_ns * 1e-9)
        except Exception:  # noqa: BLE001 - drivers raise anything; the loop takes over
            return False
        return True

    def stop_kernel_sender(self) -> None:
        """Stop the kernel's cyclic sender, if there is one."""
        sender, self.kernel_sender = self.kernel_sender, None
        self.jitter.skip_interval()
        if sender is not None:
            try:
                sender.stop()
            except Exception as error:  # noqa: BLE001 - the interface may be gone, and the task with it
                _log.warning("bus %s: kernel SYNC sender not stopped: %s", self.port.name, error)

    def start_window(self, now_ns: int, in_flight: int = 0) -> None:
        """Count SYNCs that arrive from now on, except `in_flight` that were sent before."""
        self._window_start_ns, self._sent_syncs, self._received_syncs = now_ns, 0, -in_flight

    def count_received(self, arrival_ns: int) -> None:
        """Count a received SYNC, unless it arrived before the window and was only read late."""
        self._received_syncs += arrival_ns >= self._window_start_ns

    def detect_other_producer(self, now_ns: int, period_ns: int) -> None:
        """Check once a second for more received SYNCs than this host can have sent."""
        passed_ns = now_ns - self._window_start_ns
        if passed_ns < max(_SECOND_NS, 2 * period_ns):
            return
        ours = 0
        if self.kernel_sender is not None:
            ours = passed_ns // period_ns + _WINDOW_TOLERANCE_SYNCS
        elif self.port.echoes:
            ours = self._sent_syncs + _WINDOW_TOLERANCE_SYNCS
        others = max(0, self._received_syncs - ours)
        self.port.other_syncs += others
        if others and self.problem != _OTHER_PRODUCER_PROBLEM:
            _log.warning("bus %s: %s", self.port.name, _OTHER_PRODUCER_PROBLEM)
        if others or self.kernel_sender is not None or self.problem == _OTHER_PRODUCER_PROBLEM:
            self.problem = _OTHER_PRODUCER_PROBLEM if others else ""
        self.start_window(now_ns)
