"""Scores of benchmarks: against known distributions, numerical integration and counting by hand."""

from __future__ import annotations

import itertools

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import ndtr
from scipy.stats import binom, binomtest, chi2, poisson

from benchmarks import scores

matplotlib.use("Agg")

FloatArray = NDArray[np.float64]


def forecaster(d: int, n: int, *, overconfidence: float = 1.0, seed: int = 1) -> scores.Estimates:
    """Normal errors of covariances that vary by row; stated ones are smaller by overconfidence squared."""
    generator = np.random.default_rng(seed)
    root = np.eye(d) + 0.5 * generator.uniform(-1, 1, (n, d, d))
    true = np.exp(generator.uniform(-3, 3, (n, 1, 1))) * root @ np.swapaxes(root, 1, 2)
    error = (np.linalg.cholesky(true) @ generator.normal(size=(n, d, 1)))[..., 0]
    return scores.Estimates(
        error,
        true / overconfidence**2,
        np.ones(n, np.bool_),
        np.sqrt(np.trace(true, axis1=1, axis2=2)),
        true,
        {"sheet": np.where(np.arange(n) % 2, "S1", "S2")},
    )


@pytest.mark.parametrize("d", [1, 2])
def test_a_calibrated_forecaster_is_covered_as_stated(d: int) -> None:
    score = scores.EstimateScore.of_estimates(forecaster(d, 4000))
    for level, share in score.coverage.items():
        assert binomtest(share.count, share.total, level).pvalue > 1e-3
    assert score.beyond_5_sigma.count == 0
    assert score.ratio_rms == pytest.approx(1, rel=0.05)
    assert score.median_std == pytest.approx(score.oracle_std)


@pytest.mark.parametrize("d", [1, 2])
def test_an_overconfident_forecaster_is_covered_less_by_the_expected_amount(d: int) -> None:
    factor = 3.0
    score = scores.EstimateScore.of_estimates(forecaster(d, 4000, overconfidence=factor))
    for level, share in score.coverage.items():
        expected = chi2.cdf(chi2.ppf(level, d) / factor**2, d)
        assert binomtest(share.count, share.total, expected).pvalue > 1e-3
    far = score.beyond_5_sigma
    assert binomtest(far.count, far.total, chi2.sf(25 / factor**2, d)).pvalue > 1e-3
    assert score.median_std == pytest.approx(score.oracle_std / factor)


@pytest.mark.parametrize("d", [1, 2])
def test_crps_is_least_for_the_calibrated_forecaster(d: int) -> None:
    honest, vain, timid = (
        scores.EstimateScore.of_estimates(forecaster(d, 4000, overconfidence=factor)).crps
        for factor in (1.0, 2.0, 0.5)
    )
    assert honest < vain
    assert honest < timid


@given(st.floats(-5, 5), st.floats(0.05, 20))
@settings(max_examples=25, deadline=None)
def test_crps_of_a_normal_is_the_integral_of_its_definition(error: float, std: float) -> None:
    below = quad(lambda t: ndtr((t - error) / std) ** 2, error - 12 * std - 12, 0)[0]
    above = quad(lambda t: ndtr((error - t) / std) ** 2, 0, error + 12 * std + 12)[0]
    assert float(scores.normal_crps(error, std)) == pytest.approx(below + above, rel=1e-6)


def test_crps_in_two_dimensions_is_the_energy_score_of_drawn_values() -> None:
    covariance = np.array([[2.0, 0.6], [0.6, 0.3]])
    error = np.array([[1.0, -0.4]])
    one = scores.Estimates(error, covariance[None], np.array([True]), np.ones(1), covariance[None])
    generator = np.random.default_rng(3)
    a, b = (generator.normal(size=(400_000, 2)) @ np.linalg.cholesky(covariance).T for _ in range(2))
    drawn = np.linalg.norm(a - error, axis=1).mean() - np.linalg.norm(a - b, axis=1).mean() / 2
    assert scores.mean_crps(one) == pytest.approx(drawn, rel=5e-3)


@given(st.integers(0, 60), st.integers(1, 60))
@settings(deadline=None)
def test_limits_of_a_share_leave_the_stated_tails(count: int, more: int) -> None:
    total = count + more
    low, high = scores.Share(count, total).interval
    assert binom.cdf(count, total, high) == pytest.approx(0.025)
    assert (count == 0 and low == 0) or binom.sf(count - 1, total, low) == pytest.approx(0.025)


@given(st.integers(0, 60), st.floats(0.1, 1000))
@settings(deadline=None)
def test_limits_of_a_rate_leave_the_stated_tails(count: int, hours: float) -> None:
    low, high = scores.Rate(count, hours).interval
    assert poisson.cdf(count, high * hours) == pytest.approx(0.025)
    assert (count == 0 and low == 0) or poisson.sf(count - 1, low * hours) == pytest.approx(0.025)


def test_estimates_that_are_not_valid_count_in_their_share_only() -> None:
    good = forecaster(2, 100)
    bad = scores.Estimates(
        np.full((50, 2), np.nan), np.full((50, 2, 2), np.nan), np.zeros(50, np.bool_),
        np.full(50, np.nan), np.full((50, 2, 2), np.nan), {"sheet": np.full(50, "S1")},
    )  # fmt: skip
    both = scores.EstimateScore.of_estimates(scores.concatenate([good, bad]))
    alone = scores.EstimateScore.of_estimates(good)
    assert (both.valid, alone.valid) == (scores.Share(100, 150), scores.Share(100, 100))
    assert both.coverage == alone.coverage
    assert both.crps == alone.crps


def test_no_valid_estimate_gives_no_figures_and_no_error() -> None:
    none = forecaster(2, 3).where(np.zeros(3, np.bool_))
    score = scores.EstimateScore.of_estimates(none)
    assert score.coverage[0.95] == scores.Share(0, 0)
    assert np.isnan([score.crps, score.ratio_rms, score.median_std]).all()
    assert str(score.row()["in 95 %"]) == "-"


def test_slices_share_all_rows_among_themselves() -> None:
    every = forecaster(1, 101)
    parts = dict(scores.slices(every, "sheet"))
    assert {name: len(part) for name, part in parts.items()} == {"S1": 50, "S2": 51}
    assert sum(np.abs(part.error).sum() for part in parts.values()) == pytest.approx(
        np.abs(every.error).sum()
    )
    with pytest.raises(KeyError):
        next(scores.slices(every, "force"))


def test_a_slice_of_few_touches_says_so() -> None:
    few, many = (scores.EstimateScore.of_estimates(forecaster(1, n)).row()["touches"] for n in (399, 400))
    assert "fewer" in few
    assert many == "400"


def test_bins_hold_their_lower_edge_and_sort_in_their_order() -> None:
    labels = scores.bin_labels([5.0, 0.1, 0.5, 2.0, 1.9], (0.5, 2.0, 5.0), "N")
    assert sorted(set(labels)) == ["1: below 0.5 N", "2: 0.5 to 2 N", "3: 2 to 5 N", "4: 5 and more N"]
    assert [int(label[0]) for label in labels] == [4, 1, 2, 3, 2]


def test_the_oracle_of_a_linear_model_is_the_posterior_that_draws_have() -> None:
    generator = np.random.default_rng(4)
    design, prior = generator.normal(size=(1, 5, 3)), np.array([np.inf, 0.3, 2.0])
    noise = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    stated = scores.laplace_covariance(design, noise, prior)[0]
    weights = np.diag(noise**-2)
    gain = stated @ design[0].T @ weights
    true = np.where(np.isinf(prior), 0, prior) * generator.normal(size=(200_000, 3))
    found = (true @ design[0].T + noise * generator.normal(size=(200_000, 5))) @ gain.T
    assert np.cov((found - true).T) == pytest.approx(stated, rel=0.05, abs=1e-3 * stated.max())


def test_events_are_matched_one_to_one_by_key_and_window() -> None:
    truth = [("thumb", 1.0), ("thumb", 5.0), ("palm", 1.0), ("palm", 9.0)]
    detected = [("thumb", 1.02), ("thumb", 1.05), ("palm", 3.0), ("palm", 9.2), ("index", 5.0)]
    score = scores.score_events(truth, detected, hours=0.5, late_s=0.3)
    assert score.recall == scores.Share(2, 4)
    assert score.precision == scores.Share(2, 4)
    assert (score.repeated, score.false_alarms.count) == (1, 2)
    assert score.false_alarms.per_hour == 4
    assert score.delays_s == pytest.approx([0.02, 0.2])


def test_a_detection_before_its_event_counts_only_within_the_early_window() -> None:
    late = scores.score_events([("a", 1.0)], [("a", 0.95)], hours=1, late_s=1)
    early = scores.score_events([("a", 1.0)], [("a", 0.95)], hours=1, early_s=0.1, late_s=1)
    assert (late.recall.count, late.false_alarms.count) == (0, 1)
    assert early.delays_s == pytest.approx([-0.05])


times = st.lists(st.integers(0, 30).map(float), max_size=5)


@given(times, times)
@settings(deadline=None, max_examples=200)
def test_as_many_events_are_matched_as_any_matching_can(truth: list[float], detected: list[float]) -> None:
    score = scores.score_events(
        [("a", t) for t in truth], [("a", t) for t in detected], hours=1, early_s=1, late_s=3
    )
    few, many = sorted((truth, detected), key=len)
    sign = 1 if few is truth else -1
    best = max(
        sum(-1 <= sign * (other - one) <= 3 for one, other in zip(few, chosen, strict=True))
        for chosen in itertools.permutations(many, len(few))
    )
    assert score.recall.count == best
    assert score.precision.count + score.repeated + score.false_alarms.count == len(detected)


@pytest.mark.parametrize(("count", "total"), [(-1, 3), (4, 3)])
def test_an_impossible_share_is_refused(count: int, total: int) -> None:
    with pytest.raises(ValueError, match="of 3"):
        scores.Share(count, total)


def test_estimates_refuse_shapes_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match=r"bound of shape \(2,\), not \(1,\)"):
        scores.Estimates(np.zeros((1, 2)), np.eye(2)[None], np.array([True]), np.ones(2), np.eye(2)[None])


def test_a_share_of_clusters_covers_the_truth_where_a_binomial_interval_does_not() -> None:
    rng, held = np.random.default_rng(3), [0, 0]
    cluster = np.repeat(np.arange(40), 20)
    for _ in range(300):
        hits = rng.random(800) < np.repeat(rng.beta(1, 1, 40), 20)  # half on average
        limits = scores.ClusterShare.of_mask(hits, cluster).interval, scores.Share.of_mask(hits).interval
        for number, (low, high) in enumerate(limits):
            held[number] += low <= 0.5 <= high
    assert held[0] > 0.9 * 300 > 0.75 * 300 > held[1]


def test_a_share_of_one_cluster_has_no_interval() -> None:
    with pytest.raises(ValueError, match="1 clusters"):
        scores.ClusterShare.of_mask(np.ones(3, np.bool_), np.zeros(3))
