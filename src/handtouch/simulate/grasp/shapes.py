"""Points near a pad's surface -> coordinates on it: the inverse of `handtouch.simulate.shape`.

Public name: `foot`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.shape import Shape

FloatArray = NDArray[np.float64]


class Foot(NamedTuple):
    """Where the normals through n points meet a surface."""

    fraction: FloatArray
    """(n, 2) of the way from electrodes x0 and y0; outside 0 to 1 it isn't on the pad"""
    height_m: FloatArray
    """(n,) of the points above the surface, negative below"""
    normal: FloatArray
    """(n, 3) outward, in the pad's frame"""


def foot(shape: Shape, points_m: FloatArray) -> Foot:
    """Of points (n, 3) in the pad's frame. On the axis of a round surface any foot will do."""
    x, y, z = points_m.T
    if shape.flat:
        along = np.stack([x / shape.length_m + 0.5, y / shape.arc + 0.5], axis=1)
        return Foot(along, z.copy(), np.tile([0.0, 0.0, 1.0], (len(x), 1)))
    middle = shape.length_m / 2
    tilt = _climb(shape, np.array(middle))
    axial = np.cos(tilt) * x - np.sin(tilt) * z
    outward = np.sin(tilt) * x + np.cos(tilt) * z + float(shape.radius(middle))
    angle, away = np.arctan2(y, outward), np.hypot(y, outward)
    if shape.sphere_from_rad is None:
        cos, sin = np.cos(tilt), np.sin(tilt)
        from_middle = axial * cos + (away - float(shape.radius(middle))) * sin
        s, height = middle + from_middle, -axial * sin + (away - float(shape.radius(middle))) * cos
    else:
        axial = axial + shape.start_radius_m * np.sin(shape.sphere_from_rad + middle / shape.start_radius_m)
        latitude = np.arctan2(axial, away)
        s = shape.start_radius_m * (latitude - shape.sphere_from_rad)
        height = np.hypot(axial, away) - shape.start_radius_m
    climb = _climb(shape, s)
    across, up, along = np.cos(climb) * np.sin(angle), np.cos(climb) * np.cos(angle), -np.sin(climb)
    normal = [np.cos(tilt) * along + np.sin(tilt) * up, across, np.cos(tilt) * up - np.sin(tilt) * along]
    return Foot(
        np.stack([s / shape.length_m, angle / shape.arc + 0.5], axis=1), height, np.stack(normal, axis=1)
    )


def _climb(shape: Shape, s_m: FloatArray) -> FloatArray:
    """Angle of the profile against the axis (n,)."""
    if shape.sphere_from_rad is None:
        return np.full(np.shape(s_m), np.arcsin(shape.slope))
    return np.asarray(-(shape.sphere_from_rad + s_m / shape.start_radius_m))
