"""From the deployment's millimetres and degrees to a pad's surface, electrodes and mount in SI."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.surface import Cone, Cylinder, Plane, Sphere, Surface

_MM = 1e-3


def surface_of(pad: config.Pad) -> Surface:
    """The surface that a pad covers, in metres and radians."""
    shape = pad.surface
    if isinstance(shape, config.Plane):
        return Plane(shape.length_mm * _MM, shape.width_mm * _MM)
    arc_rad = math.radians(shape.arc_deg)
    if isinstance(shape, config.Cylinder):
        return Cylinder(shape.radius_mm * _MM, shape.length_mm * _MM, arc_rad)
    if isinstance(shape, config.Cone):
        return Cone(shape.near_radius_mm * _MM, shape.far_radius_mm * _MM, shape.slant_mm * _MM, arc_rad)
    return Sphere(shape.radius_mm * _MM, math.radians(shape.from_deg), math.radians(shape.to_deg), arc_rad)


def mount_of(pad: config.Pad) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and translation (3,) [m] that carry the pad's frame into its link's frame."""
    return rotation_of(np.radians(pad.mount.rpy_deg)), np.array(pad.mount.position_mm) * _MM


class Mounts:
    """How sure it is where the pads of a hand sit on their links: `covariance` of places on them."""

    def __init__(self, hand: config.Hand) -> None:
        self._origin_m = np.array([pad.mount.position_mm for pad in hand.pads]) * _MM
        self._place_m2 = (hand.mount_std_mm * _MM) ** 2
        self._turn_rad2 = math.radians(hand.mount_std_deg) ** 2

    def covariance(self, pads: NDArray[np.intp], position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """What that adds to places (k, 3) on pads (k,), both in the links' frames: (k, 3, 3) [m^2].

        A turn of s about each axis through the pad's origin moves what is r away by s^2 (r.r 1 - r r').
        """
        arm = position_m - self._origin_m[pads]
        even = self._place_m2 + self._turn_rad2 * np.einsum("ki,ki->k", arm, arm)
        return np.asarray(
            even[:, None, None] * np.eye(3) - self._turn_rad2 * (arm[:, :, None] * arm[:, None])
        )


def rotation_of(rpy_rad: ArrayLike) -> NDArray[np.float64]:
    """Matrix (3, 3) of roll, pitch and yaw [rad] about the fixed axes x, y and z, in turn, as in URDF."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy_rad), np.cos(rpy_rad)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(yaw @ pitch @ roll)


def network_of(pad: config.Pad, sheet: config.Sheet) -> ElectrodeNetwork:
    """The pad's electrodes on its rectangle, with the bare corners as they are on the surface."""
    surface, gap_m = surface_of(pad), pad.gap_mm * _MM
    (begin, end), _ = surface.to_rectangle([gap_m, surface.extent_m[0] - gap_m], [0.0, 0.0])
    _, corners = surface.to_rectangle([0.0, surface.extent_m[0]], [gap_m, gap_m])
    near, far = corners.tolist()
    electrodes = [
        Electrode("x0", near, surface.b - near),
        Electrode("xa", far, surface.b - far),
        Electrode("y0", float(begin), float(end)),
        Electrode("yb", float(begin), float(end)),
    ]
    return ElectrodeNetwork.from_electrodes(
        surface.a, surface.b, electrodes, sheet.ohm_per_square, pad.series_ohm
    )
