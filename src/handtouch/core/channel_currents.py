"""Largest currents of a pad's channels, anywhere on the pad.

Public names: `PeakCurrent`, `ChannelCurrents`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handtouch.field.contact_law import MIN_SPREADING_RATIO, ContactLaw
from handtouch.field.model import ChannelModel
from handtouch.field.surface_base import Surface

_POINTS = 25  # along each side
_MIN_EDGE_SIDES = 1e-3
_MIN_FORCE_N, _MAX_FORCE_N = 1e-3, 1e3


class PeakCurrent(NamedTuple):
    """Largest current of one electrode by contacts of one force."""

    current_a: float
    """in the unit of the sum of the currents, which with switched electrodes is the mean of the states"""
    electrode: int
    edge_m: float
    """distance of the contact from the nearest edge"""


class ChannelCurrents:
    """Currents of a pad's electrodes by contacts on a grid of places."""

    def __init__(
        self,
        network: ChannelModel,
        surface: Surface,
        law: ContactLaw,
        drive_v: float,
        sheet_ohm_per_square: float,
    ) -> None:
        along = np.linspace(_MIN_EDGE_SIDES, 1 - _MIN_EDGE_SIDES, _POINTS)
        x, y = (at.ravel() for at in np.meshgrid(network.a * along, network.b * along))
        scale_x, scale_y = surface.scales(x, y)
        self._law, self._drive_v, self._sheet_ohm = law, drive_v, sheet_ohm_per_square
        self._spreading_m = network.spreading_radius(x, y) * np.sqrt(scale_x * scale_y)
        self._series_ohm, self._fractions = network.series_resistance(x, y), network.fractions(x, y)
        inward_x = np.minimum(x, network.a - x) * scale_x
        self._edge_m = np.minimum(inward_x, np.minimum(y, network.b - y) * scale_y)

    def peak(self, force_n: float) -> PeakCurrent:
        """Return the largest current of an electrode by contacts of a force.

        A contact that hangs over an edge is between one that touches it from inside and one whose current is
        all at its centre; here the mean of their resistances.
        """
        law, sheet_ohm = self._law, self._sheet_ohm
        total_a = law.current(force_n, self._drive_v, sheet_ohm, self._spreading_m, self._series_ohm)
        ratio = np.log(self._spreading_m / law.radius(force_n))
        over = np.maximum(ratio, np.log(MIN_SPREADING_RATIO)) - np.maximum(ratio, 0.0)
        total_a = self._drive_v / (self._drive_v / total_a - sheet_ohm * over / (4 * np.pi))
        currents_a = self._fractions * total_a
        electrode, place = np.unravel_index(int(np.argmax(currents_a)), currents_a.shape)
        return PeakCurrent(float(currents_a[electrode, place]), int(electrode), float(self._edge_m[place]))

    def middle(self, force_n: float) -> float:
        """Return the largest current [A] of an electrode by a contact of a force in the pad's middle."""
        place = self._spreading_m.size // 2
        spreading_m, series_ohm = self._spreading_m[place], self._series_ohm[place]
        total_a = self._law.current(force_n, self._drive_v, self._sheet_ohm, spreading_m, series_ohm)
        return float(total_a * self._fractions[:, place].max())

    def measured_force(self, full_scale_a: float) -> tuple[float, PeakCurrent]:
        """Return the greatest force [N] whose contacts, anywhere on the pad, leave every electrode below
        `full_scale_a`, infinite if all do; and the current of that force where it is largest."""
        low, high = _MIN_FORCE_N, _MAX_FORCE_N
        if (peak := self.peak(high)).current_a < full_scale_a:
            return float("inf"), peak
        while high > 1.001 * low:
            middle = (low * high) ** 0.5
            if self.peak(middle).current_a < full_scale_a:
                low = middle
            else:
                high = middle
        return low, self.peak(high)
