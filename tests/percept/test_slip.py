"""Slip test: bounded rate of false alarms, short latency, none for a firm grip."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.percept.slip import GripModel, SlipTest

FloatArray = NDArray[np.float64]
DT_S, NOISE_M, FORCE_N = 0.005, 10e-6, 2.0


def wandering(
    pads: int, steps: int, rng: np.random.Generator, grip: GripModel, dt_s: float = DT_S
) -> FloatArray:
    """Centroids (steps, pads, 2) as the test's own model of a grip has them, without noise and force."""
    rate = 2 * np.pi * grip.tremor_corner_hz
    passed = rate * dt_s
    forward = np.exp(-passed) * np.array([[1 + passed, dt_s], [-rate * passed, 1 - passed]])
    still = grip.tremor_std_m**2 * np.diag([1, rate**2])
    root = np.linalg.cholesky(still - forward @ still @ forward.T)
    state = rng.standard_normal((pads, 2, 2)) @ np.sqrt(still)
    place = np.empty((steps, pads, 2))
    for k in range(steps):
        state = state @ forward.T + rng.standard_normal((pads, 2, 2)) @ root.T
        place[k] = state[:, :, 0]
    level = rng.standard_normal(place.shape) * (grip.level_drift_std_m * np.sqrt(dt_s))
    return np.asarray(place + level.cumsum(axis=0))


def alarms(
    test: SlipTest, place: FloatArray, force: FloatArray, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Step and pad of every alarm; a new contact begins after each."""
    found = []
    pads = np.arange(place.shape[1])
    noise = np.full((len(pads), 2), NOISE_M**2)
    seen = place + NOISE_M * rng.standard_normal(place.shape)
    press = force / 5
    test.start_contacts(pads, seen[0], noise, press[0])
    for k in range(1, len(seen)):
        alarm = test.process_samples(pads, np.full(len(pads), DT_S), seen[k], noise, press[k])
        again = np.flatnonzero(alarm)
        found += [(k, pad) for pad in again.tolist()]
        if len(again):
            test.start_contacts(again, seen[k][again], noise[again], press[k][again])
    return found


def test_false_alarms_are_as_rare_as_configured() -> None:
    rng, pads, steps, every_s = np.random.default_rng(1), 60, 300, 1.5
    grip = GripModel(creep_std_m_per_s=1e-6)  # as this one does: none
    force = np.full((steps, pads), FORCE_N)
    found = alarms(SlipTest(pads, DT_S, every_s, grip), wandering(pads, steps, rng, grip), force, rng)
    expected = pads * steps * DT_S / every_s
    assert len(found) < expected + 3 * np.sqrt(expected)
    assert len(found) > 0  # else it would be no test of that


def test_tremor_and_ripple_of_a_firm_grip_raise_no_alarm() -> None:
    rng, pads, steps = np.random.default_rng(2), 12, 500
    t = (np.arange(steps) * DT_S)[:, None, None]
    tones = rng.uniform(1, 10, (3, pads, 6))
    waves = [np.sin(2 * np.pi * tones[k] * t + 6 * tones[k]).sum(axis=2) / np.sqrt(3) for k in range(3)]
    force = FORCE_N * (1 + 0.1 * waves[0])
    place = 1e-4 * (force - FORCE_N)[:, :, None] + 15e-6 * np.stack(waves[1:], axis=2)
    assert alarms(SlipTest(pads, DT_S, 600.0), place, force, rng) == []


@pytest.mark.parametrize("hz", [200, 500])
def test_non_matern_tremor_raises_no_alarm_with_low_channel_noise(hz: int) -> None:
    """Innovations are then tiny beside the tremor, more at a high rate: they don't reveal its size."""
    rng, pads, steps = np.random.default_rng(21), 15, 3 * hz
    t = (np.arange(steps) / hz)[:, None, None]
    hertz, phase = rng.uniform(1, 10, (2, pads, 8)), rng.uniform(0, 6.3, (2, pads, 8))
    waves = np.stack([np.sin(2 * np.pi * hertz[k] * t + phase[k]).sum(axis=2) for k in (0, 1)], axis=2)
    place = 20e-6 * waves + 0.5e-6 * rng.standard_normal((steps, pads, 2))
    test, every, found = SlipTest(pads, 1 / hz, 600.0), np.arange(pads), 0
    quiet = np.full((pads, 2), 0.25e-12)
    test.start_contacts(every, place[0], quiet, np.ones(pads))
    for k in range(1, steps):
        alarm = test.process_samples(every, np.full(pads, 1 / hz), place[k], quiet, np.ones(pads))
        again = np.flatnonzero(alarm)
        found += len(again) * (k > hz)  # in the first second the tremor is being learnt
        test.mark_slipping(again)
        test.start_contacts(again, place[k, again], quiet[again], np.ones(len(again)), keep=True)
    assert found == 0


def test_centroid_shift_by_pressing_harder_is_not_slip() -> None:
    rng, pads, steps = np.random.default_rng(3), 10, 500
    force = np.repeat(np.linspace(1.0, 4.0, steps)[:, None], pads, axis=1)
    angle = rng.uniform(0, 2 * np.pi, pads)
    moved = 1e-4 * (force - 1)[:, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert alarms(SlipTest(pads, DT_S, 600.0), moved, force, rng) == []


@pytest.mark.parametrize(("speed_mm_per_s", "most_samples"), [(3.0, 30), (10.0, 6), (30.0, 3), (100.0, 2)])
def test_slip_is_detected_within_a_few_samples(speed_mm_per_s: float, most_samples: int) -> None:
    rng, pads, onset, steps = np.random.default_rng(4), 20, 300, 360
    place = wandering(pads, steps, rng, GripModel())
    ramp = np.maximum(np.arange(steps) - onset, 0) * DT_S * speed_mm_per_s * 1e-3
    angle = rng.uniform(0, 2 * np.pi, pads)
    place += ramp[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first: dict[int, int] = {}
    test = SlipTest(pads, DT_S, 600.0)
    for k, pad in alarms(test, place, np.full((steps, pads), FORCE_N), rng):
        first.setdefault(pad, k)
    delays = np.array([first.get(pad, steps) - onset for pad in range(pads)])
    assert (delays > 0).all()
    assert np.median(delays) <= most_samples


def test_missing_samples_neither_raise_an_alarm_nor_hide_a_slip() -> None:
    rng, pads, onset = np.random.default_rng(5), np.arange(10), 300
    place = wandering(10, 340, rng, GripModel()) + NOISE_M * rng.standard_normal((340, 10, 2))
    place[onset:, :, 0] += (np.arange(40) * DT_S * 20e-3)[:, None]
    test, noise, force = SlipTest(10, DT_S, 600.0), np.full((10, 2), NOISE_M**2), np.full(10, FORCE_N)
    test.start_contacts(pads, place[0], noise, force)
    last, found = 0, np.zeros(10, dtype=np.bool_)
    for k in range(1, 340):
        if rng.random() < 0.3:
            continue
        alarm = test.process_samples(pads, np.full(10, (k - last) * DT_S), place[k], noise, force)
        last = k
        assert k > onset or not alarm.any()
        found |= alarm
    assert found.all()


def test_onset_and_speed_match_the_slip() -> None:
    rng, onset = np.random.default_rng(6), 300
    place = wandering(1, 312, rng, GripModel()) + NOISE_M * rng.standard_normal((312, 1, 2))
    place[onset:, 0, 1] -= np.arange(12) * DT_S * 20e-3
    test = SlipTest(1, DT_S, 600.0)
    pads, one = np.array([0]), np.full(1, DT_S)
    test.start_contacts(pads, place[0], np.full((1, 2), NOISE_M**2), np.ones(1))
    for k in range(1, 312):
        test.process_samples(pads, one, place[k], np.full((1, 2), NOISE_M**2), np.ones(1))
    assert test.onset_age_s[0] == pytest.approx(11 * DT_S, abs=3 * DT_S)
    assert test.slip_velocity_m_per_s[0] == pytest.approx([0, -20e-3], abs=3e-3)


def test_creep_is_not_slip() -> None:
    """At half a millimetre a second, as pads on things that are held do, from the first sample on."""
    rng, pads, steps = np.random.default_rng(7), 12, 500
    creeps = 0.5e-3 * DT_S * np.arange(steps)[:, None, None] * np.array([0.8, -0.6])
    place = creeps + 0.2 * wandering(pads, steps, rng, GripModel())
    assert alarms(SlipTest(pads, DT_S, 600.0), place, np.full((steps, pads), FORCE_N), rng) == []


def test_light_contact_may_begin_at_a_noisy_position() -> None:
    rng, pads, noise_m = np.random.default_rng(8), np.arange(8), 1e-3
    test, noise = SlipTest(8, DT_S, 600.0), np.full((8, 2), noise_m**2)
    test.start_contacts(pads, 2 * noise_m * np.ones((8, 2)), noise, np.ones(8))
    for _ in range(100):
        seen = noise_m * rng.standard_normal((8, 2))
        assert not test.process_samples(pads, np.full(8, DT_S), seen, noise, np.ones(8)).any()


def test_information_of_a_slip_grows_with_its_age() -> None:
    test, noise = SlipTest(1, DT_S, 600.0), np.full((1, 2), NOISE_M**2)
    test.start_contacts(np.array([0]), np.zeros((1, 2)), noise, np.ones(1))
    for _ in range(60):
        test.process_samples(np.array([0]), np.full(1, DT_S), np.zeros((1, 2)), noise, np.ones(1))
    (ages,), (information,) = test.onset_information()
    begun = ages > 0
    assert ages[begun].max() == pytest.approx(59 * DT_S, abs=5 * DT_S)
    assert (np.diff(information[begun]) > 0).all()
    assert (np.diff(ages[begun]) > 0).all()
