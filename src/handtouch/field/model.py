"""Interface of forward models: estimators and tables work with any pad that implements it."""

from __future__ import annotations

from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray


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


class ChannelModel(ForwardModel, Protocol):
    """A `ForwardModel` with what tables, tolerances and diagnoses read of a pad: an `ElectrodeNetwork`, or a
    `ChannelMap`."""

    @property
    def digest(self) -> str:
        """Name of what isn't among the other parameters."""
        ...

    @property
    def sheet_ohm_per_square(self) -> float:
        """Sheet resistance."""
        ...

    @property
    def is_potential(self) -> bool:
        """Whether fractions are potentials of one sheet, harmonic, whose sum is 1."""
        ...

    @property
    def states(self) -> tuple[tuple[int, ...], ...]:
        """Channels that are connected in each state of a schedule; empty: all of them, always."""
        ...

    @property
    def ends(self) -> tuple[Any, ...]:
        """Ends of the electrodes, where fractions are singular; empty where they are smooth."""
        ...

    @property
    def series_ohm(self) -> tuple[float, ...]:
        """Series resistors (m,) from the channels to ground."""
        ...

    @property
    def conductance(self) -> FloatArray:
        """Currents between channels (m, m). Raises ValueError where there is none, or an infinite one."""
        ...

    @property
    def centres(self) -> FloatArray:
        """Mean position, or place of the greatest response, of each channel (m, 2)."""
        ...

    @property
    def currents_per_ideal(self) -> FloatArray:
        """Matrix (m, m) from the fractions without resistors to those measured."""
        ...

    @property
    def series_quadratic_form(self) -> FloatArray:
        """Matrix (m, m) of the form of measured fractions that gives `series_resistance`."""
        ...

    @property
    def series_sensitivity(self) -> FloatArray:
        """Matrix (m, m) of changes of the fractions by each resistor, per its channel's fraction."""
        ...

    def with_open_electrode(self, electrode: int) -> Self:
        """Return the pad with one channel connected to nothing."""
        ...

    def spreading_radius(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the radius in the sheet resistance to a contact, (...)."""
        ...

    def series_resistance(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return what resistors add to the resistance of a contact [ohm], (...)."""
        ...

    def variation_slopes(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return changes (waves, m, ...) of the fractions by each way in which all may be off together."""
        ...


def channel_noise(noise: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return standard deviations for currents of shape (channels, ...), broadcast to it.

    noise: one for all, one per channel (channels,), or any array that broadcasts against the currents. One
    dimension as long as there are channels always means one per channel; for one per contact give (1, n).
    """
    sigma = np.asarray(noise, dtype=np.float64)
    if sigma.ndim == 1 and len(shape) > 1 and len(sigma) == shape[0]:
        sigma = sigma.reshape(-1, *(1,) * (len(shape) - 1))
    return np.broadcast_to(sigma, shape)
