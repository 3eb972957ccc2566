"""Simulated nodes on a line with simulated time: a whole test of a node takes a fraction of a second."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.canbus.bus.router import CanFrame
from handtouch.device import Device, DeviceBus
from handtouch.procedures.conformance import (
    CATALOGUE,
    ConformanceOptions,
    NodeReport,
    NodeUnderTest,
    run_checks,
)

MS = 1_000_000
NODE = 5
SERIAL = 105
QUICK = ConformanceOptions(syncs=40)


class SimulatedLine:
    """A line to nodes whose counts are `counts` with noise of 2 counts; `now` is called as time passes."""

    echoes = False

    def __init__(self) -> None:
        self.t_ns = 1_000_000 * MS
        self.counts: NDArray[np.float64] = np.zeros(4)
        self.during: list[tuple[int, Callable[[], None]]] = []
        """(time, action), in the order of time"""
        self.sent: list[tuple[int, bytes]] = []
        self.frames: deque[CanFrame] = deque()
        self.bus = DeviceBus(self, self._sample, clock=lambda: self.t_ns)  # type: ignore[arg-type]
        self._noise = np.random.default_rng(1)

    # as the nodes' bus
    def recv(self, timeout: float | None = None) -> None:
        """Return nothing: frames are passed to the nodes when they are sent."""

    # as both: python-can's bus, and the line
    def send(self, frame: Any, data: bytes = b"", remote: bool = False) -> None:
        if isinstance(frame, can.Message):
            self.frames.append((frame.arbitration_id, bytes(frame.data), self.t_ns))
            return
        self.sent.append((frame, data))
        message = can.Message(
            arbitration_id=frame,
            data=b"" if remote else data,
            is_remote_frame=remote,
            is_extended_id=False,
        )
        self.bus.handle_frame(message, self.t_ns)

    def now_ns(self) -> int:
        return self.t_ns

    def receive(self, until_ns: int) -> CanFrame | None:
        while not self.frames:
            if self.t_ns >= until_ns:
                return None
            due_ns = self.bus.advance(self.t_ns)
            if self.frames:
                break
            next_ns = until_ns if due_ns is None else min(until_ns, due_ns)
            if self.during:
                next_ns = min(next_ns, self.during[0][0])
            self.t_ns = max(self.t_ns + MS // 100, next_ns)
            while self.during and self.during[0][0] <= self.t_ns:
                self.during.pop(0)[1]()
            self.bus.advance(self.t_ns)
        return self.frames.popleft()

    def add(self, node_id: int = NODE, **kind: Any) -> Device:
        """Add a node and switch it on."""
        device = self.bus.add(node_id, **{"serial": 100 + node_id} | kind)
        device.plug()
        self.frames.clear()
        return device

    def at(self, delay_ms: float, action: Callable[[], None]) -> None:
        """Do something in so many milliseconds."""
        self.during.append((self.t_ns + round(delay_ms * MS), action))
        self.during.sort(key=lambda entry: entry[0])

    def _sample(self, t_ns: int) -> NDArray[np.int64]:  # noqa: ARG002
        rows = max(1, len(self.bus.devices))
        return np.rint(self.counts + 2 * self._noise.standard_normal((rows, 4))).astype(np.int64)


@pytest.fixture
def line() -> SimulatedLine:
    return SimulatedLine()


@pytest.fixture
def check(line: SimulatedLine) -> Callable[..., NodeReport]:
    """Run all checks of node 5; keyword arguments are those of `NodeUnderTest`."""

    def run(options: ConformanceOptions = QUICK, operator: Any = None, **node: Any) -> NodeReport:
        described = NodeUnderTest("can", NODE, **{"noise_counts": 2.0} | node)
        report = run_checks(line, described, options, operator=operator)
        assert [result.name for result in report.results] == list(CATALOGUE)
        return report

    return run
