"""Smoothstep: a transition from 0 to 1 with zero slope at both ends.

Public names: `smoothstep` (one number), `smoothstep_array`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def smoothstep(fraction: float) -> float:
    """Return 0 below 0, 1 above 1, and 3 f^2 - 2 f^3 in between."""
    fraction = min(max(fraction, 0.0), 1.0)
    return fraction * fraction * (3 - 2 * fraction)


def smoothstep_array(fraction: ArrayLike) -> NDArray[np.float64]:
    """Return `smoothstep` of every element."""
    clipped = np.clip(fraction, 0.0, 1.0)
    return np.asarray(clipped * clipped * (3 - 2 * clipped))
