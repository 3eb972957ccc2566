"""Pads whose electrodes are switched between resistors to ground, one state a period.

Public name: `SwitchedNetwork`.

The currents of every state are linear functions of those of directly grounded electrodes. Where each
electrode is measured on its own, states therefore add no equation, they only repeat the measurement with
other noise; where electrodes share a channel, states add equations, up to one for every electrode.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handtouch.field._series_resistors import GroundedElectrodes
from handtouch.field.model import FloatArray

_RANK_TOLERANCE = 1e-9


class SwitchedNetwork:
    """The currents of a schedule of states, as one `ForwardModel`.

    network: the pad, whatever its resistors. states: (states, electrodes), resistors to ground in each period
    [ohm], infinity for an open switch. channels: for each electrode the number of the channel that measures
    it, 0, 1 ... in any order; each its own if absent. Channels of the model are those of the first state,
    then of the second, and so on. Fractions are per unit of the current injected in the same state; that may
    differ from state to state, as the contact sees other resistors and its force changes.

    Raises ValueError for no state, resistances below 0, a state without ground, and gaps in `channels`.
    """

    def __init__(
        self,
        network: GroundedElectrodes,
        states: Sequence[Sequence[float]],
        channels: Sequence[int] | None = None,
    ) -> None:
        if not len(states):
            raise ValueError("states: at least one is needed")
        count = len(network.series_ohm)
        number = np.arange(count) if channels is None else np.asarray(channels)
        if number.shape != (count,) or set(number.tolist()) != set(range(number.max() + 1)):
            raise ValueError(
                f"channels must be {count} numbers from 0 without gaps, one per electrode, got {channels}"
            )
        self.network = network.with_series_ohm([0.0] * count)
        self.states = tuple(tuple(float(r) for r in state) for state in states)
        collected = (number == np.arange(number.max() + 1)[:, None]).astype(float)
        self._mix: FloatArray = np.concatenate(
            [collected @ network.with_series_ohm(state).currents_per_ideal for state in self.states]
        )

    @property
    def a(self) -> float:
        """Extent along x."""
        return self.network.a

    @property
    def b(self) -> float:
        """Extent along y."""
        return self.network.b

    @property
    def independent_channels(self) -> int:
        """Number of linearly independent currents of the whole schedule; at most that of electrodes."""
        return int(np.linalg.matrix_rank(self._mix, _RANK_TOLERANCE))

    def fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the measured fractions (states * channels, ...), those of each state summing to one."""
        return np.asarray(np.tensordot(self._mix, self.network.ideal_fractions(x, y), axes=1))

    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` and derivatives by (x, y), (states * channels, 2, ...)."""
        ideal, jacobian = self.network.fractions_with_jacobian(x, y)
        return np.tensordot(self._mix, ideal, axes=1), np.tensordot(self._mix, jacobian, axes=1)
