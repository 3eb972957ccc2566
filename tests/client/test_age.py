"""Never old: frames judged by their own time, a daemon that is gone, and the clock of another machine."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

import handtouch
from handtouch import wire
from handtouch.client.daemon_clock import MIN_AGE_LIMIT_S, DaemonClock, age_limit_s
from handtouch.client.hand_arrays import HandArrays
from handtouch.client.link_column import NotSampledError
from tests.client.hand_messages import LINKS, make_contact, make_frame, make_service

LONGEST_S = 60.0
SECOND_NS = 1_000_000_000
CLEAR, TOUCHED, STALE = wire.PadState.CLEAR, wire.PadState.TOUCHED, wire.PadState.STALE


class Clock:
    """This machine's monotonic clock, which the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = time.monotonic_ns()
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now_ns)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.fixture
def hand(publisher: Any, endpoints: dict[str, str], clock: Clock) -> Iterator[handtouch.Hand]:
    """A hand whose daemon has published one frame, of now."""
    with handtouch.Hand("right", endpoint=endpoints["live"]) as made:
        for _ in range(3):
            publisher.recv()
        publish(publisher, 1, clock.now_ns)
        receive(made, 1)
        yield made


def publish(publisher: Any, seq: int, t_ns: int, **values: Any) -> None:
    values = {"state": (CLEAR, TOUCHED, STALE), "sample_ns": (t_ns,) * 3} | values
    publisher.send_multipart(wire.encode(make_frame(seq, t_ns=t_ns, **values)))


def receive(hand: handtouch.Hand, seq: int) -> HandArrays:
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        if (arrays := hand.latest()) is not None and arrays.frame.seq == seq:
            return arrays
    raise AssertionError(f"frame {seq} never came")


# --- what isn't sampled is neither touched nor clear


@pytest.mark.parametrize("state", [s for s in wire.PadState if s not in (CLEAR, TOUCHED)])
def test_a_pad_that_is_not_sampled_is_never_not_touched(state: wire.PadState) -> None:
    arrays = HandArrays(
        make_frame(state=(CLEAR, TOUCHED, state), t_ns=2 * SECOND_NS, sample_ns=(1, 1, SECOND_NS))
    )
    assert not arrays.touched["thumb_tip"]
    assert arrays.touched["index_tip"]
    with pytest.raises(NotSampledError) as error:
        _ = arrays.touched["index_base"]
    for said in ("index_base", state.text, "1.000 s"):
        assert said in str(error.value)
    assert arrays.touched.get("index_base") is None
    assert np.ma.getmaskarray(arrays.touched.array).tolist() == [False, False, True]
    with pytest.raises(NotSampledError):
        arrays.require(["thumb_*", "index_*"])
    arrays.require("thumb_*")


# --- age


def test_nothing_counts_once_the_newest_frame_is_old(hand: handtouch.Hand, clock: Clock) -> None:
    assert hand.touched["index_tip"]
    clock.now_ns += round(1.01e9 * MIN_AGE_LIMIT_S)
    assert not any(hand.sampled.values())
    assert [hand.touched.get(link) for link in LINKS] == [None] * 3
    assert np.isnan(hand.total_force_n("index_*")).all()
    assert np.isnan(hand.wrench("index_tip", "link").force_n).all()
    assert not hand.alive
    assert not hand.contacts
    assert hand.latest() is None
    with pytest.raises(LookupError):
        _ = hand.touched


def test_a_backlog_never_counts_as_new(hand: handtouch.Hand, publisher: Any, clock: Clock) -> None:
    """The daemon hung, or the controller paused: what waits is judged by its own time."""
    for seq in range(2, 2000):
        publish(publisher, seq, clock.now_ns + seq)
    clock.now_ns += 6 * SECOND_NS
    for _ in range(500):
        assert hand.latest() is None
        time.sleep(0.0002)
    publish(publisher, 2000, clock.now_ns)
    assert receive(hand, 2000).t_ns == clock.now_ns


@pytest.mark.parametrize("stated", [{"period_s": 0.2}, {"period_s": 0.005, "frame_period_s": 0.2}])
def test_the_limit_is_three_periods_of_frames_as_service_states_them(
    hand: handtouch.Hand, publisher: Any, clock: Clock, stated: dict[str, Any]
) -> None:
    for seq in (2, 3, 4):  # frames of an overloaded daemon don't become fresh by being late
        assert hand.max_age_s == MIN_AGE_LIMIT_S
        clock.now_ns += SECOND_NS // 10
        assert hand.latest() is None
        publish(publisher, seq, clock.now_ns)
        receive(hand, seq)
    publisher.send_multipart(wire.encode(make_service(**stated)))
    end_s = time.monotonic() + LONGEST_S
    while hand.max_age_s < 0.6 and time.monotonic() < end_s:
        hand.latest()
    assert hand.max_age_s == pytest.approx(age_limit_s(0.2))


def test_frames_of_a_replay_have_the_age_since_their_reception(
    hand: handtouch.Hand, publisher: Any, clock: Clock
) -> None:
    publisher.send_multipart(wire.encode(make_service(replay=True)))
    publish(publisher, 2, 5)
    receive(hand, 2)
    clock.now_ns += SECOND_NS // 50
    assert hand.age_s["index_tip"] == pytest.approx(0.02)
    clock.now_ns += SECOND_NS
    assert hand.latest() is None


# --- a daemon that is gone


def _end(publisher: Any) -> None:
    publisher.setsockopt(zmq.LINGER, 0)
    publisher.close()


@pytest.mark.usefixtures("clock")
def test_a_disconnection_voids_everything_at_once(hand: handtouch.Hand, publisher: Any) -> None:
    """The clock stands still, so that it isn't age that tells."""
    assert hand.latest() is not None
    _end(publisher)
    end_s = time.monotonic() + LONGEST_S
    while hand.latest() is not None:
        assert time.monotonic() < end_s
    assert not hand.alive


@pytest.mark.usefixtures("clock")
def test_loops_end_with_an_error_when_the_daemon_is_gone(hand: handtouch.Hand, publisher: Any) -> None:
    frames = iter(hand)
    publish(publisher, 2, time.monotonic_ns())
    next(frames)
    _end(publisher)
    with pytest.raises(ConnectionError):
        next(frames)


@pytest.mark.usefixtures("clock")
def test_asynchronous_loops_end_with_an_error_when_the_daemon_is_gone(
    hand: handtouch.Hand, publisher: Any
) -> None:
    async def main() -> int:
        count = 0
        async for _ in hand:
            count += 1
            _end(publisher)
        return count

    with pytest.raises(ConnectionError):
        asyncio.run(main())


@pytest.mark.usefixtures("clock")
def test_loops_end_with_an_error_when_the_daemon_is_another(hand: handtouch.Hand, publisher: Any) -> None:
    frames = iter(hand)
    publish(publisher, 2, time.monotonic_ns())
    next(frames)
    publish(publisher, 1, time.monotonic_ns(), session=2)
    with pytest.raises(ConnectionError):
        next(frames)


def test_callbacks_are_told_that_the_daemon_is_gone(publisher: Any, endpoints: dict[str, str]) -> None:
    lost, seen = [threading.Event(), threading.Event()], [threading.Event(), threading.Event()]
    with handtouch.Hand("right", endpoint=endpoints["live"], max_age_s=1e9) as hand:
        hand.on_frame(lambda _: seen[0].set(), lost[0].set)
        hand.on_contact(lambda _: seen[1].set(), lost[1].set)
        end_s = time.monotonic() + LONGEST_S
        for seq in range(1, 10_000):
            publish(publisher, seq, time.monotonic_ns())
            publisher.send_multipart(wire.encode(make_contact("index_tip", "begin", seq, seq=seq)))
            publisher.send_multipart(wire.encode(make_service(seq=seq)))
            if all(event.wait(0.01) for event in seen) and seq > 30:
                break
            assert time.monotonic() < end_s
        assert not lost[0].is_set()
        _end(publisher)
        assert all(event.wait(LONGEST_S) for event in lost)


# --- the clock of another machine


@given(
    offset_ns=st.integers(-(10**18), 10**18),
    delays_ns=st.lists(st.integers(100_000, 5 * SECOND_NS), min_size=1, max_size=30),
    steps_ns=st.lists(st.integers(0, 60 * SECOND_NS), min_size=30, max_size=30),
)
def test_an_age_by_the_smallest_delay_is_a_lower_bound_and_never_negative(
    offset_ns: int, delays_ns: list[int], steps_ns: list[int]
) -> None:
    clock, daemon_ns = DaemonClock(is_local=False), 10**19
    assert clock.daemon_ns(daemon_ns + offset_ns) is None
    for delay_ns, step_ns in zip(delays_ns, steps_ns, strict=False):
        daemon_ns += step_ns
        received_ns = daemon_ns + delay_ns + offset_ns
        clock.observe(daemon_ns, received_ns)
        now_ns = clock.daemon_ns(received_ns)
        assert now_ns is not None
        assert 0 <= now_ns - daemon_ns <= delay_ns
        assert clock.uncertainty_s == np.inf


@given(
    offset_ns=st.integers(-(10**15), 10**15),
    ways_ns=st.lists(
        st.tuples(st.integers(0, SECOND_NS), st.integers(0, SECOND_NS)), min_size=1, max_size=20
    ),
)
def test_round_trips_bound_the_clock_by_the_stated_uncertainty(
    offset_ns: int, ways_ns: list[tuple[int, int]]
) -> None:
    clock, t_ns = DaemonClock(is_local=False), 10**15
    for there_ns, back_ns in ways_ns:
        t_ns += 5 * SECOND_NS
        clock.measure(t_ns + offset_ns - there_ns, t_ns, t_ns + offset_ns + back_ns)
        found_ns = clock.daemon_ns(t_ns + offset_ns + back_ns)
        assert found_ns is not None
        error_ns = abs(found_ns - (t_ns + back_ns))
        assert error_ns <= 1e9 * clock.uncertainty_s + 10
        assert clock.uncertainty_s <= 0.5e-9 * (there_ns + back_ns) + 1e-8


def test_after_a_pause_a_backlog_from_another_machine_is_as_old_as_it_is() -> None:
    """The smallest delay seen is kept, widened by the drift of clocks only."""
    clock, offset_ns = DaemonClock(is_local=False), 10**12
    for t_ns in range(0, SECOND_NS, SECOND_NS // 100):
        clock.observe(t_ns, t_ns + offset_ns + 1_000_000)
    times_ns = [SECOND_NS, 2 * SECOND_NS, 3 * SECOND_NS]
    ages_s = []
    for t_ns in times_ns:
        clock.observe(t_ns, 61 * SECOND_NS + offset_ns)
        ages_s.append(1e-9 * ((clock.daemon_ns(61 * SECOND_NS + offset_ns) or 0) - t_ns))
    assert ages_s[0] == pytest.approx(60.0, abs=0.05)
    assert all(before > after for before, after in pairwise(ages_s))
