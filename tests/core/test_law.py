"""Uncertainty of forces from the covariance of a calibrated contact law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch.calibration.calibration import LawParameters
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import contact_law, law_of
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from tests.procedures.test_calibrate import TRUE, Table, deployed, fitted, weights

FORCES = np.array([0.3, 1.0, 2.0, 4.0])


def test_confidence_intervals_of_forces_cover_the_truth_in_95_percent_of_sessions() -> None:
    true, model = build_pad_model(deployed(**TRUE)), build_pad_model(deployed(contact_radius_std_mm=0.0))
    network = true.networks[0]
    fractions = network.fractions(network.a / 2, network.b / 2)
    currents = np.zeros((1, 4))
    values = np.full((1, VALUE_COUNT), np.nan)
    inside, sessions = np.zeros(len(FORCES)), 80
    centre = float(network.spreading_radius(network.a / 2, network.b / 2))
    sheet = deployed(**TRUE).sheets["s"]
    law = contact_law(sheet, law_of(sheet))
    totals_a = [float(law.current(force, 5.0, sheet.ohm_per_square, centre)) for force in FORCES]
    for seed in range(500, 500 + sessions):
        found_law = fitted(Table(weights(), seed).readings()).law
        model.set_calibration(0, ActiveCalibration("4711-1", law=found_law))
        solver = ContactSolver(model, currents, np.zeros(1), np.ones(1, np.bool_), values)
        for number, (force_n, total_a) in enumerate(zip(FORCES, totals_a, strict=True)):
            currents[0] = total_a * fractions
            solver.solve_contacts(np.zeros(1, np.intp).data)
            found, std = values[0, VALUE_SLICES["force_n"]][0], values[0, VALUE_SLICES["force_std_n"]][0]
            inside[number] += abs(found - force_n) < 1.96 * std
    assert 0.90 <= inside.mean() / sessions <= 0.99


def test_the_std_of_a_force_includes_the_covariance_of_a_calibrated_law(bench: Any) -> None:
    results = []
    for spread in (0.0, 0.2):
        model = build_pad_model(bench.deployment)
        covariance = tuple(map(tuple, np.diag([spread**2, 0.0, 0.0]).tolist()))
        law = LawParameters(20000.0, 1.5, 2400.0, covariance)
        model.set_calibration(0, ActiveCalibration("1-1", law=law))
        currents = np.zeros((3, 4))
        currents[0] = bench.counts(0, 0.5, 0.5, 1e-3) * model.ampere_per_count[0]
        values = np.full((3, VALUE_COUNT), np.nan)
        solver = ContactSolver(model, currents, np.zeros(3), np.ones(3, np.bool_), values)
        solver.solve_contacts(np.zeros(1, np.intp).data)
        results.append((values[0, VALUE_SLICES["force_n"]][0], values[0, VALUE_SLICES["force_std_n"]][0]))
    (force, exact_std), (same, std) = results
    assert same == pytest.approx(force, rel=0.02)  # the mean, of other probabilities
    # the layer dominates here: force goes nearly as k^(1 / alpha)
    assert np.sqrt(std**2 - exact_std**2) / force == pytest.approx(0.2 / 1.5, rel=0.2)
