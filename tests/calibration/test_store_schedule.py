"""When baselines and sheet states that the daemon tracks are stored."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from handtouch.calibration.store_schedule import StoreSchedule

MINUTE_NS = 60 * 10**9


def make_schedule() -> StoreSchedule:
    """Return the schedule of a pad that has waited for a minute."""
    none, schedule = np.full(1, np.nan), StoreSchedule([4])
    schedule.update_block(
        SimpleNamespace(
            offset_counts=np.full((1, 4), 12.0), offset_std=np.ones(1), noise_counts=np.ones((1, 4)),
            back_n=none, back_std_n=none, learned_pad=np.int32(0), learned=none,
        )
    )  # fmt: skip
    assert schedule.due_parts(0, 0) == (None, None)
    return schedule


def test_unchanged_offsets_are_stored_once() -> None:
    schedule = make_schedule()
    assert schedule.due_parts(0, MINUTE_NS)[0] is not None
    assert all(schedule.due_parts(0, n * MINUTE_NS)[0] is None for n in range(2, 200))


def test_what_could_not_be_written_is_stored_a_minute_later() -> None:
    schedule = make_schedule()
    for n in (1, 2, 3):
        assert schedule.due_parts(0, n * MINUTE_NS)[0] is not None
        schedule.retry_pad(0, n * MINUTE_NS)
        assert schedule.due_parts(0, n * MINUTE_NS + 1)[0] is None
