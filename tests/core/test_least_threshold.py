"""Least thresholds: one false contact in 100 hours by the noise, hum and drift of an untouched pad."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import norm

from handtouch.core.least_threshold import (
    FALSE_CONTACT_PERIOD_S,
    begin_samples,
    least_begin_counts,
    level_scatter,
)
from handtouch.supervisor.level_scatter import LevelScatter
from tests.core.test_contacts import BEGIN, Detector

RATE_HZ = 200.0
PERIOD_NS = round(1e9 / RATE_HZ)
FloatArray = np.ndarray


def played(levels: FloatArray, touched: FloatArray | None = None, block: int = 20) -> LevelScatter:
    """Return the scatter of a pad that begins contacts after two samples, by blocks of so many ticks."""
    scatter = LevelScatter([1e-6 * PERIOD_NS])
    held = np.zeros(len(levels), bool) if touched is None else touched
    times = (1 + np.arange(len(levels))) * PERIOD_NS
    for first, end in pairwise(range(0, len(levels) + 1, block)):
        part = slice(first, end)
        scatter.add_block(times[part], levels[part, None], ~held[part, None], held[part, None])
    return scatter


@pytest.mark.parametrize(("begin", "period_ns"), [(1, 10), (2, 10), (2, 20), (3, 13), (5, 10), (2, 2)])
def test_as_many_samples_begin_a_contact_as_the_least_threshold_assumes(begin: int, period_ns: int) -> None:
    detector = Detector(begin=begin, period_ns=period_ns)
    samples = 1
    while not len(detector.step(BEGIN + 1).began):
        samples += 1
    assert samples == begin_samples(1e-5 * (begin - 1), period_ns)


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_white_noise_begins_at_most_one_contact_in_100_hours(samples: int) -> None:
    threshold = least_begin_counts(2.0 / np.sqrt(samples), RATE_HZ)
    runs = norm.sf(threshold / 2.0) ** samples * RATE_HZ * FALSE_CONTACT_PERIOD_S
    assert runs <= 1.0 + 1e-9
    if samples <= 2:  # and hardly less can be said of more: their mean is a sum of all
        assert runs > 0.02


def test_hum_and_noise_in_common_raise_the_scatter_as_they_raise_the_mean_of_samples() -> None:
    rng, t = np.random.default_rng(3), np.arange(60_000) / RATE_HZ
    levels = rng.normal(0, 2, len(t)) + 3 * np.sin(2 * np.pi * 49.97 * t) + 0.7
    expected = np.sqrt(2**2 / 2 + (3 * np.cos(np.pi * 49.97 / RATE_HZ)) ** 2 / 2 + 0.7**2)
    assert played(levels).counts[0] == pytest.approx(expected, rel=0.02)
    about_mean = np.sqrt(expected**2 - 0.7**2)
    assert level_scatter(levels, 2) == pytest.approx(about_mean, rel=0.02)


@pytest.mark.parametrize("block", [2, 7, 50])
def test_the_scatter_is_the_same_whatever_the_blocks(block: int) -> None:
    levels = np.random.default_rng(4).normal(0, 2, 30_100)
    levels[:] = levels - levels.mean()
    assert played(levels, block=block).counts[0] == pytest.approx(level_scatter(levels, 2), rel=0.01)


def test_nothing_is_known_of_less_than_a_minute_without_a_touch() -> None:
    levels = np.random.default_rng(5).normal(0, 2, 16_000)
    assert np.isnan(played(levels[:11_000]).counts[0])
    assert np.isfinite(played(levels[:13_000]).counts[0])
    held = np.zeros(len(levels), bool)
    held[::1000] = True  # every five seconds
    assert np.isnan(played(levels, held).counts[0])


def test_a_contact_and_ten_seconds_after_it_are_no_noise() -> None:
    levels = np.random.default_rng(6).normal(0, 2, 40_000)
    alone = played(levels).counts[0]
    held = np.zeros(len(levels), bool)
    held[20_000:20_400] = True
    levels[20_000:22_000] += 40.0  # and what a sheet returns late
    assert played(levels, held).counts[0] == pytest.approx(alone, rel=0.05)


def test_a_scatter_that_has_gone_is_forgotten_within_hours() -> None:
    levels = np.random.default_rng(7).normal(0, 1, 4 * 36_000)
    levels[: 2 * 36_000] *= 3
    scatter = LevelScatter([0])
    for first, end in pairwise(range(0, len(levels) + 1, 50)):
        times = (1 + np.arange(first, end)) * 10**8  # 10 Hz
        none = np.zeros((50, 1), bool)
        scatter.add_block(times, levels[first:end, None], ~none, none)
    assert 1.0 < scatter.counts[0] < 2.0
    scatter.forget(0)
    assert np.isnan(scatter.counts[0])
