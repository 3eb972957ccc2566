"""Whatever a tick computes, a contact message can be read: what isn't finite is nil on the wire."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.daemon.pipeline import Pipeline

ODD = np.array([np.nan, np.inf, -np.inf, 0.0, 1e30, -1e-30, 1.0])
PARTS = ("position_m", "normal", "covariance_m2", "pad_m")
NUMBERS = ("force_n", "force_std_n", "residual", "residual_std", "raw_force_n")


class Nobody:
    def wants(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: Any) -> None:
        """Nobody listens."""


@pytest.mark.parametrize("event", ["begin", "update", "end"])
def test_a_contact_of_odd_numbers_can_be_read(bench: Any, event: str) -> None:
    pipeline = Pipeline(bench.model, 5_000_000, 0.6, Nobody())
    rng, columns = np.random.default_rng(1), pipeline.tick.columns
    for _ in range(300):
        for name in (*PARTS, *NUMBERS):
            column = getattr(columns, name)
            column[:] = rng.choice(ODD, column.shape) if rng.random() < 0.5 else rng.normal(size=column.shape)
        pipeline.tick.contacts.peak_n[:] = rng.choice(ODD, pipeline.model.size)
        pad = int(rng.integers(pipeline.model.size))
        sent = pipeline.messages._contact(pad, event, 10**9, 10**9)
        read = wire.decode(wire.encode(sent))
        assert isinstance(read, wire.Contact)
        assert (read.location == "valid") == (read.position_m is not None)
