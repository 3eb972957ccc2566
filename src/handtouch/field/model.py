"""Interface of forward models: estimators and tables work with any pad that implements it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


class FractionModel(Protocol):
    """Maps a point contact at (x, y) of a pad 0 <= x <= a, 0 <= y <= b to the fractions its channels
    measure.

    Channels are ordered x0, xa, y0, yb; a model with other electrodes has as many channels as electrodes. The
    fractions are those *measured* (corner gaps and series resistors included), per unit of the current that
    the contact would inject into a grounded sheet; they need not sum to one.
    """

    @property
    def a(self) -> float:
        """Length of the pad along x, in the unit of x."""
        ...

    @property
    def b(self) -> float:
        """Length of the pad along y, in the unit of y."""
        ...

    def fractions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the measured fractions, shape (channels, ...) for x and y of broadcast shape (...).

        NaN, in its own element only, for a point that is NaN or off the pad.
        """
        ...


@runtime_checkable
class ForwardModel(FractionModel, Protocol):
    """A `FractionModel` with derivatives."""

    def fractions_with_jacobian(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` and their derivatives by (x, y), shape (channels, 2, ...)."""
        ...


def spreading_radius(model: ForwardModel, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the radius in the sheet resistance ln(radius / A) / (2 pi): the conformal radius, enlarged by
    gaps.
    """
    radius = getattr(model, "spreading_radius", None) or model.conformal_radius  # type: ignore[attr-defined]
    return np.asarray(radius(x, y), dtype=np.float64)


def channel_noise(noise: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return standard deviations for currents of shape (channels, ...), broadcast to it.

    noise: one for all, one per channel (channels,), or any array that broadcasts against the currents. One
    dimension as long as there are channels always means one per channel; for one per contact give (1, n).
    """
    sigma = np.asarray(noise, dtype=np.float64)
    if sigma.ndim == 1 and len(shape) > 1 and len(sigma) == shape[0]:
        sigma = sigma.reshape(-1, *(1,) * (len(shape) - 1))
    return np.broadcast_to(sigma, shape)
