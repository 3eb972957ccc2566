"""Uneven sheets against closed forms for a resistance that changes exponentially along x."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import k0

from handtouch import config
from handtouch.field import ElectrodeNetwork
from handtouch.field.contact_law import contact_stack_resistance
from handtouch.field.uneven_sheet import UNEVEN_WAVES, unevenness_slopes
from handtouch.simulate.coarse_sheet import uneven_sheet_maps
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_solver import TABLE_NODES, ElectrodeGaps, solve_sheet
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.unevenness import Unevenness
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import UNEVEN_MODES, ElectronicsSpread, Fixed, PartSpread, World
from tests.simulate.surfaces import SURFACE_TABLES

FloatArray = NDArray[np.float64]
SHAPE = simulated_surface(SURFACE_TABLES["plane"])
A, B = SHAPE.length_m, SHAPE.arc
NO_GAPS = ElectrodeGaps(*(4 * ((0.0, 0.0),)))
INNER = (TABLE_NODES > 0.1) & (TABLE_NODES < 0.9)


@dataclass(frozen=True)
class Exponential(Unevenness):
    """Resistance exp(-2 rate x), x in metres from the middle."""

    rate: float = 0.0

    @property
    def is_even(self) -> bool:
        return self.rate == 0

    def ohm_ratio(self, position: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-2 * self.rate * A * (position[0] - 0.5)))


def exact_shares(rate: float, s: FloatArray, phi: FloatArray) -> FloatArray:
    """Return the shares (4, n, m) on the grid s x phi: u = exp(-rate s) v, and v'' + v'' = rate^2 v."""
    s, phi = s[:, None], phi[None, :]
    shares = np.zeros((4, s.size, phi.size))
    for n in range(1, 400):
        across, along = n * math.pi / B, n * math.pi / A
        kappa = math.hypot(across, rate)
        if n % 2:
            wave = 4 / (n * math.pi) * np.sin(across * phi)
            shares[0] += wave * np.exp(-rate * s) * _sinh_ratio(kappa, A - s, A)
            shares[1] += wave * np.exp(rate * (A - s)) * _sinh_ratio(kappa, s, A)
        kappa = math.hypot(along, rate)
        weight = 2 / A * along * (1 - (-1) ** n * math.exp(rate * A)) / (rate**2 + along**2)
        wave = weight * np.exp(-rate * s) * np.sin(along * s)
        shares[2] += wave * _sinh_ratio(kappa, B - phi, B)
        shares[3] += wave * _sinh_ratio(kappa, phi, B)
    return shares


def _sinh_ratio(kappa: float, at: FloatArray, whole: float) -> FloatArray:
    return np.asarray(
        np.exp(kappa * (at - whole)) * -np.expm1(-2 * kappa * at) / -math.expm1(-2 * kappa * whole)
    )


def exact_log_radius(rate: float, s: float, phi: float) -> float:
    """Return ln R of a contact: 2 pi / rho(s) times its resistance is ln(R / radius); images of K0."""
    total, k = math.log(2 / abs(rate)) - np.euler_gamma, abs(rate)
    i, j = np.meshgrid(np.arange(-60, 61), np.arange(-90, 91), indexing="ij")
    for sign_s in (1, -1):
        for sign_phi in (1, -1):
            distance = np.hypot(s - (sign_s * s + 2 * i * A), phi - (sign_phi * phi + 2 * j * B))
            images = np.where(distance > 0, distance, np.inf)
            total += sign_s * sign_phi * float(k0(k * images).sum())
    return total


@pytest.mark.parametrize("ratio", [1.2, 2.0])
def test_shares_of_an_exponential_sheet_are_exact(ratio: float) -> None:
    """`ratio` is that of the resistances at the ends."""
    rate = math.log(ratio) / (2 * A)
    s, phi = A * TABLE_NODES[INNER], B * TABLE_NODES[INNER]
    exact, even = exact_shares(rate, s, phi), exact_shares(1e-9, s, phi)
    np.testing.assert_allclose(exact.sum(0), 1.0, atol=5e-3)  # the series at 10 % from a side
    maps, plain = uneven_sheet_maps(SHAPE, NO_GAPS, Exponential(rate=rate)), solve_sheet(SHAPE, NO_GAPS)
    change = (maps.table - plain.table)[:4][:, INNER][:, :, INNER]
    assert np.abs(change).max() > 0.04 * math.log(ratio)
    np.testing.assert_allclose(change, exact - even, atol=2e-4)


@pytest.mark.parametrize(("ratio", "tolerance"), [(1.2, 2.5e-3), (2.0, 3e-3), (20.0, 1.5e-2)])
def test_resistance_of_a_contact_on_an_exponential_sheet_is_exact(ratio: float, tolerance: float) -> None:
    """In ln R, about 2 for a contact of 2.5 mm; 2e-3 of the tolerance is the even sheet's."""
    rate = math.log(ratio) / (2 * A)
    maps, plain = uneven_sheet_maps(SHAPE, NO_GAPS, Exponential(rate=rate)), solve_sheet(SHAPE, NO_GAPS)
    changes = []
    for row in np.flatnonzero(INNER)[::7]:
        for column in np.flatnonzero(INNER)[::7]:
            expected = exact_log_radius(rate, A * TABLE_NODES[row], B * TABLE_NODES[column])
            assert maps.table[4, row, column] == pytest.approx(expected, abs=tolerance)
            changes.append(expected - plain.table[4, row, column])
    if ratio == 20.0:
        assert np.ptp(changes) > 4 * tolerance


@pytest.mark.parametrize("kind", ["cylinder", "cone", "sphere"])
def test_uneven_sheets_conserve_current_and_are_reciprocal(kind: str) -> None:
    shape, gaps = (
        simulated_surface(SURFACE_TABLES[kind]),
        ElectrodeGaps(*(2 * ((0.06, 0.05),)), *(2 * ((1e-3, 1e-3),))),
    )
    maps = uneven_sheet_maps(shape, gaps, Unevenness(UNEVEN_MODES, (0.1, -0.1, 0.05, 0.1, 0.05)))
    np.testing.assert_allclose(maps.table[:4].sum(0), 1.0, atol=1e-6)
    np.testing.assert_allclose(maps.conductance, maps.conductance.T, atol=1e-6)
    np.testing.assert_allclose(maps.conductance.sum(0), 0.0, atol=1e-6)


def test_a_sheet_of_uniformly_higher_resistance_keeps_its_shares() -> None:
    maps = uneven_sheet_maps(SHAPE, NO_GAPS, Unevenness(((0, 0),), (0.2,)))
    plain = solve_sheet(SHAPE, NO_GAPS)
    np.testing.assert_allclose(maps.table, plain.table, atol=1e-9)
    np.testing.assert_allclose(maps.conductance, plain.conductance * math.exp(-0.2), rtol=2e-3)


def test_first_order_theory_of_uneven_sheets_agrees_with_finite_elements() -> None:
    """The slopes of the shares by each wave, which tolerances of uneven sheets are made of."""
    network = ElectrodeNetwork(A, B, 1e-3 * A, 1.0)
    inner = TABLE_NODES[INNER]
    slopes = unevenness_slopes(network, *np.meshgrid(A * inner, B * inner, indexing="ij"))
    for wave in (1, 2, 3):
        amplitudes = tuple(0.02 * np.eye(5)[wave])
        maps = uneven_sheet_maps(SHAPE, NO_GAPS, Unevenness(UNEVEN_WAVES, amplitudes))
        change = (maps.table[:4] - solve_sheet(SHAPE, NO_GAPS).table[:4])[:, INNER][:, :, INNER] / 0.02
        assert np.abs(slopes[wave] - change).max() < 0.02 * np.abs(change).max()


def test_counts_of_an_uneven_pad_follow_its_local_resistance(deployment: config.Deployment) -> None:
    touch = {"link": "flat", "from_s": 0.0, "duration_s": 9.0, "path": [[0.3, 0.4]], "force_n": [3.0]}
    scenario = Scenario.model_validate({"touch": [touch]}, strict=False)
    silent = ElectronicsSpread(noise_ratio=Fixed(0.0))
    world = World("uneven", PartSpread(unevenness=Fixed(0.1)), electronics=silent).draw(4)
    hand = VirtualHand(deployment, scenario, world)
    counts = hand.counts(0, [4.0])[0]
    np.testing.assert_array_equal(hand.sample(4.0)[0], counts)
    even = VirtualHand(deployment, scenario, World("even", electronics=silent).draw(4)).counts(0, [4.0])[0]
    assert np.abs(counts - even).max() > 20
    pad = deployment.hands[0].pads[0]
    sheet, node = deployment.sheets[pad.sheet], deployment.nodes[pad.node]
    shape = world.surface("right", pad)
    gap = 1e-3 * pad.gap_mm
    unevenness = Unevenness(UNEVEN_MODES, 5 * (0.1,))
    maps = uneven_sheet_maps(shape, ElectrodeGaps(*(4 * ((gap, gap),))), unevenness)
    local_ohm = sheet.ohm_per_square * float(unevenness.ohm_ratio(np.array([0.3, 0.4])))
    radius_m = 1e-3 * sheet.contact_radius_mm
    contact_ohm_m2 = 1e-6 * sheet.contact_ohm_mm2
    contact_ohm_m2 *= (1e3 * sheet.reference_kpa * math.pi * radius_m**2 / 3.0) ** sheet.alpha
    nearest = np.abs(TABLE_NODES - 0.3).argmin(), np.abs(TABLE_NODES - 0.4).argmin()
    outer_m = math.exp(maps.table[4][nearest])
    ohm = contact_stack_resistance(local_ohm, contact_ohm_m2, radius_m, outer_m)
    expected = node.drive_v / ohm / (1e-3 * node.full_scale_ma) * 32767
    assert counts.sum() == pytest.approx(expected, rel=0.01)
