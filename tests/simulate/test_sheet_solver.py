"""The finite elements obey the laws of the sheet and agree with the independent `handtouch.field`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import SurfaceTable
from handtouch.field import Electrode, ElectrodeNetwork, Rectangle
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import (
    EDGE_INSET_FRACTION,
    ElectrodeGaps,
    SheetMapBank,
    SheetMaps,
    solve_sheet,
)
from handtouch.simulate.surfaces import simulated_surface
from tests.simulate.surfaces import SURFACE_TABLES

SQUARE = SimulatedSurface(1.0, 1.0, 1.0, flat=True)
REFERENCE = json.loads((Path(__file__).parents[1] / "field" / "data" / "electrodes.json").read_text())
FRACTIONS = np.array([0.03, 0.05, 0.1, 0.25, 0.5, 0.7, 0.92, 0.97])
GRID = np.stack([grid.ravel() for grid in np.meshgrid(FRACTIONS, FRACTIONS)])


def even(gap: float) -> ElectrodeGaps:
    return ElectrodeGaps(*[(gap, gap)] * 4)


def look_up(maps: SheetMaps, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return SheetMapBank([maps]).look_up(np.zeros(x.shape, np.intp), x, y)[0]


@pytest.mark.parametrize("table", SURFACE_TABLES.values(), ids=list(SURFACE_TABLES))
def test_shares_and_conformal_radius_agree_with_exact_solution_on_every_surface(table: SurfaceTable) -> None:
    shape, surface = simulated_surface(table), table.build()
    ends = shape.radius([0.0, shape.length_m])
    bare = np.array([[0.7, 1.1], [0.9, 0.6], [0.8, 1.2], [1.0, 0.75]]) * 1e-3  # all different
    gaps = ElectrodeGaps(
        (bare[0, 0] / ends[0], bare[0, 1] / ends[0]),
        (bare[1, 0] / ends[1], bare[1, 1] / ends[1]),
        (bare[2, 0], bare[2, 1]),
        (bare[3, 0], bare[3, 1]),
    )
    stations = surface.to_rectangle([gaps.y0[0], shape.length_m - gaps.y0[1]], 0.0)[0].tolist()
    others = surface.to_rectangle([gaps.yb[0], shape.length_m - gaps.yb[1]], 0.0)[0].tolist()
    unit = surface.b / shape.arc
    network = ElectrodeNetwork.from_sides(
        surface.a,
        surface.b,
        [
            Electrode("x0", gaps.x0[0] * unit, surface.b - gaps.x0[1] * unit),
            Electrode("xa", gaps.xa[0] * unit, surface.b - gaps.xa[1] * unit),
            Electrode("y0", *stations),
            Electrode("yb", *others),
        ],
        2400.0,
    )
    s, phi = GRID[0] * shape.length_m, GRID[1] * shape.arc
    x, y = surface.to_rectangle(s, phi * shape.radius(s))
    found = solve_sheet(shape, gaps)
    values = look_up(found, *GRID)
    exact = network.fractions(x, y)
    np.testing.assert_allclose(values[:4], exact, rtol=0, atol=2e-5)
    np.testing.assert_allclose(found.conductance, network.conductance, rtol=0, atol=1e-3)
    inner = np.all((GRID > 0.04) & (GRID < 0.96), axis=0)
    np.testing.assert_allclose(values[:4, inner], exact[:, inner], rtol=0, atol=1e-5)
    radius = network.spreading_radius(x, y) * surface.scale(x, y)
    np.testing.assert_allclose(values[4, inner], np.log(radius)[inner], rtol=0, atol=3e-3)


@pytest.mark.parametrize("case", [c for c in REFERENCE if not any(c["series_ohm"])][:4], ids=str)
def test_conductance_and_shares_agree_with_reference_values(case: dict[str, float]) -> None:
    a, b, gap = case["a"], case["b"], case["gap"]
    found = solve_sheet(SimulatedSurface(a, b, 1.0, flat=True), even(gap))
    assert case["order"] == ["x0", "xa", "y0", "yb"]  # type: ignore[comparison-overlap]
    np.testing.assert_allclose(found.conductance, case["conductance"], rtol=0, atol=1e-3)
    x, y = np.array(case["x"]) / a, np.array(case["y"]) / b
    inner = (np.minimum(x, 1 - x) > EDGE_INSET_FRACTION) & (np.minimum(y, 1 - y) > EDGE_INSET_FRACTION)
    expected = np.array(case["fractions"])
    expected = expected if expected.shape[0] == 4 else expected.T
    np.testing.assert_allclose(look_up(found, x, y)[:4, inner], expected[:, inner], rtol=0, atol=2e-5)


def test_shares_sum_to_one_and_have_the_symmetry_of_the_pad() -> None:
    x, y = GRID
    values = look_up(solve_sheet(SQUARE, even(0.05)), x, y)
    np.testing.assert_allclose(values[:4].sum(0), 1, rtol=0, atol=1e-12)
    turned = look_up(solve_sheet(SQUARE, even(0.05)), y, x)
    np.testing.assert_allclose(values[[2, 3, 0, 1, 4]], turned, rtol=0, atol=1e-6)
    mirrored = look_up(solve_sheet(SQUARE, even(0.05)), 1 - x, y)
    np.testing.assert_allclose(values[[1, 0, 2, 3, 4]], mirrored, rtol=0, atol=1e-6)


def test_conductance_is_symmetric_and_conserves_current() -> None:
    conductance = solve_sheet(
        SQUARE, ElectrodeGaps((0.02, 0.05), (0.04, 0.03), (0.06, 0.02), (0.01, 0.05))
    ).conductance
    np.testing.assert_allclose(conductance, conductance.T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(conductance.sum(1), 0, rtol=0, atol=1e-6)


def test_error_decreases_with_element_degree() -> None:
    network = ElectrodeNetwork(1.0, 1.0, 0.02, 1.0)
    exact = network.fractions(*GRID)
    errors = [
        np.abs(look_up(solve_sheet(SQUARE, even(0.02), degree), *GRID)[:4] - exact).max()
        for degree in (3, 5, 8)
    ]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]


def test_vanishing_gap_gives_the_ideal_pad() -> None:
    inner = (GRID > 0.04) & (GRID < 0.96)
    x, y = GRID[:, inner.all(axis=0)]
    values = look_up(solve_sheet(SQUARE, even(0.0)), x, y)
    ideal = Rectangle(1.0, 1.0)
    np.testing.assert_allclose(values[:4], ideal.side_fractions(x, y), rtol=0, atol=2e-5)
    np.testing.assert_allclose(np.exp(values[4]), ideal.conformal_radius(x, y), rtol=3e-3)
    centre = look_up(solve_sheet(SQUARE, even(0.0)), np.array([0.5]), np.array([0.5]))
    assert np.exp(centre[4, 0]) == pytest.approx(0.5393526, rel=2e-4)


def test_derivatives_agree_with_finite_differences() -> None:
    bank = SheetMapBank(
        [solve_sheet(SQUARE, even(0.05)), solve_sheet(SimulatedSurface(2.0, 1.0, 1.0, flat=True), even(0.05))]
    )
    sheet = np.array([0, 1, 1])
    x, y, step = np.array([0.3, 0.44, 0.88]), np.array([0.06, 0.5, 0.7]), 1e-6
    _, slopes = bank.look_up(sheet, x, y)
    by_x = bank.look_up(sheet, x + step, y)[0] - bank.look_up(sheet, x - step, y)[0]
    by_y = bank.look_up(sheet, x, y + step)[0] - bank.look_up(sheet, x, y - step)[0]
    np.testing.assert_allclose(slopes, np.stack([by_x, by_y], axis=1) / (2 * step), rtol=0, atol=1e-7)


@pytest.mark.parametrize("off", [1e-7, 1e-6, -2e-6])
def test_nearly_equal_opposite_gaps_keep_shares_accurate(off: float) -> None:
    """A sliver element between two such ends once falsified the shares by a third."""
    exact, near = (
        ElectrodeGaps(*[(0.07, 0.069)] * 4),
        ElectrodeGaps((0.07, 0.069 + off), *[(0.07, 0.069)] * 3),
    )
    assert solve_sheet(SQUARE, near, 5).conductance == pytest.approx(
        solve_sheet(SQUARE, exact, 5).conductance, rel=1e-4
    )
