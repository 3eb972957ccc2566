"""Pads of two films: x electrodes on the upper one, y electrodes on the lower one, a pressed layer between.

Public name: `TwoLayers`. Geometry of four-wire touch film. With two insulated sides a film's potential is
linear between its electrodes, and so, by reciprocity, is the share that each collects of the current at a
place: the centroid of all current follows exactly, of any contacts at any pressures.

The layer carries its current between the films, so that sheet resistances add, and the logarithms of both
films' spreading radii; the law of a contact on one film holds with these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.channel_map import VARIATIONS, ChannelMap
from handtouch.field.surface_base import Surface

_IMAGES = 2  # on each side, and as many more per a / b; they fall by exp(-2 pi b / a) from one to the next
_TINY = 1e-30  # variance of leads below which they are exact
_LEAST_DISTANCE = 1e-9  # of an image, in sides: a contact on an insulated edge is as good as two


class TwoLayers(ChannelMap):
    """Channels x0, xa of the upper film, y0, yb of the lower one; signals are shares of a contact's
    current.

    ohm_per_square: of each film. lead_ohm: of the four electrodes, to their amplifiers. lead_std_ohm: their
    standard deviation, if they could be below 0; unevenness_std: that of the logarithm of a film's resistance
    from one end to the middle, and of shorter waves of it, each film's own.
    """

    def __init__(
        self,
        surface: Surface,
        ohm_per_square: float,
        contact_radius_m: float,
        lead_ohm: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
        *,
        lead_std_ohm: float = 0.0,
        unevenness_std: float = 0.0,
    ) -> None:
        super().__init__(surface, 4, contact_radius_m)
        self.sheet_ohm_per_square = 2 * ohm_per_square
        self._unevenness_std = unevenness_std
        known = np.array([_from_zero_on(ohm, lead_std_ohm) for ohm in lead_ohm])
        leads, lead_stds = np.moveaxis(known.reshape(2, 2, 2), 2, 0)
        film = ohm_per_square * np.array([self.a / self.b, self.b / self.a])
        whole = film + leads.sum(axis=1)
        self._begin, self._growth = leads[:, 0] / whole, film / whole
        self._lead_variance = np.square(lead_stds / whole[:, None])

    def respond(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return _pairs(*self._shares(x, y))

    def variation_slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return changes of each film: by what both leads shift alike, and by all else.

        With the variances v and w of its leads over the film's resistance, that of a share s is v (1 - s)^2
        + w s^2, of which v w / (v + w) is the same all over.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        along, sides, none = (x / self.a, y / self.b), (self.a, self.b), np.zeros_like(x)
        found = np.zeros((VARIATIONS, self.channels, *x.shape))
        for film, share in enumerate(self._shares(x, y)):
            begin, end = self._lead_variance[film]
            both = max(begin + end, _TINY)
            waves = _wave_variance(along[film], along[1 - film], sides[film] / sides[1 - film])
            varying = np.sqrt(both * (share - begin / both) ** 2 + self._unevenness_std**2 * waves)
            for number, change in enumerate((none + math.sqrt(begin * end / both), varying)):
                of_films = (change, none) if film == 0 else (none, change)
                found[2 * film + number] = _pairs(*of_films, change=True)
        return found

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the geometric mean of both films' radii."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        upper, lower = _strip_radius(x, y, self.a, self.b), _strip_radius(y, x, self.b, self.a)
        return np.asarray(np.sqrt(upper * lower))

    def _shares(self, x: FloatArray, y: FloatArray) -> list[FloatArray]:
        """Return the shares of the electrodes xa and yb."""
        along = x / self.a, y / self.b
        return [self._begin[k] + self._growth[k] * along[k] for k in range(2)]


def _pairs(of_xa: FloatArray, of_yb: FloatArray, *, change: bool = False) -> FloatArray:
    """Return the signals (4, ...) of which those of both electrodes of a film sum to 1, or changes, to 0."""
    whole = 0.0 if change else 1.0
    return np.stack([whole - of_xa, of_xa, whole - of_yb, of_yb])


def _from_zero_on(mean: float, std: float) -> tuple[float, float]:
    """Return mean and deviation of what is above 0 of a normal distribution with this mean and deviation."""
    if not std > 0:
        return mean, 0.0
    sigmas = mean / std
    ratio = NormalDist().pdf(sigmas) / NormalDist().cdf(sigmas)
    return mean + std * ratio, std * math.sqrt(1 - ratio * (sigmas + ratio))


def _wave_variance(s: FloatArray, t: FloatArray, ratio: float) -> FloatArray:
    """Return the variance of a share by waves of the film's resistance, each of unit amplitude, as those of a
    sheet; s: along the current, t: across, fractions of the sides of this ratio.

    By cos(pi i s) cos(pi j t) it changes by i sin(pi i s) cos(pi j t) / (pi (i^2 + (ratio j)^2)), to first
    order; waves across the current alone change nothing.
    """
    first, second = np.sin(np.pi * s) / np.pi, np.sin(2 * np.pi * s) / (2 * np.pi)
    across = np.cos(np.pi * t) / (1 + ratio**2)
    return np.asarray(first**2 * (1 + across**2) + second**2)


def _strip_radius(x: FloatArray, y: FloatArray, a: float, b: float) -> FloatArray:
    """Return the spreading radius of a film with electrodes at x = 0 and a, insulated at y = 0 and b.

    Of an endless strip it is that of a conformal map; insulated sides are mirrors.
    """
    twice = np.cos(2 * np.pi * x / a)
    log_radius = np.log(2 * a / np.pi * np.sin(np.pi * x / a))
    count = math.ceil(_IMAGES * (1 + a / b))
    mirrored = [2 * (y + b * number) for number in range(-count, count + 1)]
    repeated = [2 * b * number + 0 * y for number in range(1, count + 1)] * 2
    for away in mirrored + repeated:
        reach = np.cosh(np.pi * np.maximum(np.abs(away), _LEAST_DISTANCE * b) / a)
        log_radius = log_radius + 0.5 * np.log((reach - twice) / (reach - 1))
    return np.asarray(np.exp(log_radius))
