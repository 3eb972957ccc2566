"""`handtouch node` passes `handtouch conformance`, in simulated time."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import can
import numpy as np

from handtouch.canbus.bus.router import CanFrame
from handtouch.config import shipped
from handtouch.node.service import NodeService
from handtouch.node.settings import load
from handtouch.procedures.conformance import ConformanceOptions, NodeUnderTest, Verdict, run_checks
from tests.node.stand_in import raw_of_ma

MS = 1_000_000
NODE = 5
NOISE_MA = 2 * 10.0 / 32767


class ServedLine:
    """A line to a node's service, whose ADC reads noise of 2 counts; its time passes in `receive` only."""

    echoes = False

    def __init__(self, bench: Any) -> None:
        self.t_ns = 10**12
        self._frames: deque[CanFrame] = deque()
        self._requests: deque[can.Message] = deque()
        self._noise = np.random.default_rng(1)
        self._adc = bench.adc
        bus: Any = self
        self.service = NodeService(load(bench.write()), bus, clock=lambda: self.t_ns)
        self.service.start()
        self._frames.clear()  # its boot-up message

    # as the service's bus
    def recv(self, timeout: float | None = None) -> can.Message | None:  # noqa: ARG002
        return self._requests.popleft() if self._requests else None

    def set_filters(self, filters: Any) -> None:
        """Pass every frame."""

    def fileno(self) -> int:
        raise NotImplementedError

    # as both
    def send(self, frame: Any, data: bytes = b"", remote: bool = False) -> None:
        if isinstance(frame, can.Message):
            self._frames.append((frame.arbitration_id, bytes(frame.data), self.t_ns))
            return
        if frame == 0x80:
            self._adc.set_raw(raw_of_ma(self._noise.normal(0.0, NOISE_MA, 4)))
        message = can.Message(arbitration_id=frame, data=data, is_remote_frame=remote, is_extended_id=False)
        self._requests.append(message)
        self.service.poll(0.0)

    def now_ns(self) -> int:
        return self.t_ns

    def receive(self, until_ns: int) -> CanFrame | None:
        while not self._frames:
            if self.t_ns >= until_ns:
                return None
            self.t_ns = min(self.t_ns + MS, until_ns)
            self.service.poll(0.0)
        return self._frames.popleft()


def test_a_node_passes_every_check_that_needs_no_operator(bench: Any) -> None:
    line = ServedLine(bench)
    node = NodeUnderTest("can", NODE, noise_counts=2.0, eds=str(shipped.path("handtouch-node.eds")))
    report = run_checks(line, node, ConformanceOptions(syncs=40))
    line.service.close()
    assert report.failures == []
    assert report.verdict("lss.select") is report.verdict("pdo.delay") is Verdict.PASSED
    assert report.verdict("channels.noise") is Verdict.PASSED
    assert Path(bench.folder / "node.toml.state.json").exists()
