"""Contacts against finite volumes of the sheet and the layer together, which share nothing with them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags, eye, kron
from scipy.sparse.linalg import SuperLU, splu

from handtouch import config
from handtouch.field import Rectangle
from handtouch.simulate.contact_patch import PROFILES, ContactPatch, Profile
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_solver import ElectrodeGaps, SheetMapBank, solve_sheet
from handtouch.simulate.solved_contact import ContactLayer, PatchNodes, look_up_nodes, solve_patches
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import ContactSpread, ElectronicsSpread, Fixed, OneOf, World

FloatArray = NDArray[np.float64]
LENGTH_MM, WIDTH_MM, STEP_MM, FINE = 24.0, 20.0, 0.25, 4
OHM, LAYER = 2400.0, ContactLayer(0.02, 1e5, 1.5)
RADIUS_MM = 2.5
PLACES = {
    "inside": (10.3, 8.7),
    "near an edge": (3.1, 10.2),
    "near a corner": (3.6, 4.1),
    "over an edge": (1.2, 10.1),
}


def unit_pressure(profile: str, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the pressure of a profile, in any unit, at points of the plane of its unit disc; x along it."""
    r = np.hypot(x, y)
    on = r < 1
    if profile == "hertz":
        return np.asarray(np.sqrt(np.maximum(1 - r**2, 0)))
    if profile == "ring":
        return np.asarray(on & (r > 0.6), np.float64)
    if profile == "two_spots":
        return np.asarray(np.hypot(np.abs(x) - 0.6, y) < 0.55, np.float64)
    tilt = {"half_tilted": 0.5, "tilted": 1.0}.get(profile, 0.0)
    return np.asarray(on * (1 + tilt * x))


def solve_by_finite_volumes(
    patch: ContactPatch, place_mm: tuple[float, float], force_n: float
) -> tuple[FloatArray, FloatArray]:
    """Return currents (4,) [A] for 1 V into the sheet's grounded sides, and the centre of pressure [mm]."""
    n, m = round(LENGTH_MM / STEP_MM), round(WIDTH_MM / STEP_MM)
    x = ((np.arange(n * FINE) + 0.5) * STEP_MM / FINE)[:, None]
    y = (np.arange(m * FINE) + 0.5) * STEP_MM / FINE
    turn = complex(math.cos(patch.direction_rad), -math.sin(patch.direction_rad))
    local = ((x - place_mm[0]) + 1j * (y - place_mm[1])) * turn / (1e3 * patch.radius_m)
    u, v = local.real / math.sqrt(patch.elongation), local.imag * math.sqrt(patch.elongation)
    shift = {"half_tilted": 0.125, "tilted": 0.25}.get(patch.profile, 0.0)
    pressure = unit_pressure(patch.profile, u + shift, v)
    cell_m2 = (1e-3 * STEP_MM / FINE) ** 2
    pressure *= force_n / (pressure.sum() * cell_m2)
    centre_mm = np.array([(pressure * x).sum(), (pressure * y).sum()]) / pressure.sum()
    density = (pressure / LAYER.reference_pa) ** LAYER.alpha / LAYER.contact_ohm_m2 * cell_m2
    conductance = density.reshape(n, FINE, m, FINE).sum(axis=(1, 3)).ravel()
    volt = laplace(n, m)(conductance).reshape(n, m)
    sides = volt[0].sum(), volt[-1].sum(), volt[:, 0].sum(), volt[:, -1].sum()
    return 2.0 / OHM * np.array(sides), centre_mm


def laplace(n: int, m: int) -> Callable[[FloatArray], FloatArray]:
    """Return the solver for the volts of squares with these conductances to 1 V."""

    def line(count: int) -> csc_matrix:
        matrix = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
        matrix[[0, -1], [0, -1]] = 3.0  # an edge is half a square away
        return csc_matrix(matrix)

    sheet = (kron(line(n), eye(m)) + kron(eye(n), line(m))) / OHM

    def solve(conductance: FloatArray) -> FloatArray:
        factor: SuperLU = splu(csc_matrix(sheet + diags(conductance)))
        return np.asarray(factor.solve(conductance))

    return solve


@pytest.fixture(scope="module")
def plane() -> tuple[SimulatedSurface, SheetMapBank]:
    """A plane whose electrodes have all but no gaps."""
    shape = SimulatedSurface(1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM, 1.0, flat=True)
    return shape, SheetMapBank([solve_sheet(shape, ElectrodeGaps(*(4 * ((0.0, 0.0),))))])


def solve_reduced(
    plane: tuple[SimulatedSurface, SheetMapBank],
    patch: ContactPatch,
    place_mm: tuple[float, float],
    force_n: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the same by the simulator."""
    shape, bank = plane
    position = np.array([[place_mm[0] / LENGTH_MM], [place_mm[1] / WIDTH_MM]])
    nodes = PatchNodes.of_patches(shape, position, patch.column(np.array([force_n])))
    log_radius, shares = look_up_nodes(bank, np.zeros(1, np.intp), nodes)
    one = np.zeros(1, np.intp)
    ohm, mean, _ = solve_patches(nodes, log_radius, shares, one, np.array([force_n]), OHM, LAYER)
    centre = nodes.centres(shape, position)[:, 0] * (LENGTH_MM, WIDTH_MM)
    return mean[0] / ohm[0], centre


@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("profile", PROFILES)
def test_contacts_are_those_of_finite_volumes(
    plane: tuple[SimulatedSurface, SheetMapBank], profile: Profile, place: str
) -> None:
    elongation = 1.5 if profile in ("uniform", "tilted") else 1.0
    patch = ContactPatch(1e-3 * RADIUS_MM, elongation, 0.4, profile)
    rectangle = Rectangle(LENGTH_MM, WIDTH_MM)
    if profile == "ring" and place == "over an edge":
        pytest.skip("a ring over an edge is squeezed onto the pad, hole included")
    for force_n in (0.2, 4.0):
        expected, centre_mm = solve_by_finite_volumes(patch, PLACES[place], force_n)
        currents, found_mm = solve_reduced(plane, patch, PLACES[place], force_n)
        is_rough = place == "over an edge" and profile == "two_spots"
        np.testing.assert_allclose(currents.sum(), expected.sum(), rtol=0.1 if is_rough else 0.01)
        one, other = rectangle.locate(currents), rectangle.locate(expected)
        tolerance_mm = 0.1 if is_rough else 0.02
        assert math.hypot(one.x - other.x, one.y - other.y) < tolerance_mm
        np.testing.assert_allclose(found_mm, centre_mm, atol=tolerance_mm)


def test_currents_of_long_patches_beside_edges_rise_with_the_force(
    plane: tuple[SimulatedSurface, SheetMapBank],
) -> None:
    rng = np.random.default_rng(2)
    sides_mm, forces_n = np.array([LENGTH_MM, WIDTH_MM]), (1.0, 3.0, 10.0, 30.0)
    for _ in range(400):
        profile = PROFILES[rng.integers(len(PROFILES))]
        direction = float(rng.uniform(0, np.pi))
        patch = ContactPatch(1e-3 * rng.uniform(1.0, 4.0), rng.uniform(2.0, 3.0), direction, profile)
        place_mm = sides_mm * rng.uniform(0.02, 0.98, 2)
        axis = rng.integers(2)
        place_mm[axis] = sides_mm[axis] * rng.choice([0.02, 0.05, 0.1])
        totals = [solve_reduced(plane, patch, tuple(place_mm), force_n)[0] for force_n in forces_n]
        assert min(currents.min() for currents in totals) > 0
        assert (np.diff([currents.sum() for currents in totals]) > 0).all()


@pytest.mark.parametrize("shape", [{"elongation": 3.0}, {"profile": "tilted", "direction_deg": 40.0}])
def test_live_samples_and_series_have_the_same_counts_of_shaped_touches(
    deployment: config.Deployment, shape: dict[str, object]
) -> None:
    touch = {"link": "flat", "from_s": 0.0, "duration_s": 9.0, "path": [[0.3, 0.3]], "force_n": [3.0]}
    world = World("silent", electronics=ElectronicsSpread(noise_ratio=Fixed(0.0))).draw(4)

    def counts(more: dict[str, object]) -> FloatArray:
        scenario = Scenario.model_validate({"touch": [touch | more]}, strict=False)
        hand = VirtualHand(deployment, scenario, world)
        np.testing.assert_array_equal(hand.sample(4.0)[0], hand.counts(0, [4.0])[0])
        return np.asarray(hand.counts(0, [4.0])[0], np.float64)

    assert np.abs(counts(shape) - counts({})).max() > 10


def test_worlds_draw_profiles_and_elongations_of_touches_that_state_none(
    deployment: config.Deployment,
) -> None:
    spread = ContactSpread(elongation=Fixed(2.0), profile=OneOf(("ring",)))
    contact = World("rings", contacts=spread).draw(4).contact(deployment.sheets["s"], 0)
    assert contact.patch.elongation == 2.0
    assert contact.patch.profile == "ring"
