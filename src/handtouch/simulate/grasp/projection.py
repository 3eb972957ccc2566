"""Project points near a pad's surface onto it; the inverse of `handtouch.simulate.pad_geometry`.

Public names: `project_to_surface` -> `SurfaceProjection`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.pad_geometry import SimulatedPrism, SimulatedRevolution, SimulatedSurface

FloatArray = NDArray[np.float64]
_PROFILE_CELLS = 400
_NEWTON_STEPS = 3


class SurfaceProjection(NamedTuple):
    """Feet of the normals from n points to a surface."""

    fraction: FloatArray
    """(n, 2), fractions from electrodes x0 and y0; outside 0 to 1 the foot isn't on the pad."""
    height_m: FloatArray
    """(n,), height of the points above the surface, negative below."""
    normal: FloatArray
    """(n, 3), outward normals in the pad's frame."""


def project_to_surface(shape: SimulatedSurface, points_m: FloatArray) -> SurfaceProjection:
    """Project points (n, 3) in the pad's frame; for points on the axis of the surface any foot is correct."""
    if isinstance(shape, SimulatedPrism):
        return _project_to_prism(shape, points_m)
    if isinstance(shape, SimulatedRevolution):
        return _project_to_profile(shape, points_m)
    x, y, z = points_m.T
    if shape.flat:
        along = np.stack([x / shape.length_m + 0.5, y / shape.arc + 0.5], axis=1)
        return SurfaceProjection(along, z.copy(), np.tile([0.0, 0.0, 1.0], (len(x), 1)))
    middle = shape.length_m / 2
    tilt = _profile_angle(shape, np.array(middle))
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
    climb = _profile_angle(shape, s)
    across, up, along = np.cos(climb) * np.sin(angle), np.cos(climb) * np.cos(angle), -np.sin(climb)
    normal = [np.cos(tilt) * along + np.sin(tilt) * up, across, np.cos(tilt) * up - np.sin(tilt) * along]
    return SurfaceProjection(
        np.stack([s / shape.length_m, angle / shape.arc + 0.5], axis=1), height, np.stack(normal, axis=1)
    )


def _profile_angle(shape: SimulatedSurface, s_m: FloatArray) -> FloatArray:
    """Return the angle (n,) between profile and axis."""
    if shape.sphere_from_rad is None:
        return np.full(np.shape(s_m), np.arcsin(shape.slope))
    return np.asarray(-(shape.sphere_from_rad + s_m / shape.start_radius_m))


def _project_to_prism(shape: SimulatedPrism, points_m: FloatArray) -> SurfaceProjection:
    """Project to the nearest face."""
    nearest = np.full(len(points_m), np.inf)
    phi, height = np.zeros(len(points_m)), np.zeros(len(points_m))
    normal = np.zeros((len(points_m), 3))
    section = points_m[:, 1:]
    for begin, end, first, last in shape.faces():
        along = (last - first) / (end - begin)
        outward = np.array([-along[1], along[0]])
        into = np.clip((section - first) @ along, 0.0, end - begin)
        distance = np.linalg.norm(section - first - into[:, None] * along, axis=1)
        closer = distance < nearest
        nearest[closer], phi[closer] = distance[closer], begin + into[closer]
        height[closer] = ((section - first) @ outward)[closer]
        normal[closer] = np.append(0.0, outward)
    s = points_m[:, 0] + shape.length_m / 2
    return SurfaceProjection(np.stack([s / shape.length_m, phi / shape.arc], axis=1), height, normal)


def _project_to_profile(shape: SimulatedRevolution, points_m: FloatArray) -> SurfaceProjection:
    """Find the nearest point of the profile in each point's half plane, by Newton's method."""
    middle, tilt = shape.length_m / 2, shape.profile_angle(shape.length_m / 2)
    mid_axial, mid_radius = shape.profile_point(np.array(middle))
    x, y, z = points_m.T
    axial = np.cos(tilt) * x - np.sin(tilt) * z + mid_axial
    outward = np.sin(tilt) * x + np.cos(tilt) * z + mid_radius
    angle, away = np.arctan2(y, outward), np.hypot(y, outward)
    cells = np.linspace(0.0, shape.length_m, _PROFILE_CELLS + 1)
    on_profile = np.stack(shape.profile_point(cells))
    squared = ((np.stack([axial, away])[:, :, None] - on_profile[:, None]) ** 2).sum(0)
    s = cells[squared.argmin(axis=1)]
    for _ in range(_NEWTON_STEPS):
        along_axis, along_radius = shape.profile_point(s)
        climb = shape.profile_angles(s)
        s = s + np.cos(climb) * (axial - along_axis) + np.sin(climb) * (away - along_radius)
        s = np.clip(s, 0.0, shape.length_m)
    along_axis, along_radius = shape.profile_point(s)
    climb = shape.profile_angles(s)
    height = np.cos(climb) * (away - along_radius) - np.sin(climb) * (axial - along_axis)
    across, up, along = np.cos(climb) * np.sin(angle), np.cos(climb) * np.cos(angle), -np.sin(climb)
    normal = [np.cos(tilt) * along + np.sin(tilt) * up, across, np.cos(tilt) * up - np.sin(tilt) * along]
    return SurfaceProjection(
        np.stack([s / shape.length_m, angle / shape.arc + 0.5], axis=1), height, np.stack(normal, axis=1)
    )
