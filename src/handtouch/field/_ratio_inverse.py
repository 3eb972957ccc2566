"""Distance from a side, given the ratio of its current to the opposite one: Landen's transformation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field._separable import SideRatio

_MIN_MODULUS = 1e-15  # a smaller modulus changes the inverse by less than rounding
_MAX_TRIGONOMETRIC_MODULUS = 6e-9  # a complementary modulus below this leaves an arctangent
LOGARITHMIC_DEPTH = 12.0  # depth / length from which the modulus is below _MIN_MODULUS


def landen_moduli(k: float, k_complement: float) -> list[tuple[float, float]]:
    """Return (k, k') of every step of the descending Landen transformation, until k is negligible."""
    steps = []
    while k > _MIN_MODULUS:
        steps.append((k, k_complement))
        k, k_complement = k * k / (1 + k_complement) ** 2, 2 * math.sqrt(k_complement) / (1 + k_complement)
    return steps


class RatioInverse:
    """Solves T0 / T1 = ratio for the distance to the nearer side, for one or both pairs of sides at once."""

    def __init__(self, pairs: Sequence[SideRatio]) -> None:
        self._pairs = tuple(pairs)

    @cached_property
    def _trigonometric(self) -> bool:
        return all(pair.moduli[1] < _MAX_TRIGONOMETRIC_MODULUS for pair in self._pairs)

    @cached_property
    def _first(self) -> FloatArray:
        """1 / k of each pair."""
        return np.array([[1 / pair.moduli[0]] for pair in self._pairs])

    @cached_property
    def _steps(self) -> list[tuple[FloatArray, FloatArray]]:
        """k^2 and (1 + k')^2 of each step, for each pair; a pair that finishes early takes idle steps."""
        chains = [landen_moduli(*pair.moduli) for pair in self._pairs]
        longest = max(map(len, chains))
        chains = [chain + [(1.0, 0.0)] * (longest - len(chain)) for chain in chains]
        return [
            (np.array([[k * k] for k, _ in step]), np.array([[(1 + kc) ** 2] for _, kc in step]))
            for step in zip(*chains, strict=True)
        ]

    @cached_property
    def _scale(self) -> FloatArray:
        """Distance per unit of the final arsinh."""
        scales = np.array([[1 / pair.wavenumber] for pair in self._pairs])
        if not self._trigonometric:
            for _, factor in self._steps:
                scales = scales / np.sqrt(factor)
        return scales

    def __call__(self, ratio: FloatArray) -> FloatArray:
        """Return the distance to the nearer side, for `ratio` >= 1 of its T to the opposite one; (pairs,
        n).
        """
        squared = self._first / ratio  # sc(kappa d; k')^2
        if self._trigonometric:
            return np.asarray(np.arctan(np.sqrt(squared)) * self._scale)
        for modulus, factor in self._steps:
            squared = squared * (squared + 1) * factor / (squared * modulus + 1)
        return np.asarray(np.arcsinh(np.sqrt(squared)) * self._scale)


def distance_in_strip(pair: SideRatio, near: FloatArray, across: FloatArray) -> FloatArray:
    """Return the distance to the nearer side of a pair more than LOGARITHMIC_DEPTH times as deep as long.

    `near` is the T of that side, `across` the distance to the nearer long side. The other end of such a strip
    collects no measurable current, so this end alone decides: sinh(pi d / length) = sin(pi across / length) /
    T. NaN where the current of this end has underflowed as well.
    """
    shift = math.pi / pair.length
    across = np.where(np.isnan(across), pair.length / 2, across)  # NaN only on the end itself
    sine = np.sin(shift * across)
    log_sinh = np.log(sine) - np.log(near)
    distance = np.where(log_sinh > 20, log_sinh + math.log(2), np.arcsinh(sine / near))
    return np.asarray(np.where(near >= np.finfo(float).tiny, distance / shift, np.nan))
