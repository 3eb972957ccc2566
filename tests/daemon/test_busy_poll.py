"""Busy polling for the last sample."""

from __future__ import annotations

import pytest

from handtouch.daemon.busy_poll import BusyPoll


def learned(busy_ns: int) -> BusyPoll:
    """Return a poll that learned samples 0.8 ms after SYNC."""
    poll = BusyPoll(busy_ns)
    for sync_ns in range(0, 1_000_000_000, 5_000_000):
        poll.update_usual_latency(sync_ns, sync_ns + 800_000)
    return poll


def test_sleep_ends_shortly_before_the_usual_arrival() -> None:
    poll = learned(100_000)
    assert poll.max_sleep_ns(0, 0) == pytest.approx(700_000, abs=100)
    assert poll.max_sleep_ns(0, 750_000) == poll.max_sleep_ns(0, 850_000) == 0
    assert poll.max_sleep_ns(0, 900_100) > 1_000_000_000


def test_sync_without_samples_is_not_learned() -> None:
    poll = learned(100_000)
    before_ns = poll.max_sleep_ns(0, 0)
    poll.update_usual_latency(1_000_000_000, 999_000_000)
    assert poll.max_sleep_ns(0, 0) == before_ns


@pytest.mark.parametrize("now_ns", [0, 799_000, 800_000, 801_000])
def test_without_busy_polling_the_loop_sleeps(now_ns: int) -> None:
    assert learned(0).max_sleep_ns(0, now_ns) > 1_000_000_000
