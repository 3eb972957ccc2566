"""Ways to locate a contact from four currents: the paper's, handtouch's, and what a user would take instead.

Public names: `Setup` (a pad as its builder knows it), `Locator`, `WAYS` -> `Way`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from skfem.models.poisson import laplace

from benchmarks.ratio_table import RatioTable
from handtouch import config
from handtouch.core.contact_solver import VALUE_COUNT, VALUE_SLICES, ContactSolver, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.field import ElectrodeNetwork, Rectangle
from handtouch.field.paper_methods import LogRatioTable, log_ratio, single_sum_fractions
from handtouch.hand import electrode_network
from tests.deployments import deployment_text, pad_text

FloatArray = NDArray[np.float64]
Position = tuple[FloatArray, FloatArray]
Locator = Callable[[FloatArray], Position]
"""Positions x, y (n,) [m] from currents (4, n) [A] of x0, xa, y0, yb."""

LENGTH_MM, WIDTH_MM = 30.0, 24.0
CORE_PADS = 60
"""Pads of the core's model; more contacts are solved in several calls."""
CELLS, SAMPLES, TRAINED, DEGREE = 64, 100_000, 20_000, 11
MARGIN = 0.02


@dataclass(frozen=True)
class Setup:
    """A plane pad of 30 x 24 mm and what its builder knows of it."""

    gap_mm: float
    series_ohm: float

    def deployment(self, pads: int) -> config.Deployment:
        """Return a deployment with so many pads of this kind."""
        surface = f'{{ kind = "plane", length_mm = {LENGTH_MM}, width_mm = {WIDTH_MM} }}'
        extra = f"series_ohm = {[self.series_ohm] * 4}"
        texts = [pad_text(f"p{k}", k + 1, surface, extra, gap_mm=self.gap_mm) for k in range(pads)]
        return config.parse(deployment_text(*texts, daemon=""))

    @cached_property
    def model(self) -> PadModel:
        """`CORE_PADS` such pads as the daemon has them."""
        return PadModel(self.deployment(CORE_PADS))

    @cached_property
    def pad(self) -> Rectangle | ElectrodeNetwork:
        """The exact forward model."""
        if not self.gap_mm:
            return self.rectangle
        deployment = self.deployment(1)
        pad = deployment.pads[0].pad
        return electrode_network(pad, deployment.sheets[pad.sheet])

    @property
    def rectangle(self) -> Rectangle:
        """The pad without gaps and resistors, which the paper's methods assume."""
        return Rectangle(1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM)

    @property
    def noise_a(self) -> FloatArray:
        """Standard deviations (4, 1) of the channels."""
        return np.asarray(self.model.noise_a[0][:, None])


@dataclass(frozen=True)
class Way:
    """One way to locate; `make` builds its tables."""

    make: Callable[[Setup], Locator]
    kind: Literal["core", "handtouch", "paper", "instead"]
    ideal_only: bool = False
    """For pads without gaps and resistors alone."""
    samples: int = 20_000
    """Contacts of which errors are measured; few for slow ones, which take one contact after the other."""


# Of the paper and of handtouch


def ratio_table(setup: Setup) -> Locator:
    return RatioTable(setup.rectangle).locate


def exact(setup: Setup) -> Locator:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.locate(currents)
        return found.x, found.y

    return locate


def likelihood(setup: Setup) -> Locator:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.estimate(currents, setup.noise_a)
        return found.x, found.y

    return locate


def core(setup: Setup, *, tracked: bool) -> Locator:
    """Return the daemon's stages, compiled where they are: position, covariance and place on the link.

    If tracked, the contact in a column is located from its last position.
    """
    size = setup.model.size
    rows, columns = np.arange(size), VALUE_SLICES["xy"]
    parts: list[tuple[ContactSolver, FloatArray, FloatArray]] = []

    def part(number: int) -> tuple[ContactSolver, FloatArray, FloatArray]:
        while len(parts) <= number:
            given, values = np.zeros((size, 4)), np.full((size, VALUE_COUNT), np.nan)
            force = np.zeros(size, np.bool_)
            parts.append((make_solver(setup.model, given, np.zeros(size), force, values), given, values))
        return parts[number]

    def locate(currents: FloatArray) -> Position:
        found = np.empty((currents.shape[1], 2))
        for number, first in enumerate(range(0, len(found), size)):
            solver, given, values = part(number if tracked else 0)
            columns_now = currents[:, first : first + size].T
            n = len(columns_now)
            given[:n] = columns_now
            if not tracked:
                values[:n] = np.nan
            solver.solve_contacts(rows[:n].data)
            found[first : first + n] = values[:n, columns]
        return found[:, 0], found[:, 1]

    return locate


# What a user would take instead


def nominal_contacts(setup: Setup, count: int) -> tuple[FloatArray, FloatArray]:
    """Return positions (2, count) [m] and fractions (4, count) of contacts by the forward model."""
    sides = np.array([[setup.pad.a], [setup.pad.b]])
    at = sides * np.random.default_rng(11).uniform(MARGIN, 1 - MARGIN, (2, count))
    return at, setup.pad.fractions(*at)


def nearest_neighbour(setup: Setup) -> Locator:
    """Return the nearest of 100 000 contacts in the space of the fractions, by scipy's k-d tree."""
    at, fractions = nominal_contacts(setup, SAMPLES)
    tree = cKDTree(fractions.T)

    def locate(currents: FloatArray) -> Position:
        _, index = tree.query((currents / currents.sum(axis=0)).T)
        return at[0, index], at[1, index]

    return locate


def polynomial(setup: Setup) -> Locator:
    """Return a regression on the two ratios of opposite sides, of degree 11, trained on 20 000 contacts."""
    powers = np.array([p for p in product(range(DEGREE + 1), repeat=2) if sum(p) <= DEGREE])

    def features(currents: FloatArray) -> FloatArray:
        low, high = currents[::2], currents[1::2]
        ratios = (high - low) / (high + low)
        x, y = ratios[:, None] ** np.arange(DEGREE + 1)[:, None]  # (powers, n) each
        return np.asarray((x[powers[:, 0]] * y[powers[:, 1]]).T)

    at, fractions = nominal_contacts(setup, TRAINED)
    weights, *_ = np.linalg.lstsq(features(fractions), at.T, rcond=None)

    def locate(currents: FloatArray) -> Position:
        x, y = (features(currents) @ weights).T
        return x, y

    return locate


def grid_interpolator(setup: Setup) -> Locator:
    """Return eq. 8 corrected by scipy's cubic RegularGridInterpolator, as in a look-up table of one's own."""
    adjusted, table = LogRatioTable(setup.rectangle, cells=0), LogRatioTable(setup.rectangle, CELLS)
    places, origin, steps = table.correction_table
    axes = [origin[i] + steps[i] * np.arange(CELLS + 1) for i in range(2)]
    interpolator = RegularGridInterpolator(axes, places, method="cubic", bounds_error=False, fill_value=None)

    def locate(currents: FloatArray) -> Position:
        found = interpolator(np.stack(adjusted.locate(currents), axis=-1))
        return found[..., 0], found[..., 1]

    return locate


def fit_of_sums(setup: Setup) -> Locator:
    """Return scipy's least_squares on the paper's eqs. 4-5, ten terms."""
    return _one_by_one(setup, lambda x, y: single_sum_fractions(setup.rectangle, x, y))


def fit_of_field(setup: Setup) -> Locator:
    """Return scipy's least_squares on the exact forward model."""
    return _one_by_one(setup, lambda x, y: setup.pad.fractions(x, y))


def fit_of_elements(setup: Setup) -> Locator:
    """Return scipy's least_squares on a forward model of quadratic elements, 64 a side."""
    a, b = setup.rectangle.a, setup.rectangle.b
    mesh = skfem.MeshTri.init_tensor(np.linspace(0, a, CELLS + 1), np.linspace(0, b, CELLS + 1))
    basis = skfem.Basis(mesh, skfem.ElementTriP2())
    stiffness = skfem.asm(laplace, basis)
    x, y = basis.doflocs
    on = np.stack([x == 0, x == a, y == 0, y == b])
    count = np.sum(on, axis=0)
    potentials = [
        skfem.solve(
            *skfem.condense(
                stiffness, x=np.where(side, 1 / np.maximum(count, 1), 0.0), D=np.flatnonzero(count)
            )
        )
        for side in on
    ]
    columns = np.stack(potentials, axis=1)

    def forward(px: float, py: float) -> FloatArray:
        return np.asarray(np.asarray(basis.probes(np.array([[px], [py]])) @ columns)[0])

    return _one_by_one(setup, forward)


def _one_by_one(setup: Setup, forward: Callable[[float, float], FloatArray]) -> Locator:
    a, b = setup.rectangle.a, setup.rectangle.b
    bounds = (1e-3 * a, 1e-3 * b), (0.999 * a, 0.999 * b)

    def misfit(point: FloatArray, fractions: FloatArray) -> FloatArray:
        return forward(float(point[0]), float(point[1])) - fractions

    def locate(currents: FloatArray) -> Position:
        found = [
            least_squares(
                misfit, (a / 2, b / 2), bounds=bounds, args=(column / column.sum(),), x_scale=(a, b),
                xtol=1e-12, ftol=1e-12, gtol=1e-12,
            ).x
            for column in currents.T
        ]  # fmt: skip
        x, y = np.array(found).T
        return x, y

    return locate


WAYS: dict[str, Way] = {
    "log-ratio (eq. 8)": Way(lambda setup: lambda currents: log_ratio(setup.rectangle, currents), "paper"),
    "log-ratio, adjusted (fig. 3)": Way(
        lambda setup: LogRatioTable(setup.rectangle, cells=0).locate, "paper"
    ),
    "log-ratio, table of 32 cells": Way(lambda setup: LogRatioTable(setup.rectangle).locate, "paper"),
    "ratio table": Way(ratio_table, "handtouch", ideal_only=True),
    "exact inverse": Way(exact, "handtouch"),
    "likelihood, exact field": Way(likelihood, "handtouch"),
    "core, new contacts": Way(lambda setup: core(setup, tracked=False), "core"),
    "core, tracked contacts": Way(lambda setup: core(setup, tracked=True), "core"),
    "nearest of 1e5 samples": Way(nearest_neighbour, "instead"),
    "polynomial regression": Way(polynomial, "instead"),
    "RegularGridInterpolator": Way(grid_interpolator, "instead"),
    "least_squares, eqs. 4-5": Way(fit_of_sums, "instead", samples=200),
    "least_squares, exact field": Way(fit_of_field, "instead", samples=100),
    "least_squares, finite elements": Way(fit_of_elements, "instead", ideal_only=True, samples=40),
}
"""By name."""
