"""What a room does to untouched pads: hum, warmth, unknown zeros; and that light touches are still felt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.core.pipeline import Pipeline
from handtouch.wire import ForceStatus, PadState

FloatArray = NDArray[np.float64]


class Room:
    """A hand with a count of noise on each channel; `states` (k, n): those of the pads in each tick."""

    def __init__(self, bench: Any, rate_hz: float = 200.0, noise: float = 1.0) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.pipeline = Pipeline(bench.model, self.period_ns, 0.6, self)
        self.pipeline.node_state[:] = 0
        self.pads, self.states = bench.model.size, list[NDArray[np.uint8]]()
        self._rng, self._noise, self._t_ns = np.random.default_rng(4), noise, 10**9

    def has_subscriber(self, _: str) -> bool:
        return False

    def send(self, _: object) -> None:
        raise AssertionError("no subscriber")

    def run(self, seconds: float, reads: Callable[[float], FloatArray]) -> NDArray[np.uint8]:
        """Read `reads(t)` (n, 4) or what is broadcast to it for some time; return the states (k, n)."""
        states, begin_ns = [], self._t_ns
        while self._t_ns < begin_ns + seconds * 1e9:
            self._t_ns += self.period_ns
            noise = self._rng.normal(0, self._noise, (self.pads, 4))
            counts = np.rint(reads((self._t_ns - begin_ns) * 1e-9) + noise).astype("<i2")
            self.pipeline.begin_cycle(self._t_ns, self._t_ns)
            for pad in range(self.pads):
                self.pipeline.slab.write_pdo(pad, counts[pad].tobytes(), self._t_ns + 1000)
            assert self.pipeline.tick_if_due(self._t_ns + self.period_ns - 1)
            states.append(self.pipeline.state.pad_state.copy())
        return np.array(states)

    @property
    def contacts(self) -> int:
        return self.pipeline.tick.contacts.begun_count

    @property
    def threshold_factor(self) -> FloatArray:
        return self.pipeline.tick.baseline.threshold_factor


def hum(amplitude: float, frequency_hz: float = 49.97) -> Callable[[float], FloatArray]:
    """Return a hum of all channels, another phase on each pad."""
    phase = np.array([[0.0], [1.0], [2.5]])
    return lambda t_s: amplitude * np.sin(2 * np.pi * frequency_hz * t_s + phase)


def steady(counts: float) -> Callable[[float], FloatArray]:
    return lambda _: np.full((1, 4), counts)


def touch(bench: Any, factor: float) -> FloatArray:
    """Return the counts (n, 4) of a contact on the first pad with so many times the begin threshold."""
    counts = np.zeros((bench.model.size, 4))
    counts[0] = bench.counts(0, 0.4, 0.6, factor * float(bench.model.begin_threshold_a[0]))
    return counts


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 1000.0])
def test_hum_raises_thresholds_within_half_a_second_and_then_begins_no_contact(
    bench: Any, rate_hz: float
) -> None:
    room = Room(bench, rate_hz)
    room.run(1.0, steady(0.0))
    room.run(0.5, hum(60.0))
    before = room.contacts
    states = room.run(5.0, hum(60.0))
    assert room.contacts == before
    assert (states[len(states) // 5 :] == PadState.CLEAR).all()
    assert room.threshold_factor.min() > 1.5


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_noise_up_to_three_times_the_stated_raises_no_threshold(bench: Any, noise: float) -> None:
    room = Room(bench, noise=noise)
    room.run(5.0, steady(0.0))
    assert room.threshold_factor.max() == 1.0


def test_a_touch_in_hum_is_felt_where_it_exceeds_the_hum(bench: Any) -> None:
    room, heavy = Room(bench), touch(bench, 10.0)
    room.run(1.0, steady(0.0))
    noise = hum(40.0)
    room.run(2.0, noise)
    before = room.contacts
    states = room.run(2.0, lambda t_s: noise(t_s) + heavy)
    assert (states[5:, 0] == PadState.TOUCHED).all()
    room.run(2.0, noise)
    assert room.contacts == before + 1


def test_thresholds_return_minutes_after_the_hum_is_gone(bench: Any) -> None:
    room = Room(bench, 100.0)
    room.run(1.0, steady(0.0))
    room.run(2.0, hum(40.0, 60.0))
    assert room.threshold_factor.min() > 1.2
    room.run(200.0, steady(0.0))
    assert room.threshold_factor.max() == 1.0


@pytest.mark.parametrize("repeats_hz", [2.0, 8.0, 14.0])
def test_taps_and_tremor_raise_no_threshold(bench: Any, repeats_hz: float) -> None:
    room, light = Room(bench), touch(bench, 3.0)
    room.run(1.0, steady(0.0))
    room.run(5.0, lambda t_s: light * (np.sin(2 * np.pi * repeats_hz * t_s) > 0))
    room.run(5.0, lambda t_s: light * (1 + 0.3 * np.sin(2 * np.pi * repeats_hz * t_s)))
    assert room.threshold_factor.max() == 1.0
    assert room.contacts > 5 * repeats_hz - 1


@pytest.mark.parametrize("signs", [(1, 1, -1, 1), (-1, -1, -1, -1), (1, -1, 1, -1)])
def test_a_pad_that_warms_up_by_ten_kelvin_in_two_minutes_is_clear(bench: Any, signs: Any) -> None:
    room = Room(bench, 50.0)
    room.run(2.0, steady(0.0))
    drift = 5.0 * 10.0 * np.array([signs], np.float64)
    states = room.run(130.0, lambda t_s: drift * min(t_s / 120.0, 1.0))
    assert (states == PadState.CLEAR).all()


@pytest.mark.parametrize("drift", [(-40.0, 30.0, -25.0, 20.0), (-8.0, -60.0, -8.0, -30.0)])
def test_zeros_that_moved_while_a_pad_was_touched_are_learned_when_it_is_released(
    bench: Any, drift: tuple[float, ...]
) -> None:
    room, firm = Room(bench, 50.0), touch(bench, 40.0)
    room.run(2.0, steady(0.0))
    moved = np.zeros((bench.model.size, 4))
    moved[0] = drift
    held = room.run(60.0, lambda t_s: firm + moved * t_s / 60.0)
    released = room.run(3.0, lambda _: moved)
    assert (held[5:, 0] == PadState.TOUCHED).all()
    assert (released[5:, 0] == PadState.CLEAR).all()
    assert room.contacts == 1
    again = room.run(0.5, lambda _: moved + touch(bench, 1.5))
    assert (again[5:, 0] == PadState.TOUCHED).all()
    assert room.pipeline.tick.baseline.expected_counts[0] == pytest.approx(drift, abs=2.0)


def test_what_drift_left_of_a_contact_ends_when_it_lies_still(bench: Any) -> None:
    room, firm, left = Room(bench, 50.0), touch(bench, 40.0), touch(bench, 0.8)
    room.run(2.0, steady(0.0))
    room.run(60.0, lambda t_s: firm + left * t_s / 60.0)
    states = room.run(15.0, lambda _: left)
    assert (states[-50:, 0] == PadState.CLEAR).all()
    assert room.contacts == 1


@pytest.mark.parametrize(
    ("firmer", "held_s", "trembles"), [(40.0, 60.0, 0.2), (40.0, 5.0, 0.0), (5.0, 60.0, 0.0)]
)
def test_a_light_contact_lasts_that_moves_came_soon_or_was_never_much_firmer(
    bench: Any, firmer: float, held_s: float, trembles: float
) -> None:
    room, light = Room(bench, 50.0), touch(bench, 1.2)
    room.run(2.0, steady(0.0))
    room.run(held_s, lambda _: firmer * light)
    states = room.run(15.0, lambda t_s: light * (1 + trembles * np.sin(2 * np.pi * 3 * t_s)))
    assert (states[:, 0] == PadState.TOUCHED).all()


def test_a_step_below_the_baseline_is_a_fault_not_drift(bench: Any) -> None:
    room = Room(bench)
    room.run(2.0, steady(0.0))
    states = room.run(1.0, lambda _: np.array([[60.0, -60.0, 0.0, 0.0]]))
    assert (states[5:] == PadState.FAULTED).all()


@pytest.mark.parametrize("size", [20.0, 40.0, 80.0, 400.0])
def test_zeros_that_no_contact_could_cause_are_learned_at_the_first_start(bench: Any, size: float) -> None:
    room, zeros = Room(bench), size * np.array([[1.0, -0.7, 0.4, 0.2], [-1, -1, -1, -1], [0.1, -1, 0, 0.9]])
    states = room.run(1.0, lambda _: zeros)
    assert set(np.unique(states[:30])) <= {PadState.STARTING, PadState.CLEAR}
    assert (states[60:] == PadState.CLEAR).all()
    assert room.contacts == 0
    light = touch(bench, 1.5)
    states = room.run(0.5, lambda _: zeros + light)
    assert (states[5:, 0] == PadState.TOUCHED).all()


def test_zeros_beyond_two_percent_of_the_range_are_a_fault(bench: Any) -> None:
    room = Room(bench)
    states = room.run(0.5, lambda _: np.array([[0.0, -700.0, 100.0, 0.0]]))
    assert (states == PadState.FAULTED).all()


def test_zeros_that_a_contact_could_cause_are_a_contact_whose_force_is_unreliable(bench: Any) -> None:
    room, zeros = Room(bench), touch(bench, 2.0)
    states = room.run(1.0, lambda _: zeros)
    assert (states[5:, 0] == PadState.TOUCHED).all()
    assert room.pipeline.tick.columns.force_status[0] == ForceStatus.UNRELIABLE


def test_a_pad_that_is_moved_at_the_first_start_learns_no_zeros(bench: Any) -> None:
    room = Room(bench)
    held = np.array([[60.0, -60.0, 0.0, 0.0]])
    states = room.run(1.0, lambda t_s: held * (1 + 0.5 * np.sin(2 * np.pi * 7 * t_s)))
    assert (states == PadState.STARTING).mean() > 0.5
    assert not room.pipeline.state.known.any()
    assert not (states == PadState.FAULTED).any()
