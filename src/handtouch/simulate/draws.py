"""Random quantities that faults and episodes are drawn from.

Public names: `log_uniform`, `electrode`, `position`.
"""

from __future__ import annotations

import math

import numpy as np

from handtouch.config.tables import SIDE_ELECTRODES


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def electrode(rng: np.random.Generator) -> str:
    """Draw an electrode's name."""
    return str(rng.choice(SIDE_ELECTRODES))


def position(rng: np.random.Generator, margin: float = 0.12) -> tuple[float, float]:
    """Draw a position (x, y) as fractions of a pad, at least `margin` from its sides."""
    x, y = rng.uniform(margin, 1 - margin, 2).tolist()
    return x, y
