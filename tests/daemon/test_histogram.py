"""Stage times add up to each period, and late ticks are attributed to a stage."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from handtouch.daemon import stage_timer
from handtouch.daemon.stage_timer import (
    FIRST_BUCKET_NS,
    STAGES,
    WAKE_UP_DELAY,
    Histogram,
    StageTimer,
)

MS = 1_000_000
PERIOD_NS = 5 * MS


@given(st.lists(st.integers(0, 2**62), max_size=50))
def test_durations_are_counted_in_their_buckets(
    durations: list[int],
) -> None:
    counted = Histogram()
    for duration_ns in durations:
        counted.add(duration_ns)
    statistics = counted.statistics()
    assert sum(statistics["counts"]) == len(durations)
    assert (
        statistics["sum_s"] * 1e9 == sum(durations) or abs(statistics["sum_s"] - sum(durations) * 1e-9) < 1e-3
    )
    below = 0
    for k, count in enumerate(statistics["counts"]):
        below += count
        assert below == sum(duration_ns < FIRST_BUCKET_NS * 2**k for duration_ns in durations)


def period(timer: StageTimer, start_ns: int, **took_ns: int) -> int:
    """Run a period of the loop with the given stage times; return its end."""
    now_ns = start_ns
    for stage, name in enumerate(STAGES):
        now_ns += took_ns.get(name, 10_000)
        if name == "wait":
            timer.record_wait(now_ns - took_ns.get(WAKE_UP_DELAY, 0), now_ns)
        else:
            timer.lap(stage, now_ns)
        if name == "send":
            timer.record_tick(start_ns, PERIOD_NS, now_ns - 50_000, now_ns)
    return now_ns


def test_the_stages_of_a_period_add_up_to_it() -> None:
    timer = StageTimer(0)
    timer.start(1000)
    end_ns = period(timer, 1000, wait=3 * MS, tick=MS)
    timer.begin_period(0, unticked=False)
    statistics = timer.statistics()
    assert round(sum(stage["sum_s"] for stage in statistics["stages"].values()) * 1e9) == end_ns - 1000
    assert statistics["latency"]["counts"][6] == 1  # 50 us
    assert statistics["late"] == {}


def test_late_tick_is_counted_once_under_its_longest_part() -> None:
    for name in set(STAGES) - {"wait"}:
        timer = StageTimer(0)
        timer.start(0)
        now_ns = period(timer, 0)
        timer.begin_period(0, unticked=False)
        period(timer, now_ns, wait=4 * MS, **{name: 6 * MS})
        skipped = 0 if STAGES.index(name) <= STAGES.index("send") else 1
        timer.begin_period(skipped, unticked=False)
        assert timer.late_ticks == {name: 1}, name
        assert timer.take_late_ticks() == [(name, 1, 6 * MS)]
        assert timer.take_late_ticks() == []


def test_wake_up_delay_is_not_attributed_to_the_loop() -> None:
    timer = StageTimer(0)
    timer.start(0)
    period(timer, 0, wait=9 * MS, **{WAKE_UP_DELAY: 6 * MS}, tick=MS)
    timer.begin_period(0, unticked=False)
    assert timer.late_ticks == {WAKE_UP_DELAY: 1}


def test_skipped_periods_count_each_with_the_cause_of_the_pause() -> None:
    timer = StageTimer(0)
    timer.start(0)
    period(timer, 0, report=23 * MS)
    timer.begin_period(3, unticked=False)
    assert timer.late_ticks == {"report": 3}
    assert timer.take_late_ticks() == [("report", 3, 23 * MS)]


def test_kernel_syncs_queued_in_a_pause_have_its_cause() -> None:
    timer = StageTimer(0)
    timer.start(0)
    now_ns = period(timer, 0, nodes=23 * MS)
    timer.begin_period(0, unticked=False)  # the first received one: its tick comes later
    for _ in range(3):
        timer.lap(stage_timer.SYNC, now_ns := now_ns + 1000)
        timer.begin_period(0, unticked=True)
    period(timer, now_ns)
    timer.begin_period(0, unticked=False)
    assert timer.late_ticks == {"nodes": 3}


def test_cause_is_reset_after_a_period_in_time() -> None:
    timer = StageTimer(0)
    timer.start(0)
    now_ns = period(timer, 0, report=23 * MS)
    timer.begin_period(3, unticked=False)
    for _ in range(2):
        now_ns = period(timer, now_ns)
        timer.begin_period(3, unticked=False)
    period(timer, now_ns, tick=6 * MS)
    timer.begin_period(3, unticked=False)
    assert timer.late_ticks == {"report": 3, "tick": 1}
