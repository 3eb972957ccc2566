"""A small hand without resistors and one with, and the counts that touches on it give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse
from handtouch.daemon.model import PadModel

DEPLOYMENT = """
[daemon]
sync_period_ms = 5.0

[[bus]]
name = "can0"
interface = "virtual"
channel = "test"

[node.n]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 1.0

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5

[touch]
on_n = 0.1
off_n = 0.05
begin_samples = 2
end_samples = 2

[[hand]]
name = "h"

[[hand.pad]]
link = "plane"
bus = "can0"
node_id = 1
node = "n"
sheet = "s"
surface = { kind = "plane", length_mm = 30.0, width_mm = 24.0 }
gap_mm = 0.6
mount = { position_mm = [10.0, 0.0, 5.0], rpy_deg = [0.0, 0.0, 90.0] }

[[hand.pad]]
link = "round"
bus = "can0"
node_id = 2
node = "n"
sheet = "s"
surface = { kind = "cylinder", radius_mm = 10.0, length_mm = 30.0, arc_deg = 150.0 }
gap_mm = 0.6

[[hand.pad]]
link = "resisted"
bus = "can0"
node_id = 3
node = "n"
sheet = "s"
surface = { kind = "plane", length_mm = 30.0, width_mm = 24.0 }
gap_mm = 0.6
series_ohm = [336.0, 336.0, 336.0, 336.0]
"""


@dataclass(frozen=True)
class Bench:
    """A deployment with its model."""

    deployment: Deployment
    model: PadModel

    def counts(self, pad: int, x: float, y: float, current_a: float) -> NDArray[np.int16]:
        """Reading of a pad into which a contact at (x, y) parts of its rectangle injects a current."""
        side_a, side_b = self.model.locator.sides[pad]
        at = np.array([pad]), np.array([x * side_a]), np.array([y * side_b])
        fractions = self.model.locator.fractions(*at)[:, 0]
        counts: NDArray[np.int16] = np.rint(
            fractions * (current_a / self.model.ampere_per_count[pad])
        ).astype(np.int16)
        return counts


@pytest.fixture(scope="session")
def bench() -> Bench:
    deployment = parse(DEPLOYMENT)
    return Bench(deployment, PadModel(deployment))
