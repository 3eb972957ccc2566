"""Elliptical patches: shares by the mean-value property, resistance against an integral equation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import config
from handtouch.simulate.contact_patch import (
    ContactPatch,
    effective_patch,
    look_up_patches,
    mean_half_axis,
)
from handtouch.simulate.pad_circuit import contact_layer_ohm
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_solver import ElectrodeGaps, SheetMapBank, solve_sheet
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import ContactSpread, ElectronicsSpread, Fixed, World
from tests.simulate.surfaces import SURFACE_TABLES

FloatArray = NDArray[np.float64]


def ellipse_points(patch: ContactPatch, radial: int = 24, around: int = 64) -> tuple[FloatArray, FloatArray]:
    """Return points (2, n) [m] from the centre of a patch, and the areas (n,) that they represent."""
    length = math.hypot(*patch.focus_m)
    longer = math.sqrt((length**2 + math.sqrt(length**4 + 4 * patch.radius_m**4)) / 2)
    shorter, turn = patch.radius_m**2 / longer, math.atan2(patch.focus_m[1], patch.focus_m[0])
    nodes, weights = np.polynomial.legendre.leggauss(radial)
    rho, angle = np.sqrt((nodes + 1) / 2), 2 * math.pi * (np.arange(around) + 0.5) / around
    u, v = longer * np.outer(rho, np.cos(angle)).ravel(), shorter * np.outer(rho, np.sin(angle)).ravel()
    areas = np.repeat(weights, around) * math.pi * longer * shorter / 2 / around
    turned = [u * math.cos(turn) - v * math.sin(turn), u * math.sin(turn) + v * math.cos(turn)]
    return np.array(turned), areas


@pytest.mark.parametrize("direction", [0.0, 0.7, math.pi / 2])
def test_shares_are_the_mean_over_the_ellipse(direction: float) -> None:
    shape = simulated_surface(SURFACE_TABLES["plane"])
    gaps = ElectrodeGaps(*(4 * ((1e-3, 1e-3),)))
    bank = SheetMapBank([solve_sheet(shape, gaps)])
    patch = ContactPatch.ellipse(2.5e-3, 3.0, direction)
    size = np.array([[shape.length_m], [shape.arc]])
    centre, (points, areas) = np.array([[0.3], [0.35]]), ellipse_points(patch)
    inside, _ = bank.look_up(np.zeros(len(areas), np.intp), *(centre + points / size))
    mean = inside[:4] @ areas / areas.sum()
    sheet = np.zeros(1, np.intp)
    values, _ = look_up_patches(bank, sheet, centre, np.array(patch.focus_m)[:, None] / size)
    at_centre, _ = bank.look_up(sheet, *centre)
    np.testing.assert_allclose(values[:4, 0], mean, atol=2e-5)
    assert np.abs(at_centre[:4, 0] - mean).max() > 1e-3


def test_slopes_of_averaged_shares_are_their_derivatives() -> None:
    shape = simulated_surface(SURFACE_TABLES["plane"])
    bank = SheetMapBank([solve_sheet(shape, ElectrodeGaps(*(4 * ((1e-3, 1e-3),))))])
    focus, step = np.array([[0.08], [0.05]]), 1e-5
    sheet = np.zeros(1, np.intp)
    _, slopes = look_up_patches(bank, sheet, np.array([[0.4], [0.3]]), focus)
    for axis in (0, 1):
        offset = np.array([[step], [0.0]])[:: 1 - 2 * axis]
        after, before = (
            look_up_patches(bank, sheet, np.array([[0.4], [0.3]]) + sign * offset, focus)[0][:4, 0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(slopes[:4, axis, 0], (after - before) / (2 * step), atol=1e-5)


def resistance_by_integral_equation(patch: ContactPatch, sheet_ohm: float, layer_ohm_m2: float) -> float:
    """Return the resistance between the conductor over the patch and a circle of radius 1 m around it."""
    points, areas = ellipse_points(patch, 16, 60)
    distance = np.hypot(*(points[:, :, None] - points[:, None, :]))
    np.fill_diagonal(distance, np.sqrt(areas / math.pi) * math.exp(-0.5))  # mean logarithm over a disc
    kernel = -sheet_ohm / (2 * math.pi) * np.log(distance) * areas
    density = np.linalg.solve(np.diag(np.full(len(areas), layer_ohm_m2)) + kernel, np.ones(len(areas)))
    return float(1 / (density @ areas))


@pytest.mark.parametrize("layer_ohm_mm2", [1e5, 7e3, 1e3])
@pytest.mark.parametrize("elongation", [1.0, 2.0, 3.0])
def test_resistance_of_an_ellipse_agrees_with_an_integral_equation(
    elongation: float, layer_ohm_mm2: float
) -> None:
    sheet_ohm, radius_m = 2400.0, 2.5e-3
    patch = ContactPatch.ellipse(radius_m, elongation, 0.3)
    expected = resistance_by_integral_equation(patch, sheet_ohm, 1e-6 * layer_ohm_mm2)
    pressure = 1.0 / (math.pi * radius_m**2)  # of 1 N: the layer has its reference resistance
    layer = contact_layer_ohm(
        np.ones(1), np.array([radius_m]), sheet_ohm, 1e-6 * layer_ohm_mm2, pressure, 1.5
    )
    outer = mean_half_axis(np.array([radius_m]), np.array([math.hypot(*patch.focus_m)]))
    ohm = float((layer - sheet_ohm / (2 * math.pi) * np.log(outer))[0])
    assert ohm == pytest.approx(expected, rel=0.006)


@given(st.floats(1.0, 4.0), st.floats(0.0, math.pi), st.floats(0.5, 2.0))
def test_patch_on_an_anisotropic_sheet_is_the_stretched_ellipse(
    elongation: float, direction: float, stretch: float
) -> None:
    patch = ContactPatch.ellipse(1.0, elongation, direction)
    radius, focus = effective_patch(np.ones(1), np.array(patch.focus_m)[:, None], stretch)
    points, areas = ellipse_points(patch)
    points[0] *= stretch
    covariance = 4 * (points * areas) @ points.T / areas.sum()  # its eigenvalues are squared half axes
    shorter, longer = np.linalg.eigvalsh(covariance)
    if math.hypot(*patch.focus_m) > 0:
        assert radius[0] * (1 + stretch) == pytest.approx(math.sqrt(shorter) + math.sqrt(longer), rel=1e-6)
        in_metric = np.array([stretch * focus[0, 0], focus[1, 0]])
        assert in_metric @ in_metric == pytest.approx(longer - shorter, rel=1e-5, abs=1e-6)
        along = covariance @ in_metric - longer * in_metric
        np.testing.assert_allclose(along, 0, atol=1e-5)


def test_elongated_patches_move_currents_and_round_ones_do_not(deployment: config.Deployment) -> None:
    touch = {"link": "flat", "from_s": 0.0, "duration_s": 9.0, "path": [[0.3, 0.3]], "force_n": [3.0]}
    scenario = Scenario.model_validate({"touch": [touch]}, strict=False)
    silent = ElectronicsSpread(noise_ratio=Fixed(0.0))

    def counts(elongation: float) -> FloatArray:
        contacts = ContactSpread(elongation=Fixed(elongation))
        world = World("patches", contacts=contacts, electronics=silent).draw(4)
        hand = VirtualHand(deployment, scenario, world)
        np.testing.assert_array_equal(hand.sample(4.0)[0], hand.counts(0, [4.0])[0])
        return np.asarray(hand.counts(0, [4.0])[0], np.float64)

    disc = VirtualHand(deployment, scenario, World("disc", electronics=silent).draw(4)).counts(0, [4.0])[0]
    np.testing.assert_array_equal(counts(1.0), disc)
    assert np.abs(counts(3.0) - disc).max() > 10
