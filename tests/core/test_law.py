"""Uncertainty of forces from the covariance of a calibrated contact law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch.calibration.calibration import LawParameters
from handtouch.core.pad_model import PadModel
from handtouch.core.tick import TickProcessor
from tests.procedures.test_calibrate import TRUE, Table, deployed, fitted, weights

CENTRE = np.array([0])
FORCES = np.array([0.3, 1.0, 2.0, 4.0])


def test_confidence_intervals_of_forces_cover_the_truth_in_95_percent_of_sessions() -> None:
    true = PadModel(deployed(**TRUE))
    model = PadModel(deployed())
    pads = np.zeros(len(FORCES), np.intp)
    side_a, side_b = true.locator.sides[0]
    fractions = true.locator.fractions(CENTRE, np.array([side_a / 2]), np.array([side_b / 2]))
    currents = np.repeat(fractions, len(FORCES), axis=1)
    radius_m = np.repeat(true._centre_spreading[0], len(FORCES))
    total_a = true._law.current(FORCES, 5.0, TRUE["ohm_per_square"], radius_m)
    assert (model.law_force_std(pads, currents, total_a, radius_m, FORCES) == 0).all()
    inside, sessions = np.zeros(len(FORCES)), 80
    for seed in range(500, 500 + sessions):
        model.set_gains_and_law(0, np.ones(4), "4711-1", fitted(Table(weights(), seed).readings()).law)
        force_n = model.estimate_force(pads, currents, total_a, np.zeros(len(pads)), radius_m).force_n
        std_n = model.law_force_std(pads, currents, total_a, radius_m, force_n)
        inside += np.abs(force_n - FORCES) < 1.96 * std_n
    assert 0.90 <= inside.mean() / sessions <= 0.99


def test_the_std_of_a_force_includes_the_covariance_of_a_calibrated_law(bench: Any) -> None:
    results = []
    for spread in (0.0, 0.2):
        model = PadModel(bench.deployment)
        covariance = tuple(map(tuple, np.diag([spread**2, 0.0, 0.0]).tolist()))
        model.set_gains_and_law(0, np.ones(4), "1-1", LawParameters(20000.0, 1.5, 2400.0, covariance))
        tick = TickProcessor(model, 5_000_000)
        currents = bench.counts(0, 0.5, 0.5, 1e-3) * model.ampere_per_count[0]
        found = tick.linearisations.solve_contacts(CENTRE, currents[None], np.full((1, 2), np.nan))
        values, _ = tick.linearisations.evaluate(CENTRE, currents[None])
        results.append((values[0, -1], found.force_std_n[0]))
    (force, exact_std), (same, std) = results
    assert same == pytest.approx(force)
    # the layer dominates here: force goes nearly as k^(1 / alpha)
    assert np.sqrt(std**2 - exact_std**2) / force == pytest.approx(0.2 / 1.5, rel=0.2)
