"""What the simulator hides from the estimator: noise, tolerances of parts, the true size of contacts.

Public names: `World`, `Parts`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch import config

Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class Parts:
    """One pad as it was really built; electrodes in the order x0, xa, y0, yb."""

    gain: Four
    """Of the channels; 1 is as configured."""
    series_ohm: Four
    gap_before_mm: Four
    """Bare length of each electrode's side, along the surface, from the corner where y or x begins."""
    gap_after_mm: Four
    """The same, to the corner where y or x ends."""


@dataclass(frozen=True)
class World:
    """How reality differs from the deployment file; the same seed makes the same world.

    Parts are spread evenly within their tolerances, contact radii normally. Raises ValueError for a seed
    below 0.
    """

    seed: int = 1
    noise_counts: float | None = None
    """Standard deviation of a reading; None: that of the file."""
    gain_tolerance: float = 0.02
    gap_tolerance_mm: float = 0.2
    resistor_tolerance: float = 0.05
    radius_spread: float = 1.0
    """Standard deviation of a contact's radius, in units of the sheet's contact_radius_std_mm."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: must be 0 or more")

    @classmethod
    def ideal_parts(cls, seed: int = 1) -> World:
        """Only noise and quantisation hidden: everything else is as the file says."""
        return cls(seed, None, 0.0, 0.0, 0.0, 0.0)

    def parts(self, hand: str, pad: config.Pad) -> Parts:
        """The pad as built; depends on nothing but the seed, the names and the pad's own table."""
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"{hand}/{pad.link}".encode()))).uniform(
            -1, 1, 16
        )
        gain = 1 + self.gain_tolerance * drawn[:4]
        series = np.array(pad.series_ohm) * (1 + self.resistor_tolerance * drawn[4:8])
        gaps = np.maximum(pad.gap_mm + self.gap_tolerance_mm * drawn[8:].reshape(2, 4), 0.0)
        before, after = gaps
        return Parts(_four(gain), _four(series), _four(before), _four(after))

    def radius_mm(self, sheet: config.Sheet, touch: int) -> float:
        """True radius of a contact; `touch` is its number in the scenario."""
        drawn = np.random.default_rng((self.seed, touch)).normal()
        spread = self.radius_spread * sheet.contact_radius_std_mm
        return max(sheet.contact_radius_mm + spread * drawn, 0.3 * sheet.contact_radius_mm)


def _four(values: NDArray[np.float64]) -> Four:
    x0, xa, y0, yb = values.tolist()
    return x0, xa, y0, yb
