"""Waiting awake for the last sample."""

from __future__ import annotations

import pytest

from handtouch.daemon.cycle import BusyPoll


def learned(busy_ns: int) -> BusyPoll:
    """Samples have always been there 0.8 ms after SYNC."""
    poll = BusyPoll(busy_ns)
    for sync_ns in range(0, 1_000_000_000, 5_000_000):
        poll.ticked(sync_ns, sync_ns + 800_000)
    return poll


def test_it_sleeps_until_shortly_before_the_last_sample_usually_comes_and_again_soon_after() -> None:
    poll = learned(100_000)
    assert poll.sleep_ns(0, 0) == pytest.approx(700_000, abs=100)
    assert poll.sleep_ns(0, 750_000) == poll.sleep_ns(0, 850_000) == 0
    assert poll.sleep_ns(0, 900_100) > 1_000_000_000


def test_a_sync_that_nobody_answers_teaches_nothing() -> None:
    poll = learned(100_000)
    before_ns = poll.expected_ns(0)
    poll.ticked(1_000_000_000, 999_000_000)
    assert poll.expected_ns(0) == before_ns


@pytest.mark.parametrize("now_ns", [0, 799_000, 800_000, 801_000])
def test_without_it_the_loop_sleeps_until_something_comes(now_ns: int) -> None:
    assert learned(0).sleep_ns(0, now_ns) > 1_000_000_000
