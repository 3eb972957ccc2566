"""Contacts of pads that aren't sheets with electrodes, by the compiled stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.hand_touches import TouchReadings, draw_touches, position_error
from benchmarks.untouched_zeros import Zeros, play_zeros
from handtouch.config import Deployment, load, shipped
from handtouch.config.responses import Taxels
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.field.channel_map import ChangedMap, ChannelMap
from handtouch.hand import models_with_other_parts, part_stds
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread

FloatArray = NDArray[np.float64]
PLACES = ((0.5, 0.5), (0.3, 0.4), (0.1, 0.6), (0.85, 0.8), (0.05, 0.05))


@pytest.fixture(scope="module")
def deployment() -> Deployment:
    return load(shipped.path("taxels.toml"))


@pytest.fixture(scope="module")
def model(deployment: Deployment) -> PadModel:
    return PadModel(deployment)


def solved(model: PadModel, row: int, signals: FloatArray) -> FloatArray:
    """Return the values of a contact with these signals on a pad."""
    currents, values = np.zeros((model.size, model.channels)), np.full((model.size, VALUE_COUNT), np.nan)
    currents[row, : len(signals)] = signals
    solver = ContactSolver(model, currents, np.zeros(model.size), np.ones(model.size, np.bool_), values)
    solver.solve_contacts(view_memory(np.array([row])))
    return np.asarray(values[row])


def signals(model: PadModel, row: int, place: tuple[float, float], force_n: float) -> FloatArray:
    """Return the signals of a contact of a force at fractions of a pad."""
    network = model.networks[row]
    strength = model.centre_current(row, force_n) / network.fractions(network.a / 2, network.b / 2).sum()
    return np.asarray(strength * network.fractions(place[0] * network.a, place[1] * network.b))


@pytest.mark.parametrize("row", [0, 1])
def test_exact_signals_give_place_and_force(model: PadModel, row: int) -> None:
    network = model.networks[row]
    for place in PLACES:
        for force_n in (0.2, 2.0, 20.0):
            values = solved(model, row, signals(model, row, place, force_n))
            x, y = values[VALUE_SLICES["xy"]]
            assert (x / network.a, y / network.b) == pytest.approx(place, abs=2e-3)
            # the harmonic mean of what is as likely: a little less than the most likely one
            relative = values[VALUE_SLICES["force_std_n"]][0] / force_n
            assert values[VALUE_SLICES["force_n"]][0] == pytest.approx(force_n, rel=0.01 + relative**2)


def test_a_signal_of_one_newton_is_that_of_the_file(deployment: Deployment, model: PadModel) -> None:
    response, network = deployment.pads[0].pad.response, model.networks[0]
    assert isinstance(response, Taxels)
    assert isinstance(network, ChannelMap)
    on_taxel = network.centres[4]
    strength = model.centre_current(0, 1.0) / network.fractions(network.a / 2, network.b / 2).sum()
    assert strength * network.fractions(*on_taxel)[4] == pytest.approx(response.signal_per_n, rel=0.01)


def test_thresholds_are_those_of_a_contact_at_the_centre(model: PadModel) -> None:
    for row in range(model.size):
        counts = signals(model, row, (0.5, 0.5), 0.06).sum() / model.mean_ampere_per_count[row]
        assert model.begin_threshold_counts[row] == pytest.approx(counts, rel=1e-6)
        assert model.centre_force(row, counts) == pytest.approx(0.06, rel=1e-3)


def test_a_taxel_that_is_known_to_be_dead_is_left_out(model: PadModel) -> None:
    found = signals(model, 0, (0.4, 0.6), 2.0)
    found[4] = 0.0
    try:
        model.set_calibration(0, replace(ActiveCalibration("dead", (1.0,) * 9), dead_electrode=4))
        values = solved(model, 0, found)
    finally:
        model.set_calibration(0, model.default_calibration(0))
    network = model.networks[0]
    x, y = values[VALUE_SLICES["xy"]]
    assert (x / network.a, y / network.b) == pytest.approx((0.4, 0.6), abs=5e-3)


def test_every_part_is_one_standard_deviation_of_its_tolerance(deployment: Deployment) -> None:
    pad = deployment.pads[0].pad
    assert isinstance(pad.response, Taxels)
    node, sheet = deployment.nodes[pad.node], deployment.sheet_of(pad)
    moved = pad.response.model_copy(
        update={"position_std_mm": 0.1, "width_std": 0.0, "crosstalk_std": 0.0, "profile_std": 0.0}
    )
    network = moved.build(pad.surface.build())
    others = models_with_other_parts(network, pad, node, sheet)
    assert len(others) == len(part_stds(pad, node, sheet))
    changed = [other for other in others if isinstance(other, ChangedMap)]
    x, y = network.centres[1] + 1e-3
    shifted = moved.model_copy(
        update={"positions_mm": (moved.positions_mm[0], (0.1, -5.0), *moved.positions_mm[2:])}
    )
    expected = shifted.build(pad.surface.build()).fractions(x, y)
    assert changed[2].fractions(x, y) == pytest.approx(expected, abs=5e-4)


def test_positions_of_sensors_with_effects_that_the_model_lacks_are_in_their_intervals() -> None:
    inside = []
    for number in range(6):
        drawn = replace(WORLDS["default"], mounts=MountSpread()).draw(Family.TUNING.seed(number))
        stated = drawn.describe(load(shipped.path("taxels.toml")))
        model, numbers = PadModel(stated), range(2, 18)
        stimulus = Scenario(touch=draw_touches(model.links, numbers.stop, drawn.seed))
        readings = TouchReadings.of_hand(VirtualHand(stated, stimulus, drawn), stated, numbers)
        contacts = readings.contacts(model, stated)
        for key, truth in readings.truths.items():
            error, covariance = position_error(contacts.get(key), truth)
            inside.append(float(error @ np.linalg.solve(covariance, error)) < 5.99)
    assert 0.9 < np.mean(inside) <= 1.0


@pytest.mark.parametrize(
    "zeros", [Zeros(turn_n=0.1), Zeros(drift_n=0.5, gain_drift=0.1)], ids=["turning", "drifting"]
)
def test_moving_zeros_are_no_contact_and_light_touches_are_found(zeros: Zeros) -> None:
    found = play_zeros(zeros, 0, 1 / 30)
    assert found.false == 0
    assert sum(found.touches.values()) == 8
    assert found.found == found.touches
