"""Estimation of the electrode that each channel is wired to, from presses at roughly known positions.

The score of each of the 24 orders is its evidence: the likelihood of the presses' current shares under the
forward model, marginalised over the finger's position. Mirror-image orders differ only in that prior, so a
press in the middle carries no information, and a result needs a minimum log odds.

Public names: `ShareGrid`, `PressReading`, `ElectrodeOrder`, `find_electrode_order`, `PRESS_TARGETS`,
`ElectrodeName`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from handtouch.field.model import ForwardModel
from handtouch.field.surface import Surface

FloatArray = NDArray[np.float64]
ElectrodeName = Literal["x0", "xa", "y0", "yb"]

ELECTRODES: tuple[ElectrodeName, ...] = ("x0", "xa", "y0", "yb")
ELECTRODE_ORDERS: tuple[tuple[int, ...], ...] = tuple(itertools.permutations(range(4)))
PRESS_TARGETS: dict[ElectrodeName, tuple[float, float]] = {
    "x0": (0.15, 0.5),
    "xa": (0.85, 0.5),
    "y0": (0.5, 0.15),
    "yb": (0.5, 0.85),
}
"""Positions of requested presses, as fractions of the pad along its surface."""

POSITION_STD_FRACTION = 0.15
"""Standard deviation of the finger's position around it, as a fraction of a side."""
SHARE_STD_RELATIVE, SHARE_STD_ABSOLUTE = 0.1, 0.01
"""Relative and absolute error of a share: gains, non-uniform sheets."""
MIN_LOG_ODDS = math.log(50)
"""Least log odds of the best order over the second best."""
_GRID_CELLS = 32  # cells along a side
_MAX_MISFIT_VARIANCES = 25.0  # beyond this, no position explains a press


class ShareGrid:
    """The forward model's shares (4, m) of a contact's current on a grid of m positions.

    `positions` (m, 2): fractions of the pad's sides along the surface, from x0 and from y0.
    """

    def __init__(self, model: ForwardModel, surface: Surface) -> None:
        middle = (np.arange(_GRID_CELLS) + 0.5) / _GRID_CELLS
        s, t = np.meshgrid(middle, middle, indexing="ij")
        self.positions: FloatArray = np.stack([s.ravel(), t.ravel()], axis=1)
        x, _ = surface.to_rectangle(self.positions[:, 0] * surface.extent_m[0], 0.0)
        self.shares: FloatArray = np.asarray(model.fractions(x, self.positions[:, 1] * surface.b))


@dataclass(frozen=True)
class PressReading:
    """A press near an electrode: currents (4,) of the channels, their noise, and the working channels.

    Any unit of current; channel gains are already equalised.
    """

    electrode: ElectrodeName
    currents: FloatArray
    noise: float
    working: NDArray[np.bool_]


@dataclass(frozen=True)
class ElectrodeOrder:
    """The best order: channel c is wired to `electrodes[c]`.

    `log_odds`: over the second best order. `consistent`: every press is explained by some position.
    """

    electrodes: tuple[ElectrodeName, ElectrodeName, ElectrodeName, ElectrodeName]
    log_odds: float
    consistent: bool

    @property
    def is_clear(self) -> bool:
        """The order is consistent and significant."""
        return self.consistent and self.log_odds >= MIN_LOG_ODDS


def find_electrode_order(shares: ShareGrid, readings: Sequence[PressReading]) -> ElectrodeOrder:
    """Return the best of the 24 orders. Raises ValueError without readings."""
    if not readings:
        raise ValueError("no press")
    evidence, misfit = np.zeros(len(ELECTRODE_ORDERS)), np.zeros(len(ELECTRODE_ORDERS))
    for reading in readings:
        squared, log_variance = _squared_misfit(shares, reading)
        prior = _log_position_prior(shares, reading.electrode)
        evidence += logsumexp(prior - (squared + log_variance) / 2, axis=1)
        misfit = np.maximum(misfit, squared.min(axis=1))
    ranked = np.argsort(-evidence)
    best = ranked[0]
    a, b, c, d = (ELECTRODES[electrode] for electrode in ELECTRODE_ORDERS[best])
    fits = bool(misfit[best] < _MAX_MISFIT_VARIANCES)
    return ElectrodeOrder((a, b, c, d), float(evidence[best] - evidence[ranked[1]]), fits)


def _squared_misfit(shares: ShareGrid, reading: PressReading) -> tuple[FloatArray, FloatArray]:
    """Return each order's squared misfit at each position, in variances, and log variance, both (24, m)."""
    working = reading.working
    measured = np.where(working, reading.currents, 0.0)
    total = measured.sum()
    expected = shares.shares[np.array(ELECTRODE_ORDERS)]  # (24, 4, m)
    expected = np.where(working[None, :, None], expected, 0.0)
    expected /= expected.sum(axis=1, keepdims=True)  # shares of the working channels only
    variance = (SHARE_STD_RELATIVE * expected) ** 2 + SHARE_STD_ABSOLUTE**2 + (reading.noise / total) ** 2
    off = expected - (measured / total)[None, :, None]
    return (off**2 / variance).sum(axis=1), np.log(variance).sum(axis=1)


def _log_position_prior(shares: ShareGrid, electrode: ElectrodeName) -> FloatArray:
    """Return the log prior of the positions (m,) for a press requested near an electrode."""
    off = (shares.positions - PRESS_TARGETS[electrode]) / POSITION_STD_FRACTION
    log = -0.5 * (off**2).sum(axis=1)
    return np.asarray(log - logsumexp(log))
