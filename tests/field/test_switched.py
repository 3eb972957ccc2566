"""Electrodes that are connected in turn: fractions and resistance of a schedule are those of its states."""

from __future__ import annotations

import math

import numpy as np
import pytest

from handtouch.field import ElectrodeNetwork

A, B, SHEET, OHM = 24.0, 18.0, 2400.0, 30.0
SPANS = [(0.4 + 12 * k, 11.6 + 12 * k) for k in range(2)]
SPANS += [(24.4, 32.6), (33.4, 41.6), (42.4, 53.6), (54.4, 65.6), (66.4, 74.6), (75.4, 83.6)]
STATES = ((0, 2, 4, 6), (1, 3, 5, 7))
X, Y = np.random.default_rng(1).uniform(0.05, 0.95, (2, 30)) * [[A], [B]]


@pytest.fixture(scope="module")
def pad() -> ElectrodeNetwork:
    return ElectrodeNetwork.from_arcs(A, B, SPANS, SHEET, [OHM] * 8)


@pytest.fixture(scope="module")
def scheduled(pad: ElectrodeNetwork) -> ElectrodeNetwork:
    return pad.switched(STATES)


def test_each_state_collects_the_fractions_of_its_connected_electrodes(
    pad: ElectrodeNetwork, scheduled: ElectrodeNetwork
) -> None:
    fractions = scheduled.fractions(X, Y)
    for state in STATES:
        alone = pad.with_series_ohm([OHM if k in state else math.inf for k in range(8)]).fractions(X, Y)
        np.testing.assert_allclose(2 * fractions[list(state)], alone[list(state)], atol=1e-12)
        np.testing.assert_allclose(fractions[list(state)].sum(axis=0), 0.5)
    assert np.linalg.matrix_rank(scheduled.currents_per_ideal) == 7  # the total of a state is no information


def test_slopes_are_those_of_the_fractions(scheduled: ElectrodeNetwork) -> None:
    fractions, slopes = scheduled.fractions_with_jacobian(X, Y)
    np.testing.assert_allclose(fractions, scheduled.fractions(X, Y))
    step = 1e-5
    by_x = (scheduled.fractions(X + step, Y) - scheduled.fractions(X - step, Y)) / (2 * step)
    by_y = (scheduled.fractions(X, Y + step) - scheduled.fractions(X, Y - step)) / (2 * step)
    np.testing.assert_allclose(slopes, np.stack([by_x, by_y], axis=1), atol=1e-7)


def test_the_spreading_radius_has_the_resistance_of_switches_and_floating_electrodes(
    pad: ElectrodeNetwork, scheduled: ElectrodeNetwork
) -> None:
    added = [
        pad.with_series_ohm([OHM if k in state else math.inf for k in range(8)]).series_resistance(X, Y)
        for state in STATES
    ]
    enlarged = np.log(scheduled.spreading_radius(X, Y) / pad.spreading_radius(X, Y))
    np.testing.assert_allclose(enlarged * SHEET / (2 * math.pi), np.mean(added, axis=0))
    assert (np.array(added) > 0).all()


def test_a_resistor_changes_the_fractions_of_its_state_as_stated(scheduled: ElectrodeNetwork) -> None:
    step, fractions = 1e-6, scheduled.fractions(X, Y)
    for electrode in range(8):
        ohm = OHM * np.exp(step * (np.arange(8) == electrode))
        change = (scheduled.with_series_ohm(ohm.tolist()).fractions(X, Y) - fractions) / step
        stated = OHM * scheduled.series_sensitivity[:, [electrode]] * fractions[electrode]
        np.testing.assert_allclose(change, stated, atol=1e-7)


@pytest.mark.parametrize("states", [[range(8)], [[0, 1, 2, 3], [4, 5, 6]], [[0, 1, 2, 3], [3, 4, 5, 6, 7]]])
def test_an_electrode_in_no_state_or_in_two_is_refused(
    pad: ElectrodeNetwork, states: list[list[int]]
) -> None:
    with pytest.raises(ValueError, match="each of 8 electrodes"):
        pad.switched(states)
