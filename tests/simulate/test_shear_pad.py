"""Simulated shear pads: the theory's overlap by finite elements, and the layer's history."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtouch.config.shear import Shear
from handtouch.field.elastic_layer import ElasticLayer
from handtouch.field.shear import overlap_ratio
from handtouch.field.shear_estimate import ShearPad
from handtouch.simulate.shear_pad import LayerHistory, Plates, SimulatedShearPad, solve_section
from handtouch.simulate.worlds import WORLDS

BARS = {"bars": 2, "pitch_mm": 3.4, "overlap_mm": 0.6, "length_mm": 6.0, "gap_mm": 0.4}
PATTERNS: dict[str, dict[str, Any]] = {
    "bars": {"kind": "bars", **BARS},
    "crossed bars": {"kind": "crossed_bars", **BARS},
    "pinwheel": {"kind": "pinwheel", "arm_mm": 5.0, "overlap_mm": 0.8, "length_mm": 5.0},
    "discs": {"kind": "discs", "discs": 9, "radius_mm": 2.0, "gap_mm": 0.4},
}
IDEAL = WORLDS["ideal"].draw(1).shear("hand/tip")


def shear(kind: str) -> Shear:
    return Shear(
        pattern=PATTERNS[kind],  # type: ignore[arg-type]
        film_mm=0.15,
        film_ohm_mm2=9000.0,
        plate_mm=14.0,
        stiffness_n_per_mm=(12.0, 12.0),
    )


@pytest.mark.parametrize("overlap", [-1.0, 0.0, 1.5])
def test_elements_agree_with_the_closed_form_of_an_overlap(overlap: float) -> None:
    (current,) = solve_section(Plates(((-8.0, overlap),), ((0.0, 8.0),), 1.0))
    assert current == pytest.approx(float(overlap_ratio(overlap)[0]), abs=0.03)


@pytest.mark.parametrize("kind", PATTERNS)
def test_displacement_from_simulated_currents_is_the_true_one(kind: str) -> None:
    """Estimator and simulator solve the overlap independently: 1 um at displacements of 0.35 mm."""
    table, rng = shear(kind), np.random.default_rng(3)
    moved = rng.uniform(-0.35e-3, 0.35e-3, (2, 30))
    currents = SimulatedShearPad(table, 5.0, IDEAL).currents(moved, np.zeros(30), np.zeros((2, 30)))
    found = ShearPad(table.build_pattern(), 5.0).estimate(currents, 1e-7)
    known = min(len(found.motion), 2)
    np.testing.assert_allclose(found.motion[:known], moved[:known], atol=1e-6)
    np.testing.assert_allclose(found.conductance_s_per_m2, table.build_film().siemens_per_m2, rtol=6e-3)


def test_twist_and_contact_resistance_scale_but_do_not_shift_a_symmetric_pattern() -> None:
    hidden = replace(IDEAL, plate_turn_deg=2.0, contact_share=0.1)
    pad = SimulatedShearPad(shear("crossed bars"), 5.0, hidden)
    currents = pad.currents(np.zeros((2, 1)), np.zeros(1), np.zeros((2, 1)))
    assert currents[0] == pytest.approx(currents[1], rel=1e-6)
    assert (
        currents[0]
        < 0.9
        * SimulatedShearPad(shear("crossed bars"), 5.0, IDEAL).currents(
            np.zeros((2, 1)), np.zeros(1), np.zeros((2, 1))
        )[0]
    )


def test_an_ideal_layer_is_linear_and_a_real_one_has_loops_and_creeps() -> None:
    path = 3.0 * np.sin(np.linspace(0, 2 * np.pi, 81))
    ideal = LayerHistory(shear("discs"), IDEAL)
    moved = np.array([ideal.advance(np.array([force, 0.0]), 0.01) for force in path])
    np.testing.assert_allclose(moved[:, 0], path / 12e3, atol=1e-12)
    looped = LayerHistory(shear("discs"), replace(IDEAL, hysteresis=0.1))
    moved = np.array([looped.advance(np.array([force, 0.0]), 0.01) for force in path])
    width_n = 12e3 * (moved[40, 0] - 0.0)  # displacement left at zero force
    assert 0.03 * 3 < width_n < 0.15 * 3
    creeping = LayerHistory(shear("discs"), replace(IDEAL, creep=0.1))
    first, last = (float(creeping.advance(np.array([1.0, 0.0]), wait)[0]) for wait in (0.0, 60.0))
    assert last == pytest.approx(1.1 * first, rel=1e-4)


def test_the_loop_of_the_layer_is_as_wide_as_its_stated_deviation() -> None:
    """After other loads along one axis, far from the greatest one and near it."""
    table, rng = shear("crossed bars"), np.random.default_rng(4)
    hidden = replace(IDEAL, hysteresis=0.05)
    first_n = np.array([2.0, 0.0])
    stiffness = float(2.0 / LayerHistory(table, hidden).advance(first_n, 0.1)[0])
    layer = ElasticLayer((stiffness, stiffness), 0.0, 0.0, 0.05, 0.0)
    ratios: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(300):
        history, loads = LayerHistory(table, hidden), rng.uniform(-3.0, 3.0, 4)
        for load in loads:
            history.advance(np.array([load, 0.0]), 0.1)
        force_n = float(loads[-1] * rng.choice([1.0, rng.uniform()]))
        moved = history.advance(np.array([force_n, 0.0]), 0.1)
        peak_n = float(np.abs(loads).max())
        found = layer.force(moved, 0.0, peak_n)
        sigma = (found.vector_n[0] - force_n) / np.sqrt(found.covariance_n2[0, 0])
        ratios[abs(force_n) > 0.7 * peak_n].append(float(sigma))
    for sigmas in ratios.values():
        assert 0.6 < np.sqrt(np.mean(np.square(sigmas))) < 1.25
