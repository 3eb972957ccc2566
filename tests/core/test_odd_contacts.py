"""Contact messages are readable for any computed numbers: those not finite are nil."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.core.pipeline import Pipeline

ODD = np.array([np.nan, np.inf, -np.inf, 0.0, 1e30, -1e-30, 1.0])
PARTS = ("position_m", "normal", "covariance_m2", "pad_m")
NUMBERS = ("force_n", "force_std_n", "residual", "residual_std", "uncompensated_force_n")


class DiscardingSink:
    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: Any) -> None:
        """Discard the message."""


@pytest.mark.parametrize("event", ["begin", "update", "end"])
def test_a_contact_of_non_finite_numbers_is_readable(bench: Any, event: wire.ContactEvent) -> None:
    pipeline = Pipeline(bench.model, 5_000_000, 0.6, DiscardingSink())
    rng, columns = np.random.default_rng(1), pipeline.tick.columns
    for _ in range(300):
        for name in (*PARTS, *NUMBERS):
            column = getattr(columns, name)
            column[:] = rng.choice(ODD, column.shape) if rng.random() < 0.5 else rng.normal(size=column.shape)
        pipeline.tick.contacts.peak_force_n[:] = rng.choice(ODD, pipeline.model.size)
        state = pipeline.state
        state.contact_id[:], state.solved[:], state.known[:] = 1, True, True
        pipeline.tick.refresh()
        pad = int(rng.integers(pipeline.model.size))
        sent = pipeline.messages._contact_message(pad, event, 10**9, 10**9)
        read = wire.decode(wire.encode(sent))
        assert isinstance(read, wire.Contact)
        assert (read.position_status == "valid") == (read.position_m is not None)
