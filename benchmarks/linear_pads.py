"""Contacts on many drawn pads of any outline, whose currents follow from the pads' parts to first order.

Public names: `LinearPads`. The daemon's own model gives nominal fractions and their changes by each part, so
that no sheet is solved: hundreds of pads show how coverage varies from pad to pad, which a few pads that are
solved can't. Parts' effects of second order and errors of the model are no part of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.core.contact_solver import PART_COUNT, PARTS_COUNT, VALUE_COUNT, VALUE_SLICES, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.hand import models_with_other_parts, pad_surface
from handtouch.simulate.worlds import DrawnWorld

FloatArray = NDArray[np.float64]


class LinearPads:
    """Pad `row` of a deployment with an even sheet and no series resistors, with parts of many drawn worlds.

    Solves samples of its currents by the daemon's stages, without baseline and sheet behaviour.
    """

    def __init__(self, deployment: Deployment, row: int) -> None:
        self._row, (self._hand, pad) = row, deployment.pads[row]
        self._pad, self._sheet = pad, deployment.sheets[pad.sheet]
        self.model = PadModel(deployment)
        self._network = self.model.networks[row]
        self._surface = pad_surface(pad)
        networks = models_with_other_parts(
            self._network, pad, deployment.nodes[pad.node], deployment.sheets[pad.sheet]
        )
        self._changed = networks[: 2 * len(pad.electrode_names) + 1]  # ends, and the ratio of the sides
        count = self.model.size
        self._currents = np.zeros((count, self.model.channels))
        self._values = np.full((count, VALUE_COUNT), np.nan)
        self._parts = np.full((count, PARTS_COUNT), np.nan)
        self._solver = make_solver(
            self.model,
            self._currents,
            np.zeros(count),
            np.zeros(count, np.bool_),
            self._values,
            self._parts,
        )

    def deviations(self, drawn: DrawnWorld) -> tuple[FloatArray, FloatArray]:
        """Return the parts of a drawn pad in standard deviations (p,), and its gains (n,)."""
        hidden, sheet, pad = drawn.pad(self._hand, self._pad), self._sheet, self._pad
        nominal = np.array(pad.gaps_mm).T.ravel().reshape(2, -1)
        gaps = np.array([hidden.gap_before_mm, hidden.gap_after_mm]) - nominal
        along_m, across_m = self._surface.extent_m
        ratio = 0.5 * math.log(hidden.anisotropy_ratio)
        ratio += 1e-3 * (hidden.length_offset_mm / along_m - hidden.width_offset_mm / across_m)
        stated = math.hypot(sheet.anisotropy_std / 2, 1e-3 * sheet.size_std_mm / along_m)
        stated = math.hypot(stated, 1e-3 * sheet.size_std_mm / across_m)
        return np.append(gaps.T.ravel() / sheet.gap_std_mm, ratio / stated), np.array(hidden.gain_ratio)

    def fractions(self, s: FloatArray, t: FloatArray) -> FloatArray:
        """Return fractions at positions (...), in sides of the conformal rectangle: the nominal ones, and
        their changes by a standard deviation of each part, (1 + p, n, ...)."""
        nominal = self._network.fractions(s * self._network.a, t * self._network.b)
        changed = []
        for network in self._changed:
            a, b = getattr(network, "a", self._network.a), getattr(network, "b", self._network.b)
            changed.append(network.fractions(s * a, t * b) - nominal)
        return np.array([nominal, *changed])

    def draw_currents(
        self, drawn: DrawnWorld, s: FloatArray, t: FloatArray, totals_a: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Return noisy currents (n, k) of a drawn pad under k samples of contacts with these totals, at these
        positions, each (k, contacts)."""
        deviations, gains = self.deviations(drawn)
        fractions = np.tensordot(np.append(1.0, deviations), self.fractions(s, t), 1)
        currents = gains[:, None] * (fractions * totals_a).sum(axis=-1)
        return np.asarray(currents + self.noise_a[:, None] * rng.normal(size=currents.shape))

    def position_m(self, s: FloatArray, t: FloatArray) -> FloatArray:
        """Return positions (..., 3) in the pad's frame, which is the link's for a pad without a mount."""
        return np.moveaxis(self._surface.point(s * self._network.a, t * self._network.b), 0, -1)

    def solve(self, currents: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position (3,) and covariance (3, 3) of one contact in the link's frame, and two contacts
        (2, PART_COUNT), NaN if there is one; currents (n,) [A]."""
        self._currents[self._row, : len(currents)], self._values[:] = currents, np.nan
        self._solver.solve_contacts(np.array([self._row]).data)
        values = self._values[self._row]
        return (
            values[VALUE_SLICES["position_m"]].copy(),
            values[VALUE_SLICES["covariance_m2"]].reshape(3, 3).copy(),
            self._parts[self._row].reshape(2, PART_COUNT).copy(),
        )

    @property
    def noise_a(self) -> FloatArray:
        """Standard deviation of the noise of each channel (n,)."""
        return np.asarray(self.model.noise_a[self._row, : len(self._pad.electrode_names)])


def squared_deviation(error_m: FloatArray, covariance_m2: FloatArray) -> float:
    """Return the square of an error (3,) along the surface, in units of its covariance (3, 3)."""
    variance, axes = np.linalg.eigh(covariance_m2)
    return float(np.sum((axes.T @ error_m)[1:] ** 2 / variance[1:]))
