"""Where the time goes is counted whole, and what makes a tick late has a name."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from handtouch.daemon import histogram
from handtouch.daemon.histogram import MACHINE, STAGES, UNIT_NS, Histogram, StageClock

MS = 1_000_000
PERIOD_NS = 5 * MS


@given(st.lists(st.integers(0, 2**62), max_size=50))
def test_every_duration_is_in_the_bucket_that_it_is_below_and_not_below_the_one_before(
    durations: list[int],
) -> None:
    counted = Histogram()
    for duration_ns in durations:
        counted.add(duration_ns)
    figures = counted.figures()
    assert sum(figures["counts"]) == len(durations)
    assert figures["sum_s"] * 1e9 == sum(durations) or abs(figures["sum_s"] - sum(durations) * 1e-9) < 1e-3
    below = 0
    for k, count in enumerate(figures["counts"]):
        below += count
        assert below == sum(duration_ns < UNIT_NS * 2**k for duration_ns in durations)


def period(clock: StageClock, start_ns: int, **took_ns: int) -> int:
    """A period of the loop, in which the stages took so long; where it ends."""
    now_ns = start_ns
    for stage, name in enumerate(STAGES):
        now_ns += took_ns.get(name, 10_000)
        if name == "wait":
            clock.slept(now_ns - took_ns.get(MACHINE, 0), now_ns)
        else:
            clock.lap(stage, now_ns)
        if name == "send":
            clock.ticked(start_ns, PERIOD_NS, now_ns - 50_000, now_ns)
    return now_ns


def test_the_stages_of_a_period_add_up_to_it() -> None:
    clock = StageClock(0)
    clock.start(1000)
    end_ns = period(clock, 1000, wait=3 * MS, tick=MS)
    clock.begin(0, unticked=False)
    figures = clock.figures()
    assert round(sum(stage["sum_s"] for stage in figures["stages"].values()) * 1e9) == end_ns - 1000
    assert figures["latency"]["counts"][6] == 1  # 50 us
    assert figures["late"] == {}


def test_a_late_tick_is_counted_once_under_what_took_longest() -> None:
    for name in set(STAGES) - {"wait"}:
        clock = StageClock(0)
        clock.start(0)
        now_ns = period(clock, 0)
        clock.begin(0, unticked=False)
        period(clock, now_ns, wait=4 * MS, **{name: 6 * MS})
        skipped = 0 if STAGES.index(name) <= STAGES.index("send") else 1
        clock.begin(skipped, unticked=False)
        assert clock.late == {name: 1}, name
        assert clock.take_late() == [(name, 1, 6 * MS)]
        assert clock.take_late() == []


def test_time_that_the_machine_kept_for_itself_is_not_laid_on_the_loop() -> None:
    clock = StageClock(0)
    clock.start(0)
    period(clock, 0, wait=9 * MS, machine=6 * MS, tick=MS)
    clock.begin(0, unticked=False)
    assert clock.late == {MACHINE: 1}


def test_periods_without_a_tick_count_each_and_have_the_cause_of_the_pause() -> None:
    clock = StageClock(0)
    clock.start(0)
    period(clock, 0, report=23 * MS)
    clock.begin(3, unticked=False)
    assert clock.late == {"report": 3}
    assert clock.take_late() == [("report", 3, 23 * MS)]


def test_syncs_of_the_kernel_that_piled_up_in_a_pause_have_its_cause() -> None:
    clock = StageClock(0)
    clock.start(0)
    now_ns = period(clock, 0, nodes=23 * MS)
    clock.begin(0, unticked=False)  # the first that is seen: its tick is to come
    for _ in range(3):
        clock.lap(histogram.SYNC, now_ns := now_ns + 1000)
        clock.begin(0, unticked=True)
    period(clock, now_ns)
    clock.begin(0, unticked=False)
    assert clock.late == {"nodes": 3}


def test_after_a_period_in_time_an_old_cause_is_forgotten() -> None:
    clock = StageClock(0)
    clock.start(0)
    now_ns = period(clock, 0, report=23 * MS)
    clock.begin(3, unticked=False)
    for _ in range(2):
        now_ns = period(clock, now_ns)
        clock.begin(3, unticked=False)
    period(clock, now_ns, tick=6 * MS)
    clock.begin(3, unticked=False)
    assert clock.late == {"report": 3, "tick": 1}
