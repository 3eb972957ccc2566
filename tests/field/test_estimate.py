"""The maximum-likelihood estimate reaches the Cramer-Rao bound, with a valid covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri

from handtouch.arrays import FloatArray
from handtouch.field import (
    ElectrodeNetwork,
    ForwardModel,
    Rectangle,
    estimate,
)


def scatter(pad: Rectangle, count: int, seed: int, margin: float = 0.05) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(margin, 1 - margin, (2, count))
    return x * pad.a, y * pad.b


def bound(pad: ForwardModel, x: FloatArray, y: FloatArray, noise: FloatArray) -> FloatArray:
    """Inverse Fisher information of (x, y, total) for a total of one, from the public Jacobian."""
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    design = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), 2, 0) / noise[:, None]
    return np.asarray(np.linalg.inv(np.swapaxes(design, 1, 2) @ design))


@pytest.mark.parametrize("aspect", [1.0, 1.77])
@pytest.mark.parametrize(("noise", "limit"), [(1e-5, 1.05), (1e-3, 1.05), (3e-3, 1.05), (1e-2, 1.15)])
def test_error_reaches_the_cramer_rao_bound(aspect: float, noise: float, limit: float) -> None:
    pad = Rectangle(aspect, 1.0)
    x, y = scatter(pad, 20_000, 7)
    levels = np.full(4, noise)
    currents = pad.fractions(x, y) + levels[:, None] * np.random.default_rng(8).normal(size=(4, len(x)))
    found = pad.estimate(currents, noise)
    expected = np.trace(bound(pad, x, y, levels)[:, :2, :2], axis1=1, axis2=2)
    assert np.sqrt(((found.x - x) ** 2 + (found.y - y) ** 2).mean() / expected.mean()) < limit


def test_unequal_noise_is_weighted_and_covariance_is_calibrated() -> None:
    pad = Rectangle(1.2, 1.0)
    x, y = scatter(pad, 10_000, 1, margin=0.1)
    levels = np.array([3e-4, 1e-3, 2e-4, 2e-3])
    currents = 2.5 * pad.fractions(x, y) + levels[:, None] * np.random.default_rng(2).normal(size=(4, len(x)))
    found = pad.estimate(currents, levels[:, None])
    error = np.stack([found.x - x, found.y - y, found.total - 2.5], axis=1)
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    assert distance.mean() == pytest.approx(3, rel=0.05)
    assert found.chi_squared.mean() == pytest.approx(1, rel=0.05)
    assert found.converged.all()


def test_covariance_equals_the_inverse_information() -> None:
    pad = Rectangle(3.0, 1.0)
    x, y = scatter(pad, 200, 3)
    levels = np.array([1e-4, 2e-4, 3e-4, 4e-4])
    found = pad.estimate(pad.fractions(x, y), levels[:, None])
    expected = bound(pad, x, y, levels)
    scale = np.sqrt(np.einsum("nii->ni", expected))
    assert np.abs((found.covariance - expected) / scale[:, :, None] / scale[:, None, :]).max() < 1e-5


@given(st.floats(0.3, 3.0), st.floats(0.02, 0.98), st.floats(0.02, 0.98), st.floats(1e-9, 1e6))
def test_estimate_without_noise_equals_the_exact_inverse(
    aspect: float, u: float, v: float, total: float
) -> None:
    pad = Rectangle(aspect, 1.0)
    found = pad.estimate(total * pad.fractions(u * aspect, v), 1e-7 * total)
    assert found.x == pytest.approx(u * aspect, abs=1e-8)
    assert found.y == pytest.approx(v, abs=1e-8)
    assert found.total == pytest.approx(total, rel=1e-8)
    assert abs(found.residual) < 1e-8


@given(
    st.lists(
        st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4),
        min_size=1,
        max_size=4,
    ),
    st.floats(1e-12, 10),
)
def test_any_reading_gives_a_point_on_the_pad_or_nan(readings: list[list[float]], noise: float) -> None:
    pad = Rectangle(1.4, 1.0)
    centre = pad.fractions(0.7, 0.5)
    with np.errstate(all="raise"):
        found = pad.estimate(np.array([*readings, [1e6 * f for f in centre]]).T, noise)
    for coordinate, side in ((found.x, pad.a), (found.y, pad.b)):
        assert ((coordinate >= 0) & (coordinate <= side) | np.isnan(coordinate)).all()
    assert found.x[-1] == pytest.approx(0.7, abs=1e-5)


def test_channel_of_infinite_noise_is_excluded() -> None:
    pad = Rectangle(1.0, 1.0)
    currents = pad.fractions(0.3, 0.6)
    currents[2] = 77.0
    found = pad.estimate(currents, [1e-4, 1e-4, np.inf, 1e-4])
    assert found.x == pytest.approx(0.3, abs=1e-6)
    assert found.y == pytest.approx(0.6, abs=1e-6)


def test_unobservable_coordinate_has_infinite_variance() -> None:
    found = Rectangle(1500.0, 1.0).estimate([0.0, 0.0, 0.5, 0.5], 1e-3)
    assert np.isnan(found.x)
    assert found.y == pytest.approx(0.5)
    assert np.isinf(found.covariance[0, 0])
    assert np.isfinite(found.covariance[1:, 1:]).all()
    assert not np.isnan(found.covariance).any()
    nothing = Rectangle(1.0, 1.0).estimate([-1e-3, -2e-3, -1e-3, 1e-4], 1e-3)
    assert not nothing.converged


def test_start_saves_the_search_and_makes_no_difference() -> None:
    pad = Rectangle(1.0, 1.3)
    x, y = scatter(pad, 500, 5)
    currents = pad.fractions(x, y) + 1e-3 * np.random.default_rng(6).normal(size=(4, 500))
    cold, warm = estimate(pad, currents, 1e-3), estimate(pad, currents, 1e-3, start=(x, y))
    assert np.abs(cold.x - warm.x).max() < 1e-5
    assert np.abs(cold.y - warm.y).max() < 1e-5


def test_wrong_number_of_channels_is_named() -> None:
    with pytest.raises(ValueError, match="4 channels"):
        Rectangle(1, 1).estimate([1.0, 2.0, 3.0], 1.0)


@pytest.mark.parametrize("scale", [1e-290, 1e-120, 1e120, 1e290])
def test_units_make_no_difference(scale: float) -> None:
    currents = Rectangle(1.5, 1.0).fractions([0.4, 1.2], [0.3, 0.6]) + 1e-3
    plain = Rectangle(1.5, 1.0).estimate(currents, 1e-3)
    with np.errstate(all="raise"):
        large = Rectangle(1.5 * scale, scale).estimate(currents, 1e-3)
        strong = Rectangle(1.5, 1.0).estimate(currents * scale, 1e-3 * scale)
    assert large.x / scale == pytest.approx(plain.x, rel=1e-9)
    assert strong.x == pytest.approx(plain.x, rel=1e-9)
    assert strong.total / scale == pytest.approx(plain.total, rel=1e-9)
    assert strong.covariance[:, :2, :2] == pytest.approx(plain.covariance[:, :2, :2], rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("contacts", [1, 4, 5])
def test_one_dimensional_noise_is_per_channel(contacts: int) -> None:
    pad = Rectangle(1.5, 1.0)
    noise = np.array([1e-3, 2e-3, 1e-4, 3e-3])
    x, y = np.linspace(0.3, 1.2, contacts), np.linspace(0.7, 0.4, contacts)
    currents = pad.fractions(x, y) + 1e-4 * np.arange(4)[:, None]
    found = pad.estimate(currents, noise)
    for k in range(contacts):
        alone = pad.estimate(currents[:, k], noise)
        np.testing.assert_allclose(found.x[k], alone.x, rtol=1e-9)
        np.testing.assert_allclose(found.covariance[k], alone.covariance, rtol=1e-6)


def test_no_positive_total_is_no_position() -> None:
    for currents in ([-1.0] * 4, [0.0] * 4):
        found = Rectangle(1.0, 1.0).estimate(currents, 1e-2)
        assert np.isnan(found.x)
        assert np.isnan(found.y)
        assert np.isinf(found.covariance[0, 0])
        assert np.isinf(found.covariance[1, 1])


def test_excluded_dead_channel_has_no_effect() -> None:
    pad = Rectangle(1.0, 1.0)
    currents = pad.fractions(0.4, 0.6)
    currents[1] = np.nan
    noise = [1e-3, np.inf, 1e-3, 1e-3]
    found = pad.estimate(currents, noise)
    np.testing.assert_allclose([found.x, found.y], [0.4, 0.6], atol=1e-6)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("pad", [Rectangle(1.0, 1.0), ElectrodeNetwork(1.5, 1.0, 0.03, 2400.0)])
def test_the_residual_of_points_is_a_normal_number(noise: float, pad: Rectangle | ElectrodeNetwork) -> None:
    """Its square is chi_squared, by which a pair is told from a point."""
    count, rng = 40_000, np.random.default_rng(11)
    x, y = rng.uniform(0.05, 0.95, (2, count)) * np.array([[pad.a], [pad.b]])
    found = pad.estimate(pad.fractions(x, y) + noise * rng.normal(size=(4, count)), noise)
    for rate in (1e-1, 1e-2, 1e-3):
        alarms = int((np.sqrt(found.chi_squared) > -ndtri(rate / 2)).sum())
        assert abs(alarms - rate * count) < 4.5 * math.sqrt(rate * count)
