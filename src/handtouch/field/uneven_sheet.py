"""Fractions of a sheet whose resistance varies smoothly over the pad, to first order.

Public names: `UNEVEN_WAVES`, `unevenness_slopes`, `UnevenSheet`.

With sheet resistance rho exp(u) the potential phi of an electrode changes by d, where laplace(d) =
grad(u) . grad(phi), and d = 0 on the electrodes; gaps between them are taken for electrodes. In sine series,
integrated by parts, d needs phi itself only, which is bounded at the electrodes' ends; its slope isn't.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray
from handtouch.field.model import FractionModel

UNEVEN_WAVES = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Waves (p, q), cos(p pi x / a) cos(q pi y / b), of the logarithm of an uneven sheet's resistance."""
_TERMS, _QUADRATURE_POINTS = 24, 64  # along each side


class _CachedModel(FractionModel, Hashable, Protocol):
    """A `FractionModel` that results are kept for."""


def unevenness_slopes(network: _CachedModel, x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Return derivatives (waves, channels, ...) of the fractions at x, y by the amplitude of each wave."""
    number = np.arange(1, _TERMS + 1)[:, None] * math.pi
    s, t = np.broadcast_arrays(np.asarray(x) / network.a, np.asarray(y) / network.b)
    along_x, along_y = np.sin(number * s.ravel()), np.sin(number * t.ravel())
    found = np.einsum("wcmn,mk,nk->wck", _sine_coefficients(network), along_x, along_y, optimize=True)
    return np.asarray(found.reshape(*found.shape[:2], *s.shape))


class UnevenSheet:
    """A `FractionModel`: a network on a sheet with one wave of small amplitude in its resistance.

    wave: index of `UNEVEN_WAVES`. amplitude: of the logarithm of the sheet resistance.
    """

    def __init__(self, network: _CachedModel, wave: int, amplitude: float) -> None:
        self._network, self._wave, self._amplitude = network, wave, amplitude

    @property
    def a(self) -> float:
        """Length along x."""
        return self._network.a

    @property
    def b(self) -> float:
        """Length along y."""
        return self._network.b

    def fractions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the measured fractions (channels, ...)."""
        change = self._amplitude * unevenness_slopes(self._network, x, y)[self._wave]
        return np.asarray(self._network.fractions(x, y) + change)


@lru_cache(maxsize=64)
def _sine_coefficients(network: _CachedModel) -> FloatArray:
    """Return coefficients (waves, channels, terms, terms) of sin(m pi x / a) sin(n pi y / b)."""
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS)
    at, weights = (nodes + 1) / 2, weights / 2
    fractions = network.fractions(*np.meshgrid(network.a * at, network.b * at, indexing="ij"))
    weighted = fractions * weights[:, None] * weights
    number = np.arange(1, _TERMS + 1)[:, None] * math.pi
    sine, cosine = np.sin(number * at), number * np.cos(number * at)
    per_x, per_y = network.a**-2, network.b**-2
    eigenvalue = per_x * number**2 + per_y * number.T**2
    found = []
    for p, q in UNEVEN_WAVES:
        wave_x, wave_y = np.cos(p * math.pi * at), np.cos(q * math.pi * at)
        slope_x, slope_y = -p * math.pi * np.sin(p * math.pi * at), -q * math.pi * np.sin(q * math.pi * at)
        curvature = -(math.pi**2) * (per_x * p**2 + per_y * q**2)
        source = per_x * ((cosine * slope_x) @ weighted @ (sine * wave_y).T)
        source += per_y * ((sine * wave_x) @ weighted @ (cosine * slope_y).T)
        source += curvature * ((sine * wave_x) @ weighted @ (sine * wave_y).T)
        found.append(4 * source / eigenvalue)
    return np.asarray(found)
