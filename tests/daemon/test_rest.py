"""Fading sheets rest while nobody needs them: never more than half of a hand, and none once it is touched."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handtouch.daemon.rest import FADED, Turns

SECOND_NS = 1_000_000_000
ON_N = np.full(6, 0.1)
NEEDED = np.ones(6, np.bool_)
NOBODY = np.zeros(6, np.bool_)
USED = np.array([1.0, 0.9, 0.8, 0.7, 0.1, np.nan])


def turns(after_s: float | None = 60.0) -> Turns:
    return Turns([slice(0, 4), slice(4, 6)], 6, after_s)


def test_fading_sheets_of_an_untouched_hand_rest_half_of_them_at_a_time() -> None:
    made = turns()
    assert not made.step(SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    assert not made.step(60 * SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    assert made.step(62 * SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    assert made.resting.tolist() == [True, True, False, False, False, False]
    assert made.step(700 * SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    assert made.resting.tolist() == [False, False, True, True, False, False]


def test_a_touch_anywhere_on_the_hand_wakes_all_of_it_at_once() -> None:
    made = turns()
    made.step(SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    made.step(100 * SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    assert made.resting.any()
    touched = np.arange(6) == 3
    assert made.step(100 * SECOND_NS + 5_000_000, touched, NEEDED, USED, ON_N)
    assert not made.resting.any()


def test_nothing_rests_unless_the_deployment_allows_it() -> None:
    made = turns(None)
    for second in range(1, 10_000, 100):
        assert not made.step(second * SECOND_NS, NOBODY, NEEDED, USED, ON_N)


@given(
    st.lists(st.floats(0, 5), min_size=6, max_size=6),
    st.lists(st.booleans(), min_size=6, max_size=6),
    st.integers(100, 10_000),
)
def test_half_of_what_is_needed_stays_awake(back_n: list[float], needed: list[bool], second: int) -> None:
    made = turns()
    wanted, back = np.array(needed), np.array(back_n)
    made.step(SECOND_NS, NOBODY, wanted, back, ON_N)
    made.step(second * SECOND_NS, NOBODY, wanted, back, ON_N)
    for rows in (slice(0, 4), slice(4, 6)):
        assert made.resting[rows].sum() <= wanted[rows].sum() / 2
    assert (wanted | ~made.resting).all()
    assert (back[made.resting] > FADED * 0.1).all()


def test_every_fading_sheet_gets_its_turn() -> None:
    made, rested = turns(), np.zeros(6, np.bool_)
    made.step(SECOND_NS, NOBODY, NEEDED, USED, ON_N)
    for minute in range(2, 60):
        made.step(60 * minute * SECOND_NS, NOBODY, NEEDED, USED, ON_N)
        rested |= made.resting
    assert rested.tolist() == [True] * 4 + [False] * 2
