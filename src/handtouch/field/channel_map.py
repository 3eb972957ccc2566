"""Pads whose channels respond to a contact in any known way: arrays of taxels, measured maps.

Public names: `ChannelMap`, `VARIATIONS`. What tables, tolerances and diagnoses read of them is the same as of
an `ElectrodeNetwork`, with another meaning: fractions are the channels' signals for a contact of unit
strength, and needn't sum to 1.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.surface_base import Surface

VARIATIONS = 5
"""Ways in which a map may be off in all channels together; as many as waves of a sheet's resistance."""
_SLOPE_STEP = 1e-4  # step of differences, in sides
_PATCH_STEP = 0.02  # the same of second ones: signals of a patch vary no faster
_DIGEST_POINTS = 11
_CENTRE_POINTS = 33  # along each side, among which a channel's greatest response is found
_SPREADING_RATIO = np.e**1.5
"""Spreading radius of the equivalent contact, over its own: any that keeps it away from an edge."""


class ChannelMap(ABC):
    """Signals of n channels for a contact at (x, y) of a surface's rectangle; a `ForwardModel`.

    A subclass gives the signals `respond` for a contact of unit strength, and the tolerances of its parts,
    each as the change by one standard deviation. contact_radius_m: of the contacts that they are for;
    contact_radius_std_m, contact_elongation_std: spread of their radii, and of the logarithm of their length
    over their width.
    """

    sheet_ohm_per_square = 1.0  # unit of a conductance that isn't there
    states: tuple[tuple[int, ...], ...] = ()
    ends: tuple[()] = ()
    is_potential = False
    _open: frozenset[int] = frozenset()

    def __init__(
        self,
        surface: Surface,
        channels: int,
        contact_radius_m: float,
        contact_radius_std_m: float = 0.0,
        contact_elongation_std: float = 0.0,
    ) -> None:
        self.surface, self.channels = surface, channels
        self.contact_radius_m = contact_radius_m
        by_radius = contact_radius_m * contact_radius_std_m / 2
        by_shape = contact_radius_m**2 / 4 * np.sinh(contact_elongation_std) / np.sqrt(2)
        self.patch_std_m2 = float(np.hypot(by_radius, by_shape))
        """standard deviation of the variance of a contact's pressure along an axis"""

    @abstractmethod
    def respond(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the signals (n, ...) of a contact of unit strength at places on the pad, of shape (...)."""

    @cached_property
    def digest(self) -> str:
        """Name of everything that tables depend on: a hash of signals and changes on a grid."""
        way = (np.arange(_DIGEST_POINTS) + 0.5) / _DIGEST_POINTS
        x, y = np.meshgrid(self.a * way, self.b * way)
        parts = self.fractions(x, y), self.channel_slopes(x, y), self.variation_slopes(x, y)
        values = np.concatenate([part.ravel() for part in (*parts, self.spreading_radius(0.0, 0.0))])
        return hashlib.sha256(values.tobytes()).hexdigest()

    def channel_slopes(self, x: FloatArray, y: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return changes (2, n, ...) of each channel by its own two parts, one standard deviation of each."""
        return np.zeros((2, self.channels, *np.shape(x)))

    def variation_slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:  # noqa: ARG002
        """Return changes (VARIATIONS, n, ...) of all channels by what they have in common, likewise."""
        return np.zeros((VARIATIONS, self.channels, *np.shape(x)))

    @property
    def touch_error(self) -> float:
        """Standard deviation of a signal at unit strength that is another one in each touch."""
        return 0.0

    @property
    def a(self) -> float:
        """Length of the surface's rectangle along x."""
        return self.surface.a

    @property
    def b(self) -> float:
        """Length of the surface's rectangle along y."""
        return self.surface.b

    @property
    def series_ohm(self) -> tuple[float, ...]:
        """Series resistors: none."""
        return (0.0,) * self.channels

    @property
    def conductance(self) -> FloatArray:
        """Raise ValueError: no current flows between channels."""
        raise ValueError("channels of a map have no conductance to each other")

    @property
    def currents_per_ideal(self) -> FloatArray:
        """Matrix (n, n) from the signals of a pad with all channels to those of this one."""
        return np.diag([float(channel not in self._open) for channel in range(self.channels)])

    @property
    def series_quadratic_form(self) -> FloatArray:
        """Zeros (n, n): there are no resistors."""
        return np.zeros((self.channels, self.channels))

    @property
    def series_sensitivity(self) -> FloatArray:
        """Zeros (n, n): there are no resistors."""
        return np.zeros((self.channels, self.channels))

    @cached_property
    def centres(self) -> FloatArray:
        """Places (n, 2) of the greatest response of each channel."""
        way = (np.arange(_CENTRE_POINTS) + 0.5) / _CENTRE_POINTS
        x, y = (at.ravel() for at in np.meshgrid(self.a * way, self.b * way))
        most = self.respond(x, y).argmax(axis=1)
        return np.stack([x[most], y[most]], axis=1)

    def with_open_electrode(self, electrode: int) -> Self:
        """Return the same pad with one channel that reads nothing."""
        other = self.__class__.__new__(self.__class__)
        other.__dict__.update(self.__dict__)
        other._open = self._open | {electrode}
        return other

    def fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the signals (n, ...) of a contact of unit strength; NaN off the pad."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        on_pad = (x >= 0) & (x <= self.a) & (y >= 0) & (y <= self.b)
        found = self.respond(np.where(on_pad, x, self.a / 2), np.where(on_pad, y, self.b / 2))
        found = np.where(on_pad, found, np.nan)
        for channel in self._open:
            found[channel] *= 0.0
        return found

    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` and their derivatives (n, 2, ...) by (x, y)."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        slopes = []
        for axis, side in enumerate((self.a, self.b)):
            at, step = (x, y)[axis], _SLOPE_STEP * side
            low, high = np.clip(at - step, 0, side), np.clip(at + step, 0, side)
            ends = [self.fractions(*((end, y) if axis == 0 else (x, end))) for end in (low, high)]
            with np.errstate(all="ignore"):
                slopes.append((ends[1] - ends[0]) / (high - low))
        return self.fractions(x, y), np.stack(slopes, axis=1)

    def patch_slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return derivatives (n, ...) of the signals by the variance of a contact's pressure along both axes
        at once, and by half the difference of both."""
        second = []
        for axis, side in enumerate((self.a, self.b)):
            step = _PATCH_STEP * side
            at = np.clip((x, y)[axis], step, side - step)
            less, middle, more = (
                self.fractions(*((at + k * step, y) if axis == 0 else (x, at + k * step))) for k in (-1, 0, 1)
            )
            second.append((more - 2 * middle + less) / step**2)
        along_x, along_y = second
        return (along_x + along_y) / 2, (along_x - along_y) / 2

    def patch_std(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the standard deviation (...) of a contact's variances, in squares of the unit of x."""
        return np.asarray(self.patch_std_m2 / np.prod(self.surface.scales(x, y), axis=0))

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return a radius that is the same everywhere: strength doesn't depend on the place."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        scale = float(self.surface.scale(self.a / 2, self.b / 2))
        return np.full(x.shape, _SPREADING_RATIO * self.contact_radius_m / scale)

    def series_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return zeros: there are no resistors."""
        return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))


class ChangedMap:
    """A `FractionModel`: a map with one part of one channel, or one variation, off by a standard deviation.

    slot: part `slot % 2` of channel `slot // 2`; from 2 n on a variation.
    """

    def __init__(self, channel_map: ChannelMap, slot: int) -> None:
        self._map, self._slot = channel_map, slot

    @property
    def a(self) -> float:
        """Length along x."""
        return self._map.a

    @property
    def b(self) -> float:
        """Length along y."""
        return self._map.b

    def fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the signals (n, ...)."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        found, own = self._map.fractions(x, y), 2 * self._map.channels
        if self._slot >= own:
            return np.asarray(found + self._map.variation_slopes(x, y)[self._slot - own])
        channel, part = divmod(self._slot, 2)
        found[channel] += self._map.channel_slopes(x, y)[part, channel]
        return found
