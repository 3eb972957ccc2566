"""Slip test: bounded rate of false alarms, short latency, none for a firm grip."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.slip import INFORMATION, MOTION_CLASSES, GripModel, SlipDetector
from handtouch.core.state import TickState

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
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


class Contacts:
    """Contacts on n pads as a tick has them, and the slip detector that reads them."""

    def __init__(
        self, pads: int, dt_s: float = DT_S, false_alarm_s: float = 600.0, grip: GripModel | None = None
    ) -> None:
        self.pads, self._dt_s = np.arange(pads), dt_s
        self.values = np.full((pads, VALUE_COUNT), np.nan)
        self.current_a, self.times = np.zeros(pads), np.zeros(pads, dtype=np.int64)
        self.ids = np.arange(1, pads + 1, dtype=np.uint32)
        held = TickState.empty(pads)
        self.slip = SlipDetector(
            dt_s, self.values, self.current_a, self.times, self.ids, held, false_alarm_s, grip
        )
        self.slip.set_requested(np.ones(pads, dtype=np.bool_))

    def step(
        self,
        k: int,
        position_m: FloatArray,
        force_n: FloatArray | float = FORCE_N,
        noise_m: float = NOISE_M,
        pads: IntArray | None = None,
    ) -> BoolArray:
        """Process the k-th sample of all pads or some, at positions (n, 2); return which slips began (n,)."""
        rows = self.pads if pads is None else pads
        before = self.slip.contacts().slipping != 0
        self.values[:, VALUE_SLICES["pad_m"]] = position_m
        self.values[:, VALUE_SLICES["pad_noise_m2"]] = noise_m**2 * np.array([1.0, 0.0, 1.0])
        self.values[:, VALUE_SLICES["covariance_m2"]] = noise_m**2 * np.eye(3).ravel()
        self.values[:, VALUE_SLICES["force_n"]] = np.broadcast_to(force_n, len(self.pads))[:, None]
        self.current_a[:] = 1e-3 * np.asarray(force_n)
        self.times[rows] = 10**9 + round(k * self._dt_s * 1e9)
        self.slip.detect_slips(rows)
        return np.asarray((self.slip.contacts().slipping != 0) & ~before)


def alarms(
    contacts: Contacts, place: FloatArray, force: FloatArray, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Step and pad of every alarm; a new contact begins after each."""
    found = []
    seen = place + NOISE_M * rng.standard_normal(place.shape)
    for k in range(len(seen)):
        again = np.flatnonzero(contacts.step(k, seen[k], force[k]))
        found += [(k, pad) for pad in again.tolist()]
        if len(again):
            contacts.ids[again] += len(contacts.ids)
            contacts.step(k, seen[k], force[k], pads=again)
    return found


def test_false_alarms_are_as_rare_as_configured() -> None:
    rng, pads, steps, every_s = np.random.default_rng(1), 60, 300, 1.5
    grip = GripModel(creep_std_m_per_s=1e-6, chatter_m=0.0)  # as this one does: none
    force = np.full((steps, pads), FORCE_N)
    found = alarms(Contacts(pads, DT_S, every_s, grip), wandering(pads, steps, rng, grip), force, rng)
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
    assert alarms(Contacts(pads), place, force, rng) == []


@pytest.mark.parametrize("hz", [200, 500])
def test_non_matern_tremor_raises_no_alarm_with_low_channel_noise(hz: int) -> None:
    """Innovations are then tiny beside the tremor, more at a high rate: they don't reveal its size."""
    rng, pads, steps = np.random.default_rng(21), 15, 3 * hz
    t = (np.arange(steps) / hz)[:, None, None]
    hertz, phase = rng.uniform(1, 10, (2, pads, 8)), rng.uniform(0, 6.3, (2, pads, 8))
    waves = np.stack([np.sin(2 * np.pi * hertz[k] * t + phase[k]).sum(axis=2) for k in (0, 1)], axis=2)
    place = 20e-6 * waves + 0.5e-6 * rng.standard_normal((steps, pads, 2))
    contacts = Contacts(pads, 1 / hz)
    found = 0
    for k in range(steps):
        began = int(np.count_nonzero(contacts.step(k, place[k], noise_m=0.5e-6)))
        found += began * (k > hz)  # in the first second the tremor is being learnt
    assert found == 0


def test_centroid_shift_by_pressing_harder_is_not_slip() -> None:
    rng, pads, steps = np.random.default_rng(3), 10, 500
    force = np.repeat(np.linspace(1.0, 4.0, steps)[:, None], pads, axis=1)
    angle = rng.uniform(0, 2 * np.pi, pads)
    moved = 1e-4 * (force - 1)[:, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert alarms(Contacts(pads), moved, force, rng) == []


@pytest.mark.parametrize("amplitude_m", [0.1e-3, 0.2e-3])
def test_chatter_that_returns_is_not_slip(amplitude_m: float) -> None:
    """A saturated sheet shows it larger than it is: farther than a slip has to move."""
    rng, pads, steps = np.random.default_rng(11), 12, 1600
    place = wandering(pads, steps, rng, GripModel())
    since_s = np.arange(steps)[:, None] * DT_S - 1.0 - rng.uniform(0.0, 1.4, pads)
    burst = np.where((since_s > 0) & (since_s % 2.0 < 0.6), np.sin(2 * np.pi * 9 * (since_s % 2.0)), 0.0)
    angle = rng.uniform(0, 2 * np.pi, pads)
    place += amplitude_m * burst[:, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert alarms(Contacts(pads), place, np.full((steps, pads), FORCE_N), rng) == []


@pytest.mark.parametrize(("speed_mm_per_s", "most_samples"), [(3.0, 36), (10.0, 9), (30.0, 3), (100.0, 2)])
def test_slip_is_detected_within_a_few_samples(speed_mm_per_s: float, most_samples: int) -> None:
    rng, pads, onset, steps = np.random.default_rng(4), 20, 300, 360
    place = wandering(pads, steps, rng, GripModel())
    ramp = np.maximum(np.arange(steps) - onset, 0) * DT_S * speed_mm_per_s * 1e-3
    angle = rng.uniform(0, 2 * np.pi, pads)
    place += ramp[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first: dict[int, int] = {}
    for k, pad in alarms(Contacts(pads), place, np.full((steps, pads), FORCE_N), rng):
        first.setdefault(pad, k)
    delays = np.array([first.get(pad, steps) - onset for pad in range(pads)])
    assert (delays > 0).all()
    assert np.median(delays) <= most_samples


def test_missing_samples_neither_raise_an_alarm_nor_hide_a_slip() -> None:
    rng, onset = np.random.default_rng(5), 300
    place = wandering(10, 340, rng, GripModel()) + NOISE_M * rng.standard_normal((340, 10, 2))
    place[onset:, :, 0] += (np.arange(40) * DT_S * 20e-3)[:, None]
    contacts, found = Contacts(10), np.zeros(10, dtype=np.bool_)
    contacts.step(0, place[0])
    for k in range(1, 340):
        if rng.random() < 0.3:
            continue
        alarm = contacts.step(k, place[k])
        assert k > onset or not alarm.any()
        found |= alarm
    assert found.all()


def test_onset_and_speed_match_the_slip() -> None:
    rng, onset = np.random.default_rng(6), 300
    place = wandering(1, 312, rng, GripModel()) + NOISE_M * rng.standard_normal((312, 1, 2))
    place[onset:, 0, 1] -= np.arange(12) * DT_S * 20e-3
    contacts = Contacts(1)
    for k in range(312):
        contacts.step(k, place[k])
    (contact,) = contacts.slip.contacts()
    age_s, velocity = contact.onset_age_s, contact.slip_velocity_m_per_s
    assert age_s == pytest.approx(11 * DT_S, abs=3 * DT_S)
    assert velocity == pytest.approx([0, -20e-3], abs=3e-3)


def test_creep_is_not_slip() -> None:
    """At half a millimetre a second, as pads on things that are held do, from the first sample on."""
    rng, pads, steps = np.random.default_rng(7), 12, 500
    creeps = 0.5e-3 * DT_S * np.arange(steps)[:, None, None] * np.array([0.8, -0.6])
    place = creeps + 0.2 * wandering(pads, steps, rng, GripModel())
    assert alarms(Contacts(pads), place, np.full((steps, pads), FORCE_N), rng) == []


def test_light_contact_may_begin_at_a_noisy_position() -> None:
    rng, noise_m, contacts = np.random.default_rng(8), 1e-3, Contacts(8)
    contacts.step(0, 2 * noise_m * np.ones((8, 2)), noise_m=noise_m)
    for k in range(1, 101):
        assert not contacts.step(k, noise_m * rng.standard_normal((8, 2)), noise_m=noise_m).any()


@pytest.mark.parametrize("noise_m", [5e-5, 1.5e-4])
def test_twice_the_noise_that_is_known_raises_few_alarms(noise_m: float) -> None:
    """Without the limit in standard deviations it is one a second."""
    rng, pads, steps, count = np.random.default_rng(9), 40, 600, 0
    contacts = Contacts(pads)
    for k in range(steps):
        seen = 2.0 * noise_m * rng.standard_normal((pads, 2))
        count += int(contacts.step(k, seen, 0.3, noise_m).sum()) * (k > 100)
    assert count < 0.4 * pads * (steps - 100) * DT_S


def test_information_of_a_slip_grows_with_its_age() -> None:
    contacts = Contacts(1)
    for k in range(61):
        contacts.step(k, np.zeros((1, 2)))
    (contact,) = contacts.slip.contacts()
    ages, information = contact.onset_ages_s, contact.ramps[0, INFORMATION]
    begun = ages > 0
    assert ages[begun].max() == pytest.approx(59 * DT_S, abs=5 * DT_S)
    assert (np.diff(information[begun]) > 0).all()
    assert (np.diff(ages[begun]) > 0).all()


def test_contact_whose_first_samples_have_no_position_begins_with_the_first_that_has() -> None:
    rng, contacts = np.random.default_rng(9), Contacts(1)
    contacts.step(0, np.full((1, 2), np.nan))
    for k in range(1, 200):
        assert not contacts.step(k, NOISE_M * rng.standard_normal((1, 2))).any()
    slipped = [
        contacts.step(k, NOISE_M * rng.standard_normal((1, 2)) + [30e-3 * DT_S * (k - 199), 0.0]).any()
        for k in range(200, 210)
    ]
    assert any(slipped)


def test_slip_starts_afresh_where_a_calibration_moves_the_position() -> None:
    """A position that jumps by 2 mm slips, unless the calibration that it is computed with has changed."""
    rng = np.random.default_rng(10)
    for restart in (False, True):
        contacts = Contacts(1)
        for k in range(200):
            contacts.step(k, NOISE_M * rng.standard_normal((1, 2)))
        if restart:
            contacts.slip.restart_contacts(np.array([0]))
        moved = [
            contacts.step(k, 2e-3 + NOISE_M * rng.standard_normal((1, 2))).any() for k in range(200, 300)
        ]
        assert any(moved) is not restart


def test_unloading_until_the_force_vanishes_is_lift_off() -> None:
    contacts = Contacts(1)
    for k in range(200):
        contacts.step(k, np.zeros((1, 2)))
    labels = []
    for k in range(200, 216):
        contacts.step(k, np.zeros((1, 2)), force_n=FORCE_N * (1 - (k - 199) / 20))
        labels.append(int(contacts.slip.contacts().label[0]))
    assert MOTION_CLASSES[labels[-1]] == "lift-off"
    assert MOTION_CLASSES[labels[0]] == "sticking"


def test_evidence_near_the_threshold_does_not_chatter() -> None:
    """The odds fall by a factor of e in 50 ms at most, however fast R falls."""
    rng, contacts, steps = np.random.default_rng(11), Contacts(10), 400
    moved = np.cumsum(np.where(np.arange(steps) % 40 < 8, 4e-3 * DT_S, 0.0) * (np.arange(steps) > 100))
    place = 0.3 * wandering(10, steps, rng, GripModel())
    place[:, :, 0] += moved[:, None]
    before, falls = np.full(10, -np.inf), []
    for k in range(steps):
        contacts.step(k, place[k] + NOISE_M * rng.standard_normal((10, 2)))
        odds = contacts.slip.contacts().log_odds.copy()
        known = np.isfinite(before) & np.isfinite(odds)
        falls += (before[known] - odds[known]).tolist()
        before = odds
    assert max(falls) <= DT_S / 0.05 + 1e-9
    assert max(falls) == pytest.approx(DT_S / 0.05)
