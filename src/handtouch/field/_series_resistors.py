"""Series resistors from electrodes to ground, the same for pads of any shape.

Resistors R mix the currents phi that directly grounded electrodes would collect: (1 + G R / sheet) I = phi, G
the conductance matrix for one ohm per square.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray


class GroundedElectrodes(ABC):
    """A pad whose m electrodes are grounded through `series_ohm`; infinity leaves one floating."""

    sheet_ohm_per_square: float
    series_ohm: tuple[float, ...]

    @property
    @abstractmethod
    def a(self) -> float:
        """Length along x."""

    @property
    @abstractmethod
    def b(self) -> float:
        """Length along y."""

    @property
    @abstractmethod
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square."""

    @abstractmethod
    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, shape (m, ...), summing to
        1.
        """

    @abstractmethod
    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...), unbounded at electrodes'
        ends.
        """

    def with_series_ohm(self, series_ohm: Sequence[float]) -> Self:
        """Return the same pad with other series resistors; costs microseconds."""
        network = self.__class__.__new__(self.__class__)
        network.__dict__.update(self.__dict__)
        network._set_series_resistors(series_ohm)
        return network

    def with_open_electrode(self, electrode: int) -> Self:
        """Return the same pad with one electrode connected to nothing; costs microseconds."""
        series = list(self.series_ohm)
        series[electrode] = np.inf
        return self.with_series_ohm(series)

    @np.errstate(all="ignore")
    def fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the measured fractions of the contact's current, resistors included; (m, ...), summing to
        1.
        """
        return self._mixed(self.ideal_fractions(x, y))

    def currents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return `fractions`, by its other name."""
        return self.fractions(x, y)

    @np.errstate(all="ignore")
    def series_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the resistance [ohm] that resistors add between a contact and ground: sum of phi_i V_i."""
        ideal = self.ideal_fractions(x, y)
        return np.asarray(np.einsum("i...,ij,j...->...", ideal, self._voltage_per_current, ideal))

    @property
    def series_quadratic_form(self) -> FloatArray:
        """Matrix Q (m, m) of the form f @ Q @ f [ohm] that gives `series_resistance` from measured fractions
        f.

        Raises ValueError where an electrode floats: its voltage doesn't follow from the currents.
        """
        if self._unmix is None:
            raise ValueError(
                "series_ohm: the voltage of a floating electrode does not follow from the currents"
            )
        return np.asarray(self._unmix.T * np.asarray(self.series_ohm))

    @property
    def series_sensitivity(self) -> FloatArray:
        """Matrix S (m, m) [1/ohm]: more of resistor j changes the measured fractions f by S[:, j] f[j].

        0 where electrodes touch: any resistance between them makes the currents of both unknown.
        """
        try:
            conductance = self.conductance
        except ValueError:
            return np.zeros_like(self._mix)
        return np.asarray(-self._mix @ conductance / self.sheet_ohm_per_square)

    @property
    def currents_per_ideal(self) -> FloatArray:
        """Matrix (m, m) from the fractions of directly grounded electrodes to those measured."""
        return self._mix

    @np.errstate(all="ignore")
    def _set_series_resistors(self, series_ohm: Sequence[float], count: int | None = None) -> None:
        """Compute the resistors' matrices: currents from phi and back, and voltages per ampere from phi."""
        resistance = np.asarray(series_ohm, np.float64)
        count = len(self.series_ohm) if count is None else count
        if resistance.shape != (count,) or not (resistance >= 0).all():
            raise ValueError(f"series_ohm must be {count} resistances of at least 0, got {series_ohm}")
        self.series_ohm = tuple(float(r) for r in resistance)
        self._mix: FloatArray = np.eye(count)
        self._unmix: FloatArray | None = np.eye(count)
        self._voltage_per_current: FloatArray = np.zeros((count, count))
        if not resistance.any():
            return
        if not np.isfinite(resistance).any():
            raise ValueError("series_ohm: at least one electrode must be connected to ground")
        # unknowns: the current of a connected electrode, the voltage over `sheet` of a floating one
        connected = np.isfinite(resistance)
        drop = np.where(connected, resistance, self.sheet_ohm_per_square)
        system = np.diag(connected.astype(float)) + self.conductance * (drop / self.sheet_ohm_per_square)
        solution = np.asarray(np.linalg.inv(system), np.float64)
        self._mix = solution * connected[:, None]
        self._unmix = system if connected.all() else None
        self._voltage_per_current = drop[:, None] * solution

    def _mixed(self, ideal: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(self._mix, ideal, axes=1)) if any(self.series_ohm) else ideal
