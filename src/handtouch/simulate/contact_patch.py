"""Elliptical contact patches: their equivalent radii, and shares of the electrodes averaged over them.

Public names: `ContactPatch`, `mean_half_axis`, `effective_patch`, `look_up_patches`.

A patch is given by the radius of a disc of the same area and by its focus, the vector from its centre to a
focus of the ellipse, 0 for a disc. The mean of a harmonic function over an ellipse is that over the segment
between its foci with the density (1 - t^2)^(1/2), so a few points give the shares of a uniform current. Seen
from outside, an ellipse is a disc of its mean half axis; the layer under it that of its area.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.sheet_solver import EDGE_INSET_FRACTION, SheetMapBank

FloatArray = NDArray[np.float64]

_MIN_FORCE_N = 1e-6
_NODE_COUNT = 7
_ANGLES = math.pi * np.arange(1, _NODE_COUNT + 1) / (_NODE_COUNT + 1)
_NODES: Final = np.cos(_ANGLES)  # Gauss quadrature, exact up to degree 13
_WEIGHTS: Final = 2 / (_NODE_COUNT + 1) * np.sin(_ANGLES) ** 2


class ContactPatch(NamedTuple):
    """Patch of a contact [m]; `focus_m` along x and y on the pad.

    `hertz_force_n`: force at which it has this size, which grows as force^(1/3); None: it doesn't.
    """

    radius_m: float
    focus_m: tuple[float, float] = (0.0, 0.0)
    hertz_force_n: float | None = None

    @classmethod
    def ellipse(
        cls, radius_m: float, elongation: float, direction_rad: float, hertz_force_n: float | None = None
    ) -> ContactPatch:
        """Return an ellipse of half axes radius elongation^(1/2) and radius elongation^(-1/2)."""
        focus_m = radius_m * math.sqrt(max(elongation - 1 / elongation, 0.0))
        focus = focus_m * math.cos(direction_rad), focus_m * math.sin(direction_rad)
        return cls(radius_m, focus, hertz_force_n)

    def growth(self, force_n: FloatArray) -> FloatArray:
        """Return the patch's size under forces (n,), relative to that stated."""
        if self.hertz_force_n is None:
            return np.ones_like(force_n)
        return np.asarray(np.cbrt(np.maximum(force_n, _MIN_FORCE_N) / self.hertz_force_n))

    def under(self, force_n: float) -> ContactPatch:
        """Return the patch under a force."""
        if self.hertz_force_n is None:
            return self
        growth, (x, y) = float(self.growth(np.array(force_n))), self.focus_m
        return ContactPatch(growth * self.radius_m, (growth * x, growth * y))


def mean_half_axis(radius_m: FloatArray, focus_length_m: FloatArray) -> FloatArray:
    """Return half the sum of the half axes (...) of ellipses with the area of a disc, and their foci."""
    square = radius_m**2
    return np.asarray(np.sqrt(np.sqrt(focus_length_m**4 + 4 * square**2) + 2 * square) / 2)


def effective_patch(
    radius_m: FloatArray, focus_m: FloatArray, stretch: float
) -> tuple[FloatArray, FloatArray]:
    """Return the radii (n,) of discs equivalent to patches on a sheet, and their foci (2, n) [m].

    `stretch` is the length of x in the isotropic equivalent of the sheet, relative to that on the surface:
    an ellipse becomes another one there. Discs (focus 0) remain discs.
    """
    length = np.hypot(*focus_m)
    if stretch == 1 or not length.any():
        return mean_half_axis(radius_m, length), focus_m
    longer = (length**2 + np.sqrt(length**4 + 4 * radius_m**4)) / 2  # squares of the half axes
    shorter = radius_m**4 / longer
    cos, sin = focus_m / np.where(length > 0, length, 1.0)
    xx = stretch**2 * (longer * cos**2 + shorter * sin**2)
    yy, xy = longer * sin**2 + shorter * cos**2, stretch * (longer - shorter) * cos * sin
    difference = np.hypot(xx - yy, 2 * xy)  # difference of the squares of the new half axes
    turned = np.arctan2(2 * xy, xx - yy) / 2
    focus = np.sqrt(difference) * np.stack([np.cos(turned) / stretch, np.sin(turned)])
    mean = (np.sqrt((xx + yy + difference) / 2) + np.sqrt((xx + yy - difference) / 2)) / 2
    is_disc = length == 0
    return (
        np.where(is_disc, radius_m, mean * 2 / (1 + stretch)),  # the map of a disc has (1 + stretch) / 2
        np.where(is_disc, 0.0, focus),
    )


def look_up_patches(
    bank: SheetMapBank, sheet: NDArray[np.intp], position: FloatArray, focus: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `SheetMapBank.look_up` of patches (k,), with their shares averaged.

    position: (2, k), focus: (2, k) from the centre, both fractions of the pad.
    """
    values, slopes = bank.look_up(sheet, *position)
    long = np.flatnonzero(focus.any(axis=0))
    if len(long):
        points = position[:, None, long] + _NODES[:, None] * focus[:, None, long]
        shape = (_NODE_COUNT, len(long))
        found, by = bank.look_up(np.tile(sheet[long], _NODE_COUNT), *points.reshape(2, -1))
        # maps end inside the edge, from where shares are nearly linear; what hangs over enters at the edge
        beyond = np.clip(points, 0.0, 1.0) - np.clip(points, EDGE_INSET_FRACTION, 1 - EDGE_INSET_FRACTION)
        found[:-1] += np.einsum("mak,ak->mk", by[:-1], beyond.reshape(2, -1))
        values[:-1, long] = np.einsum("n,mnk->mk", _WEIGHTS, found[:-1].reshape(-1, *shape))
        slopes[:-1, :, long] = np.einsum("n,mank->mak", _WEIGHTS, by[:-1].reshape(-1, 2, *shape))
    return values, slopes
