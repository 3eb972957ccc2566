"""Motion of contacts: sticking, sliding, rolling and lift-off with probabilities."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.slip import MOTION_CLASSES, SlipDetector
from handtouch.core.state import TickState
from handtouch.percept.motion import MotionReporter
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

FloatArray = NDArray[np.float64]
PERIOD_NS, NOISE_M = 5_000_000, 8e-6
Way = Callable[[float], float]


class Held:
    """Contacts at places on pads, moved along x, on links that move in the palm."""

    def __init__(self, pads: int = 1, seed: int = 1, joints_m: float = 0.0) -> None:
        """joints_m: deviation of positions in the palm from joints, as reported."""
        self._joints_m = joints_m
        self._values = np.full((pads, VALUE_COUNT), np.nan)
        self._current_a, self._times = np.zeros(pads), np.zeros(pads, dtype=np.int64)
        self._ids = np.arange(1, pads + 1, dtype=np.uint32)
        held = TickState.empty(pads)
        self.slip = SlipDetector(
            PERIOD_NS * 1e-9, self._values, self._current_a, self._times, self._ids, held
        )
        self.slip.set_requested(np.ones(pads, dtype=np.bool_))
        self.poses = ContactBuffer(pads, length=22)
        self.reporter = MotionReporter(self.slip, self.poses, PERIOD_NS * 1e-9)
        self._rng = np.random.default_rng(seed)
        self._k = 0

    def feel(
        self,
        seconds: float,
        along_m: Way,
        force: Way = lambda _: 2.0,
        links_m: Sequence[Way] = (),
        turns_rad: Way = lambda _: 0.0,
    ) -> list[PerceptEstimate]:
        """Play contacts and return the percepts of the first pad.

        along_m: the first pad's centroid; links_m: of links, along x in the palm; turns_rad: of the first
        link, about y, while its point in contact moves as the centroid does.
        """
        percepts = []
        pads = np.arange(len(self._ids))
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            t_s, self._k = self._k * PERIOD_NS * 1e-9, self._k + 1
            self._times[:] = 10**9 + self._k * PERIOD_NS
            place = NOISE_M * self._rng.standard_normal((len(pads), 2))
            place[0, 0] += along_m(t_s)
            self._values[:, VALUE_SLICES["pad_m"]] = place
            self._values[:, VALUE_SLICES["pad_noise_m2"]] = NOISE_M**2 * np.array([1.0, 0.0, 1.0])
            self._values[:, VALUE_SLICES["force_n"]] = force(t_s)
            self._current_a[:] = 1e-3 * force(t_s)
            self.slip.detect_slips(pads)
            if links_m:
                posed = self._posed(place, [way(t_s) for way in links_m])
                turn = turns_rad(t_s)
                c, s = np.cos(turn), np.sin(turn)
                posed["palm_rotation"][0] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
                self.poses.add_samples(posed)
            found = self.reporter.report_contacts(pads, int(self._times[0]))
            percepts += [percept for percept in found if percept.pad == 0]
        return percepts

    def _posed(self, place: FloatArray, links_m: list[float]) -> ContactSamples:
        pads = np.arange(len(place))
        sample = ContactSamples(pads, self._times.copy(), self._ids)
        on_link = np.hstack([place, np.zeros((len(pads), 1))])
        sample["position_m"], sample["pad_m"] = on_link, place
        sample["total_current_a"] = self._current_a
        link = np.zeros((len(pads), 3))
        link[:, 0] = links_m
        link[:, 1] = 0.03 * pads
        sample["palm_position_m"] = on_link + link
        sample["palm_normal"] = np.tile([0.0, 0.0, 1.0], (len(pads), 1))
        sample["palm_rotation"] = np.tile(np.eye(3), (len(pads), 1, 1))
        sample["palm_joints_m2"] = np.full(len(pads), self._joints_m**2)
        return sample


def still(_: float) -> float:
    return 0.0


def ramp(from_s: float, speed: float) -> Way:
    return lambda t_s: speed * max(0.0, t_s - from_s)


def test_firm_contact_is_reported_sticking_twenty_times_a_second() -> None:
    percepts = Held().feel(2.0, still)
    assert {percept.label for percept in percepts} == {"sticking"}
    assert 38 <= len(percepts) <= 42
    assert percepts[-1].probabilities["sticking"] > 0.95
    assert percepts[-1].evidence["samples"] == (percepts[-1].estimate_ns - 10**9) / PERIOD_NS


def test_probabilities_sum_to_one() -> None:
    for percept in Held().feel(1.5, ramp(1.0, 10e-3)):
        assert set(percept.probabilities) == set(MOTION_CLASSES)
        assert sum(percept.probabilities.values()) == pytest.approx(1.0)


def test_slip_is_reported_at_once_with_velocity_and_distance() -> None:
    percepts = Held().feel(1.2, ramp(1.0, 20e-3))
    first = next(percept for percept in percepts if percept.label == "sliding")
    assert (first.estimate_ns - 10**9) * 1e-9 < 1.03
    last = percepts[-1]
    assert last.values["velocity_m_per_s"] == pytest.approx([20e-3, 0.0], abs=4e-3)
    since_s = last.estimate_ns * 1e-9 - 2.0
    assert last.values["slip_distance_m"] == pytest.approx(since_s * 20e-3, rel=0.2)


def test_contact_at_rest_after_slip_sticks_again() -> None:
    percepts = Held().feel(2.5, lambda t_s: min(20e-3 * max(0.0, t_s - 1.0), 4e-3))
    labels = [percept.label for percept in percepts]
    assert "sliding" in labels
    assert labels[-10:] == ["sticking"] * 10
    assert percepts[-1].evidence["slips"] == 1


def test_vanishing_force_is_lift_off() -> None:
    percepts = Held().feel(1.08, still, force=lambda t_s: 2.0 - 20.0 * max(0.0, t_s - 1.0))
    assert percepts[-1].label == "lift-off"


def test_ended_contact_has_lifted_off() -> None:
    held = Held()
    held.feel(0.5, still)
    (last,) = held.reporter.end_contacts(np.array([0]), 2 * 10**9)
    assert (last.label, last.contact) == ("lift-off", 1)


def test_contact_that_nothing_is_known_of_ends_silently() -> None:
    assert Held().reporter.end_contacts(np.array([0]), 2 * 10**9) == []


def test_ripple_and_tremor_are_sticking() -> None:
    percepts = Held().feel(
        3.0,
        lambda t_s: 5e-5 * np.sin(2 * np.pi * 3 * t_s) + 1e-5 * np.sin(2 * np.pi * 7 * t_s),
        force=lambda t_s: 2.0 + 0.5 * np.sin(2 * np.pi * 3 * t_s),
    )
    assert {percept.label for percept in percepts} == {"sticking"}


def test_joint_states_distinguish_rolling_from_sliding() -> None:
    """A centroid runs over the pad, and two fingers hold the object still: its link stands or moves."""
    held = [still, still, still]
    rolls = Held(3).feel(1.3, ramp(1.0, 15e-3), links_m=held)[-1]
    assert rolls.label == "rolling"
    assert rolls.values["object_reference"] == "grasp"
    slides = Held(3).feel(1.3, ramp(1.0, 15e-3), links_m=[ramp(1.0, -15e-3), still, still])[-1]
    assert slides.label == "sliding"
    assert slides.probabilities["sliding"] > 0.95
    relative = slides.values["relative_velocity_m_per_s"]
    assert relative == pytest.approx([-15e-3, 0.0, 0.0], abs=3e-3)


def test_link_that_turns_rolls_and_one_that_moves_against_the_object_slides() -> None:
    """The same centroid on a pad: its link turns and its surface stays on the object, or it is moved."""
    rolls = Held(4).feel(1.3, ramp(1.0, 4e-3), links_m=[still] * 4, turns_rad=ramp(1.0, 0.5))
    assert not {"sliding", "incipient"} & {percept.label for percept in rolls}
    slides = Held(4).feel(1.3, ramp(1.0, 4e-3), links_m=[ramp(1.0, -30e-3), still, still, still])
    assert "sliding" in {percept.label for percept in slides}


def test_moving_hand_with_its_object_does_not_slide() -> None:
    carried = Held(3).feel(1.5, still, links_m=[ramp(1.0, 30e-3)] * 3)
    assert {percept.label for percept in carried} == {"sticking"}


@pytest.mark.parametrize("joints_m", [0.2e-3, 0.0])
def test_reported_encoder_noise_is_not_sliding(joints_m: float) -> None:
    """Each sample's angles put a fingertip 0.2 mm off: 6 mm/s over 50 ms, that nothing moves with."""
    rng = np.random.default_rng(8)
    shaken = [lambda _: float(0.2e-3 * rng.standard_normal())] * 4
    labels = {percept.label for percept in Held(4, joints_m=joints_m).feel(2.0, still, links_m=shaken)}
    assert ("sliding" in labels) == (joints_m == 0.0)  # taken for as good as none, it is one


def test_object_dragged_under_resting_centroids_slides_despite_noise() -> None:
    rng = np.random.default_rng(9)

    def noise(_: float) -> float:
        return float(0.2e-3 * rng.standard_normal())

    pulled = ramp(1.0, -100e-3)
    links = [lambda t_s: pulled(t_s) + noise(t_s), *[noise] * 4]
    percepts = Held(5, joints_m=0.2e-3).feel(1.3, still, links_m=links)
    first = next(percept for percept in percepts if percept.label == "sliding")
    assert 1.0 < (first.estimate_ns - 10**9) * 1e-9 < 1.15


def test_single_contact_assumes_a_static_object() -> None:
    percepts = Held(1).feel(1.3, ramp(1.0, 15e-3), links_m=[ramp(1.0, -15e-3)])[-1]
    assert percepts.values["object_reference"] == "static"
    assert percepts.label == "sliding"


def test_moving_centroid_on_a_resting_link_slides_without_other_contacts() -> None:
    percepts = Held(1).feel(1.3, ramp(1.0, 15e-3), links_m=[still])[-1]
    assert percepts.values["object_reference"] == "static"
    assert percepts.label == "sliding"
