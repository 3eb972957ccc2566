"""Baselines: tracking, maximum rate, hold in contact, common drift, gravity."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.core.baseline import Baseline, BaselineSettings
from handtouch.core.state import TickState

FloatArray = NDArray[np.float64]
BEGIN, END, SLOW_S = 80.0, 40.0, 20.0
BOUND = END / SLOW_S  # counts a second, of the sum of four
SECOND_NS = 10**9


class Rig:
    """A hand of n pads; readings are given as counts (n, 4) or one number for every channel."""

    def __init__(self, pads: int = 4, period_ns: int = 5_000_000, noise: float = 0.0) -> None:
        full = np.full(pads, 1.0)
        self.state = TickState.empty(pads)
        settings = BaselineSettings(full, BEGIN * full, END * full, SLOW_S * full)
        self.baseline = Baseline(settings, [slice(0, pads)], self.state)
        self.pads, self.period_ns, self.noise = pads, period_ns, noise
        self.t_ns = SECOND_NS
        self.touching = np.zeros(pads, np.bool_)
        self._rng = np.random.default_rng(1)
        self.baseline.update_baseline(self.t_ns, self.touching)

    def run(self, seconds: float, reads: Callable[[float], object], sampled: float = 1.0) -> None:
        """Read `reads(t)` for some time; each pad has a sample with the probability `sampled`."""
        start_ns = self.t_ns
        while self.t_ns < start_ns + seconds * 1e9 - 1:
            self.t_ns += self.period_ns
            counts = np.broadcast_to(np.asarray(reads((self.t_ns - start_ns) * 1e-9)), (self.pads, 4))
            if self.noise:
                counts = counts + self._rng.normal(0, self.noise, (self.pads, 4))
            excess = counts - self.baseline.expected_counts
            total = excess.sum(axis=1)
            began = ~self.touching & (total > BEGIN)
            self.touching = np.where(self.touching, total >= END, total > BEGIN)
            self.state.held[began] = True
            for block in (self.state.block_sum, self.state.block_squares, self.state.block_count):
                block[began] = 0.0
            free = ~self.touching & (total <= BEGIN)
            if sampled < 1:
                free &= self._rng.random(self.pads) < sampled
            self.state.block_sum[free] += excess[free]
            self.state.block_squares[free] += np.square(excess[free])
            self.state.block_count[free] += 1
            self.baseline.update_baseline(self.t_ns, self.touching)

    def total(self, pad: int = 0) -> float:
        return float(self.baseline.expected_counts[pad].sum())


def only(pad: int, channel_counts: float, others: float = 0.0, pads: int = 4) -> FloatArray:
    counts = np.full((pads, 4), others)
    counts[pad] = channel_counts
    return counts


def test_the_first_block_becomes_the_baseline_of_untouched_pads() -> None:
    rig = Rig(noise=1.0)
    rig.run(0.5, lambda _: 15.0)
    assert rig.baseline.expected_counts == pytest.approx(15.0, abs=1.0)
    assert not rig.baseline.unverified.any()


def test_the_baseline_of_a_touched_pad_is_held_for_an_hour() -> None:
    rig = Rig(period_ns=500_000_000)
    rig.run(2.0, lambda _: 3.0)
    held = only(0, 300.0, others=3.0)
    rig.run(3600.0, lambda _: held)
    assert rig.touching[0]
    assert rig.baseline.expected_counts[0] == pytest.approx(3.0, abs=1e-6)


def test_the_noise_of_untouched_pads_moves_no_touched_one() -> None:
    rig = Rig(pads=11, period_ns=100_000_000, noise=1.0)
    rig.run(60.0, lambda _: 0.0)
    before = rig.baseline.expected_counts[0].copy()
    rig.run(1200.0, lambda _: only(0, 300.0, pads=11))
    assert rig.touching[0]
    assert np.abs(rig.baseline.expected_counts[0] - before).max() < 0.8  # a median's walk: 0.2 (1 sigma)


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.3, 2.0), st.floats(-1.0, 12.0)), min_size=1, max_size=5),
    st.sampled_from([2_000_000, 4_000_000, 10_000_000]),
    st.floats(0.2, 1.0),
)
def test_tick_rate_and_missing_samples_make_no_difference(
    levels: list[tuple[float, float]], period_ns: int, sampled: float
) -> None:
    ends = np.cumsum([duration for duration, _ in levels])

    def reads(t_s: float) -> float:
        return levels[min(int(np.searchsorted(ends, t_s)), len(levels) - 1)][1]

    frequent, rare = Rig(period_ns=2_000_000), Rig(period_ns=period_ns)
    for rig in (frequent, rare):
        rig.run(1.0, lambda _: 0.0)
    frequent.run(float(ends[-1]), reads)
    rare.run(float(ends[-1]), reads, sampled)
    # levels change inside of a block: each may differ by one block's change
    falls = sum(max(before - after, 0.0) for (_, before), (_, after) in pairwise([(0, 0.0), *levels]))
    slack = 0.2 * (BOUND * (len(levels) + 1) + 4 * falls / 2.0)  # falls are tracked within two seconds
    assert np.abs(frequent.baseline.expected_counts - rare.baseline.expected_counts).sum(axis=1).max() < slack


def test_a_step_is_tracked_at_the_maximum_rate() -> None:
    for period_ns in (2_000_000, 20_000_000, 500_000_000):
        rig = Rig(period_ns=period_ns)
        rig.run(2.0, lambda _: only(0, 0.0))
        rig.run(10.0, lambda _: only(0, 15.0))  # 60 counts: 20 more than bound * time constant
        assert rig.total() == pytest.approx(10 * BOUND, abs=0.6 * BOUND)
        rig.run(40.0, lambda _: only(0, 15.0))
        remaining = 60 - rig.total()
        assert remaining == pytest.approx(20 * np.exp(-(50 - 20) / 10), rel=0.25)


@pytest.mark.parametrize(("speed", "touched"), [(0.5, False), (0.9, False), (1.3, True), (3.0, True)])
def test_a_rise_slower_than_the_maximum_rate_is_drift_and_a_faster_one_a_contact(
    speed: float, touched: bool
) -> None:
    rig = Rig(period_ns=100_000_000)
    rig.run(1.0, lambda _: 0.0)
    rig.run(300.0, lambda t: only(0, speed * BOUND * t / 4))
    assert bool(rig.touching[0]) == touched


def test_common_drift_is_applied_to_touched_pads() -> None:
    rig = Rig(pads=5, period_ns=40_000_000, noise=0.5)
    rig.run(2.0, lambda _: 0.0)
    rig.run(300.0, lambda t: only(0, 300.0 + 0.02 * t, others=0.02 * t, pads=5))
    assert rig.touching[0]
    assert rig.baseline.expected_counts[0] == pytest.approx(6.0, abs=0.5)
    few = Rig(pads=2, period_ns=20_000_000)
    few.run(2.0, lambda _: 0.0)
    few.run(60.0, lambda t: only(0, 300.0, others=0.1 * t, pads=2))
    assert few.baseline.expected_counts[0] == pytest.approx(0.0)  # one pad's drift isn't common


def test_pads_that_a_light_contact_may_load_are_no_common_drift() -> None:
    rig = Rig(pads=5, noise=1.0)
    rig.run(2.0, lambda _: 0.0)
    held = np.array([[300.0] * 4] + [[10.0, 3.0, 2.0, 1.0]] * 4)
    rig.run(18.0, lambda _: held)
    assert rig.total(0) == pytest.approx(0.0, abs=1.5)
    assert rig.total(1) > 5.0  # theirs follow, as no contact has begun


def test_one_odd_pad_does_not_move_the_common_drift() -> None:
    rig = Rig(pads=4)
    rig.run(2.0, lambda _: 0.0)
    start = only(0, 300.0)
    rig.run(60.0, lambda t: start + t * np.array([[0.05] * 4, [0.05] * 4, [0.05] * 4, [-0.2] * 4]))
    assert rig.total(0) == pytest.approx(4 * 0.05 * (60 - 10), rel=0.15)


def test_drift_that_all_pads_share_is_no_speed_of_their_own() -> None:
    speeds = {}
    for others in (0.05, 0.0):
        rig = Rig(pads=5, period_ns=40_000_000)
        rig.run(300.0, lambda t, others=others: only(0, 0.05 * t, others=others * t, pads=5))  # type: ignore[misc]
        speeds[others] = float(rig.baseline.drift_speed[0])
    assert speeds[0.0] > 0.1  # 0.2 counts a second of its own, half learned after five measurements
    assert speeds[0.05] < 0.03


def test_a_released_pad_is_held_until_it_is_nearly_back() -> None:
    rig = Rig(period_ns=20_000_000)
    rig.run(2.0, lambda _: 0.0)
    rig.run(5.0, lambda _: only(0, 100.0))
    rig.run(60.0, lambda _: only(0, 9.0))  # 36 counts remain: below END, above half of it
    assert not rig.touching[0]
    assert rig.baseline.held[0]
    assert rig.total() == pytest.approx(0.0)
    rig.run(5.0, lambda _: only(0, 2.0))
    assert not rig.baseline.held[0]
    assert rig.total() > 1.0


def test_leakage_after_a_release_neither_begins_a_contact_nor_becomes_baseline() -> None:
    rig = Rig(period_ns=20_000_000, noise=0.5)
    rig.run(2.0, lambda _: 0.0)
    rig.run(5.0, lambda _: only(0, 100.0))
    rig.run(120.0, lambda t: only(0, 9.0 + 0.4 * np.sin(t)))
    assert not rig.touching[0]
    assert abs(rig.total()) < 1.0


def test_a_stored_baseline_survives_a_start_while_touched() -> None:
    rig = Rig()
    rig.baseline.set_offset(0, [5.0] * 4, [0.5] * 4)
    rig.run(5.0, lambda _: only(0, 60.0))
    assert rig.touching[0]
    assert rig.baseline.known[0]
    assert rig.baseline.expected_counts[0] == pytest.approx(5.0)


def test_the_stored_variance_decides_whether_a_first_reading_is_drift() -> None:
    for std, touched in ((20.0, False), (1.0, True)):
        rig = Rig()
        rig.baseline.set_offset(0, [0.0] * 4, [std] * 4)
        rig.touching[0] = touched
        rig.baseline.touching[0] = touched
        rig.run(1.0, lambda _: only(0, 19.0))  # 76 counts, just below a contact
        near = rig.total() > 70
        assert near != touched


def test_without_a_stored_baseline_a_pad_touched_at_the_start_is_unknown_until_released() -> None:
    rig = Rig()
    rig.run(2.0, lambda _: only(1, 60.0, others=4.0))
    assert rig.baseline.known.tolist() == [True, False, True, True]
    rig.run(1.0, lambda _: 4.0)
    rig.run(1.0, lambda _: only(1, 60.0, others=4.0))
    assert rig.baseline.known.all()
    assert rig.baseline.expected_counts[1] == pytest.approx(4.0, abs=0.3)


def test_noise_is_estimated_per_channel_with_any_drift() -> None:
    rig = Rig(period_ns=20_000_000)
    true, rng = np.array([0.5, 1.0, 2.0, 4.0]), np.random.default_rng(2)
    rig.run(200.0, lambda t: 0.05 * t + true * rng.normal(size=(4, 4)))
    assert rig.baseline.noise_counts == pytest.approx(np.tile(true, (4, 1)), rel=0.15)


def test_gravity_is_distinguished_from_an_offset_and_compensated() -> None:
    rig, rng = Rig(period_ns=100_000_000, noise=0.5), np.random.default_rng(3)
    by_gravity = rng.normal(0, 4.0, (4, 4, 3))
    directions = rng.normal(0, 1, (4, 3))

    def gravity(t_s: float) -> FloatArray:
        direction = directions + 2 * np.sin(t_s * np.array([0.9, 0.6, 1.3]))
        return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))

    def reads(t_s: float) -> FloatArray:
        rig.baseline.set_felt_gravity(gravity(t_s))
        return np.asarray(7.0 + (by_gravity @ gravity(t_s)[:, :, None])[:, :, 0])

    rig.run(400.0, reads)
    off = []
    for _ in range(20):
        rig.run(1.0, reads)
        off.append(reads(1.0) - rig.baseline.expected_counts)
    assert np.sqrt(np.mean(np.square(off))) < 0.15 * np.sqrt(np.mean(np.square(by_gravity)))


def test_the_standard_deviation_covers_the_error_of_a_held_baseline() -> None:
    """200 pads with independent drift, touched for half an hour."""
    pads, rng = 200, np.random.default_rng(4)
    speed = rng.normal(0, 0.01, (pads, 4))  # counts a second, independent
    rig = Rig(pads=pads, period_ns=500_000_000)
    rig.run(900.0, lambda t: speed * t)
    rig.run(1800.0, lambda t: speed * (900 + t) + 300.0 * (np.arange(pads) >= 20)[:, None])
    touched = np.arange(pads) >= 20
    off = (rig.baseline.expected_counts - speed * 2700).sum(axis=1)[touched]
    within = np.abs(off) < 2 * rig.baseline.std[touched]
    assert within.mean() > 0.9
    assert np.median(rig.baseline.std[touched]) < 4 * np.std(off)


@pytest.mark.parametrize("sampled", [1.0, 0.3])
def test_a_baseline_learned_during_a_light_touch_is_learned_again_after_it(sampled: float) -> None:
    rig = Rig()
    light = 0.9 * BEGIN / 4
    rig.run(1.0, lambda _: only(0, light))
    assert rig.total() == pytest.approx(0.9 * BEGIN, rel=0.05)  # indistinguishable from an offset
    rig.run(1.0, lambda _: only(0, 300.0))
    rig.run(0.3, lambda _: 0.0, sampled)
    assert rig.total() == pytest.approx(0.0, abs=0.5)
    assert not rig.baseline.held[0]
    rig.run(1.0, lambda _: only(0, 0.7 * BEGIN / 2))
    assert rig.touching[0]


def test_readings_far_below_the_baseline_move_it_no_faster_than_drift() -> None:
    rig = Rig()
    rig.run(2.0, lambda _: 0.0)
    rig.run(1.0, lambda _: -1.1 * BEGIN / 4)
    assert rig.total() == pytest.approx(-BOUND, rel=0.15)
