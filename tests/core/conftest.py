"""A small hand with and without series resistors, and the counts of contacts on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse
from handtouch.core.pad_model import PadModel
from handtouch.daemon.table_cache import build_pad_model
from tests.deployments import CYLINDER, deployment_text, pad_text
from tests.exact_pads import ExactPads

PADS = (
    pad_text("plane", 1, extra="mount = { position_mm = [10.0, 0.0, 5.0], rpy_deg = [0.0, 0.0, 90.0] }"),
    pad_text("round", 2, CYLINDER),
    pad_text("resisted", 3, extra="series_ohm = [336.0, 336.0, 336.0, 336.0]"),
)
DEPLOYMENT = deployment_text(*PADS, exact_parts=True)
TOLERANT_DEPLOYMENT = deployment_text(*PADS)
"""The same with the tolerances of the default values."""


@dataclass(frozen=True)
class Bench:
    """A deployment, its model, and the exact theory."""

    deployment: Deployment
    model: PadModel
    exact: ExactPads

    def counts(self, pad: int, x: float, y: float, current_a: float) -> NDArray[np.int16]:
        """Return the counts of a contact at (x, y), fractions of the pad's rectangle, with a current."""
        network = self.model.networks[pad]
        fractions = network.fractions(x * network.a, y * network.b)
        counts: NDArray[np.int16] = np.rint(
            fractions * (current_a / self.model.ampere_per_count[pad])
        ).astype(np.int16)
        return counts


@pytest.fixture(scope="session")
def bench() -> Bench:
    deployment = parse(DEPLOYMENT)
    model = build_pad_model(deployment)
    return Bench(deployment, model, ExactPads(deployment, model))
