"""Measured sheet resistance of a simulated pad's film, between the places where it was measured.

Public name: `FilmRatio`. It is independent of `handtouch.field`: places are found by the simulated geometry,
and values in between by another interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.simulate.pad_geometry import SimulatedSurface

_NEIGHBOURS = 24


@dataclass(frozen=True)
class FilmRatio:
    """Local over nominal sheet resistance of a film, by fractions of the pad."""

    place: tuple[tuple[float, float], ...]
    """Fractions of the pad at which it was measured."""
    log_ratio: tuple[float, ...]

    @classmethod
    def of_pad(cls, pad: config.Pad, sheet: config.Sheet, shape: SimulatedSurface) -> FilmRatio | None:
        """Return the film of a pad; None for an even one. shape: nominal surface of the pad."""
        if pad.resistance_map is None:
            return None
        film = config.film_of(pad.resistance_map)
        log_ratio = np.log(film.ohm_per_square / sheet.ohm_per_square)
        return cls(tuple(map(tuple, shape.film_fractions(film.place_m).tolist())), tuple(log_ratio.tolist()))

    def log_at(self, position: FloatArray) -> FloatArray:
        """Return the logarithm of the ratio (...) at positions (2, ...)."""
        flat = np.asarray(position, np.float64).reshape(2, -1).T
        return np.asarray(_interpolator(self)(np.clip(flat, 0, 1)).reshape(np.shape(position)[1:]))


@lru_cache(maxsize=64)
def _interpolator(film: FilmRatio) -> Any:
    from scipy.interpolate import RBFInterpolator

    count = min(_NEIGHBOURS, len(film.place))
    place, values = np.array(film.place), np.array(film.log_ratio)
    return RBFInterpolator(place, values, neighbors=count, kernel="linear", degree=1)
