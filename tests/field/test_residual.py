"""The residual of a point fit detects other contacts at the configured false-alarm rate."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtri

from handtouch.field import Rectangle
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.residual import point_test

SQUARE = Rectangle(1.0, 1.0)


def test_the_papers_pair_is_elongated_along_x() -> None:
    """Eqs. 14-15: contacts at 0.5 and 0.7 against one at 0.6."""
    pair = SQUARE.side_fractions([0.5, 0.7], [0.5, 0.5]).mean(axis=1)
    point = SQUARE.side_fractions(0.6, 0.5)
    assert (point[0] + point[1]) / (point[2] + point[3]) == pytest.approx(1.0915, abs=5e-5)
    assert (pair[0] + pair[1]) / (pair[2] + pair[3]) == pytest.approx(1.1913, abs=5e-5)
    seen = point_test(SQUARE, pair, 1e-3)
    assert not seen.is_point
    assert seen.score > 0
    assert seen.axis == pytest.approx(0, abs=1e-6)
    assert seen.extent == pytest.approx(0.2, rel=0.03)
    assert point_test(SQUARE, point, 1e-3).is_point


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_direction_and_extent_of_a_small_pair(angle: float) -> None:
    distance = 0.05
    dx, dy = distance / 2 * math.cos(angle), distance / 2 * math.sin(angle)
    pair = SQUARE.side_fractions([0.45 - dx, 0.45 + dx], [0.55 - dy, 0.55 + dy]).mean(axis=1)
    seen = point_test(SQUARE, pair, 1e-4)
    assert math.cos(2 * (float(seen.axis) - angle)) == pytest.approx(1, abs=0.05)
    assert seen.extent == pytest.approx(distance, rel=0.05)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("pad", [SQUARE, Rectangle(1.77, 1.0), ElectrodeNetwork(1.5, 1.0, 0.03, 2400.0)])
def test_false_alarms_occur_at_the_configured_rate(noise: float, pad: Rectangle | ElectrodeNetwork) -> None:
    count = 40_000
    generator = np.random.default_rng(11)
    x, y = generator.uniform(0.05, 0.95, (2, count)) * np.array([[pad.a], [pad.b]])
    currents = pad.fractions(x, y) + noise * generator.normal(size=(4, count))
    seen = point_test(pad, currents, noise)
    for rate in (1e-1, 1e-2, 1e-3):
        alarms = int((np.abs(seen.score) > -ndtri(rate / 2)).sum())
        assert abs(alarms - rate * count) < 4.5 * math.sqrt(rate * count)
    assert (~seen.is_point).sum() == (np.abs(seen.score) > -ndtri(1e-3 / 2)).sum()


def test_residual_scatters_as_predicted() -> None:
    generator = np.random.default_rng(12)
    levels = np.array([1e-3, 2e-3, 5e-4, 1e-3])[:, None]
    currents = 3 * SQUARE.side_fractions(0.4, 0.3)[:, None] + levels * generator.normal(size=(4, 20_000))
    found = SQUARE.estimate(currents, levels)
    seen = point_test(SQUARE, currents, levels, found=found)
    assert found.residual.std() == pytest.approx(seen.residual_std.mean(), rel=0.03)
    assert seen.score == pytest.approx(np.sign(found.residual) * np.sqrt(found.chi_squared), abs=0.05)


def test_invalid_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="false_alarm"):
        point_test(SQUARE, [0.25] * 4, 1e-3, false_alarm=0)
    assert math.isnan(point_test(SQUARE, [math.nan, 1, 1, 1], 1e-3).score)


def test_contact_without_location_counts_as_a_point() -> None:
    pad = Rectangle(1.0, 1.0)
    rng = np.random.default_rng(5)
    x, y = rng.random((2, 40_000))  # up to the edges, where some estimates are lost
    currents = pad.fractions(x, y) + 1e-2 * rng.normal(size=(4, x.size))
    alarms = ~point_test(pad, currents, 1e-2, 1e-2).is_point
    assert 0.008 < alarms.mean() < 0.012
    assert point_test(pad, [-1.0] * 4, 1e-2).is_point
