"""The score recovers known errors, and separates missed touches from false positives."""

from __future__ import annotations

from dataclasses import replace
from math import erf

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import wire
from handtouch.simulate.score import score_contacts
from handtouch.simulate.truth import GroundTruth, TouchCounter, Vector
from tests.client.hand_messages import make_contact

PERIOD = 5_000_000


def make_placed(
    link: str, t_ns: int, event: wire.ContactEvent, position_m: Vector | None, force_n: float = 1.0
) -> wire.Contact:
    plain = make_contact(link, event, 1)
    return replace(
        plain, t_ns=t_ns, position_m=position_m, position_status="valid", force_n=force_n, force_std_n=None
    )


def touch(link: str, start: int, samples: int, number: int = 0) -> list[GroundTruth]:
    blank = GroundTruth(
        0, "right", link, number, 0, 0, (0.01, 0.02, 0.03), (0, 0, 1), 1.0, 2e-3, (0, 0, 0, 0), 1e-5
    )
    return [replace(blank, t_ns=(start + k) * PERIOD) for k in range(samples)]


def follow(
    truth: list[GroundTruth], error: NDArray[np.float64], force_error: float = 0.0
) -> list[wire.Contact]:
    return [
        make_placed(
            record.link,
            record.t_ns + 1000,
            "update" if k else "begin",
            tuple(np.add(record.position_m, error[k])),
            record.force_n + force_error,
        )
        for k, record in enumerate(truth)
    ]


def test_known_errors_are_recovered() -> None:
    truth = touch("tip", 1000, 4000)
    noise = np.random.default_rng(1).normal(0, 1e-5 / np.sqrt(2), (4000, 3)) * [1, 1, 0]
    total = score_contacts(follow(truth, noise + np.array([3e-5, 0, 0]), 0.25), truth).total
    assert total.samples == 4000
    assert total.rms_error_m == pytest.approx(np.hypot(3e-5, 1e-5), rel=0.02)
    assert total.rms_error_m / total.rms_bound_m == pytest.approx(np.hypot(3, 1), rel=0.02)
    assert total.rms_force_error_n == pytest.approx(0.25)
    assert (total.touches, total.missed, total.false_positives) == (1, 0, 0)
    assert total.max_error_m >= total.median_error_m > 0


def test_touches_without_contact_are_missed_and_contacts_without_touch_false_positives() -> None:
    truth = touch("tip", 1000, 50, 0) + touch("tip", 2000, 50, 1) + touch("flat", 1000, 50, 2)
    error = np.zeros((50, 3))
    contacts = follow(truth[:50], error)
    contacts += [
        make_placed("tip", 3000 * PERIOD, "begin", (0.0, 0.0, 0.0)),
        make_placed("round", 1000 * PERIOD, "begin", None),
    ]
    found = score_contacts(contacts, truth)
    tallies = {tally.name: tally for tally in found.links}
    assert (tallies["tip"].touches, tallies["tip"].missed, tallies["tip"].false_positives) == (2, 1, 1)
    assert (tallies["flat"].touches, tallies["flat"].missed, tallies["flat"].false_positives) == (1, 1, 0)
    assert (tallies["round"].touches, tallies["round"].missed, tallies["round"].false_positives) == (0, 0, 1)
    assert (found.total.touches, found.total.missed, found.total.false_positives) == (3, 2, 2)


def test_a_touch_that_ends_and_comes_back_counts_each_time_and_a_gap_between_samples_does_not() -> None:
    counter = TouchCounter()
    there, elsewhere = touch("tip", 0, 1), touch("flat", 0, 1, 1)
    samples = [there, there, elsewhere, there, [], [], there + elsewhere]
    numbered = [record for sample in samples for record in counter.number(sample)]
    assert score_contacts([], numbered).total.missed == 3 + 2
    interrupted = touch("tip", 0, 10) + touch("tip", 1000, 10)
    assert score_contacts([], interrupted).total.missed == 1


def test_errors_on_the_pad_and_of_its_mount_are_apart() -> None:
    off = (3e-4, 0.0, 0.0)
    truth = [
        replace(record, stated_position_m=tuple(np.add(record.position_m, off)))
        for record in touch("tip", 0, 50)
    ]
    total = score_contacts(follow(truth, np.tile([3e-4, 4e-5, 0], (50, 1))), truth).total
    assert total.mount_error_m == pytest.approx(3e-4)
    assert total.pad_error_m == pytest.approx(4e-5)
    assert total.rms_error_m == pytest.approx(np.hypot(3e-4, 4e-5))


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_coverage_is_the_share_within_the_stated_intervals(ratio: float) -> None:
    rng = np.random.default_rng(5)
    truth = touch("tip", 0, 4000)
    covariance = np.diag([4e-10, 1e-10, 0.0])
    error = ratio * rng.normal(0, 1, (4000, 3)) * np.sqrt(np.diag(covariance))
    forces = ratio * rng.normal(0, 0.1, 4000)
    contacts = [
        replace(contact, covariance_m2=tuple(covariance.ravel()), force_n=1 + force, force_std_n=0.1)
        for contact, force in zip(follow(truth, error), forces, strict=True)
    ]
    total = score_contacts(contacts, truth).total
    assert total.position_coverage == pytest.approx(1 - np.exp(-5.991 / 2 / ratio**2), abs=0.02)
    assert total.force_coverage == pytest.approx(erf(1.96 / ratio / np.sqrt(2)), abs=0.02)
    unreliable = [
        replace(contact, position_status="unreliable", force_status="unreliable") for contact in contacts
    ]
    other = score_contacts(unreliable, truth).total
    assert np.isnan(other.position_coverage)
    assert (other.force_coverage, other.force_valid) == (total.force_coverage, 0.0)  # it has an interval, too


def test_lower_bounds_are_true_or_not_and_have_no_error() -> None:
    truth = touch("tip", 0, 40)
    contacts = follow(truth, np.zeros((40, 3)), 0.25)
    below = [replace(contact, force_n=0.4, force_status="lower_bound") for contact in contacts[:9]]
    above = replace(contacts[9], force_n=300.0, force_status="lower_bound")
    score = score_contacts([*below, above, *contacts[10:]], truth)
    assert score.total.rms_force_error_n == pytest.approx(0.25)
    assert score.total.force_bounded == pytest.approx(0.25)
    assert score.total.bounds_held == pytest.approx(0.9)
    assert "25 % are lower bounds, 90 % of them true" in str(score)


def test_samples_match_within_half_a_period_and_ends_never() -> None:
    truth = touch("tip", 0, 10)
    error = np.zeros((10, 3))
    contacts = follow(truth, error)
    late = [replace(contact, t_ns=contact.t_ns + PERIOD * 100) for contact in contacts]
    ends = [replace(contact, event="end", position_m=(9.0, 9.0, 9.0)) for contact in contacts]
    unplaced = [replace(contact, event="update", position_m=None) for contact in contacts]
    total = score_contacts(contacts + late[1:] + ends + unplaced, truth).total
    assert total.samples == 10
    assert total.false_positives == 0
    shifted = [replace(contact, t_ns=contact.t_ns + round(0.4 * PERIOD)) for contact in contacts]
    assert score_contacts(shifted, truth).total.samples == 10


def test_hands_are_scored_separately() -> None:
    truth = touch("tip", 0, 10) + [replace(record, hand="left") for record in touch("tip", 0, 10)]
    found = score_contacts([replace(c, hand="left") for c in follow(truth[:10], np.zeros((10, 3)))], truth)
    assert {tally.name: tally.missed for tally in found.links} == {"right/tip": 1, "left/tip": 0}


def test_a_touch_that_begins_as_the_truth_ends_is_not_missed() -> None:
    seen = touch("tip", 0, 50)
    late = [replace(record, link="other") for record in touch("tip", 0, 50)[-3:]]
    found = score_contacts(follow(seen, np.zeros((50, 3))), [*seen, *late])
    assert (found.total.missed, found.total.touches) == (0, 1)


def test_verdict_and_table_fit_a_narrow_terminal() -> None:
    truth = touch("middle_proximal", 0, 10) + touch("flat", 0, 10)
    found = score_contacts(follow(truth[:10], np.full((10, 3), 1e-5)), truth)
    assert str(found).startswith("1 of 2 touches found")
    lines = found.table().splitlines()
    assert [line.split()[0] for line in lines[-4:]] == ["link", "middle_proximal", "flat", "all"]
    assert len({len(line) for line in lines[-4:]}) == 1
    assert max(map(len, [*lines, *str(found).splitlines()])) <= 72
    nothing = score_contacts([], [])
    assert nothing.total.samples == 0
    assert "nan" not in str(nothing) + nothing.table()
