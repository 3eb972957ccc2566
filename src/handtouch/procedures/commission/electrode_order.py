"""Estimation of the electrode that each channel is wired to, from presses at roughly known positions.

The score of an order is its evidence: the likelihood of the presses' current shares under the forward model,
marginalised over the finger's position. Mirror-image orders differ only in that prior, so a press in the
middle carries no information, and a result needs a minimum log odds. All orders of up to four channels are
compared; of more, the best is found from the best assignment of each channel by itself, and compared with
those that differ by two channels, or turn or mirror the pad.

Public names: `ShareGrid`, `PressReading`, `ElectrodeOrder`, `find_electrode_order`, `PRESS_TARGETS`,
`target_fractions`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp

from handtouch.arrays import FloatArray, IntArray
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.field.model import ChannelModel
from handtouch.field.surface_base import Surface

PRESS_TARGETS: dict[str, tuple[float, float]] = {
    "x0": (0.15, 0.5),
    "xa": (0.85, 0.5),
    "y0": (0.5, 0.15),
    "yb": (0.5, 0.85),
}
"""Positions of requested presses near electrodes on sides, as fractions of the pad along its surface."""
_INWARD = 0.3
"""Distance of other presses from the middle of their electrode, of that from there to the pad's middle."""
_MAX_COMPARED_CHANNELS = 4
"""Channels of which all orders are compared."""

POSITION_STD_FRACTION = 0.15
"""Standard deviation of the finger's position around it, as a fraction of a side."""
SHARE_STD_RELATIVE, SHARE_STD_ABSOLUTE = 0.1, 0.01
"""Relative and absolute error of a share: gains, non-uniform sheets."""
MIN_LOG_ODDS = math.log(50)
"""Least log odds of the best order over the second best."""
_GRID_CELLS = 32  # cells along a side
_MAX_MISFIT_VARIANCES = 25.0  # beyond this, no position explains a press


def target_fractions(network: ChannelModel) -> FloatArray:
    """Return the positions (c, 2) of presses near each electrode, as fractions of the pad's rectangle."""
    centres = network.centres / (network.a, network.b)
    return centres + _INWARD * (0.5 - centres)


class ShareGrid:
    """The forward model's shares (c, m) of a contact's current on a grid of m positions.

    `electrodes` (c,): their names, in the order of the shares; those of arcs counter-clockwise. `positions`
    (m, 2) and `targets` (c, 2), of presses near the electrodes: as fractions of the pad's sides along the
    surface, from x0 and from y0; of a pad with electrodes on arcs, as fractions of its rectangle.
    """

    def __init__(
        self, model: ChannelModel, surface: Surface, electrodes: tuple[str, ...] = SIDE_ELECTRODES
    ) -> None:
        middle = (np.arange(_GRID_CELLS) + 0.5) / _GRID_CELLS
        s, t = np.meshgrid(middle, middle, indexing="ij")
        self.electrodes = electrodes
        self.positions: FloatArray = np.stack([s.ravel(), t.ravel()], axis=1)
        if electrodes == SIDE_ELECTRODES:
            self.targets = np.array([PRESS_TARGETS[name] for name in electrodes])
            x, _ = surface.to_rectangle(self.positions[:, 0] * surface.extent_m[0], 0.0)
        else:
            self.targets = target_fractions(model)
            x = self.positions[:, 0] * model.a
        self.shares: FloatArray = np.asarray(model.fractions(x, self.positions[:, 1] * model.b))


@dataclass(frozen=True)
class PressReading:
    """A press near an electrode: currents (c,) of the channels, their noise, and the working channels.

    Any unit of current; channel gains are already equalised.
    """

    electrode: str
    currents: FloatArray
    noise: float
    working: NDArray[np.bool_]


@dataclass(frozen=True)
class ElectrodeOrder:
    """The best order: channel c is wired to `electrodes[c]`.

    `log_odds`: over the second best order. `consistent`: every press is explained by some position.
    """

    electrodes: tuple[str, ...]
    log_odds: float
    consistent: bool

    @property
    def is_clear(self) -> bool:
        """The order is consistent and significant."""
        return self.consistent and self.log_odds >= MIN_LOG_ODDS


def find_electrode_order(shares: ShareGrid, readings: Sequence[PressReading]) -> ElectrodeOrder:
    """Return the best order. Raises ValueError without readings."""
    if not readings:
        raise ValueError("no press")
    count = len(shares.electrodes)
    if count <= _MAX_COMPARED_CHANNELS:
        orders = np.array(list(itertools.permutations(range(count))))
        evidence, misfit = _evidence(shares, readings, orders)
    else:
        best = _assigned_order(shares, readings)
        while True:  # its evidence rises
            orders = _similar_orders(best)
            evidence, misfit = _evidence(shares, readings, orders)
            if (orders[evidence.argmax()] == best).all():
                break
            best = orders[evidence.argmax()]
    first, second = np.argsort(-evidence)[:2]
    electrodes = tuple(shares.electrodes[electrode] for electrode in orders[first])
    fits = bool(misfit[first] < _MAX_MISFIT_VARIANCES)
    return ElectrodeOrder(electrodes, float(evidence[first] - evidence[second]), fits)


def _evidence(
    shares: ShareGrid, readings: Sequence[PressReading], orders: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the evidence of orders (k, c), (k,), and their greatest squared misfit of a press."""
    evidence, misfit = np.zeros(len(orders)), np.zeros(len(orders))
    for reading in readings:
        squared, log_variance = _squared_misfit(shares, reading, orders)
        prior = _log_position_prior(shares, reading.electrode)
        evidence += logsumexp(prior - (squared + log_variance) / 2, axis=1)
        misfit = np.maximum(misfit, squared.min(axis=1))
    return evidence, misfit


def _assigned_order(shares: ShareGrid, readings: Sequence[PressReading]) -> IntArray:
    """Return the order (c,) whose channels, each by itself, are most likely."""
    score = np.zeros((len(shares.electrodes),) * 2)  # channel, electrode
    for reading in readings:
        measured = np.where(reading.working, reading.currents, 0.0)
        variance = _variance(shares.shares, reading, measured.sum())
        off = shares.shares[None] - (measured / measured.sum())[:, None, None]
        prior = _log_position_prior(shares, reading.electrode)
        score += reading.working[:, None] * logsumexp(
            prior - (off**2 / variance + np.log(variance)) / 2, axis=2
        )
    return np.asarray(linear_sum_assignment(-score)[1])


def _similar_orders(order: IntArray) -> IntArray:
    """Return an order (c,), then those that differ by two channels or take the electrodes for others along
    the pad's boundary, (k, c)."""
    count = len(order)
    found = [order]
    for pair in itertools.combinations(range(count), 2):
        swapped = order.copy()
        swapped[list(pair)] = order[list(pair[::-1])]
        found.append(swapped)
    found += [(order + step) % count for step in range(1, count)]
    found += [(step - order) % count for step in range(count)]
    return np.unique(np.array(found), axis=0)


def _squared_misfit(
    shares: ShareGrid, reading: PressReading, orders: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return each order's squared misfit at each position, in variances, and log variance, both (k, m)."""
    working = reading.working
    measured = np.where(working, reading.currents, 0.0)
    total = measured.sum()
    expected = shares.shares[orders]  # (k, c, m)
    expected = np.where(working[None, :, None], expected, 0.0)
    expected /= expected.sum(axis=1, keepdims=True)  # shares of the working channels only
    variance = _variance(expected, reading, total)
    off = expected - (measured / total)[None, :, None]
    return (off**2 / variance).sum(axis=1), np.log(variance).sum(axis=1)


def _variance(expected: FloatArray, reading: PressReading, total: float) -> FloatArray:
    return (SHARE_STD_RELATIVE * expected) ** 2 + SHARE_STD_ABSOLUTE**2 + (reading.noise / total) ** 2


def _log_position_prior(shares: ShareGrid, electrode: str) -> FloatArray:
    """Return the log prior of the positions (m,) for a press requested near an electrode."""
    off = (shares.positions - shares.targets[shares.electrodes.index(electrode)]) / POSITION_STD_FRACTION
    log = -0.5 * (off**2).sum(axis=1)
    return np.asarray(log - logsumexp(log))
