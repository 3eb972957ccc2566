"""A bank agrees with each pad's own estimate, and reports the error of its tables."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.field import LocatorBank, Rectangle
from handtouch.field.bank import IndexArray
from handtouch.field.model import FloatArray
from handtouch.field.network import Electrode, ElectrodeNetwork

MODELS: list[ElectrodeNetwork | Rectangle] = [
    ElectrodeNetwork(0.060, 0.034, 0.0005, 2400.0),
    ElectrodeNetwork(0.030, 0.030, 0.0010, 2400.0, (100.0, 150.0, 80.0, 120.0)),
    ElectrodeNetwork(0.050, 0.020, 0.0005, 2400.0),
    Rectangle(0.062, 0.035),
]
PADS = [MODELS[i % len(MODELS)] for i in range(15)]
BANK = LocatorBank(PADS)


def contacts(count: int, seed: int, margin: float) -> tuple[IndexArray, FloatArray, FloatArray, FloatArray]:
    """Pads, x, y and exact fractions of random contacts."""
    generator = np.random.default_rng(seed)
    index = generator.integers(0, len(PADS), count)
    place = generator.uniform(margin, 1 - margin, (2, count))
    x = place[0] * np.array([pad.a for pad in PADS])[index]
    y = place[1] * np.array([pad.b for pad in PADS])[index]
    fractions = np.stack([PADS[i].fractions(u, v) for i, u, v in zip(index, x, y, strict=True)], axis=1)
    return index, x, y, fractions


def test_tables_are_as_accurate_as_reported() -> None:
    index, x, y, fractions = contacts(2000, 1, 0.03)
    error = np.abs(BANK.fractions(index, x, y) - fractions).max(axis=0)
    assert (error <= 1.5 * BANK.table_error[index]).all()
    assert BANK.table_error.max() < 1e-6


def test_conformal_radius_equals_the_models() -> None:
    index, x, y, _ = contacts(300, 2, 0.03)
    expected = []
    for i, u, v in zip(index, x, y, strict=True):
        pad = PADS[i]
        radius = pad.conformal_radius(u, v) if isinstance(pad, Rectangle) else pad.spreading_radius(u, v)
        expected.append(float(radius))
    assert BANK.conformal_radius(index, x, y) == pytest.approx(np.array(expected), rel=1e-4)


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 1e-2])
def test_bank_agrees_with_single_estimates(noise: float) -> None:
    index, _, _, fractions = contacts(60, 3, 0.08)
    currents = 2e-3 * (fractions + noise * np.random.default_rng(4).normal(size=fractions.shape))
    found = BANK.estimate(index, currents, 2e-3 * noise)
    assert found.converged.all()
    for k, i in enumerate(index):
        own = PADS[i].estimate(currents[:, k], 2e-3 * noise)
        sigma = np.sqrt(np.diag(own.covariance))
        assert found.x[k] == pytest.approx(own.x, abs=0.1 * sigma[0])
        assert found.y[k] == pytest.approx(own.y, abs=0.1 * sigma[1])
        assert found.total[k] == pytest.approx(own.total, abs=0.1 * sigma[2])
        assert found.residual[k] == pytest.approx(own.residual, abs=0.05 * noise)
        assert found.chi_squared[k] == pytest.approx(own.chi_squared, abs=0.05)
        scale = np.outer(sigma, sigma)
        assert np.abs(found.covariance[k] - own.covariance).max() < np.inf
        assert (found.covariance[k] / scale) == pytest.approx(own.covariance / scale, abs=0.1)


@pytest.mark.parametrize(("noise", "limit"), [(1e-5, 1.05), (1e-4, 1.05), (1e-3, 1.05), (3e-3, 1.05)])
def test_error_reaches_the_cramer_rao_bound(noise: float, limit: float) -> None:
    index, x, y, fractions = contacts(5000, 5, 0.05)
    currents = fractions + noise * np.random.default_rng(6).normal(size=fractions.shape)
    found = BANK.estimate(index, currents, noise)
    expected = np.empty(len(x))
    for model in MODELS:
        of = np.array([PADS[i] is model for i in index])
        f, jacobian = model.fractions_with_jacobian(x[of], y[of])
        design = np.moveaxis(np.concatenate([jacobian, f[:, None]], axis=1), 2, 0) / noise
        bound = np.linalg.inv(np.swapaxes(design, 1, 2) @ design)
        expected[of] = bound[:, 0, 0] + bound[:, 1, 1]
    squared = (found.x - x) ** 2 + (found.y - y) ** 2
    assert np.sqrt((squared / expected).mean()) < limit


@pytest.mark.parametrize("strength", [0.0, 1.0, 3.0])
def test_bank_agrees_with_single_estimates_near_the_noise(strength: float) -> None:
    generator = np.random.default_rng(10)
    for model in MODELS:
        place = generator.uniform(0.05, 0.95, (2, 500)) * [[model.a], [model.b]]
        currents = strength * model.fractions(*place) + generator.normal(size=(4, 500))
        pad = np.full(500, next(i for i, other in enumerate(PADS) if other is model))
        found, own = BANK.estimate(pad, currents, 1.0), model.estimate(currents, 1.0)
        assert ((found.total > 0) == (own.total > 0)).mean() > 0.99
        both = (found.total > 0) & (own.total > 0)
        assert (np.abs(found.chi_squared - own.chi_squared)[both] < 0.1).mean() > 0.98
        assert found.converged.mean() > own.converged.mean() - 0.02


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 3.0, 100.0]), st.floats(0.01, 100.0))
def test_covariance_is_positive_semidefinite_for_any_channel_noise(
    seed: int, strength: float, uneven: float
) -> None:
    generator = np.random.default_rng(seed)
    index, _, _, fractions = contacts(50, seed, 1e-3)
    noise = np.exp(np.log(uneven) * generator.uniform(-1, 1, (4, 50)))
    found = BANK.estimate(index, strength * fractions + noise * generator.normal(size=(4, 50)), noise)
    known = np.isfinite(found.covariance).all(axis=(1, 2))
    scale = np.sqrt(np.diagonal(found.covariance[known], axis1=1, axis2=2))
    correlation = found.covariance[known] / (scale[:, :, None] * scale[:, None])
    assert np.linalg.eigvalsh(correlation).min(initial=0.0) > -1e-12


def test_start_makes_no_difference_and_nan_is_replaced() -> None:
    index, x, y, fractions = contacts(200, 7, 0.1)
    currents = fractions + 1e-4 * np.random.default_rng(8).normal(size=fractions.shape)
    cold = BANK.estimate(index, currents, 1e-4)
    start = np.stack([x, y])
    start[:, ::3] = np.nan
    warm = BANK.estimate(index, currents, 1e-4, start=start)
    sigma = np.sqrt(cold.covariance[:, 0, 0])
    assert (np.abs(cold.x - warm.x) < 0.1 * sigma).all()


readings = st.lists(st.floats(width=64, allow_nan=True, allow_infinity=True), min_size=4, max_size=4)


@given(
    st.lists(readings, min_size=1, max_size=5),
    st.sampled_from([0.0, 1e-300, 1e-9, 1.0, np.inf, np.nan, -1.0]),
)
def test_any_reading_gives_a_point_on_the_pad_or_nan(rows: list[list[float]], noise: float) -> None:
    good = BANK.fractions(np.array([0]), np.array([0.021]), np.array([0.013]))
    currents = np.concatenate([np.array(rows).T, good], axis=1)
    levels = np.full(currents.shape, noise)
    levels[:, -1] = 1e-4
    with np.errstate(all="raise"):
        found = BANK.estimate(np.zeros(currents.shape[1], dtype=int), currents, levels)
    for coordinate, side in ((found.x, PADS[0].a), (found.y, PADS[0].b)):
        assert ((coordinate >= 0) & (coordinate <= side) | np.isnan(coordinate)).all()
    assert found.x[-1] == pytest.approx(0.021, abs=1e-6)
    assert found.y[-1] == pytest.approx(0.013, abs=1e-6)
    assert found.converged[-1]


def test_contacts_on_edges_and_corners_stay_there() -> None:
    a, b = PADS[0].a, PADS[0].b
    x = np.array([0.0, a, a / 2, a / 2, 0.0, a])
    y = np.array([b / 2, b / 2, 0.0, b, 0.0, b])
    currents = PADS[0].fractions(np.clip(x, 1e-9, a - 1e-9), np.clip(y, 1e-9, b - 1e-9))
    currents += 1e-3 * np.random.default_rng(9).normal(size=currents.shape)
    found = BANK.estimate(np.zeros(6, dtype=int), currents, 1e-3)
    sigma = np.sqrt(np.array([found.covariance[:, i, i] for i in range(2)]))
    assert np.isfinite(sigma).all()
    assert (np.abs(found.x - x) < 5 * sigma[0] + 0.01 * a).all()
    assert (np.abs(found.y - y) < 5 * sigma[1] + 0.01 * b).all()


def test_a_whole_hand_is_tabulated_in_a_second() -> None:
    models = [ElectrodeNetwork(0.02 + 0.005 * i, 0.02, 0.0005, 2400.0) for i in range(6)]
    begin = time.perf_counter()
    LocatorBank([models[i % 6] for i in range(15)])
    assert time.perf_counter() - begin < 1.5


def test_empty_calls_and_unsupported_models() -> None:
    assert BANK.estimate(np.zeros(0, dtype=int), np.zeros((4, 0)), 1.0).x.shape == (0,)
    three = [Electrode("x0", 0.0, 1.0), Electrode("xa", 0.0, 1.0), Electrode("y0", 0.1, 0.9)]
    with pytest.raises(ValueError, match="four channels"):
        LocatorBank([ElectrodeNetwork.from_electrodes(1.0, 1.0, three, 1.0)])


@pytest.mark.parametrize("index", [0.5, 1.0, True, -1, 2, np.nan, "0"])
def test_only_numbers_of_pads_are_taken_as_index(index: Any) -> None:
    bank = LocatorBank([Rectangle(1.0, 1.0), Rectangle(2.0, 1.0)])
    half = np.array([0.5])
    for call in (
        lambda: bank.fractions([index], half, half),
        lambda: bank.conformal_radius([index], half, half),
        lambda: bank.tangent([index], half, half),
        lambda: bank.estimate([index], np.ones((4, 1)), 0.1),
    ):
        with pytest.raises(ValueError, match="index of pads: whole numbers from 0 to 1"):
            call()


@pytest.mark.parametrize("aspect", [1 / 20, 20.0])
def test_a_bank_of_a_long_network_agrees_with_it_where_currents_are_observable(aspect: float) -> None:
    """Warnings are errors here: fractions of far electrodes are rounding, also negative."""
    pad = ElectrodeNetwork(aspect, 1.0, 0.02 * min(aspect, 1.0), 1.0)
    x, y = np.random.default_rng(1).uniform(0.03, 0.97, (2, 200)) * [[pad.a], [pad.b]]
    currents = pad.fractions(x, y)
    banked = LocatorBank([pad]).estimate(np.zeros(200, np.intp), currents, 1e-4)
    own = pad.estimate(currents, 1e-4)
    short, long = ("y", "x") if aspect > 1 else ("x", "y")
    assert getattr(banked, short) == pytest.approx({"x": x, "y": y}[short], abs=1e-4 * min(aspect, 1.0))
    axis = "xy".index(long)
    stds = [np.sqrt(found.covariance[:, axis, axis]) for found in (banked, own)]
    observable = np.max(stds, axis=0) < 0.1
    assert observable.sum() > 20
    off = np.abs(getattr(banked, long) - {"x": x, "y": y}[long])[observable]
    assert (off < 0.2 * stds[1][observable]).all()


def test_electrodes_of_two_percent_of_a_side_are_solved_and_tabulated_quickly() -> None:
    pad = ElectrodeNetwork(1.0, 1.0, 0.49, 1.0)
    begin = time.process_time()
    bank = LocatorBank([pad])
    assert time.process_time() - begin < 8.0  # 1 s on an idle machine, 20 s by a sum over pairs of terms
    x, y = np.random.default_rng(1).uniform(0.1, 0.9, (2, 50))
    assert bank.fractions(np.zeros(50, np.intp), x, y) == pytest.approx(pad.fractions(x, y), abs=1e-5)
