"""Vector helpers.

Public names: `perpendicular_directions`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def perpendicular_directions(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two directions (n, 3) perpendicular to each unit vector (n, 3) and to each other."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)
