"""Surface, electrodes and mount of a pad in SI units, from its table in the deployment.

Public names: `pad_surface`, `mount_transform`, `electrode_network`, `rotation_from_rpy`, `MountUncertainty`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.surface import Surface

_M_PER_MM = 1e-3


def pad_surface(pad: config.Pad) -> Surface:
    """Return the surface that a pad covers, in metres and radians."""
    return pad.surface.build()


def mount_transform(pad: config.Pad) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and translation (3,) [m] from the pad frame to its link frame."""
    return rotation_from_rpy(np.radians(pad.mount.rpy_deg)), np.array(pad.mount.position_mm) * _M_PER_MM


class MountUncertainty:
    """Uncertainty of the mounts of a hand's pads on their links."""

    def __init__(self, hand: config.HandTable) -> None:
        self._origin_m = np.array([pad.mount.position_mm for pad in hand.pads]) * _M_PER_MM
        self._position_variance_m2 = (hand.mount_std_mm * _M_PER_MM) ** 2
        self._rotation_variance_rad2 = math.radians(hand.mount_std_deg) ** 2

    def position_covariance_m2(
        self, pads: NDArray[np.intp], position_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (k, 3, 3) [m^2] that mounts add to positions (k, 3) on pads (k,), in link
        frames.

        A rotation error of s about each axis through the pad's origin moves a point at r by s^2 (r.r 1 - r
        r').
        """
        arm = position_m - self._origin_m[pads]
        even = self._position_variance_m2 + self._rotation_variance_rad2 * np.einsum("ki,ki->k", arm, arm)
        return np.asarray(
            even[:, None, None] * np.eye(3) - self._rotation_variance_rad2 * (arm[:, :, None] * arm[:, None])
        )


def rotation_from_rpy(rpy_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of roll, pitch and yaw [rad] about the fixed axes x, y and z, as in URDF."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy_rad), np.cos(rpy_rad)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(yaw @ pitch @ roll)


def electrode_network(pad: config.Pad, sheet: config.Sheet) -> ElectrodeNetwork:
    """Return the pad's electrodes on its rectangle, with the bare corners as measured on the surface."""
    surface, gap_m = pad_surface(pad), pad.gap_mm * _M_PER_MM
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
