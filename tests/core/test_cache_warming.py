"""Cache warming changes no message."""

from __future__ import annotations

import numpy as np

from handtouch import wire
from handtouch.config import load, shipped
from handtouch.core.cache_warming import CacheWarmer
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.wire import PadState

PERIOD_NS = 5_000_000


class CollectingSink:
    """Collects messages of all topics."""

    def __init__(self) -> None:
        self.sent: list[wire.OutgoingMessage] = []

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return True

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent.append(message)


def messages(model: PadModel, warmed: bool) -> list[list[bytes]]:
    """Return the messages of a hand with a sliding contact."""
    sink = CollectingSink()
    pipeline = Pipeline(model, PERIOD_NS, 0.8, sink)
    warmer = CacheWarmer(pipeline, sink)
    pipeline.node_state[:] = PadState.CLEAR
    noise = np.random.default_rng(5)
    for step in range(1, 40):
        t_ns = step * PERIOD_NS
        pipeline.begin_cycle(t_ns, t_ns)
        if warmed:
            warmer.warm_all()
            warmer.warm_tick()
        counts = np.rint(noise.standard_normal((pipeline.slab.size, 4)))
        if 5 < step < 30:
            counts[3] += (900 + 4 * step, 700 - 4 * step, 800, 600)
        for pad, row in enumerate(counts.astype("<i2")):
            pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1000)
        pipeline.tick_if_due(t_ns + 2000)
        pipeline.prepare_next_tick()
    return [wire.encode(message) for message in sink.sent]


def test_cache_warming_changes_no_message() -> None:
    model = PadModel(load(shipped.path("utah_mit.toml")))
    plain = messages(model, warmed=False)
    assert any(b"contact/" in topic for topic, _ in plain)
    assert messages(model, warmed=True) == plain
