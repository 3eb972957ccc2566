"""Linearised contacts agree with solving in every tick."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.core.linearisation import FORCE_COLUMN, XY_COLUMNS, ContactLinearisations
from handtouch.core.pad_model import PadModel
from handtouch.core.tick import TickProcessor
from handtouch.field.contact_law import ForceEstimateStatus

FloatArray = NDArray[np.float64]
PADS = np.arange(3)


class Reference(NamedTuple):
    """Contacts on all pads, each solved separately."""

    xy: FloatArray
    xy_std: FloatArray
    position_m: FloatArray
    normal: FloatArray
    pad_m: FloatArray
    covariance_m2: FloatArray
    force_n: FloatArray
    force_std_n: FloatArray
    residual: FloatArray
    residual_std: FloatArray

    @classmethod
    def solve(cls, model: PadModel, currents: FloatArray) -> Reference:
        found = model.locator.estimate(PADS, currents.T, model.noise_a.T)
        placed = model.placement.to_link_frame(PADS, found.x, found.y, found.covariance[:, :2, :2])
        radius_m = model.locator.conformal_radius(PADS, found.x, found.y) * placed.scale_m_per_unit
        std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        force = model.estimate_force(PADS, currents.T, found.total, std[:, 2], radius_m)
        assert (force.status == ForceEstimateStatus.VALID).all()
        return cls(
            np.stack([found.x, found.y], axis=1),
            std[:, :2],
            placed.position_m,
            placed.normal,
            placed.pad_m,
            placed.covariance_m2 * (1 + np.fmax(found.chi_squared - 9, 0))[:, None, None],
            force.force_n,
            force.std_n,
            found.residual,
            np.abs(found.residual) / np.sqrt(np.maximum(found.chi_squared, 1e-300)),
        )


def reading(model: PadModel, xy: FloatArray, total_a: float, rng: np.random.Generator | None) -> FloatArray:
    """Return currents (3, 4) of contacts at xy (3, 2), fractions of the sides."""
    fractions = model.locator.fractions(PADS, *(xy * model.locator.sides).T).T
    noise = model.noise_a * rng.normal(size=(3, 4)) if rng else 0.0
    return np.asarray(total_a * fractions + noise)


def step(tick: TickProcessor, currents: FloatArray) -> None:
    """Process currents of contacts as a tick does."""
    tick._currents[:] = currents
    tick._solve_contacts(PADS)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(3e-4, 3e-3))
def test_a_contact_equals_its_solution(bench: Any, seed: int, total_a: float) -> None:
    rng = np.random.default_rng(seed)
    tick = TickProcessor(bench.model, 5_000_000)
    tick.baseline.std[:] = 0.0
    currents = reading(bench.model, rng.uniform(0.15, 0.85, (3, 2)), total_a, rng)
    step(tick, currents)
    columns, expected = tick.columns, Reference.solve(bench.model, currents)
    assert (np.abs(columns.xy - expected.xy) < 0.02 * expected.xy_std).all()
    np.testing.assert_allclose(columns.position_m, expected.position_m, atol=1e-7)
    np.testing.assert_allclose(columns.normal, expected.normal, atol=2e-5)
    np.testing.assert_allclose(columns.pad_m, expected.pad_m, atol=1e-7)
    np.testing.assert_allclose(columns.force_n, expected.force_n, rtol=1e-4)
    np.testing.assert_allclose(columns.force_std_n, expected.force_std_n, rtol=1e-3)
    np.testing.assert_allclose(columns.residual, expected.residual, atol=1e-5)
    np.testing.assert_allclose(columns.residual_std, expected.residual_std, rtol=0.02)
    scale = np.abs(expected.covariance_m2).max(axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(columns.covariance_m2 / scale, expected.covariance_m2 / scale, atol=0.03)


@pytest.mark.parametrize("prepared", [True, False])
@pytest.mark.parametrize("per_tick", [0.0, 1e-4, 1e-3, 1e-2], ids="{} of a side".format)
@pytest.mark.parametrize("total_a", [1e-4, 3e-4, 3e-3])
def test_a_linearised_contact_is_as_accurate_as_one_solved_in_every_tick(
    bench: Any, total_a: float, per_tick: float, prepared: bool
) -> None:
    rng = np.random.default_rng(3)
    tick = TickProcessor(bench.model, 5_000_000)
    angle = rng.uniform(0, 2 * np.pi, 3)
    velocity = per_tick * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = rng.uniform(0.3, 0.7, (3, 2))
    linearised, solved = [], []
    for _ in range(150):
        at = at + velocity
        velocity = np.where((at < 0.15) | (at > 0.85), -velocity, velocity)
        currents = reading(bench.model, at, total_a, rng)
        step(tick, currents)
        if prepared:
            tick.prepare_next_tick()
        own = bench.model.locator.estimate(PADS, currents.T, bench.model.noise_a.T)
        true = at * bench.model.locator.sides
        std = np.sqrt(np.diagonal(own.covariance, axis1=1, axis2=2))[:, :2]
        linearised.append((tick.columns.xy - true) / std)
        solved.append((np.stack([own.x, own.y], axis=1) - true) / std)
    assert np.std(linearised) < 1.02 * np.std(solved)
    assert np.std(np.subtract(linearised, solved)) < 0.15


def test_a_changing_force_is_that_of_its_current(bench: Any) -> None:
    tick = TickProcessor(bench.model, 5_000_000)
    for total_a in 1e-3 * (1 + 0.5 * np.sin(np.arange(60) * 0.15)):
        currents = reading(bench.model, np.full((3, 2), 0.4), total_a, None)
        step(tick, currents)
        tick.prepare_next_tick()
        np.testing.assert_allclose(
            tick.columns.force_n, Reference.solve(bench.model, currents).force_n, rtol=1e-4
        )


def test_a_static_contact_is_solved_once(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, calls, linearise = np.random.default_rng(4), [], ContactLinearisations.linearise

    def counted(*args: Any, **more: Any) -> Any:
        calls.append(args)
        return linearise(*args, **more)

    monkeypatch.setattr(ContactLinearisations, "linearise", counted)
    tick = TickProcessor(bench.model, 5_000_000)
    for _ in range(200):
        step(tick, reading(bench.model, np.full((3, 2), 0.4), 3e-3, rng))
        tick.prepare_next_tick()
    assert len(calls) == 1


def test_preparing_the_next_tick_changes_no_contact(bench: Any) -> None:
    tick = TickProcessor(bench.model, 5_000_000)
    step(tick, reading(bench.model, np.full((3, 2), 0.4), 1e-3, None))
    step(tick, reading(bench.model, np.full((3, 2), 0.403), 1e-3, None))
    before = tick.columns.values.copy()
    tick.prepare_next_tick()
    np.testing.assert_array_equal(tick.columns.values, before)
    tick.prepare_next_tick()  # a second call has no effect


@pytest.mark.parametrize("position", [(0.0, 0.5), (0.5, 1.0), (0.0, 0.0), (1.0, 1.0)])
def test_a_contact_on_an_edge_or_corner_keeps_the_position_of_the_locator(
    bench: Any, position: tuple[float, float]
) -> None:
    rng = np.random.default_rng(5)
    tick = TickProcessor(bench.model, 5_000_000)
    at = np.clip(np.full((3, 2), position), 1e-3, 1 - 1e-3)
    for _ in range(20):
        currents = reading(bench.model, at, 3e-4, rng)
        step(tick, currents)
        tick.prepare_next_tick()
        own = bench.model.locator.estimate(PADS, currents.T, bench.model.noise_a.T)
        std = np.sqrt(np.diagonal(own.covariance, axis1=1, axis2=2))[:, :2]
        assert (np.abs(tick.columns.xy - np.stack([own.x, own.y], axis=1)) < 0.5 * std).all()
        assert ((tick.columns.xy >= 0) & (tick.columns.xy <= bench.model.locator.sides)).all()


def test_a_new_contact_is_independent_of_the_previous_one(bench: Any) -> None:
    tick = TickProcessor(bench.model, 5_000_000)
    second = reading(bench.model, np.full((3, 2), 0.8), 3e-3, None)
    step(tick, reading(bench.model, np.full((3, 2), 0.2), 1e-3, None))
    step(tick, second)
    expected = Reference.solve(bench.model, second)
    np.testing.assert_allclose(tick.columns.position_m, expected.position_m, atol=1e-7)
    np.testing.assert_allclose(tick.columns.force_n, expected.force_n, rtol=1e-4)


def test_covariance_includes_the_uncertainty_of_gains(bench: Any) -> None:
    """Positions of a thousand nodes with random gains scatter as the covariance states."""
    rng = np.random.default_rng(11)
    deviation, model = 0.02, copy.deepcopy(bench.model)
    model.set_uncertainty(0, deviation**2 * (np.eye(4) - 0.25), quarantined=False)
    linearisations, pads = ContactLinearisations(model), np.array([0])
    true = np.array([[0.4, 0.65]])
    straight = reading(model, np.repeat(true, 3, axis=0), 2e-3, None)[:1]
    stated = linearisations.solve_contacts(pads, straight, np.full((1, 2), np.nan)).covariance_m2[0]
    logs = rng.normal(0, deviation, (1000, 4))
    logs -= logs.mean(axis=1, keepdims=True)
    found = model.locator.estimate(
        np.zeros(1000, int), (straight * np.exp(logs)).T, model.noise_a[[0] * 1000].T
    )
    placed = model.placement.to_link_frame(np.zeros(1000, int), found.x, found.y, np.zeros((1000, 2, 2)))
    scatter = np.cov(placed.position_m.T)
    assert np.sqrt(np.diag(stated))[:2] == pytest.approx(np.sqrt(np.diag(scatter))[:2], rel=0.1)


def test_a_quarantined_pad_has_no_force(bench: Any) -> None:
    model = copy.deepcopy(bench.model)
    model.set_uncertainty(1, 0.05**2 * (np.eye(4) - 0.25), quarantined=True)
    linearisations = ContactLinearisations(model)
    currents = reading(model, np.full((3, 2), 0.5), 2e-3, None)
    solved = linearisations.solve_contacts(PADS, currents, np.full((3, 2), np.nan))
    values, off = linearisations.evaluate(PADS, currents)
    assert np.isfinite(values[:, XY_COLUMNS]).all()
    assert (off <= 1).all()
    assert np.isnan(values[:, FORCE_COLUMN]).tolist() == [False, True, False]
    assert np.isnan(solved.force_std_n).tolist() == [False, True, False]


def test_a_force_at_the_end_of_the_range_is_a_value_or_a_lower_bound(bench: Any) -> None:
    """Contacts slide to and fro across the limit of the sheet's current."""
    rng, tick, model = np.random.default_rng(8), TickProcessor(bench.model, 5_000_000), bench.model
    statuses = set()
    for number in range(600):
        position = 0.5 + 0.3 * np.sin(0.07 * number + np.arange(6).reshape(3, 2))
        currents = reading(model, position, 8.5e-3 * (1 + 0.15 * np.sin(0.023 * number)), rng)
        step(tick, currents)
        tick.prepare_next_tick()
        found = model.locator.estimate(PADS, currents.T, model.noise_a.T)
        placed = model.placement.to_link_frame(PADS, found.x, found.y, found.covariance[:, :2, :2])
        radius_m = model.locator.conformal_radius(PADS, found.x, found.y) * placed.scale_m_per_unit
        std = np.sqrt(found.covariance[:, 2, 2])
        own = model.estimate_force(PADS, currents.T, found.total, std, radius_m)
        statuses |= set(own.status.tolist())
        same = tick.columns.force_saturated == (own.status == ForceEstimateStatus.LOWER_BOUND)
        assert (np.abs(tick.columns.force_n / own.force_n - 1) < 0.02)[same].all()
    assert statuses == {ForceEstimateStatus.VALID, ForceEstimateStatus.LOWER_BOUND}


def test_the_covariance_of_an_extended_contact_covers_its_centre_of_force(bench: Any) -> None:
    rng = np.random.default_rng(6)
    inside: list[bool] = []
    as_a_point: list[bool] = []
    model = bench.model
    for _ in range(60):
        middle, apart = rng.uniform(0.3, 0.7, (3, 2)), rng.uniform(0.05, 0.2, (3, 1))
        angle = rng.uniform(0, np.pi, (3, 1))
        offset = apart * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        currents = reading(model, middle - offset, 1e-3, rng) + reading(model, middle + offset, 1e-3, rng)
        tick = TickProcessor(model, 5_000_000)
        step(tick, currents)
        zero = np.zeros((3, 2, 2))
        true = model.placement.to_link_frame(PADS, *(middle * model.locator.sides).T, zero).position_m
        point = model.locator.estimate(PADS, currents.T, model.noise_a.T).covariance[:, :2, :2]
        narrow = model.placement.to_link_frame(PADS, *tick.columns.xy.T, point).covariance_m2
        for covariances, found in ((tick.columns.covariance_m2, inside), (narrow, as_a_point)):
            values, axes = np.linalg.eigh(covariances)
            along = np.einsum("kji,kj->ki", axes, tick.columns.position_m - true)[:, 1:]
            found.extend((along**2 / values[:, 1:]).sum(axis=1) < 5.991)  # 95 % of chi squared of two
    assert np.mean(inside) > 0.8
    assert np.mean(as_a_point) < 0.1


def test_a_point_contact_has_the_covariance_of_its_noise(bench: Any) -> None:
    rng, equal = np.random.default_rng(7), []
    for _ in range(100):
        tick = TickProcessor(bench.model, 5_000_000)
        currents = reading(bench.model, rng.uniform(0.2, 0.8, (3, 2)), 1e-3, rng)
        step(tick, currents)
        found = bench.model.locator.estimate(PADS, currents.T, bench.model.noise_a.T)
        placed = bench.model.placement.to_link_frame(PADS, found.x, found.y, found.covariance[:, :2, :2])
        sizes = [
            np.trace(covariance, axis1=1, axis2=2)
            for covariance in (tick.columns.covariance_m2, placed.covariance_m2)
        ]
        equal.extend(sizes[0] < 1.05 * sizes[1])
    assert 0.98 < np.mean(equal) <= 1.0
