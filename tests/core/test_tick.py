"""The tick: from counts to contacts of the whole hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.core.columns import TickResult
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.tick import TickProcessor
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
UP = np.zeros(3, dtype=np.uint8)
PLANE, ROUND, RESISTED = range(3)


class Driver:
    """Runs ticks of a hand with given counts."""

    def __init__(self, bench: Any) -> None:
        self.bench = bench
        self.slab = Slab(3)
        self.tick = TickProcessor(bench.model, PERIOD_NS)
        self.t_ns = 1_000_000_000
        self.cycle = Cycle(PERIOD_NS, 0.6)
        self.node_state = UP.copy()

    def step(self, counts: dict[int, Any], silent: tuple[int, ...] = ()) -> TickResult:
        """Run a cycle; `silent` pads send no sample."""
        self.t_ns += PERIOD_NS
        self.slab.begin_cycle(self.t_ns)
        self.cycle.begin_cycle(self.t_ns)
        for pad in range(3):
            if pad not in silent:
                data = np.asarray(counts.get(pad, np.zeros(4)), dtype="<i2").tobytes()
                self.slab.write_pdo(pad, data, self.t_ns + 1000)
        return run_tick(self.tick, self.slab, self.node_state, self.cycle)

    def state(self, pad: int) -> PadState:
        return PadState(int(self.tick.columns.state[pad]))


@pytest.fixture
def driver(bench: Any) -> Driver:
    return Driver(bench)


def test_a_contact_has_its_position_in_the_frame_of_its_link(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.7, 0.4, 1e-3)}
    driver.step(touch)
    result = driver.step(touch)
    assert result.began.tolist() == [PLANE]
    columns = driver.tick.columns
    # 0.7 of 30 mm is 6 mm beyond the middle, 0.4 of 24 mm is 2.4 mm short of it; the mount turns x into y
    np.testing.assert_allclose(columns.position_m[PLANE], [0.01 + 0.0024, 0.006, 0.005], atol=2e-5)
    np.testing.assert_allclose(columns.normal[PLANE], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(columns.pad_m[PLANE], [0.021, 0.0096], atol=2e-5)
    assert columns.force_n[PLANE] > driver.bench.model.touch.begin_threshold_n[PLANE]
    assert columns.force_std_n[PLANE] > 0
    assert abs(columns.residual[PLANE]) < 5 * columns.residual_std[PLANE]


@pytest.mark.parametrize("pad", [PLANE, ROUND, RESISTED])
@pytest.mark.parametrize("force_n", [0.2, 1.0, 3.0])
def test_force_follows_the_contact_law_with_and_without_resistors(
    driver: Driver, pad: int, force_n: float
) -> None:
    model = driver.bench.model
    current = model.centre_current(pad, force_n)
    touch = {pad: driver.bench.counts(pad, 0.5, 0.5, current)}
    driver.step(touch)
    driver.step(touch)
    # the harmonic mean of its probability
    assert driver.tick.columns.force_n[pad] == pytest.approx(force_n, rel=0.03)


def test_the_end_keeps_the_last_position(driver: Driver) -> None:
    touch = {ROUND: driver.bench.counts(ROUND, 0.3, 0.6, 1e-3)}
    for _ in range(3):
        driver.step(touch)
    position = driver.tick.columns.position_m[ROUND].copy()
    assert not len(driver.step({}).updated)
    result = driver.step({})
    assert result.ended.tolist() == [ROUND]
    np.testing.assert_array_equal(driver.tick.columns.position_m[ROUND], position)


def test_no_contact_stale_lost_and_faulted_are_distinct(driver: Driver) -> None:
    driver.step({})
    assert driver.state(PLANE) == PadState.CLEAR
    for _ in range(2):
        driver.step({}, silent=(PLANE,))
        assert driver.state(PLANE) == PadState.CLEAR  # may be late
    driver.step({}, silent=(PLANE,))
    assert driver.state(PLANE) == PadState.STALE
    driver.node_state[PLANE] = PadState.LOST
    driver.step({}, silent=(PLANE,))
    assert driver.state(PLANE) == PadState.LOST
    driver.node_state[PLANE] = PadState.CLEAR
    driver.step({PLANE: [32767, 5, 5, 5]})
    assert driver.state(PLANE) == PadState.FAULTED


@pytest.mark.parametrize("full", [32767, -32767, -32768])
def test_a_saturated_channel_is_a_fault_and_no_contact(driver: Driver, full: int) -> None:
    driver.step({PLANE: [full, 0, 1, 2]})
    for _ in range(4):
        result = driver.step({PLANE: [full, 3000, 3000, 3000]})
        assert not len(result.began)
    assert driver.state(PLANE) == PadState.FAULTED


def test_a_contact_ends_when_its_pad_is_faulted(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    driver.step(touch)
    assert driver.step({PLANE: [32767] * 4}).ended.tolist() == [PLANE]


@pytest.mark.parametrize("missing", [1, 3, 10])
def test_a_contact_survives_a_gap_of_ten_periods(driver: Driver, missing: int) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    driver.step(touch)
    position, contact_id = driver.tick.columns.position_m[PLANE].copy(), driver.tick.state.contact_id[PLANE]
    for number in range(missing):
        result = driver.step({}, silent=(PLANE,))
        assert (result.silent.tolist(), result.updated.tolist(), result.ended.tolist()) == ([PLANE], [], [])
        assert driver.state(PLANE) == (PadState.STALE if number >= 2 else PadState.TOUCHED)
        np.testing.assert_array_equal(driver.tick.columns.position_m[PLANE], position)
    result = driver.step(touch)
    assert (result.silent.tolist(), result.updated.tolist()) == ([], [PLANE])
    assert driver.tick.state.contact_id[PLANE] == contact_id


def test_a_contact_ends_with_the_eleventh_missing_sample(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    driver.step(touch)
    ended = [len(driver.step({}, silent=(PLANE,)).ended) for _ in range(12)]
    assert ended == [0] * 10 + [1, 0]


@pytest.mark.parametrize("returns", [True, False])
def test_a_pause_of_the_host_makes_no_pad_stale(driver: Driver, returns: bool) -> None:
    """In 0.6 s without SYNC no sample was due; a contact that is gone afterwards ends as any other."""
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    driver.step(touch)
    driver.t_ns += 600_000_000
    result = driver.step({}, silent=(PLANE, ROUND, RESISTED))  # this SYNC's answers are late
    assert not len(result.ended)
    assert [driver.state(pad) for pad in range(3)] == [PadState.TOUCHED, PadState.CLEAR, PadState.CLEAR]
    ended = [driver.step(touch if returns else {}).ended.tolist() for _ in range(2)]
    assert ended == [[], [] if returns else [PLANE]]


def test_samples_of_a_node_that_is_not_up_make_no_contact(driver: Driver) -> None:
    driver.node_state[PLANE] = PadState.STARTING
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    for _ in range(4):
        assert not len(driver.step(touch).began)
    assert driver.state(PLANE) == PadState.STARTING


def test_a_missing_sample_is_counted_and_its_contact_continues(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    driver.step(touch)
    result = driver.step(touch, silent=(PLANE,))
    assert not len(result.updated)
    assert not len(result.ended)
    assert driver.tick.state.missed_sample_counts.tolist() == [1, 0, 0]
    assert driver.step(touch).updated.tolist() == [PLANE]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(-32768, 32767), min_size=12, max_size=12), min_size=3, max_size=6))
def test_no_reading_is_fatal_or_affects_another_pad(bench: Any, readings: list[list[int]]) -> None:
    driver = Driver(bench)
    good = bench.counts(ROUND, 0.4, 0.4, 1e-3)
    for reading in readings:
        counts = np.reshape(reading, (3, 4)).astype(np.int16)
        counts[ROUND] = good
        driver.step(dict(enumerate(counts)))
    reference = Driver(bench)
    for _ in readings:
        reference.step({ROUND: good})
    np.testing.assert_allclose(
        driver.tick.columns.position_m[ROUND], reference.tick.columns.position_m[ROUND], atol=1e-9
    )
    assert driver.state(ROUND) == PadState.TOUCHED


def test_a_pad_with_late_samples_is_neither_stale_nor_ignored(driver: Driver) -> None:
    touch = driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)
    for _ in range(5):
        result = driver.step({}, silent=(PLANE,))
        sync_ns = driver.t_ns
        driver.slab.write_pdo(PLANE, touch.tobytes(), driver.t_ns + 4_000_000)  # after the tick
    assert driver.state(PLANE) == PadState.TOUCHED
    assert result.updated.tolist() == [PLANE]
    assert driver.tick.columns.sample_ns[PLANE] == sync_ns - PERIOD_NS
    assert driver.tick.state.missed_sample_counts[PLANE] >= 3


def test_a_sample_is_used_once(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    assert not len(driver.step({}, silent=(PLANE,)).began)  # one sample is not two in a row


def test_a_contact_begins_at_the_sync_of_its_late_sample(driver: Driver) -> None:
    touch = driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)
    driver.step({}, silent=(PLANE,))
    first_ns = driver.t_ns
    driver.slab.write_pdo(PLANE, touch.tobytes(), driver.t_ns + 4_000_000)  # after the tick
    driver.step({PLANE: touch}, silent=(PLANE,))
    assert driver.step({PLANE: touch}).began.tolist() == [PLANE]
    assert driver.tick.state.begin_ns[PLANE] == first_ns


def test_a_channel_that_sources_current_is_a_fault_and_no_contact(driver: Driver) -> None:
    for _ in range(4):
        assert not len(driver.step({PLANE: [20000, -15000, 20000, 1000]}).began)
    assert driver.state(PLANE) == PadState.FAULTED
    driver.step({PLANE: [-8, 5, -3, 2]})  # noise about zero
    assert driver.state(PLANE) == PadState.CLEAR


def test_a_start_during_a_light_touch_causes_no_fault_after_it(driver: Driver) -> None:
    touch = driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)
    light = driver.bench.counts(PLANE, 0.2, 0.5, 0.8 * driver.bench.model.begin_threshold_a[PLANE])
    for _ in range(60):
        assert not len(driver.step({PLANE: light}).began)
        driver.tick.prepare_next_tick()
    for _ in range(60):
        driver.step({})
        assert driver.state(PLANE) == PadState.CLEAR
        driver.tick.prepare_next_tick()
    assert abs(driver.tick.baseline.expected_counts[PLANE]).sum() < 1
    driver.step({PLANE: touch})
    assert driver.step({PLANE: touch}).began.tolist() == [PLANE]


def test_samples_received_in_one_batch_with_their_sync_belong_to_it(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    sync_ns = driver.t_ns + PERIOD_NS
    driver.slab.write_pdo(PLANE, touch[PLANE].tobytes(), sync_ns + 500)  # read before its SYNC was processed
    driver.slab.begin_cycle(sync_ns)
    assert driver.slab.fresh.tolist() == [1, 0, 0]
    driver.cycle.begin_cycle(sync_ns)
    run_tick(driver.tick, driver.slab, driver.node_state, driver.cycle)
    assert driver.tick.columns.sample_ns[PLANE] == sync_ns


def test_a_late_tick_ignores_samples_of_the_next_cycle(driver: Driver) -> None:
    touch = {PLANE: driver.bench.counts(PLANE, 0.5, 0.5, 1e-3)}
    driver.step(touch)
    before_ns = driver.t_ns
    next_ns = before_ns + 2 * PERIOD_NS
    driver.slab.write_pdo(PLANE, touch[PLANE].tobytes(), next_ns + 500)
    run_tick(driver.tick, driver.slab, driver.node_state, driver.cycle, until_ns=next_ns)
    assert driver.tick.columns.sample_ns[PLANE] == before_ns
    driver.slab.begin_cycle(next_ns)
    driver.cycle.begin_cycle(next_ns)
    assert run_tick(driver.tick, driver.slab, driver.node_state, driver.cycle).began.tolist() == [PLANE]
    assert driver.tick.columns.sample_ns[PLANE] == next_ns


def test_positions_are_as_uncertain_as_the_measured_noise_makes_them(driver: Driver) -> None:
    """Of channels with five times the noise that the deployment states."""
    rng, bench, noise = np.random.default_rng(3), driver.bench, 5.0
    for _ in range(36_000):  # three time constants of the estimate of the noise
        driver.step({PLANE: np.rint(rng.normal(0, noise, 4))})
        driver.tick.prepare_next_tick()
    touch, inside = bench.counts(PLANE, 0.6, 0.4, 3e-4), []
    for _ in range(400):
        driver.step({PLANE: np.rint(touch + rng.normal(0, noise, 4))})
        columns = driver.tick.columns
        if columns.state[PLANE] == PadState.TOUCHED:
            error = columns.pad_m[PLANE] - [0.6 * 0.030, 0.4 * 0.024]
            variance = np.diag(columns.covariance_m2[PLANE])
            inside.append(np.square(error).sum() < 3.0 * variance.sum())
    assert len(inside) > 390
    assert np.mean(inside) > 0.9
