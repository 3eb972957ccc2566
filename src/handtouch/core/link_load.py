"""Effect of a link's orientation and acceleration on the readings of its pad, learned while it is untouched.

Public name: `LinkLoad`.

What lies on a sheet presses on it by weight and inertia, along the normal, and only where that points down:
no linear function of gravity. So the reading of a channel is one of the second degree, whose coefficients are
estimated by recursive least squares, with one covariance for all channels of a pad. A reading is compared
with what is left after offsets were tracked, so its terms are taken from their mean with the same time
constant: a constant offset isn't attributed to gravity. Coefficients of terms never seen are 0.

Magnetic pads read the component of the Earth's field along each channel's axis, wherever that points: a
linear function of the rotation matrix of their link, whose entries are products of its quaternion's parts.
"""

from __future__ import annotations

import numpy as np

from handtouch.arrays import BoolArray, FloatArray
from handtouch.core.state import LOAD_TERMS, TickState

_INITIAL_THRESHOLDS = 1.0
"""Standard deviation of a coefficient at first, in thresholds at which a contact begins, for one g."""
_INITIAL_MAGNETIC_THRESHOLDS = 4.0
"""The same of magnetic pads, for a radian: 20 degrees shift a channel by the signal of 0.1 N, or less."""
_MISFIT_NOISE = 2.0
"""Deviation of a block's mean from the polynomial, over the noise of a sample."""
_MIN_FELT = 1e-3
"""Less is free fall"""
_FORGETTING_TIME_S = 3600.0
"""Time in which coefficients become as uncertain as at first: skins move, and wear."""


class LinkLoad:
    """Readings that gravity and acceleration cause on n pads of c channels.

    Public state: `felt` (n, 3): gravity less the acceleration in each link's frame, in units of gravity, 0:
    never known, or of `magnetic` pads (n,) the vector part of its quaternion; `coefficients` (n, c, k)
    [counts] of the terms of `felt`.
    """

    def __init__(self, state: TickState) -> None:
        self.felt, self.coefficients = state.felt, state.load_coefficients
        self._terms, self._smoothed = state.load_terms, state.smoothed_load_terms
        self._sum, self._count = state.load_term_sum, state.load_term_count
        self._covariance = state.load_covariance
        self.magnetic: BoolArray = np.zeros(len(self.felt), np.bool_)

    def set_felt(self, felt: FloatArray) -> None:
        """Set gravity less acceleration, or orientation, (n, 3), NaN where unknown: the last one holds."""
        known = ~np.isnan(felt[:, 0])
        first = known & ~self.felt.any(axis=1)
        self.felt[known] = felt[known]
        self._terms[:] = _terms(self.felt)
        if np.count_nonzero(self.magnetic):
            self._terms[self.magnetic] = _turn_terms(self.felt[self.magnetic])
        self._smoothed[first] = self._terms[first]
        self._sum += self._terms
        self._count[0] += 1.0

    def reset_pad(self, pad: int) -> None:
        """Forget what was learned of a pad."""
        self.coefficients[pad] = self._covariance[pad] = 0.0

    def expected_counts(self) -> FloatArray | None:
        """Return what channels read by it (n, c); None if nothing is known of any link."""
        if not np.count_nonzero(self.felt):
            return None
        return np.asarray(np.matmul(self.coefficients, self._terms[:, :, None])[:, :, 0])

    def learn(
        self,
        mean: FloatArray,
        free: BoolArray,
        dt_s: FloatArray,
        noise: FloatArray,
        threshold: FloatArray,
        tracking_time_s: float,
    ) -> FloatArray | None:
        """Learn from the mean excess (n, c) of a block of samples of untouched pads `free` [counts], dt_s
        (n,) after the last one; noise, threshold: (n,) of pads. Return what to add to the offsets (n, c)."""
        if not np.count_nonzero(self.felt):
            return None
        count = float(self._count[0])
        terms = self._sum / count if count else self._terms
        changed = terms - self._smoothed
        self._smoothed += changed * (-np.expm1(-dt_s / tracking_time_s) * free)[:, None]
        initial = self._initial_covariance(threshold)
        missing = initial - self._covariance
        new = (self._covariance[:, 0, 0] == 0.0)[:, None, None]
        self._covariance += np.where(
            new, missing, missing * -np.expm1(-dt_s / _FORGETTING_TIME_S)[:, None, None]
        )
        towards = np.matmul(self._covariance, changed[:, :, None])[:, :, 0]
        variance = (changed * towards).sum(axis=1) + np.square(_MISFIT_NOISE * noise)
        gain = towards * (free / variance)[:, None]
        self._covariance -= gain[:, :, None] * towards[:, None]
        moved = mean[:, :, None] * gain[:, None]
        self.coefficients += moved
        self._sum[:] = 0.0
        self._count[0] = 0.0
        return np.asarray(-np.matmul(moved, self._smoothed[:, :, None])[:, :, 0])

    def unknown_counts(self, threshold: FloatArray) -> FloatArray:
        """Return the standard deviation (n,) of what the orientation adds to a channel of magnetic pads, by
        how far its coefficients are unknown; 0 of others."""
        changed, covariance = self._terms - self._smoothed, self._covariance
        new = (covariance[:, 0, 0] == 0.0)[:, None, None]
        covariance = np.where(new, self._initial_covariance(threshold), covariance)
        variance = np.matmul(np.matmul(changed[:, None], covariance), changed[:, :, None])[:, 0, 0]
        return np.asarray(np.sqrt(variance) * self.magnetic)

    def _initial_covariance(self, threshold: FloatArray) -> FloatArray:
        std = np.where(self.magnetic, _INITIAL_MAGNETIC_THRESHOLDS, _INITIAL_THRESHOLDS) * threshold
        return np.asarray(np.square(std)[:, None, None] * np.eye(LOAD_TERMS))


def _terms(felt: FloatArray) -> FloatArray:
    """Return the terms (n, k) of vectors (n, 3): of the second degree in their directions, and as their size,
    as pressures are."""
    x, y, z = felt.T
    size = np.maximum(np.sqrt(x * x + y * y + z * z), _MIN_FELT)
    return np.stack(
        [x, y, z, x * x / size, y * y / size, z * z / size, x * y / size, x * z / size, y * z / size], axis=1
    )


def _turn_terms(vector: FloatArray) -> FloatArray:
    """Return the terms (n, k) of orientations by the vector parts (n, 3) of their quaternions."""
    x, y, z = vector.T
    w = np.sqrt(np.maximum(1 - x * x - y * y - z * z, 0.0))
    products = [w * x, w * y, w * z, x * x, y * y, z * z, x * y, x * z, y * z]
    return np.asarray(2 * np.stack(products, axis=1))
