"""Contacts that are no points in the simulator's physics: patches over an edge, several patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field.contact_law import ForceEstimateStatus
from handtouch.simulate.contact_patch import PROFILES, discs
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.solved_contact import PatchNodes
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.virtual_pad import VirtualPad
from handtouch.simulate.worlds import WORLDS, Family
from tests.deployments import deployment_text, pad_text

FloatArray = NDArray[np.float64]
TEXT = deployment_text(pad_text("plane", 1), channel="none", full_scale_ma=40.0)
ELONGATION_STD = 0.6


def deployed(**sheet: float) -> config.Deployment:
    deployment = config.parse(TEXT)
    made = deployment.sheets["s"].model_copy(update=sheet)
    return deployment.model_copy(update={"sheets": {"s": made}})


def virtual_hand(deployment: config.Deployment, *touches: dict[str, Any]) -> VirtualHand:
    held = {"link": "plane", "from_s": 0.0, "duration_s": 10.0}
    given = [held | touch for touch in touches or ({"path": ((0.5, 0.5),), "force_n": (1.0,)},)]
    return VirtualHand(deployment, Scenario.model_validate({"touch": given}), WORLDS["ideal"].draw(1))


def solve(model: PadModel, currents: FloatArray, pad: int = 0) -> dict[str, FloatArray]:
    """Return the values of contacts with these currents (n, c) on a pad, each by itself."""
    every, rows = np.zeros((model.size, model.channels)), []
    values = np.full((model.size, VALUE_COUNT), np.nan)
    solver = ContactSolver(model, every, np.zeros(model.size), np.ones(model.size, np.bool_), values)
    for own in currents:
        every[pad], values[pad] = own, np.nan
        solver.solve_contacts(np.full(1, pad, np.intp).data)
        rows.append(values[pad].copy())
    return {name: np.array(rows)[:, where] for name, where in VALUE_SLICES.items()}


def elongated_at_an_edge(elongation_std: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return errors and standard deviations [m] across the edge x0 of contacts 0.3 to 2 mm from it."""
    stated = deployed(contact_elongation_std=elongation_std)
    hand, rng = virtual_hand(stated), np.random.default_rng(5)
    length_m, _ = hand.virtual_pads[0].circuit.size_m
    position = np.stack([rng.uniform(3e-4, 2e-3, count) / length_m, rng.uniform(0.3, 0.7, count)])
    patch = discs(np.full(count, 2.5e-3))
    patch[1], patch[2] = np.exp(ELONGATION_STD * np.abs(rng.normal(size=count))), rng.uniform(0, np.pi, count)
    single = hand.solve_contacts(np.zeros(count, np.intp), position, patch, np.ones(count))
    model = build_pad_model(stated)
    found = solve(model, single)
    shape = hand.virtual_pads[0].shape
    centre = PatchNodes.of_patches(shape, position, patch).centres(shape, position)
    return (
        found["pad_m"][:, 0] - centre[0] * length_m,
        np.sqrt(found["covariance_m2"][:, 0]),
    )


def test_positions_of_elongated_contacts_that_hang_over_an_edge_hold() -> None:
    error, std = elongated_at_an_edge(ELONGATION_STD, 150)
    assert np.mean(np.abs(error) < 1.96 * std) > 0.9
    _, round_std = elongated_at_an_edge(0.0, 40)
    assert np.median(std) < 5e-4
    assert np.median(round_std) < 0.5 * np.median(std)  # round contacts pay nothing


@pytest.mark.parametrize("total_n", [0.3, 1.0, 2.0])
def test_the_force_of_two_patches_is_within_its_interval(total_n: float) -> None:
    two: list[dict[str, Any]] = [{"path": ((x, 0.5),), "force_n": (total_n / 2,)} for x in (0.25, 0.75)]
    deployment = deployed()
    hand, model = virtual_hand(deployment, *two), build_pad_model(deployment)
    counts = hand.counts(0, np.array([5.0]))
    found = solve(model, counts * model.ampere_per_count[0])
    assert found["squared_misfit"][0, 0] > 9.0
    assert found["force_status"][0, 0] == ForceEstimateStatus.VALID
    assert abs(found["force_n"][0, 0] - total_n) < 1.96 * found["force_std_n"][0, 0]


def shares_of_true_forces(tilt_std: float) -> list[float]:
    """Return the share of forces within 1.96 deviations for each profile of pressure; the law is exact."""
    exact = dict.fromkeys(("ohm_per_square_std", "contact_ohm_std", "alpha_std"), 0.0)
    stated = deployed(contact_tilt_std=tilt_std, max_force_n=20.0, **exact)
    hand, model, shares = virtual_hand(stated), build_pad_model(stated), []
    rng, count = np.random.default_rng(6), 60
    for number in range(len(PROFILES)):
        patch = discs(rng.normal(2.5e-3, 5e-4, count).clip(1e-3))
        patch[2], patch[3] = rng.uniform(0, np.pi, count), number
        force_n = np.exp(rng.uniform(0.0, np.log(20.0), count))
        position = rng.uniform(0.15, 0.85, (2, count))
        currents = hand.solve_contacts(np.zeros(count, np.intp), position, patch, force_n)
        found = solve(model, currents)
        fitted = found["force_status"][:, 0] == ForceEstimateStatus.VALID
        off_n = found["force_n"][:, 0] - force_n
        true = np.where(fitted, np.abs(off_n) < 1.96 * found["force_std_n"][:, 0], off_n < 0)
        shares.append(float(true.mean()))
    return shares


def test_firm_forces_hold_however_their_pressure_is_distributed() -> None:
    known, unknown = (shares_of_true_forces(tilt_std) for tilt_std in (0.3, 0.0))
    assert np.mean(known) > 0.91
    assert min(known) > 0.85
    assert min(unknown) < 0.8


def test_two_patches_at_the_sheets_limit_give_a_bound_below_their_force() -> None:
    total_n = 60.0
    two: list[dict[str, Any]] = [{"path": ((x, 0.5),), "force_n": (total_n / 2,)} for x in (0.25, 0.75)]
    hand, model = virtual_hand(deployed(), *two), build_pad_model(deployed())
    found = solve(model, hand.counts(0, np.array([5.0])) * model.ampere_per_count[0])
    assert found["force_status"][0, 0] == ForceEstimateStatus.LOWER_BOUND
    assert 0 < found["force_n"][0, 0] < total_n


def ellipses(
    deployment: config.Deployment, pad: int, places: FloatArray, angles: FloatArray, ratio: float
) -> tuple[VirtualPad, dict[str, FloatArray]]:
    """Return the pad, and the values of evenly pressed ellipses at places (2, n) of it."""
    link = deployment.pads[pad].pad.link
    touch = {"link": link, "from_s": 0.0, "duration_s": 1.0, "path": ((0.5, 0.5),), "force_n": (1.0,)}
    scenario = Scenario.model_validate({"touch": [touch]})
    drawn = WORLDS["ideal"].draw(Family.TUNING.seed(0))
    deployment = drawn.describe(deployment)
    hand = VirtualHand(deployment, scenario, drawn)
    patch = discs(np.full(len(angles), 2.5e-3))
    patch[1], patch[2] = ratio, angles
    currents = hand.solve_contacts(np.full(len(angles), pad, np.intp), places, patch, np.ones(len(angles)))
    return hand.virtual_pads[pad], solve(build_pad_model(deployment), currents, pad)


def line_m(ratio: float) -> float:
    """Return the length of the line with the moments of such an ellipse."""
    return 2.5e-3 * float(np.sqrt(3 * (ratio - 1 / ratio)))


@pytest.mark.parametrize("ratio", [1.0, 4.0])
def test_six_electrodes_show_length_and_direction_of_a_contact(ratio: float) -> None:
    angles = np.linspace(-1.4, 1.4, 8)
    places = np.stack([np.linspace(0.35, 0.65, 8), np.linspace(0.6, 0.4, 8)])
    six = config.load(config.shipped.path("electrodes.toml"))
    pad = [len(entry.pad.electrode_names) for entry in six.pads].index(6)
    touched, found = ellipses(six, pad, places, angles, ratio)
    length_m, least_m, most_m = (found[name][:, 0] for name in ("length_m", "min_length_m", "max_length_m"))
    true_m = line_m(ratio)
    assert np.all((least_m <= true_m) & (true_m <= most_m))
    if ratio == 1.0:
        assert np.isnan(found["length_axis"]).all()
        return
    np.testing.assert_allclose(length_m, true_m, rtol=0.1)
    along = [long_axis(touched, places[:, k], angles[k]) for k in range(len(angles))]
    assert np.all(np.abs(np.sum(found["length_axis"] * along, axis=1)) > np.cos(0.1))


def long_axis(pad: VirtualPad, place: FloatArray, angle: float) -> FloatArray:
    """Return the unit vector (3,) in its link's frame along a direction on a pad [rad]."""
    shape, (x, y) = pad.shape, place.tolist()
    step_m = 1e-5 * np.array([np.cos(angle), np.sin(angle)])
    dx, dy = np.linalg.solve(shape.metres_per_fraction(x, y), step_m).tolist()
    to_m = shape.point((x + dx) * shape.length_m, (y + dy) * shape.arc)
    from_m = shape.point(x * shape.length_m, y * shape.arc)
    return np.asarray(pad.rotation @ (to_m - from_m)) / np.linalg.norm(to_m - from_m)


def test_four_electrodes_show_the_shortest_line_and_no_upper_end() -> None:
    ratio, angles = 3.0, np.linspace(-1.5, 1.5, 13)
    places = np.full((2, 13), 0.5)
    touched, found = ellipses(deployed(), 0, places, angles, ratio)
    length_m = found["length_m"][:, 0]
    # in the middle of a rectangle they show the difference along x and y
    expected_m = line_m(ratio) * np.sqrt(np.abs(np.cos(2 * angles)))
    np.testing.assert_allclose(length_m, expected_m, atol=4e-4)
    assert np.isnan(found["max_length_m"]).all()
    assert (found["min_length_m"][:, 0] <= line_m(ratio)).all()
    sure = np.abs(np.cos(2 * angles)) > 0.3
    along_x = np.abs(found["length_axis"][sure] @ long_axis(touched, places[:, 0], 0.0)) > 0.9
    np.testing.assert_array_equal(along_x, np.cos(2 * angles[sure]) > 0)


def test_three_electrodes_show_no_length() -> None:
    three = config.load(config.shipped.path("electrodes.toml"))
    pad = [len(entry.pad.electrode_names) for entry in three.pads].index(3)
    _, found = ellipses(three, pad, np.full((2, 2), 0.5), np.zeros(2), 3.0)
    assert np.isfinite(found["pad_m"]).all()
    assert np.isnan(found["length_m"]).all()
