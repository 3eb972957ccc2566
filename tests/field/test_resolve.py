"""Points, lines and pairs of contacts at the configured false-alarm rate; switched resistors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.field import (
    ContactShape,
    Electrode,
    ElectrodeNetwork,
    SwitchedNetwork,
    resolve_contacts,
)

FloatArray = NDArray[np.float64]
SHEET, SIGMA = 1000.0, 1e-4


def divided(parts: int) -> ElectrodeNetwork:
    """A square with `parts` electrodes on each side, in the order of the sides, gaps of 2 %."""
    pitch = 1 / parts
    electrodes = [
        Electrode(side, k * pitch + 0.02, (k + 1) * pitch - 0.02)
        for side in ("x0", "xa", "y0", "yb")
        for k in range(parts)
    ]
    return ElectrodeNetwork.from_electrodes(1.0, 1.0, electrodes, SHEET)


def interior(count: int, margin: float, seed: int = 3) -> FloatArray:
    return np.random.default_rng(seed).uniform(margin, 1 - margin, (2, count))


def noise(shape: tuple[int, ...], seed: int = 4) -> FloatArray:
    return SIGMA * np.random.default_rng(seed).normal(size=shape)


def mean_distance(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return squared deviations (n,) of (k, n) in units of covariances (n, k, k)."""
    solved = np.linalg.solve(covariance, off.T[..., None])[..., 0]
    return np.asarray((off.T * solved).sum(axis=1))


def test_points_have_n_less_3_degrees_of_freedom_and_look_elongated_at_the_false_alarm_rate() -> None:
    pad, (x, y), rate = divided(2), interior(400, 0.1), 0.1
    found = resolve_contacts(pad, pad.fractions(x, y) + noise((8, 400)), SIGMA, rate)
    assert found.point.converged.all()
    assert found.point.freedom == 5
    assert found.point.chi_squared.mean() == pytest.approx(5, abs=4 * math.sqrt(10 / 400))
    off = np.concatenate([found.point.position, found.point.total[:, 0]]) - [x, y, np.ones(400)]
    assert mean_distance(off, found.point.covariance).mean() == pytest.approx(3, abs=4 * math.sqrt(6 / 400))
    assert (found.line_ratio >= 0).all()
    alarms = int((found.shape != ContactShape.POINT).sum())
    assert abs(alarms - rate * 400) < 4 * math.sqrt(rate * (1 - rate) * 400)


def test_the_moments_of_a_line_are_estimated_with_their_covariance() -> None:
    pad, (x, y) = divided(2), interior(120, 0.25)
    length, angle = 0.2, 0.6
    nodes, weights = np.polynomial.legendre.leggauss(12)
    along = length / 2 * nodes[:, None] * np.array([[[math.cos(angle)]], [[math.sin(angle)]]])
    currents = np.tensordot(pad.fractions(x + along[0], y + along[1]), weights / 2, axes=([1], [0]))
    found = resolve_contacts(pad, currents + noise(currents.shape), SIGMA)
    assert (found.shape == ContactShape.LINE).mean() > 0.97
    moments = length**2 / 12 * np.array([[math.cos(2 * angle)], [math.sin(2 * angle)]])
    off = np.concatenate([found.line.position[:2] - [x, y], found.line.position[2:] - moments])
    off = np.concatenate([off, found.line.total[:, 0] - 1])
    assert mean_distance(off, found.line.covariance).mean() == pytest.approx(5, abs=4 * math.sqrt(10 / 120))
    assert np.median(found.line.length) == pytest.approx(length, rel=0.02)
    assert np.median(found.line.axis) == pytest.approx(angle, abs=0.02)


def test_two_contacts_are_estimated_with_their_covariance() -> None:
    pad, (x, y) = divided(3), interior(120, 0.3)
    share = np.random.default_rng(8).uniform(0.3, 0.7, 120)
    first, second = (x - 0.14, y - 0.1), (x + 0.14, y + 0.1)
    currents = share * pad.fractions(*first) + (1 - share) * pad.fractions(*second)
    found = resolve_contacts(pad, currents + noise(currents.shape), SIGMA)
    assert (found.shape == ContactShape.PAIR).all()
    assert found.pair is not None
    assert found.pair.freedom == 6
    assert found.pair.chi_squared.mean() == pytest.approx(6, abs=4 * math.sqrt(12 / 120))
    off = np.concatenate([found.pair.position, found.pair.total[:, 0]])
    off -= np.stack([*first, *second, share, 1 - share])
    assert mean_distance(off, found.pair.covariance).mean() == pytest.approx(6, abs=4 * math.sqrt(12 / 120))


def test_a_close_pair_is_a_line_of_its_moments() -> None:
    pad = divided(2)
    currents = (pad.fractions(0.42, 0.5) + 2 * pad.fractions(0.5, 0.5)) / 3
    found = resolve_contacts(pad, currents, SIGMA)
    assert found.shape == ContactShape.LINE
    assert found.line.position[0] == pytest.approx(0.42 + 0.08 * 2 / 3, abs=1e-3)
    assert found.line.position[2] == pytest.approx(2 / 9 * 0.08**2, rel=0.05)
    assert found.line.axis == pytest.approx(0, abs=0.02)


def test_readings_of_excluded_channels_and_nan_stay_in_their_own_element() -> None:
    pad = divided(2)
    currents = np.repeat(pad.fractions(0.3, 0.6)[:, None], 3, axis=1)
    sigma = np.full(currents.shape, SIGMA)
    currents[2, 0], sigma[2, 0] = np.nan, np.inf
    currents[5, 1] = np.nan
    found = resolve_contacts(pad, currents, sigma)
    assert found.shape.tolist() == [ContactShape.POINT, ContactShape.UNKNOWN, ContactShape.POINT]
    assert found.point.position[:, 0] == pytest.approx([0.3, 0.6], abs=1e-6)
    assert np.isnan(found.point.position[:, 1]).all()


def test_impossible_arguments_are_rejected() -> None:
    with pytest.raises(ValueError, match="4 independent currents"):
        resolve_contacts(divided(1), np.ones(4), SIGMA)
    with pytest.raises(ValueError, match="8 channels"):
        resolve_contacts(divided(2), np.ones(4), SIGMA)
    with pytest.raises(ValueError, match="false_alarm"):
        resolve_contacts(divided(2), np.ones(8), SIGMA, 0.0)
    with pytest.raises(ValueError, match="without gaps"):
        SwitchedNetwork(divided(1), [[0.0] * 4], [0, 1, 3, 3])
    with pytest.raises(ValueError, match="at least one"):
        SwitchedNetwork(divided(1), [])


def test_states_add_equations_only_where_electrodes_share_a_channel() -> None:
    """The currents of all 2^n states are linear in those of grounded electrodes."""
    for parts in (1, 2, 3):
        pad = divided(parts)
        states = [
            [SHEET if state >> k & 1 else 0.0 for _ in range(4) for k in range(parts)]
            for state in range(2**parts)
        ]
        assert SwitchedNetwork(pad, states).independent_channels == 4 * parts
        by_side = [side for side in range(4) for _ in range(parts)]
        shared = SwitchedNetwork(pad, states, by_side)
        assert shared.independent_channels == 4 * parts
        assert SwitchedNetwork(pad, states[:1], by_side).independent_channels == 4
        x, y = interior(5, 0.1)
        fractions = shared.fractions(x, y)
        assert fractions.shape == (4 * 2**parts, 5)
        assert fractions.reshape(-1, 4, 5).sum(axis=1) == pytest.approx(np.ones((2**parts, 5)), abs=1e-12)
        built = pad.with_series_ohm(states[-1]).fractions(x, y).reshape(4, parts, 5).sum(axis=1)
        assert fractions[-4:] == pytest.approx(built, abs=1e-12)


def test_four_channels_resolve_two_contacts_by_a_schedule_whatever_the_total_of_each_state() -> None:
    pad = divided(3)
    states = [[SHEET if state >> k & 1 else 0.0 for _ in range(4) for k in range(3)] for state in range(8)]
    schedule = SwitchedNetwork(pad, states, [side for side in range(4) for _ in range(3)])
    totals = np.random.default_rng(2).uniform(0.8, 1.2, 8).repeat(4)
    first, second = (0.3, 0.35), (0.7, 0.6)
    currents = totals * (0.4 * schedule.fractions(*first) + 0.6 * schedule.fractions(*second))
    sigma = 1e-5
    currents = currents + 0.1 * noise(currents.shape)
    found = resolve_contacts(schedule, currents, sigma)
    assert found.shape == ContactShape.PAIR
    assert found.pair is not None
    assert found.pair.freedom == 32 - 4 - 2 * 8
    off = found.pair.position - np.array([*first, *second])
    assert mean_distance(off[:, None], found.pair.covariance[None, :4, :4])[0] < 20
    assert np.abs(off).max() < 0.01
    assert found.pair.total[1] == pytest.approx(0.6 * totals[::4], rel=0.05)
