"""A node's life: every transition, and what must hold in any order of events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.canbus.nodes.life import (
    NMT_OPERATIONAL,
    NMT_PREOPERATIONAL,
    NMT_STOPPED,
    Action,
    Answer,
    Beats,
    BootUp,
    Done,
    Event,
    Failed,
    Heartbeat,
    Life,
    NodeState,
    Rest,
    Role,
    Sample,
    Silence,
    Stop,
    Tick,
    Timing,
)
from handtouch.canbus.nodes.lifecycle import advance, due_ns

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
    ("configured, runs already", life(C, nmt=NMT_OPERATIONAL), Done(CONFIGURE, 1), S, (Action.START,)),
    ("configuration refused", life(C), failed(CONFIGURE), F, ()),
    ("boot-up while configuring", life(C), BootUp(), B, (IDENTIFY,)),
    ("step out of order", life(C), Done(IDENTIFY, 1), C, ()),
    # settling
    ("first sample", life(S), Sample(), S, ()),
    ("last sample to discard", life(S, discard=1), Sample(), S, ()),
    ("first sample to trust", life(S, discard=0), Sample(), O, ()),
    ("lost before, no heartbeat yet", life(S, discard=0, must_beat=True), Sample(), S, ()),
    ("configured, yet no heartbeat", life(S, must_beat=True, heartbeat_ns=QUIET), Tick(), F, ()),
    ("not synchronous again, no answer", life(O), failed(Action.PACE, silent=True), B, (IDENTIFY,)),
    ("refuses to be event-driven", life(O), failed(Action.PACE), O, ()),
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
    ("awake at last", life(F, nmt=NMT_STOPPED), Heartbeat(NMT_PREOPERATIONAL), F, ()),
    # two nodes with its id
    ("twice as many heartbeats", life(O), Beats(True), F, ()),
    ("twins at rest", life(X, resting=True), Beats(True), F, ()),
    ("twins of an absent node", life(A), Beats(True), A, ()),
    ("as many heartbeats as should be", life(O), Beats(False), O, ()),
    ("twins are not tried again", life(F, twins=True, due_ns=NOW), Tick(), F, ()),
    ("a twin reboots", life(F, twins=True), BootUp(), B, (IDENTIFY,)),
    # outside the scene
    *(
        (f"not needed while {state.name}", life(state), Rest(True), X, (Action.POWER_DOWN,))
        for state in (S, O, T)
    ),
    *((f"not needed while {state.name}", life(state), Rest(True), state, ()) for state in (A, B, I, C, F)),
    ("configured, not needed", life(C, resting=True), Done(CONFIGURE, 1), X, (Action.POWER_DOWN,)),
    ("needed again", life(X, resting=True, nmt=NMT_STOPPED), Rest(False), B, (WAKE, IDENTIFY)),
    ("not needed still", life(X, resting=True), Rest(True), X, ()),
    ("rebooted at rest", life(X, resting=True), BootUp(), B, (IDENTIFY,)),
    ("lost at rest", life(X, resting=True, heartbeat_ns=QUIET), Tick(), A, ()),
    ("at rest", life(X, resting=True), Heartbeat(NMT_STOPPED), X, ()),
    ("should rest, but runs", life(X, resting=True), Heartbeat(NMT_OPERATIONAL), X, (Action.POWER_DOWN,)),
    ("runs, was just told to rest", life(X, resting=True, started_ns=NOW), Heartbeat(5), X, ()),
    ("switched off", life(X, resting=True), Done(Action.POWER_DOWN, 1), X, ()),
    ("can't be switched off", life(X, resting=True), failed(Action.POWER_DOWN), X, ()),
    ("stop at rest", life(X, resting=True), Stop(), X, (Action.STOP,)),
    ("needed, as it was", life(O), Rest(False), O, ()),
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
            Beats(True),
            Rest(False),
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
    assert {before for before, _ in changes} == set(NodeState)  # stopped: at rest only


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
    assert advance(life(S, discard=0, failures=9), Sample(), NOW, TIMING)[0].failures == 0


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


@pytest.mark.parametrize("seen", [Heartbeat(NMT_PREOPERATIONAL), Heartbeat(NMT_OPERATIONAL)])
def test_node_that_could_not_answer_while_stopped_is_tried_as_soon_as_it_can(seen: Event) -> None:
    faulted, _ = advance(life(F, nmt=NMT_STOPPED), seen, NOW, TIMING)
    assert advance(faulted, Tick(), NOW, TIMING)[1] == (IDENTIFY,)


def test_node_whose_twin_is_gone_is_tried_at_once() -> None:
    single, _ = advance(life(F, twins=True), Beats(False), NOW, TIMING)
    assert advance(single, Tick(), NOW, TIMING)[1] == (IDENTIFY,)


def test_node_that_answers_a_probe_and_then_nothing_is_tried_less_and_less_often() -> None:
    now, absent, pauses = NOW, life(A, due_ns=NOW), []
    for _ in range(8):
        absent, actions = advance(absent, Tick(), now, TIMING)
        assert actions == (Action.PROBE,)
        booting, _ = advance(absent, Answer(), now, TIMING)
        now += 400 * MS
        lost = failed(IDENTIFY, attempt=booting.attempt, silent=True)
        absent, _ = advance(booting, lost, now, TIMING)
        assert absent.state is A
        pauses.append((absent.due_ns - now) // MS)
        now = absent.due_ns
    assert pauses == [100, 200, 400, 800, 1600, 3200, 5000, 5000]


def test_what_went_wrong_when_it_was_switched_off_is_told() -> None:
    refused, _ = advance(life(X, resting=True), failed(Action.POWER_DOWN), NOW, TIMING)
    assert refused.reason == "outside the scene: switched off until it is needed, but why"
    again, _ = advance(refused, Done(Action.POWER_DOWN, 1), NOW, TIMING)
    assert again.reason == "outside the scene: switched off until it is needed"


# Attempts are counted back from the present one.
STEPS = [IDENTIFY, MAPPING, CONFIGURE, Action.POWER_DOWN, Action.PACE]
EVENTS = st.one_of(
    st.just(BootUp()),
    st.builds(Heartbeat, st.sampled_from([4, 5, 127, 99])),
    st.just(Answer()),
    st.builds(Done, st.sampled_from(STEPS), st.sampled_from([0, 0, 0, 1])),
    st.builds(
        Failed,
        st.sampled_from(STEPS),
        st.sampled_from([0, 0, 0, 1]),
        st.just("why"),
        st.booleans(),
        st.booleans(),
    ),
    st.just(Sample()),
    st.builds(Silence, st.integers(0, 10**9)),
    st.builds(Beats, st.booleans()),
    st.builds(Rest, st.booleans()),
    st.just(Tick()),
)
HISTORIES = st.lists(st.tuples(EVENTS, st.integers(0, 500)), max_size=60)
COMMANDS = {Action.ENTER_PREOPERATIONAL, Action.START, Action.STOP, Action.POWER_DOWN}
ALLOWED = {  # by what a state can be preceded
    O: {S, T},
    C: {I},
    I: {B, F},
    T: {O, S},
}


def lived(
    history: list[tuple[Event, int]], role: Role
) -> Iterator[tuple[Life, Event, Life, tuple[Action, ...], int]]:
    """Each step of a history: life before, event, life after, actions and time."""
    now, current, timing = 0, Life(), replace(TIMING, role=role)
    for drawn, pause_ms in history:
        event = drawn
        now += pause_ms * MS
        if isinstance(event, Done | Failed):
            event = replace(event, attempt=current.attempt - event.attempt)
        before = current
        current, actions = advance(before, event, now, timing)
        yield before, event, current, actions, now


@given(HISTORIES, st.sampled_from(Role))
def test_in_any_order_of_events(history: list[tuple[Event, int]], role: Role) -> None:
    """Trust is earned step by step, attempts are counted up, and nothing is ever due in the past for good."""
    for before, event, after, actions, now in lived(history, role):
        assert after.attempt >= before.attempt
        assert before.since_ns <= after.since_ns <= now
        assert after.reason or after.state is O
        if after.state is not before.state and after.state in ALLOWED:
            assert before.state in ALLOWED[after.state]
        if after.state is O:
            assert not after.must_beat
            assert after.heartbeat_ns is not None or role is Role.LISTENER
        if after.stranger:
            assert not COMMANDS & set(actions)
        if after.resting:
            assert Action.START not in actions
        if isinstance(event, Tick):
            due = due_ns(after, replace(TIMING, role=role))
            assert due is None or due > now - 1
        if role is not Role.MASTER:
            assert not COMMANDS & set(actions)
            assert not after.resting
        if role is Role.LISTENER:
            assert actions == ()


class Answering:
    """A node that is there and right, and does what it is told; time passes 5 ms at a time."""

    def __init__(self, life: Life, now: int, nmt: int, beats: bool) -> None:
        self.life, self.now, self.nmt, self.beats = life, now, nmt, beats
        pending = {B: IDENTIFY, I: MAPPING, C: CONFIGURE}.get(life.state)  # a worker is at it, or was
        self.jobs = [(now, pending, life.attempt)] if pending else []

    def pass_time(self, ms: int) -> None:
        for _ in range(ms // 5):
            self.now += 5 * MS
            if self.nmt == NMT_OPERATIONAL:
                self.tell(Sample())
            if self.beats and self.now % (100 * MS) == 0:
                self.tell(Heartbeat(self.nmt))
            due = due_ns(self.life, TIMING)
            if due is not None and due <= self.now:
                self.tell(Tick())
            ended = [job for job in self.jobs if job[0] <= self.now]
            self.jobs = [job for job in self.jobs if job[0] > self.now]
            for _, step, attempt in ended:
                silent = self.nmt == NMT_STOPPED
                self.beats |= step is CONFIGURE and not silent
                self.tell(Failed(step, attempt, "no answer", True) if silent else Done(step, attempt))

    def tell(self, event: Event) -> None:
        self.life, actions = advance(self.life, event, self.now, TIMING)
        for action in actions:
            if action is Action.PROBE:
                self.tell(Heartbeat(self.nmt) if self.nmt == NMT_STOPPED else Answer())
            elif action in COMMANDS:
                self.nmt = {WAKE: NMT_PREOPERATIONAL, Action.START: NMT_OPERATIONAL}.get(action, NMT_STOPPED)
            else:
                patience = 400 if self.nmt == NMT_STOPPED else 5
                self.jobs.append((self.now + patience * MS, action, self.life.attempt))


@settings(max_examples=100, deadline=None)
@given(HISTORIES, st.sampled_from([4, 5, 127]), st.booleans())
def test_node_that_is_there_and_right_is_operational_soon_whatever_was_before(
    history: list[tuple[Event, int]], nmt: int, beats: bool
) -> None:
    """Within the longest pause and the time to boot; one that isn't needed is stopped by then.

    One that took a stranger's place can't be asked who it is while somebody keeps it stopped.
    """
    steps = list(lived(history, Role.MASTER))
    current, now = (steps[-1][2], steps[-1][4]) if steps else (Life(), 0)
    if current.twins:
        current, _ = advance(current, Beats(False), now, TIMING)
    nmt = NMT_PREOPERATIONAL if current.stranger else nmt
    node = Answering(current, now // (5 * MS) * 5 * MS, nmt, beats)
    node.pass_time(7000)
    wanted = (X, NMT_STOPPED) if node.life.resting else (O, NMT_OPERATIONAL)
    assert (node.life.state, node.nmt) == wanted, node.life
    node.pass_time(2000)
    assert (node.life.state, node.nmt) == wanted, node.life
