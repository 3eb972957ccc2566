"""Forces of single contacts hold with their stated probability: near edges and near the sheet's maximum
current."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import parse
from handtouch.core.pad_model import PadModel
from handtouch.core.stages import force
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field.contact_law import ContactLaw, ForceEstimateStatus
from tests.core.conftest import TOLERANT_DEPLOYMENT

FloatArray = NDArray[np.float64]
GREATEST_N = 15.0


def solve(model: PadModel, currents: FloatArray) -> tuple[float, float, int]:
    """Return force, standard deviation and status of a contact with these currents (4,) on the first pad."""
    force, std, status = solve_each(model, currents[None])[0]
    return float(force), float(std), int(status)


def solve_each(model: PadModel, currents: FloatArray) -> FloatArray:
    """Return the same (n, 3) of contacts with these currents (n, 4), one after the other."""
    every, values = np.zeros((model.size, 4)), np.full((model.size, VALUE_COUNT), np.nan)
    solver = ContactSolver(model, every, np.zeros(model.size), np.ones(model.size, np.bool_), values)
    found = []
    for own in currents:
        every[0], values[0] = own, np.nan
        solver.solve_contacts(np.zeros(1, np.intp).data)
        found.append(
            [values[0, VALUE_SLICES[name]][0] for name in ("force_n", "force_std_n", "force_status")]
        )
    return np.array(found)


def patch_factor(distance: float, x: float, alpha: float) -> float:
    """Return 2 pi V / (rho I) of a disc of radius 1 next to a straight grounded edge, cut off by it.

    By collocation on a square grid, with image charges: neither eq. 11 nor an expansion. The whole force acts
    on what is left of the disc; x is that of the whole disc.
    """
    cells = 26
    axis = (np.arange(cells) + 0.5) * 2 / cells - 1
    across, away = (grid.ravel() for grid in np.meshgrid(axis, axis + distance))
    inside = (across**2 + (away - distance) ** 2 < 1) & (away > 0)
    place = (across + 1j * away)[inside]
    cell = np.pi / np.count_nonzero(across**2 + (away - distance) ** 2 < 1)
    apart = np.abs(place[:, None] - place)
    # mean of ln r over a square about its middle
    np.fill_diagonal(apart, np.sqrt(cell) * np.exp(np.pi / 4 - 1.5 - np.log(2) / 2))
    green = np.log(np.abs(place[:, None] - place.conj()) / apart)
    pressed = x**2 * (np.pi / (cell * len(place))) ** alpha
    density = np.linalg.solve(np.eye(len(place)) * 2 * np.pi / pressed + cell * green, np.ones(len(place)))
    return float(1 / (cell * density.sum()))


@pytest.mark.parametrize("distance", [0.4, 0.7, 1.0, 1.5])
@pytest.mark.parametrize("force_n", [1.0, 3.0])
def test_a_force_next_to_an_electrode_covers_that_of_a_cut_off_patch(
    bench: Any, distance: float, force_n: float
) -> None:
    model, sheet = bench.model, bench.deployment.sheets["s"]
    radius_m, network = 1e-3 * sheet.contact_radius_mm, model.networks[0]
    pressure = force_n / (np.pi * radius_m**2) / (1e3 * sheet.reference_kpa)
    x = radius_m * np.sqrt(sheet.ohm_per_square / (1e-6 * sheet.contact_ohm_mm2) * pressure**sheet.alpha)
    total = 5.0 * 2 * np.pi / sheet.ohm_per_square / patch_factor(distance, x, sheet.alpha)
    fractions = network.fractions(distance * radius_m, network.b / 2)
    found, std, status = solve(model, total * fractions)
    assert status == ForceEstimateStatus.VALID
    assert abs(found - force_n) < 1.96 * std
    assert std < 0.75 * force_n


WIDE = """contact_radius_std_mm = 1.0
contact_ohm_std = 0.15
alpha_std = 0.12
ohm_per_square_std = 0.25"""


def solve_drawn(text: str, forces: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return forces, standard deviations and status (n,) of contacts in the middle of the first pad.

    Law and radius of each are drawn from the tolerances of a deployment.
    """
    model, rng = build_pad_model(parse(text)), np.random.default_rng(4)
    sheet, network = parse(text).sheets["s"], model.networks[0]
    fractions = network.fractions(network.a / 2, network.b / 2)
    spreading_m = float(network.spreading_radius(network.a / 2, network.b / 2))
    currents = []
    for force_n in forces.tolist():
        law = ContactLaw(
            1e-6 * sheet.contact_ohm_mm2 * np.exp(sheet.contact_ohm_std * rng.normal()),
            sheet.alpha + sheet.alpha_std * rng.normal(),
            1e-3 * max(1.0, sheet.contact_radius_mm + sheet.contact_radius_std_mm * rng.normal()),
            reference_pa=1e3 * sheet.reference_kpa,
            hertz_n=sheet.hertz_force_n,
        )
        sheet_ohm = sheet.ohm_per_square * np.exp(sheet.ohm_per_square_std * rng.normal())
        currents.append(float(law.current(force_n, 5.0, sheet_ohm, spreading_m)) * fractions)
    force, std, status = solve_each(model, np.array(currents)).T
    return force, std, status


def test_fewer_nodes_for_nearly_log_normal_forces_give_force_and_deviation_of_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    forces = np.exp(np.random.default_rng(3).uniform(np.log(0.2), np.log(GREATEST_N), 300))
    text = TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\nmax_force_n = {GREATEST_N}")
    few = solve_drawn(text, forces)
    monkeypatch.setattr(force, "NEAR_FORCE_NODES", 24)
    force.stack_table.cache_clear()
    many = solve_drawn(text, forces)
    force.stack_table.cache_clear()
    valid = many[2] == ForceEstimateStatus.VALID
    assert valid.mean() > 0.9
    assert np.array_equal(few[2], many[2])
    for found, expected in zip(few[:2], many[:2], strict=True):
        assert 0 < np.abs((found - expected) / many[1])[valid].max() < 0.02


HERTZ = "contact_radius_std_mm = 0.5\nhertz_force_n = 2.0"
RADIUS_ALONE = """contact_radius_std_mm = 0.5
contact_ohm_std = 0.0
alpha_std = 0.0
ohm_per_square_std = 0.0"""


class RadiusBench:
    """Contacts in the middle of a plane whose radius alone is uncertain, by `std_mm`."""

    def __init__(self, text: str, std_mm: float) -> None:
        text = text.replace("contact_radius_std_mm = 0.5", f"contact_radius_std_mm = {std_mm}")
        self.model, self._sheet = build_pad_model(parse(text)), parse(text).sheets["s"]
        network = self.model.networks[0]
        middle = network.a / 2, network.b / 2
        self._fractions = network.fractions(*middle)
        self._spreading_m = float(network.spreading_radius(*middle))

    def solve(
        self, forces_n: FloatArray, deviations: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return force, deviation and status of contacts of these forces, and deviations of their radii."""
        sheet, currents = self._sheet, []
        radii_mm = sheet.contact_radius_mm + deviations * sheet.contact_radius_std_mm
        for force_n, radius_mm in zip(forces_n.tolist(), radii_mm.tolist(), strict=True):
            law = ContactLaw(
                *(1e-6 * sheet.contact_ohm_mm2, sheet.alpha, 1e-3 * radius_mm),
                reference_pa=1e3 * sheet.reference_kpa,
            )
            current = float(law.current(force_n, 5.0, sheet.ohm_per_square, self._spreading_m))
            currents.append(current * self._fractions)
        force, std, status = solve_each(self.model, np.array(currents)).T
        return force, std, status


@pytest.mark.parametrize(
    "tolerances",
    ["contact_radius_std_mm = 0.5", WIDE, HERTZ, f"{WIDE}\nhertz_force_n = 2.0"],
    ids=["default", "wide", "hertz", "wide-hertz"],
)
def test_forces_up_to_the_greatest_one_hold_with_the_stated_probability(tolerances: str) -> None:
    text = TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\nmax_force_n = {GREATEST_N}")
    text = text.replace("contact_radius_std_mm = 0.5", tolerances)
    forces = np.exp(np.random.default_rng(3).uniform(np.log(0.2), np.log(GREATEST_N), 600))
    found, std, status = solve_drawn(text, forces)
    valid, error = status == ForceEstimateStatus.VALID, (found - forces) / std
    held = np.abs(error) < 1.96
    assert valid.mean() > 0.9
    assert 0.92 < held[valid].mean() < 0.99
    for slice_ in (forces < 1, (forces > 1) & (forces < 5), forces > 5):
        assert 0.84 < held[valid & slice_].mean() <= 1.0


@pytest.mark.parametrize(
    "tolerances",
    ["contact_radius_std_mm = 0.5", WIDE, RADIUS_ALONE, HERTZ],
    ids=["default", "wide", "radius", "hertz"],
)
def test_intervals_hold_of_forces_just_below_the_greatest_one(tolerances: str) -> None:
    text = TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\nmax_force_n = {GREATEST_N}")
    text = text.replace("contact_radius_std_mm = 0.5", tolerances)
    forces = np.random.default_rng(5).uniform(0.6 * GREATEST_N, GREATEST_N, 800)
    found, std, status = solve_drawn(text, forces)
    valid = status == ForceEstimateStatus.VALID
    assert valid.mean() > 0.9
    assert (np.abs(found - forces) < 1.96 * std)[valid].mean() > 0.92


@pytest.mark.parametrize("greatest_n", [10.0, 30.0])
def test_deviations_of_forces_near_the_greatest_one_dont_jump(greatest_n: float) -> None:
    text = TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\nmax_force_n = {greatest_n}")
    bench = RadiusBench(text.replace("contact_radius_std_mm = 0.5", RADIUS_ALONE), 0.5)
    forces = np.geomspace(0.05 * greatest_n, greatest_n, 3000)
    _, std, status = bench.solve(forces, np.zeros(forces.shape))
    assert (status == ForceEstimateStatus.VALID).all()
    assert np.abs(np.diff(np.log(std))).max() < 0.03


@pytest.mark.parametrize("greatest_n", [3.0, 5.0, 11.0, 20.0, 27.0])
@pytest.mark.parametrize(
    "tolerances",
    ["contact_radius_std_mm = 0.5", WIDE, HERTZ],
    ids=["default", "wide", "hertz"],
)
def test_no_current_gives_a_force_beyond_the_greatest_one(greatest_n: float, tolerances: str) -> None:
    text = TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\nmax_force_n = {greatest_n}")
    text = text.replace("contact_radius_std_mm = 0.5", tolerances)
    model = build_pad_model(parse(text))
    fractions = model.networks[0].fractions(model.networks[0].a * 0.3, model.networks[0].b / 2)
    force, std, status = solve_each(model, np.geomspace(1e-5, 0.1, 300)[:, None] * fractions).T
    valid = status == ForceEstimateStatus.VALID
    assert valid.sum() > 50
    assert force[valid].max() <= greatest_n
    assert std[valid].max() < greatest_n
    bounds = force[status == ForceEstimateStatus.LOWER_BOUND]
    assert bounds.size == 0 or bounds.max() <= greatest_n * (1 + 1e-9)


@pytest.mark.parametrize("greatest", ["", "max_force_n = 5.0", "max_force_n = 12.0"])
@pytest.mark.parametrize("corner", [(0.002, 0.002), (0.998, 0.003), (0.001, 0.995)])
def test_no_force_is_valid_that_its_current_leaves_open_as_in_a_corner(
    greatest: str, corner: tuple[float, float]
) -> None:
    model = build_pad_model(parse(TOLERANT_DEPLOYMENT.replace("alpha = 1.5", f"alpha = 1.5\n{greatest}")))
    side_a, side_b = model.networks[0].a, model.networks[0].b
    currents = np.geomspace(1e-5, 2e-3, 60)[:, None]
    force, std, status = solve_each(
        model, currents * model.networks[0].fractions(corner[0] * side_a, corner[1] * side_b)
    ).T
    valid, wide = status == ForceEstimateStatus.VALID, status == ForceEstimateStatus.WIDE
    assert valid.sum() > 20
    assert (std[valid] < 8 * force[valid]).all()
    assert (std[wide] > 1.2 * force[wide]).all()
    inside = solve_each(model, currents * model.networks[0].fractions(0.5 * side_a, 0.5 * side_b))
    assert not (inside[:, 2] == ForceEstimateStatus.WIDE).any()


def test_without_a_greatest_force_those_at_the_sheets_limit_are_lower_bounds(bench: Any) -> None:
    model = bench.model
    fractions = model.networks[0].fractions(model.networks[0].a / 2, model.networks[0].b / 2)
    law = ContactLaw(2e-2, 1.5, 2.5e-3)
    spreading_m = float(model.networks[0].spreading_radius(model.networks[0].a / 2, model.networks[0].b / 2))
    found, std, status = solve(model, float(law.current(30.0, 5.0, 2400.0, spreading_m)) * fractions)
    assert (status, std) == (ForceEstimateStatus.LOWER_BOUND, np.inf)
    assert found < 30.0


def test_a_current_far_above_all_that_the_law_allows_gives_no_greater_bound(bench: Any) -> None:
    """It contradicts the law: parts, or where the contact is, are not as stated."""
    model, place = bench.model, (bench.model.networks[0].a / 2, bench.model.networks[0].b / 2)
    law, spreading_m = ContactLaw(2e-2, 1.5, 2.5e-3), float(model.networks[0].spreading_radius(*place))
    greatest = float(law.current(1e6, 5.0, 2400.0, spreading_m)) * model.networks[0].fractions(*place)
    bounds = [solve(model, excess * greatest) for excess in (1.0, 1.5, 2.0, 4.0)]
    assert {status for _, _, status in bounds} == {ForceEstimateStatus.LOWER_BOUND}
    assert all(0 < found <= bounds[0][0] for found, _, _ in bounds)


EXACT = """contact_radius_std_mm = 0.0
contact_ohm_std = 0.0
alpha_std = 0.0
ohm_per_square_std = 0.0
max_force_n = 300.0
hertz_force_n = 0.5"""


@pytest.mark.parametrize("alpha", [1.0, 1.5, 2.2])
def test_a_radius_that_grows_with_the_force_is_that_of_the_force_found(alpha: float) -> None:
    text = TOLERANT_DEPLOYMENT.replace("contact_radius_std_mm = 0.5", EXACT)
    # the greatest force has a radius of 12.5 mm, that of an edge contact
    forces = np.geomspace(0.05, 60.0, 25)
    found, _, status = solve_drawn(text.replace("alpha = 1.5", f"alpha = {alpha}"), forces)
    assert (status == ForceEstimateStatus.VALID).all()
    inside = forces < 10.0
    assert found[inside] == pytest.approx(forces[inside], rel=5e-3)


def test_a_growing_contact_whose_layer_no_longer_resists_gives_a_lower_bound() -> None:
    text = TOLERANT_DEPLOYMENT.replace("contact_radius_std_mm = 0.5", HERTZ)
    forces = np.array([0.3, 1e3, 1e4])
    found, std, status = solve_drawn(text, forces)
    assert status.tolist() == [
        ForceEstimateStatus.VALID,
        *[ForceEstimateStatus.LOWER_BOUND] * 2,
    ]
    assert (found[1:] < forces[1:]).all()
    assert np.isinf(std[1:]).all()


@pytest.mark.parametrize(
    "tolerances", ["contact_radius_std_mm = 0.5", RADIUS_ALONE], ids=["default", "radius"]
)
def test_lower_bounds_are_below_the_force_with_the_probability_of_two_deviations(tolerances: str) -> None:
    text = TOLERANT_DEPLOYMENT.replace("contact_radius_std_mm = 0.5", tolerances)
    forces = np.exp(np.random.default_rng(3).uniform(np.log(0.5), np.log(60.0), 500))
    found, _, status = solve_drawn(text, forces)
    bound = status == ForceEstimateStatus.LOWER_BOUND
    assert bound[forces > 15].mean() > 0.9
    assert (found[bound] < forces[bound]).mean() > 0.977
    assert np.median(found[bound & (forces < 12)] / forces[bound & (forces < 12)]) > 0.4
