"""Patches that contacts press on: shape, size and distribution of the pressure.

Public names: `ContactPatch`, `Profile`, `PROFILES`, `PATCH_ROWS`, `discs`, `half_axes`.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from handtouch.arrays import FloatArray

Profile = Literal["uniform", "hertz", "half_tilted", "tilted", "ring", "two_spots"]
"""Distribution of the pressure over a patch: even; that of Hertz under round objects; rising along the
patch's direction, at one end by half and at the other less by half, or to twice its mean and to nothing; even
from 0.6 of the radius outwards; even on two discs of 0.55 radii, 1.2 radii apart along that direction."""
PROFILES: Final[tuple[Profile, ...]] = get_args(Profile)
PATCH_ROWS: Final = 4
_MIN_FORCE_N = 1e-6


class ContactPatch(NamedTuple):
    """Patch of a contact: an ellipse with half axes radius elongation^(1/2) and radius elongation^(-1/2).

    `direction_rad`: from x on the pad to its long axis and that of its profile. `hertz_force_n`: force at
    which it has this size, which grows as force^(1/3); None: it doesn't. A contact's position is the centre
    of its pressure.
    """

    radius_m: float
    elongation: float = 1.0
    direction_rad: float = 0.0
    profile: Profile = "uniform"
    hertz_force_n: float | None = None

    def column(self, force_n: FloatArray) -> FloatArray:
        """Return the patch under forces (n,), as the rest of the simulator takes it, (PATCH_ROWS, n): radius
        [m], elongation, direction and number of the profile."""
        column = np.empty((PATCH_ROWS, len(force_n)))
        column[0] = self.radius_m * self._growth(force_n)
        column[1], column[2] = self.elongation, self.direction_rad
        column[3] = PROFILES.index(self.profile)
        return column

    def radius_under(self, force_n: float) -> float:
        """Return the radius under a force [m]."""
        return float(self.radius_m * self._growth(np.array([force_n]))[0])

    def _growth(self, force_n: FloatArray) -> FloatArray:
        if self.hertz_force_n is None:
            return np.ones_like(force_n)
        return np.asarray(np.cbrt(np.maximum(force_n, _MIN_FORCE_N) / self.hertz_force_n))


def discs(radius_m: FloatArray) -> FloatArray:
    """Return the columns (..., PATCH_ROWS, n) of evenly pressed discs of these radii (..., n) [m]."""
    patches = np.zeros((*radius_m.shape[:-1], PATCH_ROWS, radius_m.shape[-1]))
    patches[..., 0, :], patches[..., 1, :] = radius_m, 1.0
    return patches


def half_axes(patch: FloatArray) -> FloatArray:
    """Return matrices (n, 2, 2) [m] that carry the unit disc to patches (PATCH_ROWS, n), x along their
    direction."""
    root = np.sqrt(patch[1])
    cos, sin = np.cos(patch[2]), np.sin(patch[2])
    along, across = patch[0] * root, patch[0] / root
    return np.stack(
        [np.stack([along * cos, -across * sin], -1), np.stack([along * sin, across * cos], -1)], 1
    )
