"""A node's life: every transition, and what must hold in any order of events."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.lifecycle import (
    NMT_OPERATIONAL,
    NMT_PREOPERATIONAL,
    NMT_STOPPED,
    Action,
    Answer,
    BootUp,
    Done,
    Event,
    Failed,
    Heartbeat,
    Life,
    NodeState,
    Sample,
    Silence,
    Stop,
    Tick,
    Timing,
    advance,
    due_ns,
)

MS = 1_000_000
NOW = 10_000 * MS
TIMING = Timing(heartbeat_ns=100 * MS, heartbeat_timeout_ns=350 * MS)
A, B, I, C, S, O, T, F, X = NodeState  # noqa: E741 - absent, booting … stale, faulted, stopped


def life(state: NodeState, **changes: object) -> Life:
    """A life that has just come to a state: heard and supervised, nothing due."""
    usual = Life(
        state=state,
        since_ns=NOW - 1,
        nmt=NMT_OPERATIONAL if state in (S, O, T) else NMT_PREOPERATIONAL,
        heard_ns=NOW - 10 * MS,
        heartbeat_ns=NOW - 10 * MS if state in (S, O, T) else None,
        started_ns=NOW - 1000 * MS,
        due_ns=NOW + 1000 * MS,
        attempt=1,
        discard=3 if state is S else 0,
    )
    return replace(usual, **changes)  # type: ignore[arg-type]  # whatever fields a test names


def failed(step: Action, **changes: object) -> Failed:
    return replace(Failed(step, 1, "why"), **changes)  # type: ignore[arg-type]


IDENTIFY, MAPPING, CONFIGURE = Action.IDENTIFY, Action.READ_MAPPING, Action.CONFIGURE
WAKE = Action.ENTER_PREOPERATIONAL
QUIET = NOW - 400 * MS

TRANSITIONS: list[tuple[str, Life, Event, NodeState, tuple[Action, ...]]] = [
    # from ABSENT
    ("boot-up", life(A), BootUp(), B, (IDENTIFY,)),
    ("found pre-operational", life(A), Heartbeat(NMT_PREOPERATIONAL), B, (IDENTIFY,)),
    ("found running", life(A), Heartbeat(NMT_OPERATIONAL), B, (IDENTIFY,)),
    ("found stopped", life(A), Heartbeat(NMT_STOPPED), B, (WAKE, IDENTIFY)),
    ("found stopped, a stranger", life(A, stranger=True), Heartbeat(NMT_STOPPED), B, (IDENTIFY,)),
    ("probe answered", life(A), Answer(), B, (IDENTIFY,)),
    ("probe not due", life(A), Tick(), A, ()),
    ("probe due", life(A, due_ns=NOW), Tick(), A, (Action.PROBE,)),
    ("sample of an absent node", life(A), Sample(), A, ()),
    ("result that nobody waits for", life(A), Done(IDENTIFY, 1), A, ()),
    ("failure that nobody waits for", life(A), failed(IDENTIFY), A, ()),
    # booting
    ("identified", life(B), Done(IDENTIFY, 1), I, (MAPPING,)),
    ("result of an earlier attempt", life(B), Done(IDENTIFY, 0), B, ()),
    ("failure of an earlier attempt", life(B), failed(IDENTIFY, attempt=0), B, ()),
    ("heartbeat while booting", life(B), Heartbeat(NMT_PREOPERATIONAL), B, ()),
    ("stopped while booting", life(B), Heartbeat(NMT_STOPPED), B, (WAKE, IDENTIFY)),
    ("still stopped", life(B, nmt=NMT_STOPPED), Heartbeat(NMT_STOPPED), B, ()),
    ("boot-up while booting", life(B), BootUp(), B, (IDENTIFY,)),
    ("answer while booting", life(B), Answer(), B, ()),
    ("identity refused", life(B), failed(IDENTIFY), F, ()),
    ("silent, heard lately", life(B), failed(IDENTIFY, silent=True), F, ()),
    ("silent, not heard lately", life(B, heard_ns=QUIET), failed(IDENTIFY, silent=True), A, ()),
    ("mapping read", life(I), Done(MAPPING, 1), C, (CONFIGURE,)),
    ("mapping unusable", life(I), failed(MAPPING), F, ()),
    ("boot-up while identified", life(I), BootUp(), B, (IDENTIFY,)),
    ("configured", life(C), Done(CONFIGURE, 1), S, (Action.START,)),
    ("configured, runs already", life(C, nmt=NMT_OPERATIONAL), Done(CONFIGURE, 1), S, ()),
    ("configuration refused", life(C), failed(CONFIGURE), F, ()),
    ("boot-up while configuring", life(C), BootUp(), B, (IDENTIFY,)),
    ("step out of order", life(C), Done(IDENTIFY, 1), C, ()),
    # settling
    ("first sample", life(S), Sample(), S, ()),
    ("last sample to discard", life(S, discard=1), Sample(), O, ()),
    ("lost before, no heartbeat yet", life(S, discard=1, must_beat=True), Sample(), S, ()),
    ("no sample", life(S, due_ns=NOW), Tick(), T, ()),
    ("old heartbeat", life(S, started_ns=NOW - MS), Heartbeat(NMT_PREOPERATIONAL), S, ()),
    ("start was not heard", life(S), Heartbeat(NMT_PREOPERATIONAL), B, (IDENTIFY,)),
    # operational
    ("sample", life(O), Sample(), O, ()),
    ("heartbeat", life(O), Heartbeat(NMT_OPERATIONAL), O, ()),
    ("silence", life(O), Silence(20 * MS), T, ()),
    ("heartbeat late, not too late", life(O, heartbeat_ns=NOW - 350 * MS), Tick(), O, ()),
    ("lost", life(O, heartbeat_ns=NOW - 351 * MS), Tick(), A, ()),
    ("rebooted", life(O), BootUp(), B, (IDENTIFY,)),
    ("stopped by somebody", life(O), Heartbeat(NMT_STOPPED), B, (WAKE, IDENTIFY)),
    ("halted by somebody", life(O), Heartbeat(NMT_PREOPERATIONAL), B, (IDENTIFY,)),
    ("late failure", life(O), failed(CONFIGURE), O, ()),
    # stale
    ("samples again", life(T), Sample(), O, ()),
    ("first samples at last", life(T, discard=3), Sample(), S, ()),
    ("still silent", life(T), Silence(40 * MS), T, ()),
    ("stale and lost", life(T, heartbeat_ns=NOW - 351 * MS), Tick(), A, ()),
    ("stale and rebooted", life(T), BootUp(), B, (IDENTIFY,)),
    # faulted
    ("not yet again", life(F), Tick(), F, ()),
    ("again", life(F, due_ns=NOW), Tick(), F, (IDENTIFY,)),
    ("again, stopped", life(F, due_ns=NOW, nmt=NMT_STOPPED), Tick(), F, (WAKE, IDENTIFY)),
    ("again, a stranger", life(F, due_ns=NOW, nmt=NMT_STOPPED, stranger=True), Tick(), F, (IDENTIFY,)),
    ("again and identified", life(F), Done(IDENTIFY, 1), I, (MAPPING,)),
    ("again and in vain", life(F), failed(IDENTIFY), F, ()),
    ("faulted and gone", life(F, heard_ns=QUIET), failed(IDENTIFY, silent=True), A, ()),
    ("faulted and lost", life(F, heartbeat_ns=NOW - 351 * MS), Tick(), A, ()),
    ("faulted and rebooted", life(F), BootUp(), B, (IDENTIFY,)),
    ("heartbeat of a faulted node", life(F), Heartbeat(NMT_OPERATIONAL), F, ()),
    # stopped
    *(
        (f"stop from {state.name}", life(state), Stop(), X, (Action.STOP,))
        for state in NodeState
        if state is not X
    ),
    ("stop a stranger", life(F, stranger=True), Stop(), X, ()),
    *(
        (f"{type(event).__name__} after stop", life(X, due_ns=0), event, X, ())
        for event in (
            BootUp(),
            Heartbeat(5),
            Answer(),
            Done(IDENTIFY, 1),
            Sample(),
            Silence(1),
            Tick(),
            Stop(),
        )
    ),
]


@pytest.mark.parametrize(
    ("before", "event", "state", "actions"), [t[1:] for t in TRANSITIONS], ids=[t[0] for t in TRANSITIONS]
)
def test_transition(before: Life, event: Event, state: NodeState, actions: tuple[Action, ...]) -> None:
    after, wanted = advance(before, event, NOW, TIMING)
    assert (after.state, wanted) == (state, actions)
    assert after.since_ns == (before.since_ns if after.state is before.state else NOW)


def test_every_state_is_left_and_reached() -> None:
    changes = [(before.state, state) for _, before, _, state, _ in TRANSITIONS if before.state is not state]
    assert {state for _, state in changes} == set(NodeState)
    assert {before for before, _ in changes} == set(NodeState) - {X}


def test_time_out_tells_how_long_nothing_was_heard_and_where_to_look() -> None:
    after, _ = advance(life(O, heartbeat_ns=NOW - 400 * MS), Tick(), NOW, TIMING)
    assert after.reason == (
        "lost: no heartbeat for 400 ms; "
        "check its power, cable, node id and the bit rate and termination of the bus"
    )


def test_retries_pause_ever_longer_up_to_a_limit_and_forget_after_success() -> None:
    pauses = []
    now, faulted = NOW, life(F)
    for _ in range(12):
        faulted, _ = advance(faulted, failed(IDENTIFY, attempt=faulted.attempt), now, TIMING)
        pauses.append((faulted.due_ns - now) // MS)
        now = faulted.due_ns
        faulted, actions = advance(faulted, Tick(), now, TIMING)
        assert actions == (IDENTIFY,)
    assert pauses[:4] == [100, 200, 400, 800]
    assert pauses[-1] == 5000
    assert advance(life(S, discard=1, failures=9), Sample(), NOW, TIMING)[0].failures == 0


@pytest.mark.parametrize("heard", [BootUp(), Heartbeat(NMT_PREOPERATIONAL), Answer()])
def test_probes_in_vain_do_not_lengthen_the_pause_after_a_failed_attempt(heard: Event) -> None:
    now, absent = NOW, life(A, due_ns=NOW)
    for _ in range(20):
        absent, actions = advance(absent, Tick(), now, TIMING)
        assert actions == (Action.PROBE,)
        now = absent.due_ns
    assert now - NOW > 60_000 * MS
    booting, _ = advance(absent, heard, now, TIMING)
    lost = failed(IDENTIFY, attempt=booting.attempt, silent=True)
    faulted, _ = advance(booting, lost, now, TIMING)
    assert (faulted.state, faulted.due_ns - now) == (F, 100 * MS)


def test_attempts_before_a_reboot_do_not_lengthen_the_pause_after_it() -> None:
    booting, _ = advance(life(F, failures=9), BootUp(), NOW, TIMING)
    faulted, _ = advance(booting, failed(IDENTIFY, attempt=booting.attempt), NOW, TIMING)
    assert faulted.due_ns - NOW == 100 * MS


def test_reason_of_a_fault_stays_while_it_is_tried_again() -> None:
    faulted = advance(life(B), failed(IDENTIFY), NOW, TIMING)[0]
    again, _ = advance(faulted, Tick(), faulted.due_ns, TIMING)
    assert (again.state, again.reason) == (F, "why")


# Attempts are counted back from the present one.
EVENTS = st.one_of(
    st.just(BootUp()),
    st.builds(Heartbeat, st.sampled_from([4, 5, 127, 99])),
    st.just(Answer()),
    st.builds(Done, st.sampled_from([IDENTIFY, MAPPING, CONFIGURE]), st.sampled_from([0, 0, 0, 1])),
    st.builds(
        Failed,
        st.sampled_from([IDENTIFY, MAPPING, CONFIGURE]),
        st.sampled_from([0, 0, 0, 1]),
        st.just("why"),
        st.booleans(),
        st.booleans(),
    ),
    st.just(Sample()),
    st.builds(Silence, st.integers(0, 10**9)),
    st.just(Tick()),
)


@given(st.lists(st.tuples(EVENTS, st.integers(0, 500)), max_size=60))
def test_in_any_order_of_events(history: list[tuple[Event, int]]) -> None:
    """Trust is earned step by step, attempts are counted up, and nothing is ever due in the past for good."""
    now, current = 0, Life()
    allowed = {
        O: {S, T},
        S: {C, T},
        C: {I},
        I: {B, F},
        T: {O, S},
    }
    for drawn, pause_ms in history:
        event = drawn
        now += pause_ms * MS
        if isinstance(event, Done | Failed):
            event = replace(event, attempt=current.attempt - event.attempt)
        before = current
        current, _ = advance(before, event, now, TIMING)
        assert current.attempt >= before.attempt
        if current.state is not before.state and current.state in allowed:
            assert before.state in allowed[current.state]
        if current.state is O:
            assert not current.must_beat
            assert current.heartbeat_ns is not None
        if isinstance(event, Tick):
            due = due_ns(current, TIMING)
            assert due is None or due > now - 1
