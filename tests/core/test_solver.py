"""Contacts solved by the stages agree with the exact theory, for any currents."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.config import parse
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import PadModel
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field import estimate
from handtouch.field.contact_law import ForceEstimateStatus
from tests.deployments import deployment_text, pad_text

FloatArray = NDArray[np.float64]
PADS = np.arange(3)


class Contacts:
    """Contacts on the three pads of a model, solved one after the other."""

    def __init__(
        self, model: PadModel, force_requested: bool = True, noise_squared: FloatArray | None = None
    ) -> None:
        self._currents, self._values = np.zeros((3, 4)), np.full((3, VALUE_COUNT), np.nan)
        requested = np.full(3, force_requested)
        measured = {} if noise_squared is None else {"noise_squared": noise_squared}
        self._solver = ContactSolver(
            model, self._currents, np.zeros(3), requested, self._values, measured=measured
        )

    def solve(self, currents: FloatArray) -> None:
        """Solve contacts with these currents (3, 4) [A]."""
        self._currents[:] = currents
        self._solver.solve_contacts(PADS.data)

    def __getattr__(self, name: str) -> FloatArray:
        """Return a value of all pads by its name."""
        values = self._values[:, VALUE_SLICES[name]].copy()
        if name == "covariance_m2":
            return values.reshape(3, 3, 3)
        return values[:, 0] if values.shape[1] == 1 else values


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
    def solve(cls, bench: Any, currents: FloatArray) -> Reference:
        found = bench.exact.estimate(PADS, currents.T, bench.model.noise_a.T)
        placed = bench.exact.to_link_frame(PADS, found.x, found.y, found.covariance[:, :2, :2])
        std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        forces = bench.exact.force(currents.T, found)
        assert all(force.status == ForceEstimateStatus.VALID for force in forces)
        return cls(
            np.stack([found.x, found.y], axis=1),
            std[:, :2],
            placed.position_m,
            placed.normal,
            placed.pad_m,
            placed.covariance_m2 * (1 + np.fmax(found.chi_squared - 9, 0))[:, None, None],
            np.array([float(force.force_n) for force in forces]),
            np.array([float(force.std_n) for force in forces]),
            found.residual,
            np.abs(found.residual) / np.sqrt(np.maximum(found.chi_squared, 1e-300)),
        )


def reading(bench: Any, xy: FloatArray, total_a: float, rng: np.random.Generator | None) -> FloatArray:
    """Return currents (3, 4) of contacts at xy (3, 2), fractions of the sides."""
    fractions = bench.exact.fractions(PADS, *(xy * bench.exact.sides).T).T
    noise = bench.model.noise_a * rng.normal(size=(3, 4)) if rng else 0.0
    return np.asarray(total_a * fractions + noise)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(3e-4, 3e-3))
def test_a_contact_equals_its_reference(bench: Any, seed: int, total_a: float) -> None:
    rng = np.random.default_rng(seed)
    currents = reading(bench, rng.uniform(0.15, 0.85, (3, 2)), total_a, rng)
    contacts, expected = Contacts(bench.model), Reference.solve(bench, currents)
    contacts.solve(currents)
    assert (np.abs(contacts.xy - expected.xy) < 0.02 * expected.xy_std + 1e-9).all()
    np.testing.assert_allclose(contacts.position_m, expected.position_m, atol=1e-7)
    np.testing.assert_allclose(contacts.normal, expected.normal, atol=2e-5)
    np.testing.assert_allclose(contacts.pad_m, expected.pad_m, atol=1e-7)
    points = contacts.squared_misfit <= MAX_SQUARED_MISFIT  # the others have an extent, or are two
    assert (np.abs(contacts.force_n - expected.force_n) < 0.3 * contacts.force_std_n)[points].all()
    np.testing.assert_allclose(contacts.residual, expected.residual, atol=1e-5)
    np.testing.assert_allclose(contacts.residual_std, expected.residual_std, rtol=0.02)
    scale = np.abs(expected.covariance_m2).max(axis=(1, 2))[:, None, None]
    got, wanted = contacts.covariance_m2 / scale, expected.covariance_m2 / scale
    np.testing.assert_allclose(got[points], wanted[points], atol=0.03)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(3e-4, 3e-3))
def test_normals_are_unit_and_covariances_singular_along_them(bench: Any, seed: int, total_a: float) -> None:
    rng = np.random.default_rng(seed)
    contacts = Contacts(bench.model)
    contacts.solve(reading(bench, rng.uniform(0.02, 0.98, (3, 2)), total_a, rng))
    np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1, atol=1e-12)
    along = np.einsum("kij,kj->ki", contacts.covariance_m2, contacts.normal)
    trace = np.trace(contacts.covariance_m2, axis1=1, axis2=2)
    assert (np.linalg.norm(along, axis=1) < 1e-9 * trace).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_contact_that_jumps_or_changes_is_found_as_a_new_one_is(bench: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracked = Contacts(bench.model)
    for total_a in 10 ** rng.uniform(-4.5, -2.5, 4):
        currents = reading(bench, rng.uniform(0.02, 0.98, (3, 2)), total_a, rng)
        tracked.solve(currents)
        new = Contacts(bench.model)
        new.solve(currents)
        for pad in range(3):
            if np.isfinite(new.xy[pad] + tracked.xy[pad]).all():
                likely = [misfit(bench.model, pad, currents, at.xy[pad]) for at in (tracked, new)]
                assert abs(likely[0] - likely[1]) < 1


@pytest.mark.parametrize("position", [(0.0, 0.5), (0.5, 1.0), (0.0, 0.0), (1.0, 1.0)])
def test_a_contact_on_an_edge_or_corner_is_within_four_deviations_of_the_most_likely_one(
    bench: Any, position: tuple[float, float]
) -> None:
    rng, model = np.random.default_rng(5), bench.model
    contacts = Contacts(model)
    at = np.clip(np.full((3, 2), position), 0.02, 0.98)
    for _ in range(20):
        currents = reading(bench, at, 3e-4, rng)
        contacts.solve(currents)
        for pad, network in enumerate(model.networks):
            own = estimate(network, currents[pad], model.noise_a[pad])
            assert (
                misfit(model, pad, currents, contacts.xy[pad]) < own.chi_squared + 16
            )  # four standard deviations
        assert ((contacts.xy >= 0) & (contacts.xy <= bench.exact.sides)).all()


def misfit(model: PadModel, pad: int, currents: FloatArray, xy: FloatArray) -> float:
    """Return the sum of squared residuals, in noise, of the best contact at a position."""
    data = currents[pad] * model.weight[pad]
    fractions = model.networks[pad].fractions(*xy) * model.weight[pad]
    return float(np.sum((data - fractions * max(fractions @ data / (fractions @ fractions), 0)) ** 2))


def test_covariance_includes_the_uncertainty_of_gains(bench: Any) -> None:
    """Positions of a thousand nodes with random gains scatter as the covariance states."""
    rng = np.random.default_rng(11)
    deviation, model = 0.02, copy.deepcopy(bench.model)
    covariance = tuple((deviation**2 * (np.eye(4) - 0.25)).ravel().tolist())
    model.set_calibration(0, ActiveCalibration("1-1", gain_covariance=covariance))
    contacts = Contacts(model)
    straight = reading(bench, np.full((3, 2), [0.4, 0.65]), 2e-3, None)
    contacts.solve(straight)
    stated, found = contacts.covariance_m2[0], []
    for logs in rng.normal(0, deviation, (1000, 4)):
        currents = straight.copy()
        currents[0] *= np.exp(logs - logs.mean())
        contacts.solve(currents)
        found.append(contacts.position_m[0])
    scatter = np.cov(np.array(found).T)
    assert np.sqrt(np.diag(stated))[:2] == pytest.approx(np.sqrt(np.diag(scatter))[:2], rel=0.1)


def test_a_force_that_is_not_requested_is_not_computed(bench: Any) -> None:
    contacts = Contacts(bench.model, force_requested=False)
    contacts.solve(reading(bench, np.full((3, 2), 0.5), 2e-3, None))
    assert np.isfinite(contacts.xy).all()
    assert np.isnan(contacts.force_n).all()
    assert np.isnan(contacts.force_std_n).all()


def test_a_force_at_the_end_of_the_range_is_a_value_or_a_lower_bound(bench: Any) -> None:
    """Contacts slide to and fro across the limit of the sheet's current.

    The core's bounds are less than the exact law's where the current is above all that the law allows.
    """
    rng, contacts, model = np.random.default_rng(8), Contacts(bench.model), bench.model
    statuses, log_ratios = set(), []
    for number in range(200):
        position = 0.5 + 0.3 * np.sin(0.21 * number + np.arange(6).reshape(3, 2))
        currents = reading(bench, position, 8.5e-3 * (1 + 0.15 * np.sin(0.069 * number)), rng)
        contacts.solve(currents)
        forces = bench.exact.force(currents.T, bench.exact.estimate(PADS, currents.T, model.noise_a.T))
        force_n, std_n, status = np.array([(one.force_n, one.std_n, one.status) for one in forces]).T
        statuses |= set(status.tolist())
        bound = contacts.force_status == ForceEstimateStatus.LOWER_BOUND
        same = bound == (status == ForceEstimateStatus.LOWER_BOUND)
        assert np.isinf(contacts.force_std_n[bound]).all()
        # where a hundredth of the factor is half of the force
        log_ratios += np.log(contacts.force_n / force_n)[same & bound].tolist()
        clear = ~bound & (std_n < 0.3 * force_n)
        assert (np.abs(contacts.force_n - force_n) < contacts.force_std_n)[clear].all()
    assert statuses == {ForceEstimateStatus.VALID, ForceEstimateStatus.LOWER_BOUND}
    assert max(log_ratios) < 1.2
    assert np.mean(np.array(log_ratios) > -1.2) > 0.85


def test_the_covariance_of_an_extended_contact_covers_its_centre_of_force(bench: Any) -> None:
    rng = np.random.default_rng(6)
    inside: list[bool] = []
    as_a_point: list[bool] = []
    model = bench.model
    for _ in range(60):
        middle, apart = rng.uniform(0.3, 0.7, (3, 2)), rng.uniform(0.05, 0.2, (3, 1))
        angle = rng.uniform(0, np.pi, (3, 1))
        offset = apart * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        currents = reading(bench, middle - offset, 1e-3, rng) + reading(bench, middle + offset, 1e-3, rng)
        contacts = Contacts(model)
        contacts.solve(currents)
        true = bench.exact.position_m(PADS, *(middle * bench.exact.sides).T)
        point = bench.exact.estimate(PADS, currents.T, model.noise_a.T).covariance[:, :2, :2]
        narrow = bench.exact.to_link_frame(PADS, *contacts.xy.T, point).covariance_m2
        for covariances, found in ((contacts.covariance_m2, inside), (narrow, as_a_point)):
            values, axes = np.linalg.eigh(covariances)
            along = np.einsum("kji,kj->ki", axes, contacts.position_m - true)[:, 1:]
            found.extend((along**2 / values[:, 1:]).sum(axis=1) < 5.991)  # 95 % of chi squared of two
    assert np.mean(inside) > 0.8
    assert np.mean(as_a_point) < 0.1


def test_a_point_contact_has_the_covariance_of_its_noise(bench: Any) -> None:
    rng, equal = np.random.default_rng(7), []
    for _ in range(100):
        contacts = Contacts(bench.model)
        currents = reading(bench, rng.uniform(0.2, 0.8, (3, 2)), 1e-3, rng)
        contacts.solve(currents)
        found = bench.exact.estimate(PADS, currents.T, bench.model.noise_a.T)
        placed = bench.exact.to_link_frame(PADS, found.x, found.y, found.covariance[:, :2, :2])
        sizes = [
            np.trace(covariance, axis1=1, axis2=2)
            for covariance in (contacts.covariance_m2, placed.covariance_m2)
        ]
        equal.extend(sizes[0] < 1.05 * sizes[1])
    assert 0.98 < np.mean(equal) <= 1.0


def test_contacts_on_a_pad_whose_electrodes_touch_are_located() -> None:
    model = build_pad_model(parse(deployment_text(pad_text("link", 1, gap_mm=0.0))))
    (network,) = model.networks
    at = np.array([0.3, 0.6]) * (network.a, network.b)
    values = np.full((1, VALUE_COUNT), np.nan)
    currents = 2e-3 * network.fractions(*at)[None]
    ContactSolver(model, currents, np.zeros(1), np.ones(1, np.bool_), values).solve_contacts(
        np.arange(1).data
    )
    np.testing.assert_allclose(values[0, VALUE_SLICES["xy"]], at, atol=1e-6)
    covariance = values[0, VALUE_SLICES["covariance_m2"]].reshape(3, 3)
    assert 0 < np.trace(covariance) < 1e-6


@pytest.mark.parametrize("place", [(0.01, 0.01), (0.99, 0.01)])
def test_of_two_maxima_beside_a_bare_corner_the_more_likely_one_is_found(place: tuple[float, float]) -> None:
    pad = pad_text("link", 1, extra="series_ohm = [336.0, 336.0, 336.0, 336.0]", gap_mm=0.6)
    model = build_pad_model(parse(deployment_text(pad, exact_parts=True, noise_counts=1e-3)))
    (network,) = model.networks
    at = np.multiply(place, (network.a, network.b))
    values = np.full((1, VALUE_COUNT), np.nan)
    currents = 1e-3 * network.fractions(*at)[None]
    ContactSolver(model, currents, np.zeros(1), np.ones(1, np.bool_), values).solve_contacts(
        np.arange(1).data
    )
    variance = np.trace(values[0, VALUE_SLICES["covariance_m2"]].reshape(3, 3))
    assert np.sum((values[0, VALUE_SLICES["xy"]] - at) ** 2) < variance < 1e-6


@pytest.mark.parametrize("ratio", [0.5, 3.0])
def test_the_noise_of_positions_is_the_measured_one_where_it_exceeds_the_stated(
    bench: Any, ratio: float
) -> None:
    measured = np.square(ratio * bench.model.noise_counts)[:, None] * np.ones(4)
    stated, noisy = Contacts(bench.model), Contacts(bench.model, noise_squared=measured)
    currents = np.array([bench.counts(pad, 0.4, 0.6, 1e-3) for pad in PADS]) * bench.model.ampere_per_count
    for contacts in (stated, noisy):
        contacts.solve(currents)
    factor = max(ratio, 1.0) ** 2
    assert noisy.pad_noise_m2 == pytest.approx(factor * stated.pad_noise_m2, rel=1e-9)
