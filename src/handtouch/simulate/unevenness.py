"""Logarithm of a sheet's resistance over its nominal value, as a sum of waves.

Public names: `Unevenness`, `wave_ratio` (of several sheets).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.simulate.film import FilmRatio


@dataclass(frozen=True)
class Unevenness:
    """Logarithm of the sheet resistance over its nominal value, as a sum of waves and of a measured film.

    amplitudes[i] is that of cos(m pi x) cos(n pi y) with (m, n) = modes[i], x and y fractions of the pad.
    """

    modes: tuple[tuple[int, int], ...] = ()
    amplitudes: tuple[float, ...] = ()
    film: FilmRatio | None = None
    """Besides: the resistance that was measured."""

    @property
    def is_even(self) -> bool:
        """True if the sheet has the same resistance everywhere."""
        return not any(self.amplitudes) and self.film is None

    def ohm_ratio(self, position: FloatArray) -> FloatArray:
        """Return the local over the nominal sheet resistance (...) at positions (2, ...)."""
        waves = wave_ratio(self.modes, self.amplitudes, position)
        return waves if self.film is None else waves * np.exp(self.film.log_at(position))


def wave_ratio(
    modes: Sequence[tuple[int, int]], amplitudes: Sequence[float] | FloatArray, position: FloatArray
) -> FloatArray:
    """Return what waves contribute to `Unevenness.ohm_ratio` of a sheet, or of several: amplitudes (modes, n)
    at positions (2, n)."""
    log_ratio = np.zeros(position.shape[1:])
    for (m, n), amplitude in zip(modes, amplitudes, strict=True):
        log_ratio += amplitude * np.cos(m * math.pi * position[0]) * np.cos(n * math.pi * position[1])
    return np.asarray(np.exp(log_ratio))
