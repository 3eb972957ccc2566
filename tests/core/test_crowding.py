"""Firm contacts, sheet and layer solved together by finite volumes: where they press, not where currents are.

The sheet is a grid of squares, grounded on all four sides; under the contact each is connected to the drive
through its layer. This shares nothing with the estimator or the simulator, which solves those on a sphere.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags, eye, kron
from scipy.sparse.linalg import SuperLU, splu

from handtouch.config import Deployment, parse
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.contact_patch import discs
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from tests.deployments import deployment_text, pad_text
from tests.exact_pads import electrodes_of

FloatArray = NDArray[np.float64]
LENGTH_MM, WIDTH_MM, STEP_MM = 30.0, 24.0, 0.25
RADIUS_MM, OHM, LAYER_OHM_MM2, ALPHA, DRIVE_V = 2.5, 2400.0, 20000.0, 1.5, 5.0
PLANE = f'{{ kind = "plane", length_mm = {LENGTH_MM}, width_mm = {WIDTH_MM} }}'
FINE = 5  # points along each side of a square, to find the contact's share of it


def deployment(crowded: bool, radius_std_mm: float = 0.5) -> Deployment:
    text = deployment_text(
        pad_text("plane", 1, PLANE, gap_mm=0.02),
        exact_parts=True,
        full_scale_ma=40.0,
        contact_radius_std_mm=radius_std_mm,
    )
    return parse(text.replace("crowding = false", f"crowding = {str(crowded).lower()}"))


@cache
def sheet() -> tuple[Any, ...]:
    """Return the conductances between the squares for 1 ohm per square, and their middles [mm]."""
    n, m = round(LENGTH_MM / STEP_MM), round(WIDTH_MM / STEP_MM)

    def line(count: int) -> Any:
        matrix = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
        matrix[[0, -1], [0, -1]] = 3.0  # an edge is half a square away
        return csc_matrix(matrix)

    matrix = kron(line(n), eye(m)) + kron(eye(n), line(m))
    middles = ((np.arange(count) + 0.5) * STEP_MM for count in (n, m))
    return csc_matrix(matrix), *(np.asarray(middle, np.float64) for middle in middles)


def solved_currents(x_mm: float, y_mm: float, force_n: float, tilt: float = 0.0) -> FloatArray:
    """Return the currents (4,) [A] of a disc pressed on; tilt: pressure at its rim along x, relative."""
    matrix, x, y = sheet()
    fine = (np.arange(FINE) + 0.5) / FINE - 0.5
    along = (x[:, None] + STEP_MM * fine).ravel() - x_mm
    across = (y[:, None] + STEP_MM * fine).ravel() - y_mm
    inside = np.hypot(along[:, None], across) < RADIUS_MM
    pressure_kpa = 1e3 * force_n / (np.pi * RADIUS_MM**2) * (1 + tilt * along / RADIUS_MM)[:, None]
    per_mm2 = inside * (np.maximum(pressure_kpa, 0) / 100.0) ** ALPHA / LAYER_OHM_MM2
    conductance = per_mm2.reshape(len(x), FINE, len(y), FINE).mean(axis=(1, 3)) * STEP_MM**2
    factor: SuperLU = splu(csc_matrix(matrix / OHM + diags(conductance.ravel())))
    volt = factor.solve(DRIVE_V * conductance.ravel()).reshape(len(x), len(y))
    sides = volt[0].sum(), volt[-1].sum(), volt[:, 0].sum(), volt[:, -1].sum()
    return 2.0 / OHM * np.array(sides)


def solved(currents_a: FloatArray, stated: Deployment) -> FloatArray:
    """Return the values (VALUE_COUNT,) of a contact with these currents (4,)."""
    model, values = build_pad_model(stated), np.full((1, VALUE_COUNT), np.nan)
    ContactSolver(model, currents_a[None], np.zeros(1), np.ones(1, np.bool_), values).solve_contacts(
        np.arange(1).data
    )
    return np.asarray(values[0])


def located_mm(
    currents_a: FloatArray, crowded: bool = True, stated: Deployment | None = None
) -> tuple[FloatArray, float]:
    """Return position [mm] and standard deviation [mm] of a contact with these currents (4,)."""
    values = solved(currents_a, stated or deployment(crowded))
    covariance = values[VALUE_SLICES["covariance_m2"]].reshape(3, 3)
    return 1e3 * values[VALUE_SLICES["pad_m"]], 1e3 * float(np.sqrt(np.trace(covariance)))


def force_n_of(currents_a: FloatArray, stated: Deployment) -> tuple[float, float]:
    """Return force [N] and standard deviation [N] of a contact with these currents (4,)."""
    values = solved(currents_a, stated)
    return float(values[VALUE_SLICES["force_n"].start]), float(values[VALUE_SLICES["force_std_n"].start])


@pytest.mark.parametrize(("x_mm", "y_mm"), [(3.0, 12.0), (3.5, 9.0), (25.0, 12.0), (6.0, 4.0), (4.0, 4.0)])
@pytest.mark.parametrize("force_n", [0.3, 1.0, 3.0, 5.0])
def test_a_firm_contact_is_where_it_presses_not_where_its_current_is(
    x_mm: float, y_mm: float, force_n: float
) -> None:
    currents_a = solved_currents(x_mm, y_mm, force_n)
    error_mm, uncorrected_mm = (
        float(np.hypot(*(located_mm(currents_a, crowded)[0] - (x_mm, y_mm)))) for crowded in (True, False)
    )
    _, std_mm = located_mm(currents_a)
    assert error_mm < max(0.02, 0.25 * uncorrected_mm)
    assert error_mm < 2.45 * max(std_mm, 0.004)  # the grid's error is below 4 um


def centre_on_pad_mm(x_mm: float, y_mm: float) -> FloatArray:
    """Return the centre (2,) of the part of a disc that is on the pad, near its corner x = y = 0."""
    angle = np.linspace(-np.pi, np.pi, 2001)
    radius = RADIUS_MM * np.sqrt((np.arange(200) + 0.5) / 200)[:, None]
    points = np.stack([x_mm + radius * np.cos(angle), y_mm + radius * np.sin(angle)])
    return np.asarray(points[:, (points > 0).all(axis=0)].mean(axis=1))


@pytest.mark.parametrize(
    ("x_mm", "y_mm", "limit"),
    [(25.0, 12.0, 0.03), (3.0, 12.0, 0.03), (4.0, 4.0, 0.06), (2.2, 12.0, 0.06), (1.0, 12.0, 0.06)],
)
@pytest.mark.parametrize("force_n", [1.0, 3.0, 8.0])
def test_a_firm_contact_of_known_radius_is_within_the_stated_share_of_its_shift(
    x_mm: float, y_mm: float, limit: float, force_n: float
) -> None:
    """Inside 3 %, in corners and over an edge 6 %, and within the region of 95 %."""
    currents_a = solved_currents(x_mm, y_mm, force_n)
    middle_mm = centre_on_pad_mm(x_mm, y_mm)
    found_mm, std_mm = located_mm(currents_a, stated=deployment(True, 0.0))
    shift_mm = float(np.hypot(*(located_mm(currents_a, False)[0] - middle_mm)))
    error_mm = float(np.hypot(*(found_mm - middle_mm)))
    assert error_mm < 0.002 + limit * shift_mm  # the grid's error is below 2 um
    assert error_mm < 2.45 * max(std_mm, 0.0015)
    if force_n > 1.0:
        assert std_mm < 0.3 * shift_mm


@pytest.mark.parametrize(("x_mm", "y_mm"), [(1.5, 6.0), (1.5, 9.0), (1.0, 3.0)])
@pytest.mark.parametrize("force_n", [0.3, 1.0])
def test_a_contact_that_an_edge_cuts_is_not_moved_along_it(x_mm: float, y_mm: float, force_n: float) -> None:
    currents_a, middle_mm = solved_currents(x_mm, y_mm, force_n), centre_on_pad_mm(x_mm, y_mm)
    found_mm, std_mm = located_mm(currents_a, stated=deployment(True, 0.0))
    along_mm = abs(located_mm(currents_a, False)[0][1] - middle_mm[1])
    assert along_mm > 0.01
    assert abs(found_mm[1] - middle_mm[1]) < 0.2 * along_mm
    assert np.hypot(*(found_mm - middle_mm)) < 2.45 * std_mm


@pytest.mark.parametrize("force_n", [2.0, 3.0])
def test_a_pressure_that_rises_to_one_side_has_its_centre_within_the_region_of_contact_tilt_std(
    force_n: float,
) -> None:
    tilted = deployment(True)
    sheet = tilted.sheets["s"].model_copy(update={"contact_tilt_std": 0.3, "contact_elongation_std": 0.4})
    tilted = tilted.model_copy(update={"sheets": {"s": sheet}})
    centre_mm = np.array([13.0 + RADIUS_MM / 4, 11.0])
    currents_a = solved_currents(13.0, 11.0, force_n, tilt=1.0)
    found_mm, std_mm = located_mm(currents_a, stated=tilted)
    error_mm = float(np.hypot(*(found_mm - centre_mm)))
    assert 0.05 < error_mm < 2.45 * std_mm / np.sqrt(2)
    assert std_mm < 0.3


def test_leads_that_the_file_does_not_state_are_within_series_std_ohm() -> None:
    stated = deployment(True)
    node = stated.nodes["n"].model_copy(update={"series_std_ohm": 2.0})
    model = build_pad_model(stated)
    (network,) = electrodes_of(model)
    with_leads = network.with_series_ohm([3.0, 0.0, 1.0, 2.0])
    currents_a = 2e-3 * with_leads.fractions(0.3 * network.a, 0.6 * network.b)
    expected_mm = np.array([0.3 * LENGTH_MM, 0.6 * WIDTH_MM])
    known = stated.model_copy(update={"nodes": {"n": node}})
    (found_mm, std_mm), (without_mm, narrow_mm) = (
        located_mm(currents_a, stated=one) for one in (known, stated)
    )
    assert np.hypot(*(found_mm - expected_mm)) < 2.45 * std_mm / np.sqrt(2)
    assert np.hypot(*(without_mm - expected_mm)) > 2.45 * narrow_mm


SPHERE = '{ kind = "sphere", radius_mm = 10.0, from_deg = -30.0, to_deg = 55.0, arc_deg = 140.0 }'


def test_a_firm_contact_on_a_sphere_is_found_where_the_simulator_presses_it() -> None:
    """The sheet's scale varies over a sphere, and with it the spreading of the current."""
    text = deployment_text(
        pad_text("ball", 1, SPHERE, gap_mm=0.5),
        exact_parts=True,
        full_scale_ma=40.0,
        contact_radius_std_mm=0.0,
    )
    stated = parse(text.replace("crowding = false", "crowding = true"))
    touch = ScenarioTouch(link="ball", from_s=0.0, duration_s=1.0, path=((0.5, 0.5),), force_n=(1.0,))
    hand = VirtualHand(stated, Scenario(touch=(touch,)), WORLDS["ideal"].draw(1))
    place = np.array([[0.35, 0.5, 0.6, 0.6], [0.5, 0.5, 0.5, 0.65]])
    force = np.array([3.0, 5.0, 3.0, 5.0])
    patches = discs(np.full(4, 1e-3 * RADIUS_MM))
    currents_a = hand.solve_contacts(np.zeros(4, np.intp), place, patches, force)
    shape, uncorrected = hand.virtual_pads[0].shape, parse(text)
    for at, own_a in zip(place.T, currents_a, strict=True):
        arcs_m = shape.arc_lengths(at[0] * shape.length_m, at[1] * shape.arc)
        error_mm, shift_mm = (
            float(np.hypot(*(located_mm(own_a, stated=one)[0] - 1e3 * np.array(arcs_m))))
            for one in (stated, uncorrected)
        )
        assert error_mm < 0.002 + 0.1 * shift_mm


@cache
def plane_under_the_simulator() -> tuple[Deployment, VirtualHand]:
    """Return a plane pad of exact parts with contacts of known radius, and the hand that solves them."""
    stated = deployment(True, 0.0)
    touch = ScenarioTouch(link="plane", from_s=0.0, duration_s=1.0, path=((0.5, 0.5),), force_n=(1.0,))
    return stated, VirtualHand(stated, Scenario(touch=(touch,)), WORLDS["ideal"].draw(1))


@pytest.mark.parametrize(
    ("radii", "along", "limit"), [(3.0, 0.5, 5e-4), (1.6, 0.5, 1e-3), (1.1, 0.4, 5e-3), (0.6, 0.5, 0.02)]
)
def test_the_force_of_a_contact_near_an_edge_is_that_which_the_simulator_presses_with(
    radii: float, along: float, limit: float
) -> None:
    """Inside, and over the edge, where the part on the pad carries the whole force."""
    stated, hand = plane_under_the_simulator()
    force_n = np.array([0.3, 1.0, 2.0, 4.0])
    place = np.array([[radii * RADIUS_MM / LENGTH_MM] * 4, [along] * 4])
    currents_a = hand.solve_contacts(
        np.zeros(4, np.intp), place, discs(np.full(4, 1e-3 * RADIUS_MM)), force_n
    )
    for pressed_n, own_a in zip(force_n, currents_a, strict=True):
        found_n, std_n = force_n_of(own_a, stated)
        assert abs(found_n - pressed_n) < limit * pressed_n
        assert abs(found_n - pressed_n) < 2.0 * std_n
        assert std_n < 0.02 * pressed_n


def test_forces_of_firm_contacts_of_exact_parts_are_within_their_intervals() -> None:
    """Near the greatest current of a sheet, a small error of the theory is a large one of the force."""
    stated, hand = plane_under_the_simulator()
    rng, count = np.random.default_rng(1), 60
    place, force_n = rng.uniform(0.1, 0.9, (2, count)), rng.uniform(5.0, 20.0, count)
    currents_a = hand.solve_contacts(
        np.zeros(count, np.intp), place, discs(np.full(count, 1e-3 * RADIUS_MM)), force_n
    )
    found_n, std_n = np.array([force_n_of(own_a, stated) for own_a in currents_a]).T
    sigmas = np.abs(found_n - force_n) / std_n
    assert np.mean(sigmas < 1.96) > 0.9
    assert sigmas.max() < 5.0
