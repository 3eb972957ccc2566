"""Directions across others.

Public names: `across`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def across(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two directions (n, 3) across each of these, (n, 3) of unit length, and across each other."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)
