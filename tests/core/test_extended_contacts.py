"""Contacts that are no points in the simulator's physics: patches over an edge, several patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.core.contact_solver import VALUE_COUNT, VALUE_SLICES, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field.contact_law import ForceEstimateStatus
from handtouch.simulate.contact_patch import PROFILES, discs
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.solved_contact import PatchNodes
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
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


def solve(model: PadModel, currents: FloatArray) -> dict[str, FloatArray]:
    """Return the values of contacts with these currents (n, 4), each by itself."""
    every, rows = np.zeros((1, 4)), []
    values = np.full((1, VALUE_COUNT), np.nan)
    solver = make_solver(model, every, np.zeros(1), np.ones(1, np.bool_), values)
    for own in currents:
        every[0], values[0] = own, np.nan
        solver.solve_contacts(np.zeros(1, np.intp).data)
        rows.append(values[0].copy())
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
