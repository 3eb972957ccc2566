"""Arrays of taxels: sensors of a force each, which a contact reaches the less the farther away it is.

Public names: `TaxelArray`, `TaxelContact`, `TaxelTolerances`, `PROFILES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.channel_map import VARIATIONS, ChannelMap
from handtouch.field.surface_base import Surface

PROFILES: Mapping[str, Callable[[FloatArray], FloatArray]] = MappingProxyType(
    {
        "gaussian": lambda square: np.exp(-0.5 * square),
        "buried": lambda square: (1 + square) ** -2.5,
    }
)
"""Response by the squared distance over the width. Gaussian: cells that a soft cover blurs; buried: pressure
at the depth `width` of an elastic cover under a point force (Boussinesq 1885)."""
_RING = math.sqrt(2 / 3)
_RING_POINTS = 6
"""Mean over a disc by its centre, weight 1/4, and six points on a ring (Abramowitz and Stegun 25.4.61): exact
for polynomials of degree 5."""
_SHIFT_STEP = 0.05  # of differences by a taxel's place, in widths


class TaxelContact(NamedTuple):
    """Contacts that signals are for."""

    radius_m: float
    radius_std_m: float = 0.0
    elongation_std: float = 0.0
    """of the logarithm of their length over their width"""


class TaxelTolerances(NamedTuple):
    """Standard deviations of the taxels' parts."""

    position_m: float = 0.0
    """of a place along each axis"""
    width: float = 0.0
    """of widths, relative"""
    crosstalk: float = 0.0
    """of the share of its nearest neighbours that a taxel reads besides"""
    profile: float = 0.0
    """of the share of the response that is about twice as wide"""
    touch: float = 0.0
    """see `ChannelMap.touch_error`"""


class TaxelArray(ChannelMap):
    """n taxels on or below a surface, each with a response that falls with the distance from it.

    places_m: (n, 2) lengths along the surface from the pad's centre, along x and y, or (n, 3) in the pad
    frame. normals: (n, 3) unit vectors out of the pad, None: the surface's. width_m: (n,) of the profile.
    gain: (n,) signal of a contact of unit strength right on the taxel.

    A taxel's place is across its normal; its height doesn't matter. Its signal is that of the force's
    component along its normal.
    """

    def __init__(
        self,
        surface: Surface,
        places_m: npt.ArrayLike,
        width_m: npt.ArrayLike,
        gain: npt.ArrayLike = 1.0,
        *,
        normals: npt.ArrayLike | None = None,
        profile: str = "gaussian",
        patch: TaxelContact,
        tolerances: TaxelTolerances,
    ) -> None:
        places = np.asarray(places_m, np.float64)
        if places.ndim != 2 or places.shape[1] not in (2, 3):
            raise ValueError("positions_mm: each must have two numbers, along the surface, or three")
        super().__init__(surface, len(places), *patch)
        count = len(places)
        self._profile = PROFILES[profile]
        self._width = np.broadcast_to(np.asarray(width_m, np.float64), (count,))
        self._gain = np.broadcast_to(np.asarray(gain, np.float64), (count,))
        self._places = _on_surface(surface, places) if places.shape[1] == 2 else places
        if normals is None:
            self._normals = _nearest_normals(surface, self._places)
        else:
            given = np.asarray(normals, np.float64)
            self._normals = given / np.linalg.norm(given, axis=1, keepdims=True)
        self._tolerances = tolerances

    @property
    def touch_error(self) -> float:
        return self._tolerances.touch

    def respond(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return self._respond(x, y, self._places, self._width)

    def channel_slopes(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return changes by a shift of each taxel along the pad's x, and across."""
        along = np.array([1.0, 0.0, 0.0]) - self._normals[:, :1] * self._normals
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.cross(self._normals, along)
        step = _SHIFT_STEP * self._width[:, None]
        shape = (-1, *(1,) * np.ndim(x))
        # a width changes a signal as a shift by the same share of the distance does
        by_width = self._tolerances.width * np.sqrt(self._squares(x, y, self._places))
        std = np.hypot(self._tolerances.position_m, by_width) / (2 * step.reshape(shape))
        return std * np.stack(
            [
                self._respond(x, y, self._places + step * way, self._width)
                - self._respond(x, y, self._places - step * way, self._width)
                for way in (along, across)
            ]
        )

    def variation_slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return changes by the width that all taxels have in common, by cross-talk and by a wide tail."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        found = np.zeros((VARIATIONS, self.channels, *x.shape))
        wide, narrow = (
            self._respond(x, y, self._places, self._width * factor)
            for factor in (1 + self._tolerances.width, 1 - self._tolerances.width)
        )
        found[0] = (wide - narrow) / 2
        nominal = self.respond(x, y)
        found[1] = self._tolerances.crosstalk * np.tensordot(self._neighbours, nominal, axes=1)
        tail = self._respond(x, y, self._places, self._width, _tail)
        found[2] = self._tolerances.profile * (tail - nominal)
        return found

    @cached_property
    def _neighbours(self) -> FloatArray:
        """Matrix (n, n): 1 for the nearest of other taxels, less for those farther away."""
        square = np.square(self._places[:, None] - self._places[None]).sum(axis=2)
        np.fill_diagonal(square, np.inf)
        return np.asarray(np.exp(1 - square / square.min()))

    def _respond(
        self,
        x: FloatArray,
        y: FloatArray,
        places: FloatArray,
        width: FloatArray,
        profile: Callable[[FloatArray], FloatArray] | None = None,
    ) -> FloatArray:
        """Return the signals (n, ...), the mean over a disc of the contact's radius."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        scale_x, scale_y = self.surface.scales(x, y)
        reach = _RING * self.contact_radius_m
        profile = profile or self._profile
        found = 0.25 * self._point_response(x, y, places, width, profile)
        for angle in 2 * np.pi * np.arange(_RING_POINTS) / _RING_POINTS:
            ring_x = np.clip(x + reach * math.cos(angle) / scale_x, 0, self.a)
            ring_y = np.clip(y + reach * math.sin(angle) / scale_y, 0, self.b)
            found += 0.75 / _RING_POINTS * self._point_response(ring_x, ring_y, places, width, profile)
        right_on_it = 0.25 + 0.75 * self._profile((reach / width) ** 2)
        return found * (self._gain / right_on_it).reshape(-1, *(1,) * x.ndim)

    def _point_response(
        self,
        x: FloatArray,
        y: FloatArray,
        places: FloatArray,
        width: FloatArray,
        profile: Callable[[FloatArray], FloatArray],
    ) -> FloatArray:
        outward, shape = self.surface.normal(x, y), (-1, *(1,) * np.ndim(x))
        facing = sum(outward[axis] * self._normals[:, axis].reshape(shape) for axis in range(3))
        square = self._squares(x, y, places) / width.reshape(shape) ** 2
        return np.asarray(profile(square) * np.maximum(facing, 0.0))

    def _squares(self, x: FloatArray, y: FloatArray, places: FloatArray) -> FloatArray:
        """Return the squared distances (n, ...) of places on the pad from the taxels' axes [m^2]."""
        point, shape = self.surface.point(x, y), (-1, *(1,) * np.ndim(x))
        away = [point[axis] - places[:, axis].reshape(shape) for axis in range(3)]
        height = sum(one * self._normals[:, axis].reshape(shape) for axis, one in enumerate(away))
        return np.asarray(np.maximum(sum(one * one for one in away) - height * height, 0.0))


def _tail(square: FloatArray) -> FloatArray:
    """Return a profile about twice as wide with the same integral as a Gaussian one."""
    return np.asarray(0.25 * (1 + square / 8) ** -2)


def _on_surface(surface: Surface, places_m: FloatArray) -> FloatArray:
    """Return the points (n, 3) [m] at lengths along the surface from the pad's centre."""
    u = surface.extent_m[0] / 2 + places_m[:, 0]
    x, _ = surface.to_rectangle(u, np.zeros_like(u))
    _, middle = surface.from_rectangle(x, np.full_like(x, surface.b / 2))
    return surface.point(*surface.to_rectangle(u, middle + places_m[:, 1])).T


def _nearest_normals(surface: Surface, points: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Return the normals (n, 3) of the surface where it is nearest to points (n, 3)."""
    way = np.linspace(0.0, 1.0, 101)
    x, y = (at.ravel() for at in np.meshgrid(surface.a * way, surface.b * way))
    on_surface = surface.point(x, y)
    nearest = [
        int(np.square(on_surface - np.asarray(point)[:, None]).sum(axis=0).argmin()) for point in points
    ]
    return surface.normal(x[nearest], y[nearest]).T
