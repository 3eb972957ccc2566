"""Pads whose electrodes are connected in turn, one group of them a period, by a schedule of switches.

Public name: `ScheduledNetwork`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handtouch.field._series_resistors import FloatArray
from handtouch.field.rectangle_network import ElectrodeEnd, RectangleNetwork


class ScheduledNetwork(RectangleNetwork):
    """The currents of a whole schedule, one of each electrode, as those of one pad; a `ForwardModel`.

    network: the pad, each electrode with its own resistor when it is connected. states: (states, k), the
    electrodes that are connected in each period, each of them in one; the others float meanwhile. Channels
    are the electrodes in the order of `network`. Fractions of one state sum to 1 / states, as if the same
    current entered in each; the true ones differ, since a contact sees other electrodes in each state, which
    is for the estimate to allow for. What floating electrodes and resistors add to the resistance between a
    contact and ground, in the mean of the states, is part of `spreading_radius`.

    Raises ValueError for fewer than two states, and unless each electrode is in exactly one.
    """

    def __init__(self, network: RectangleNetwork, states: Sequence[Sequence[int]]) -> None:
        self.network = network
        self.states = tuple(tuple(int(number) for number in state) for state in states)
        self.sheet_ohm_per_square, self.series_ohm = network.sheet_ohm_per_square, network.series_ohm
        count = len(network.series_ohm)
        if len(self.states) < 2 or sorted(sum(self.states, ())) != list(range(count)):
            raise ValueError(
                f"states: each of {count} electrodes must be in one of two states or more, got {states}"
            )
        self._of_state = [
            network.with_series_ohm(
                [ohm if number in state else math.inf for number, ohm in enumerate(network.series_ohm)]
            )
            for state in self.states
        ]
        self._bare = network.with_series_ohm([0.0] * count)
        # a floating electrode has no current, so that each row of the sum is of one state
        self._mix = np.sum([one.currents_per_ideal for one in self._of_state], axis=0) / len(self.states)

    @property
    def a(self) -> float:
        """Length along x."""
        return self.network.a

    @property
    def b(self) -> float:
        """Length along y."""
        return self.network.b

    @property
    def ends(self) -> tuple[ElectrodeEnd, ...]:
        """Both ends of each electrode: (2 m,)."""
        return self.network.ends

    @property
    def centres(self) -> FloatArray:
        """Middle of each electrode, (m, 2)."""
        return self.network.centres

    @property
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square."""
        return self.network.conductance

    @property
    def independent_channels(self) -> int:
        """Number of linearly independent currents of the schedule; at most that of the electrodes."""
        return int(np.linalg.matrix_rank(self._mix))

    def with_series_ohm(self, series_ohm: Sequence[float]) -> ScheduledNetwork:
        """Return the same pad and schedule with other resistors; infinity leaves one floating in all states.

        Raises ValueError if no electrode of a state is connected.
        """
        return ScheduledNetwork(self.network.with_series_ohm(series_ohm), self.states)

    def with_moved_end(self, end: int, step: float) -> ScheduledNetwork:
        """Return the pad with an end (index of `ends`) moved inward, which makes its electrode shorter."""
        return ScheduledNetwork(self.network.with_moved_end(end, step), self.states)

    def stretched(self, factor: float) -> ScheduledNetwork:
        """Return the pad with a, and the electrodes along x, multiplied by a factor."""
        return ScheduledNetwork(self.network.stretched(factor), self.states)

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, all at once: (m, ...)."""
        return self.network.ideal_fractions(x, y)

    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...)."""
        ideal, jacobian = self._bare.fractions_with_jacobian(x, y)
        return self._mixed(ideal), self._mixed(jacobian)

    def state_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the resistance [ohm] from a contact to ground that each state adds to that of the electrodes
        all connected directly, (states, ...)."""
        return np.array([one.series_resistance(x, y) for one in self._of_state])

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return R: the sheet and the switches, in the mean of the states, have the resistance
        sheet / (2 pi) ln(R / A) for a contact of radius A at (x, y)."""
        added = self.state_resistance(x, y).mean(axis=0)
        enlarged = np.exp(2 * math.pi * added / self.sheet_ohm_per_square)
        return np.asarray(self.network.spreading_radius(x, y) * enlarged)

    def series_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return 0: the resistors' part is in `spreading_radius`."""
        return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))

    @property
    def series_quadratic_form(self) -> FloatArray:
        """Return zeros (m, m): the resistors' part is in `spreading_radius`."""
        return np.zeros_like(self._mix)

    @property
    def series_sensitivity(self) -> FloatArray:
        """Matrix S (m, m): the logarithm of resistor j changes the fractions f of its state by
        S[:, j] f[j]."""
        found = np.zeros_like(self._mix)
        for state, one in zip(self.states, self._of_state, strict=True):
            found[:, state] = one.series_sensitivity[:, state]
        return found

    def _mixed(self, ideal: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(self._mix, ideal, axes=1))
