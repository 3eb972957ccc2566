"""Rehearsing the next tick warms the caches and does nothing else."""

from __future__ import annotations

import numpy as np

from handtouch import shipped, wire
from handtouch.config import load
from handtouch.daemon.model import PadModel
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.rehearsal import Rehearsal
from handtouch.wire import PadState

PERIOD_NS = 5_000_000


class Everything:
    """Wants all and keeps it."""

    def __init__(self) -> None:
        self.sent: list[wire.Outgoing] = []

    def wants(self, topic: str) -> bool:  # noqa: ARG002
        return True

    def send(self, message: wire.Outgoing) -> None:
        self.sent.append(message)


def messages(model: PadModel, rehearsed: bool) -> list[list[bytes]]:
    """What a hand with a sliding contact says."""
    outlet = Everything()
    pipeline = Pipeline(model, PERIOD_NS, 0.8, outlet)
    rehearsal = Rehearsal(pipeline, outlet)
    pipeline.node_state[:] = PadState.CLEAR
    noise = np.random.default_rng(5)
    for step in range(1, 40):
        t_ns = step * PERIOD_NS
        pipeline.begin(t_ns, t_ns)
        if rehearsed:
            rehearsal.all()
            rehearsal.tick()
        counts = np.rint(noise.standard_normal((pipeline.slab.size, 4)))
        if 5 < step < 30:
            counts[3] += (900 + 4 * step, 700 - 4 * step, 800, 600)
        for pad, row in enumerate(counts.astype("<i2")):
            pipeline.slab.write(pad, row.tobytes(), t_ns + 1000)
        pipeline.advance(t_ns + 2000)
        pipeline.settle()
    return [wire.encode(message) for message in outlet.sent]


def test_rehearsal_changes_no_message() -> None:
    model = PadModel(load(shipped.path("utah_mit.toml")))
    plain = messages(model, rehearsed=False)
    assert any(b"contact/" in topic for topic, _ in plain)
    assert messages(model, rehearsed=True) == plain
