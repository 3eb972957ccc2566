"""Which electrode each of a node's four channels is wired to, from presses at roughly known places.

Each of the 24 orders is judged by the evidence for it: the likelihood of the presses' current shares under
the forward model, integrated over where the finger may have been. Orders that are mirror images differ only
in that, so a press in the middle tells nothing, and a verdict needs a clear margin.

Public names: `Shares`, `Reading`, `Verdict`, `judge`, `ASKED`, `Near`.
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
Near = Literal["x0", "xa", "y0", "yb"]

ELECTRODES: tuple[Near, ...] = ("x0", "xa", "y0", "yb")
ORDERS: tuple[tuple[int, ...], ...] = tuple(itertools.permutations(range(4)))
ASKED: dict[Near, tuple[float, float]] = {
    "x0": (0.15, 0.5),
    "xa": (0.85, 0.5),
    "y0": (0.5, 0.15),
    "yb": (0.5, 0.85),
}
"""Where a person is asked to press, as fractions of the pad along its surface."""

PLACE_STD = 0.15
"""How far from there a finger may be, of a side."""
GAIN_STD, SHARE_STD = 0.1, 0.01
"""How far a share may be from the model's, relative to it and besides: gains, sheets that aren't uniform."""
MARGIN = math.log(50)
"""Log odds that the best order needs over the next."""
_GRID = 32  # cells along a side
_MISFIT = 25.0  # variances; beyond it no place explains a press


class Shares:
    """The forward model's shares (4, m) of a contact's current at m places all over a pad.

    `places` (m, 2): fractions of the pad's sides along the surface, from x0 and from y0.
    """

    def __init__(self, model: ForwardModel, surface: Surface) -> None:
        middle = (np.arange(_GRID) + 0.5) / _GRID
        s, t = np.meshgrid(middle, middle, indexing="ij")
        self.places: FloatArray = np.stack([s.ravel(), t.ravel()], axis=1)
        x, _ = surface.to_rectangle(self.places[:, 0] * surface.extent_m[0], 0.0)
        self.shares: FloatArray = np.asarray(model.fractions(x, self.places[:, 1] * surface.b))


@dataclass(frozen=True)
class Reading:
    """A press near an electrode: magnitudes (4,) of the channels, their noise, and which of them work.

    Any unit; magnitudes are of channels whose gains are equal.
    """

    near: Near
    currents: FloatArray
    noise: float
    live: NDArray[np.bool_]


@dataclass(frozen=True)
class Verdict:
    """The best order: `electrodes[c]` is what channel c is wired to.

    `margin`: log odds over the next one. `fits`: some place explains each press. `clear`: to be believed.
    """

    electrodes: tuple[Near, Near, Near, Near]
    margin: float
    fits: bool

    @property
    def clear(self) -> bool:
        return self.fits and self.margin >= MARGIN


def judge(shares: Shares, readings: Sequence[Reading]) -> Verdict:
    """Weigh the 24 orders. Raises ValueError without readings."""
    if not readings:
        raise ValueError("no press to judge by")
    evidence, misfit = np.zeros(len(ORDERS)), np.zeros(len(ORDERS))
    for reading in readings:
        squared, log_variance = _misfit(shares, reading)
        prior = _log_prior(shares, reading.near)
        evidence += logsumexp(prior - (squared + log_variance) / 2, axis=1)
        misfit = np.maximum(misfit, squared.min(axis=1))
    ranked = np.argsort(-evidence)
    best = ranked[0]
    a, b, c, d = (ELECTRODES[electrode] for electrode in ORDERS[best])
    fits = bool(misfit[best] < _MISFIT)
    return Verdict((a, b, c, d), float(evidence[best] - evidence[ranked[1]]), fits)


def _misfit(shares: Shares, reading: Reading) -> tuple[FloatArray, FloatArray]:
    """Squared misfit of each order at each place, in variances, and their logarithm, both (24, m)."""
    live = reading.live
    measured = np.where(live, reading.currents, 0.0)
    total = measured.sum()
    expected = shares.shares[np.array(ORDERS)]  # (24, 4, m)
    expected = np.where(live[None, :, None], expected, 0.0)
    expected /= expected.sum(axis=1, keepdims=True)  # a dead electrode's share goes to the others
    variance = (GAIN_STD * expected) ** 2 + SHARE_STD**2 + (reading.noise / total) ** 2
    off = expected - (measured / total)[None, :, None]
    return (off**2 / variance).sum(axis=1), np.log(variance).sum(axis=1)


def _log_prior(shares: Shares, near: Near) -> FloatArray:
    """Of the places (m,) when a press near that electrode was asked for."""
    off = (shares.places - ASKED[near]) / PLACE_STD
    log = -0.5 * (off**2).sum(axis=1)
    return np.asarray(log - logsumexp(log))
