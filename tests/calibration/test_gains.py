"""Gains from ordinary contacts: as good as the Fisher bound, honest about it, deaf to what is no point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.calibration.calibration import Gains, matrix
from handtouch.calibration.contact_scores import fisher_covariance, gain_deviation
from handtouch.calibration.gains import (
    BATCH_CONTACTS,
    MAX_TOUCH_ERROR,
    GainEstimator,
    GainStatus,
    PartModels,
)
from handtouch.field import Electrode, ElectrodeNetwork, Rectangle
from handtouch.field.model import ForwardModel
from handtouch.field.network import Side

FloatArray = NDArray[np.float64]
SQUARE = Rectangle(1.0, 1.0)
TRUTH = np.array([0.03, -0.01, -0.025, 0.005])
DAY_NS = 86_400_000_000_000


def contacts(
    model: ForwardModel,
    count: int,
    noise: float,
    log_gains: FloatArray = TRUTH,
    seed: int = 1,
    apart: float = 0.0,
) -> FloatArray:
    """Currents (channels, count) that `log_gains` correct; of points, or of two points `apart` along x."""
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(0.15, 0.85, (2, count)) * [[model.a], [model.b]]
    total = generator.uniform(0.5, 2.0, count)
    fractions = (model.fractions(x - apart / 2, y) + model.fractions(x + apart / 2, y)) / 2
    return np.asarray(
        (fractions * total + noise * generator.normal(size=fractions.shape)) * np.exp(-log_gains)[:, None]
    )


def plain(model: ForwardModel = SQUARE, **options: Any) -> GainEstimator:
    return GainEstimator(model, **{"drift_per_day": 0.0, "model_error": 0.0, **options})


def test_gains_are_exact_with_negligible_noise() -> None:
    estimator = plain()
    assert estimator.add_contacts(contacts(SQUARE, 128, 1e-7), 1e-7, 0) == 128
    found = estimator.estimate
    np.testing.assert_allclose(np.log(found.gains), TRUTH, atol=1e-6)
    assert found.status == GainStatus.ESTIMATED
    assert found.contacts == 128


@pytest.mark.parametrize("model", [Rectangle(1.5, 1.0), ElectrodeNetwork(0.04, 0.03, 8e-4, 2400.0)])
def test_any_pad_model_is_accepted(model: ForwardModel) -> None:
    estimator = plain(model)
    estimator.add_contacts(contacts(model, 96, 1e-5), 1e-5, 0)
    found = estimator.estimate
    assert np.abs(np.log(found.gains) - TRUTH).max() < 4 * found.std < 1e-3


def test_errors_match_the_covariance_and_the_fisher_bound() -> None:
    distances, ratios = [], []
    for seed in range(20):
        estimator = plain(tolerance=0.3)
        estimator.add_contacts(contacts(SQUARE, 3 * BATCH_CONTACTS, 1e-3, seed=seed), 1e-3, 0)
        found = estimator.estimate
        error = np.log(found.gains) - TRUTH
        distances.append(error @ np.linalg.pinv(found.covariance) @ error)
        generator = np.random.default_rng(seed)
        x, y = generator.uniform(0.15, 0.85, (2, 3 * BATCH_CONTACTS))
        total = generator.uniform(0.5, 2.0, 3 * BATCH_CONTACTS)
        ratios.append(found.std**2 / np.diag(fisher_covariance(SQUARE, x, y, (1e-3 / total)[None])).max())
    assert 1.6 < np.mean(distances) < 5.0  # 99.8 % of means of 20 chi squared of three degrees of freedom
    assert 0.95 < np.mean(ratios) < 1.3


def test_fisher_bound_equals_that_of_the_joint_problem() -> None:
    """Invert the joint information on gains, positions and totals, and select the gains."""
    generator = np.random.default_rng(5)
    x, y = generator.uniform(0.1, 0.9, (2, 6))
    fractions, jacobian = SQUARE.fractions_with_jacobian(x, y)
    design = np.zeros((4 * 6 + 1, 4 + 3 * 6))
    for k in range(6):
        rows = slice(4 * k, 4 * k + 4)
        design[rows, :4] = np.diag(fractions[:, k])
        design[rows, 4 + 3 * k : 7 + 3 * k] = np.column_stack([jacobian[:, :, k], fractions[:, k]])
    design[-1, :4] = 100  # log gains sum to zero
    whole = np.linalg.inv(design.T @ design)[:4, :4]
    np.testing.assert_allclose(fisher_covariance(SQUARE, x, y, 1.0), whole, rtol=1e-4, atol=1e-4)


def test_gain_deviation_of_shapes_matches_theory() -> None:
    assert gain_deviation(SQUARE) == pytest.approx(1.5, abs=0.1)
    assert gain_deviation(Rectangle(1.77, 1.0)) == pytest.approx(8.3, abs=0.3)
    assert gain_deviation(Rectangle(3.0, 1.0)) == pytest.approx(284, rel=0.05)
    assert gain_deviation(Rectangle(1.0, 1.77)) == pytest.approx(gain_deviation(Rectangle(1.77, 1.0)))


def test_shape_without_observable_gains_is_refused_with_its_deviation() -> None:
    estimator = GainEstimator(Rectangle(3.0, 1.0))
    estimator.add_contacts(contacts(Rectangle(3.0, 1.0), 320, 1e-4), 1e-4, 0)
    found = estimator.estimate
    assert found.status == GainStatus.INVALID
    assert "282 times the noise" in found.reason


def test_status_is_undetermined_before_enough_contacts() -> None:
    estimator = plain()
    assert estimator.estimate.status == GainStatus.UNDETERMINED
    estimator.add_contacts(contacts(SQUARE, BATCH_CONTACTS - 1, 1e-4), 1e-4, 0)
    assert estimator.estimate.contacts == 0
    estimator.add_contacts(contacts(SQUARE, 1, 1e-4), 1e-4, 0)
    assert estimator.estimate.contacts == BATCH_CONTACTS
    poor = plain()
    poor.add_contacts(contacts(SQUARE, BATCH_CONTACTS, 1e-2), 1e-2, 0)
    assert poor.estimate.status == GainStatus.UNDETERMINED
    assert "touch the pad all over" in poor.estimate.reason


def test_single_contacts_give_the_same_estimate_as_a_batch() -> None:
    currents = contacts(SQUARE, 2 * BATCH_CONTACTS, 1e-3)
    together, single = plain(), plain()
    together.add_contacts(currents, 1e-3, 0)
    for column in currents.T:
        single.add_contacts(column, 1e-3, 0)
    np.testing.assert_array_equal(together.estimate.gains, single.estimate.gains)


def test_estimate_is_independent_of_the_current_scale() -> None:
    currents = contacts(SQUARE, BATCH_CONTACTS, 1e-3)
    one, other = plain(), plain()
    one.add_contacts(currents, 1e-3, 0)
    other.add_contacts(currents * 1e-6, 1e-9, 0)
    np.testing.assert_allclose(one.estimate.gains, other.estimate.gains, rtol=1e-9)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_elongated_contacts_among_points_do_not_bias_the_gains(share: float) -> None:
    count, worst = 320, []
    for seed in range(6):
        currents = contacts(SQUARE, count, 5e-4, seed=seed)
        # all along x, so that their biases add up
        currents[:, : int(share * count)] = contacts(SQUARE, int(share * count), 5e-4, seed=99, apart=0.25)
        estimator = plain(tolerance=0.1)
        estimator.add_contacts(currents[:, np.random.default_rng(seed).permutation(count)], 5e-4, 0)
        found = estimator.estimate
        worst.append(np.abs(np.log(found.gains) - TRUTH).max() / found.std)
        assert found.status == GainStatus.ESTIMATED
        assert found.point_fraction == pytest.approx(1 - share, abs=0.12)
    assert np.median(worst) < 3


def test_contacts_by_edges_only_make_the_estimate_invalid() -> None:
    estimator = plain()
    estimator.add_contacts(contacts(SQUARE, 64, 1e-4), 1e-4, 0)
    before = np.log(estimator.estimate.gains)
    generator = np.random.default_rng(3)
    for apart in generator.uniform(0.1, 0.3, 400):
        estimator.add_contacts(contacts(SQUARE, 1, 1e-4, seed=int(1e6 * apart), apart=apart), 1e-4, 0)
    found = estimator.estimate
    assert found.status == GainStatus.INVALID
    assert "no points" in found.reason
    assert np.abs(np.log(found.gains) - before).max() < 5e-3


def test_gain_step_makes_the_estimate_invalid() -> None:
    estimator = plain()
    estimator.add_contacts(contacts(SQUARE, 256, 1e-4), 1e-4, 0)
    estimator.add_contacts(contacts(SQUARE, 256, 1e-4, TRUTH[::-1]), 1e-4, 0)
    assert estimator.estimate.status == GainStatus.INVALID
    assert "jumped" in estimator.estimate.reason


def test_drift_is_tracked() -> None:
    estimator = plain(drift_per_day=2e-3)
    for day in range(60):
        gains = TRUTH + 1e-3 * day * np.array([1, -1, 0, 0])
        estimator.add_contacts(contacts(SQUARE, BATCH_CONTACTS, 2e-4, gains, seed=day), 2e-4, day * DAY_NS)
    found = estimator.estimate
    assert np.abs(np.log(found.gains) - gains).max() < 2e-3
    assert found.status == GainStatus.ESTIMATED


def test_uncertainty_grows_without_contacts() -> None:
    estimator = plain(drift_per_day=2e-3)
    estimator.add_contacts(contacts(SQUARE, 256, 1e-4), 1e-4, 0)
    fresh = estimator.estimate.std
    estimator.add_contacts(np.zeros((4, 0)), 1e-4, 100 * DAY_NS)
    assert fresh < 2e-4
    assert estimator.estimate.std == pytest.approx(2e-2 * np.sqrt(3 / 4), rel=0.05)  # three of four are free
    assert estimator.estimate.status == GainStatus.UNDETERMINED


def test_information_from_one_position_is_limited_by_the_model_error() -> None:
    here = SQUARE.fractions(np.full(2000, 0.35), np.full(2000, 0.35))
    noisy = here + 1e-4 * np.random.default_rng(1).normal(size=here.shape)
    estimator = GainEstimator(SQUARE, model_error=1e-3, drift_per_day=0)
    estimator.add_contacts(noisy[:, :200], 1e-4, 0)
    early, effective = estimator.estimate.std, estimator.estimate.effective_contacts
    estimator.add_contacts(noisy[:, 200:], 1e-4, 0)
    assert estimator.estimate.std == pytest.approx(early, rel=0.01)
    assert estimator.estimate.effective_contacts == pytest.approx(effective, abs=0.5)
    assert estimator.estimate.effective_contacts < 2
    assert estimator.estimate.status == GainStatus.UNDETERMINED


def test_contacts_in_cells_of_their_own_are_worth_that_of_noise_and_model_error() -> None:
    x, y = (at.ravel() for at in np.meshgrid(*[(np.arange(1, 9) + 0.5) / 10] * 2))
    generator, ratios = np.random.default_rng(1), []
    bound = fisher_covariance(SQUARE, x, y, np.hypot(1e-4, 1e-3))
    for _ in range(10):
        errors = np.hypot(1e-4, 1e-3) * generator.normal(size=(4, len(x)))
        currents = (SQUARE.fractions(x, y) + errors) * np.exp(-TRUTH)[:, None]
        estimator = GainEstimator(SQUARE, model_error=1e-3, drift_per_day=0, tolerance=0.3)
        estimator.add_contacts(currents, 1e-4, 0)
        ratios.append(np.trace(estimator.estimate.covariance) / np.trace(bound))
    # one touch a cell doesn't tell an error of its position from one of its own: it counts as both
    assert 0.9 < np.mean(ratios) < 2.6


def test_position_dependent_model_errors_are_covered_by_the_covariance() -> None:
    """Fraction errors of 1e-3 are equal for all contacts in a cell and don't average out."""
    distances = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        x, y = generator.uniform(0.1, 0.9, (2, 800))
        wrong = 1e-3 * generator.normal(size=(4, 10, 10))
        fractions = SQUARE.fractions(x, y) + wrong[:, (10 * x).astype(int), (10 * y).astype(int)]
        currents = (fractions + 1e-4 * generator.normal(size=(4, 800))) * np.exp(-TRUTH)[:, None]
        estimator = GainEstimator(SQUARE, model_error=1e-3, drift_per_day=0)
        estimator.add_contacts(currents, 1e-4, 0)
        error = np.log(estimator.estimate.gains) - TRUTH
        distances.append(error @ np.linalg.pinv(estimator.estimate.covariance) @ error)
    assert 0.5 < np.mean(distances) < 5.0


def test_estimation_continues_from_stored_gains() -> None:
    first = plain()
    first.add_contacts(contacts(SQUARE, 320, 1e-3), 1e-3, 0)
    found = first.estimate
    second = plain(known=Gains(tuple(found.gains.tolist()), matrix(found.covariance)))
    np.testing.assert_allclose(second.estimate.gains, found.gains, rtol=1e-12)
    np.testing.assert_allclose(second.estimate.covariance, found.covariance, rtol=1e-6, atol=1e-12)
    second.add_contacts(contacts(SQUARE, 320, 1e-3, seed=2), 1e-3, 5)
    assert second.estimate.std < 0.8 * found.std


def test_weak_contacts_and_contacts_at_edges_are_ignored() -> None:
    estimator = plain()
    edge = SQUARE.fractions([0.01, 0.5, 0.5], [0.5, 0.98, 0.5])
    assert estimator.add_contacts(edge, 1e-4, 0) == 1
    assert estimator.add_contacts(0.01 * edge, 1e-3, 0) == 0
    assert estimator.add_contacts(np.full((4, 2), np.nan), 1e-3, 0) == 0
    assert estimator.add_contacts(-edge, 1e-3, 0) == 0


@settings(max_examples=12, deadline=None)
@given(st.lists(st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4), min_size=1, max_size=40))
def test_any_currents_give_finite_estimates(readings: list[list[float]]) -> None:
    estimator = GainEstimator(SQUARE)
    added = estimator.add_contacts(np.array(readings).T, 1e-3, 0)
    for _ in range(BATCH_CONTACTS // added if added else 0):
        estimator.add_contacts(np.array(readings).T, 1e-3, 0)
    assert np.isfinite(estimator.estimate.gains).all()
    assert np.isfinite(estimator.estimate.covariance).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "tolerance"),
        ({"model_error": -1.0}, "model_error"),
        ({"drift_per_day": float("nan")}, "drift_per_day"),
        ({"required_std": 0.0}, "required_std"),
        ({"known": Gains((1.0, 1.0, 1.0), matrix(np.eye(3)))}, "must be 4 positive"),
    ],
)
def test_invalid_parameters_are_refused_by_name(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GainEstimator(SQUARE, **options)


def test_gains_of_pads_with_other_gaps_are_within_their_covariance() -> None:
    """Squared errors in units of the covariance are 3 on average, one for each direction of the gains, 11
    with the gaps; where gaps aren't parameters, they are many times more."""
    nominal, generator = ElectrodeNetwork(30.0, 24.0, 0.8, 1.0), np.random.default_rng(8)

    def with_gaps(more: FloatArray) -> ElectrodeNetwork:
        sides: tuple[Side, ...] = ("x0", "xa", "y0", "yb")
        electrodes = [
            Electrode(side, 0.8 + before, length - 0.8 - after)
            for side, length, (before, after) in zip(sides, (24, 24, 30, 30), more.reshape(4, 2), strict=True)
        ]
        return ElectrodeNetwork.from_sides(30.0, 24.0, electrodes, 1.0)

    parts = [with_gaps(0.1 * one) for one in np.eye(8)]
    distances: dict[bool, list[float]] = {False: [], True: []}
    joint = []
    for number in range(12):
        gaps = generator.normal(size=8)
        readings = contacts(with_gaps(0.1 * gaps), 64, 1e-4, seed=number)
        for known in (False, True):
            estimator = plain(nominal, parts=PartModels(parts if known else ()))
            estimator.add_contacts(readings, 1e-4, 0)
            found = estimator.estimate
            error = np.log(found.gains) - TRUTH
            distances[known].append(float(error @ np.linalg.pinv(found.covariance, rcond=1e-6) @ error))
        error = np.concatenate([error, found.part_offsets - gaps])
        joint.append(error @ np.linalg.pinv(found.joint_covariance, rcond=1e-9) @ error)
    assert 1.5 < np.mean(distances[True]) < 4.5
    assert np.mean(distances[False]) > 30
    assert 7 < np.mean(joint) < 15


@pytest.mark.parametrize("leads_ohm", [(1.5, 0.2, 0.9, 2.0), (22.0, 3.0, 14.0, 8.0)])
def test_leads_are_found_however_large_and_as_certain_as_before_where_they_are_as_stated(
    leads_ohm: tuple[float, ...],
) -> None:
    stated_ohm, rng = 1.2, np.random.default_rng(3)
    nominal = ElectrodeNetwork(0.03, 0.024, 8e-4, 2400.0)
    parts = [nominal.with_series_ohm((stated_ohm * one).tolist()) for one in np.eye(4)]
    readings = contacts(nominal.with_series_ohm(leads_ohm), 96, 1e-4)
    readings = readings + 2e-4 * readings.sum(axis=0) * rng.normal(size=readings.shape)  # of patches
    found = {}
    for limit in (1.0, 20.0):
        estimator = plain(nominal, parts=PartModels(parts, limit))
        estimator.add_contacts(readings, 1e-4, 0)
        found[limit] = estimator.estimate
    error = np.log(found[20.0].gains) - TRUTH, found[20.0].part_offsets - np.array(leads_ohm) / stated_ohm
    joint = np.concatenate(error)
    distance = joint @ np.linalg.pinv(found[20.0].joint_covariance, rcond=1e-9) @ joint
    assert distance < 24  # 0.1 % of chi-squared of 7 degrees of freedom
    if max(leads_ohm) < 2 * stated_ohm:
        assert found[20.0].widening < 2
        assert found[20.0].std < 1.3 * found[1.0].std
    else:
        assert found[20.0].widening > 5
        unknown = np.log(found[1.0].gains) - TRUTH
        assert unknown @ np.linalg.pinv(found[1.0].covariance, rcond=1e-6) @ unknown > 24


def test_what_contacts_do_not_tell_of_gains_is_known_as_stated() -> None:
    """Those of a long pad change currents as positions do."""
    model, distances, stds = Rectangle(3.0, 1.0), [], []
    for seed in range(20):
        log_gains = np.random.default_rng(seed).normal(0, 0.01, 4)
        log_gains -= log_gains.mean()
        read = contacts(model, 64, 1e-3, log_gains, seed)
        stated, unknown = plain(model, gain_std=0.01), plain(model)
        for estimator in (stated, unknown):
            estimator.add_contacts(read, 1e-3, 0)
        found = stated.estimate
        assert found.std < unknown.estimate.std
        stds.append(found.std)
        error = np.log(found.gains) - log_gains
        distances.append(error @ np.linalg.pinv(found.covariance, rcond=1e-6) @ error)
    assert 1.6 < np.mean(distances) < 5.0  # 99.8 % of means of 20 chi squared of three degrees of freedom
    assert np.median(stds) < 0.012


@pytest.mark.parametrize("wrong", [0.05, 0.1, 0.3])
def test_gains_beyond_what_is_stated_are_found(wrong: float) -> None:
    log_gains = wrong * np.array([0.75, -0.25, -0.25, -0.25])
    distances = []
    for seed in range(10):
        estimator = plain(gain_std=0.01, tolerance=0.2)
        estimator.add_contacts(contacts(SQUARE, 64, 1e-3, log_gains, seed), 1e-3, 0)
        found = estimator.estimate
        error = np.log(found.gains) - log_gains
        distances.append(error @ np.linalg.pinv(found.covariance, rcond=1e-6) @ error)
    assert np.mean(distances) < 6.0
    assert found.std < 0.01


def test_errors_of_each_touch_are_estimated_and_widen_the_covariance() -> None:
    """As of patches that aren't round: their scores are no outliers; gains stay within the covariance."""
    readings, rng = contacts(SQUARE, 256, 1e-4), np.random.default_rng(5)
    disturbed = readings + 1.5e-3 * readings.sum(axis=0) * rng.normal(size=readings.shape)
    found = {}
    for name, currents in (("points", readings), ("patches", disturbed)):
        estimator = plain()
        estimator.add_contacts(currents, 1e-4, 0)
        found[name] = estimator.estimate
        error = np.log(found[name].gains) - TRUTH
        assert error @ np.linalg.pinv(found[name].covariance, rcond=1e-6) @ error < 16
    assert found["points"].touch_error < 1e-4
    assert 0.8e-3 < found["patches"].touch_error <= MAX_TOUCH_ERROR
    assert found["patches"].point_fraction > 0.8


def test_invalid_calls_are_refused() -> None:
    estimator = plain()
    with pytest.raises(ValueError, match="shape"):
        estimator.add_contacts(np.ones((3, 5)), 1e-3, 0)
    estimator.add_contacts(np.ones(4), 1e-3, 10)
    with pytest.raises(ValueError, match="now_ns = 9"):
        estimator.add_contacts(np.ones(4), 1e-3, 9)


SIX = ElectrodeNetwork.from_arcs(1.4, 1.0, [[k * 0.8 + 0.05, k * 0.8 + 0.75] for k in range(6)], 1.0)


def test_gains_of_six_channels_match_their_covariance_and_the_fisher_bound() -> None:
    truth, distances, ratios = np.array([0.03, -0.01, -0.025, 0.005, 0.02, -0.02]), [], []
    for seed in range(12):
        estimator = plain(SIX, tolerance=0.3)
        estimator.add_contacts(contacts(SIX, BATCH_CONTACTS, 1e-3, truth, seed=seed), 1e-3, 0)
        found = estimator.estimate
        error = np.log(found.gains) - truth
        distances.append(error @ np.linalg.pinv(found.covariance) @ error)
        generator = np.random.default_rng(seed)
        x, y = generator.uniform(0.15, 0.85, (2, BATCH_CONTACTS)) * [[SIX.a], [SIX.b]]
        total = generator.uniform(0.5, 2.0, BATCH_CONTACTS)
        ratios.append(found.std**2 / np.diag(fisher_covariance(SIX, x, y, (1e-3 / total)[None])).max())
    assert 2.5 < np.mean(distances) < 8.3  # 99.8 % of means of 12 chi squared of five degrees of freedom
    assert 0.9 < np.mean(ratios) < 1.3


def test_three_channels_are_refused_as_contacts_leave_nothing_over() -> None:
    three = ElectrodeNetwork.from_arcs(1.0, 1.0, [[0.1, 1.2], [1.4, 2.5], [2.7, 3.9]], 1.0)
    estimator = plain(three)
    assert estimator.estimate.status == GainStatus.INVALID
    assert gain_deviation(three) == np.inf
    with pytest.raises(ValueError, match="gains of 3 channels"):
        estimator.add_contacts(contacts(three, 4, 1e-3, np.zeros(3)), 1e-3, 0)
