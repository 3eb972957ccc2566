"""Rotations from quaternions, without the packages that only tools load.

Public name: `rotation_matrices`.
"""

from __future__ import annotations

import numpy as np

from handtouch.arrays import FloatArray


def rotation_matrices(quaternion: FloatArray) -> FloatArray:
    """Return the matrices (k, 3, 3) of unit quaternions (k, 4): x, y, z, w."""
    x, y, z, w = quaternion.T
    found = np.empty((len(quaternion), 3, 3))
    found[:, 0, 0], found[:, 0, 1], found[:, 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    found[:, 1, 0], found[:, 1, 1], found[:, 1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    found[:, 2, 0], found[:, 2, 1], found[:, 2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return found
