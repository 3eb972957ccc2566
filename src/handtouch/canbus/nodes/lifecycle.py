"""The life of one CANopen node as a pure state machine: a life and an event in, a life and actions out.

Public names: `advance`, `due_ns`, `is_supervised`. No clock, no bus: time is an argument in ns, and whoever
calls carries out the actions and reports their results as events.
"""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from .life import (
    LOOK_AT,
    NMT_NAMES,
    NMT_OPERATIONAL,
    NMT_PREOPERATIONAL,
    NMT_STOPPED,
    Action,
    Answer,
    Babble,
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

Next = tuple[Life, tuple[Action, ...]]

_NEVER_NS = 1 << 62
_NO_HEARTBEAT = (
    "answers over SDO, but sends no heartbeat, though it was told to (0x1017): its firmware may hang; "
    "power-cycle it"
)
_TWINS = (
    "two nodes have its id, for heartbeats come twice as often as they should: unplug one and give it "
    "another id (`handtouch scan` tells the serial numbers)"
)
_BABBLES = (
    "its samples come {} times as often as SYNC asks for them: its firmware babbles, or another device sends "
    "with its identifier; power-cycle it, or unplug it"
)
_RESTING = "outside the scene: switched off until it is needed"

_BOOT_STEPS = frozenset({Action.IDENTIFY, Action.READ_MAPPING, Action.CONFIGURE})
_IN_BOOT = frozenset({NodeState.BOOTING, NodeState.IDENTIFIED, NodeState.CONFIGURING})
_STARTED = frozenset({NodeState.SETTLING, NodeState.OPERATIONAL, NodeState.STALE})


def advance(life: Life, event: Event, t_ns: int, timing: Timing) -> Next:
    """The life after an event at `t_ns`, and what is to be done now."""
    if life.state is NodeState.STOPPED and not life.resting:
        return life, ()
    match event:
        case Heartbeat(nmt):
            return _heartbeat(life, nmt, t_ns, timing)
        case BootUp():
            return _boot_up(life, t_ns, timing)
        case Answer():
            return _answer(life, t_ns, timing)
        case Done():
            return _done(life, event, t_ns, timing)
        case Failed():
            return _failed(life, event, t_ns, timing)
        case Sample():
            return _sample(life, t_ns, timing)
        case Silence(age_ns):
            return _silence(life, age_ns, t_ns)
        case Beats(twice):
            return _beats(life, twice, t_ns, timing)
        case Babble(times):
            return _babble(life, times, t_ns, timing)
        case Rest(resting):
            return _rest(life, resting, t_ns, timing)
        case Tick():
            return _tick(life, t_ns, timing)
        case Stop():
            # a stranger at its id is not ours to stop
            wanted = (Action.STOP,) if timing.role is Role.MASTER and not life.stranger else ()
            told = "stopped by handtouch" if wanted else "left as it was when handtouch ended"
            return replace(_enter(life, NodeState.STOPPED, t_ns, told), resting=False), wanted
        case _:
            assert_never(event)


def due_ns(life: Life, timing: Timing) -> int | None:
    """When the life needs its next Tick; None if nothing is timed."""
    dues = []
    if life.state in (NodeState.ABSENT, NodeState.FAULTED, NodeState.SETTLING):
        dues.append(life.due_ns)
    if life.heartbeat_ns is not None and is_supervised(life):
        dues.append(life.heartbeat_ns + timing.heartbeat_timeout_ns)
    return min(dues, default=None)


def is_supervised(life: Life) -> bool:
    """Whether it is lost when its heartbeats end."""
    ended = life.state is NodeState.STOPPED and not life.resting
    return life.heartbeat_ns is not None and life.state is not NodeState.ABSENT and not ended


def _enter(life: Life, state: NodeState, t_ns: int, reason: str) -> Life:
    since_ns = life.since_ns if state is life.state else t_ns
    return replace(life, state=state, since_ns=since_ns, reason=reason)


def _boot(life: Life, t_ns: int, reason: str, timing: Timing) -> Next:
    """Begin again, with the identity; a listener has to believe what it hears."""
    if timing.role is Role.LISTENER:
        life = _enter(life, NodeState.SETTLING, t_ns, f"{reason}; we only listen, its identity isn't checked")
        return replace(life, started_ns=t_ns, discard=timing.settle_samples, due_ns=_NEVER_NS), ()
    life = _enter(life, NodeState.BOOTING, t_ns, reason)
    life = replace(life, attempt=life.attempt + 1, probes=0, twins=False, babbles=False, because=reason)
    return life, _identify(life, timing)


def _identify(life: Life, timing: Timing) -> tuple[Action, ...]:
    """A stopped node doesn't serve SDO: first it is made to."""
    if life.nmt == NMT_STOPPED and not life.stranger and timing.role is Role.MASTER:
        return Action.ENTER_PREOPERATIONAL, Action.IDENTIFY
    return (Action.IDENTIFY,)


def _heartbeat(life: Life, nmt: int, t_ns: int, timing: Timing) -> Next:
    if life.heartbeat_ns is not None or timing.role is Role.LISTENER:
        life = replace(life, heartbeat_ns=t_ns)
    just_stopped = nmt == NMT_STOPPED != life.nmt
    woken = life.nmt == NMT_STOPPED != nmt
    told = f"heartbeat: node is {NMT_NAMES.get(nmt, f'in NMT state {nmt}')}"
    back = _back(life, told)
    life = replace(life, nmt=nmt, heard_ns=t_ns, must_beat=False)
    if life.state is NodeState.ABSENT or (life.state in _IN_BOOT and just_stopped):
        return _boot(life, t_ns, back, timing)
    if life.state is NodeState.FAULTED and woken and not (life.twins or life.babbles):
        life = replace(life, due_ns=t_ns)  # while stopped it couldn't answer
    # A heartbeat sent before our command may still arrive after it.
    settled = t_ns - life.started_ns > 2 * timing.heartbeat_ns
    if life.state is NodeState.STOPPED and nmt != NMT_STOPPED and settled:
        return replace(life, started_ns=t_ns), (Action.POWER_DOWN,)
    if life.state in _STARTED and timing.role is not Role.MASTER:
        return _follow(life, told, t_ns, timing, settled), ()
    if life.state in _STARTED and nmt != NMT_OPERATIONAL and settled:
        return _boot(life, t_ns, f"{told}, though it was started", timing)
    return life, ()


def _follow(life: Life, told: str, t_ns: int, timing: Timing, settled: bool) -> Life:
    """Another master starts and stops it."""
    if life.nmt != NMT_OPERATIONAL and settled:
        life = _enter(life, NodeState.SETTLING, t_ns, f"{told}; another master has to start it")
        return replace(life, discard=timing.settle_samples, due_ns=_NEVER_NS)
    if life.nmt == NMT_OPERATIONAL and life.state is NodeState.SETTLING and life.due_ns == _NEVER_NS:
        life = _enter(life, NodeState.SETTLING, t_ns, "started by another master")
        return replace(life, due_ns=t_ns + timing.settle_timeout_ns)
    return life


def _boot_up(life: Life, t_ns: int, timing: Timing) -> Next:
    by_itself = life.state is not NodeState.ABSENT
    told = _back(life, "rebooted by itself" if by_itself else "boot-up message")
    life = replace(
        life,
        nmt=NMT_PREOPERATIONAL,
        heard_ns=t_ns,
        heartbeat_ns=None,  # a restarted node's heartbeat time is its default, maybe none
        must_beat=False,
        failures=0,  # those of its life before say nothing of this one
        reboots=life.reboots + by_itself,
    )
    return _boot(life, t_ns, told, timing)


def _answer(life: Life, t_ns: int, timing: Timing) -> Next:
    life = replace(life, heard_ns=t_ns)
    if life.state is not NodeState.ABSENT:
        return life, ()
    return _boot(replace(life, nmt=None), t_ns, _back(life, "answers over SDO"), timing)


def _back(life: Life, told: str) -> str:
    """That a lost node is back, and that it was lost: it may be back before anybody has read that."""
    was_lost = life.state is NodeState.ABSENT and life.must_beat
    return f"{told}, but was {life.reason.partition(';')[0]}" if was_lost else told


def _done(life: Life, event: Done, t_ns: int, timing: Timing) -> Next:
    if event.attempt != life.attempt:
        return life, ()
    life = replace(life, heard_ns=t_ns)
    match event.step:
        case Action.IDENTIFY if life.state in (NodeState.BOOTING, NodeState.FAULTED):
            life = replace(_enter(life, NodeState.IDENTIFIED, t_ns, "identity as expected"), stranger=False)
            return life, (Action.READ_MAPPING,)
        case Action.READ_MAPPING if life.state is NodeState.IDENTIFIED:
            life = _enter(life, NodeState.CONFIGURING, t_ns, "PDO mapping as expected")
            return life, (Action.CONFIGURE,)
        case Action.CONFIGURE if life.state is NodeState.CONFIGURING:
            return _start(life, t_ns, timing)
        case Action.POWER_DOWN if life.state is NodeState.STOPPED:
            return _enter(life, NodeState.STOPPED, t_ns, _RESTING), ()
    return life, ()


def _start(life: Life, t_ns: int, timing: Timing) -> Next:
    """Trust begins after some samples; one not needed is stopped.

    A node found running is started as well: it may have been halted to be configured.
    """
    if life.resting:
        life = replace(life, heartbeat_ns=t_ns, started_ns=t_ns)
        return _rest(_enter(life, NodeState.SETTLING, t_ns, ""), True, t_ns, timing)
    running = life.nmt == NMT_OPERATIONAL
    ours = timing.role is Role.MASTER
    told = "found running" if running else "started" if ours else "configured; another master has to start it"
    life = _enter(life, NodeState.SETTLING, t_ns, told)
    life = replace(
        life,
        heartbeat_ns=t_ns,
        started_ns=t_ns,
        discard=timing.settle_samples,
        due_ns=t_ns + timing.settle_timeout_ns if running or ours else _NEVER_NS,
    )
    return life, (Action.START,) if ours else ()


def _failed(life: Life, event: Failed, t_ns: int, timing: Timing) -> Next:
    if event.attempt != life.attempt:
        return life, ()
    if event.step is Action.PACE and event.silent and life.state in _STARTED:  # its TPDO may be off now
        return _boot(life, t_ns, event.reason, timing)
    if event.step is Action.POWER_DOWN and life.state is NodeState.STOPPED:
        return _enter(life, NodeState.STOPPED, t_ns, f"{_RESTING}, but {event.reason}"), ()
    if event.step not in _BOOT_STEPS or life.state not in _IN_BOOT | {NodeState.FAULTED}:
        return life, ()
    quiet_ns = t_ns - life.heard_ns if life.heard_ns is not None else t_ns
    gone = event.silent and quiet_ns > timing.heartbeat_timeout_ns
    life = _enter(life, NodeState.ABSENT if gone else NodeState.FAULTED, t_ns, event.reason)
    failures = life.failures + 1
    stranger = life.stranger or event.stranger
    due = t_ns + timing.pause_ns(failures)
    heartbeat_ns = None if gone else life.heartbeat_ns
    return replace(life, failures=failures, stranger=stranger, due_ns=due, heartbeat_ns=heartbeat_ns), ()


def _sample(life: Life, t_ns: int, timing: Timing) -> Next:
    if life.state is NodeState.ABSENT and timing.role is Role.LISTENER and not life.must_beat:
        return _boot(life, t_ns, "samples came", timing)
    if life.state not in (NodeState.SETTLING, NodeState.STALE):
        return life, ()
    if life.discard == 0 and not life.must_beat:
        return replace(_enter(life, NodeState.OPERATIONAL, t_ns, ""), failures=0), ()
    if life.state is NodeState.STALE:
        life = _enter(life, NodeState.SETTLING, t_ns, "samples came")
    return replace(life, discard=max(life.discard - 1, 0), due_ns=t_ns + timing.settle_timeout_ns), ()


def _silence(life: Life, age_ns: int, t_ns: int) -> Next:
    if life.state is not NodeState.OPERATIONAL:
        return life, ()
    beats = "its heartbeat is there" if life.heartbeat_ns is not None else "it sends no heartbeat either"
    told = f"no sample for {age_ns / 1e6:.0f} ms, {beats}; is there a SYNC?"
    return _enter(life, NodeState.STALE, t_ns, told), ()


def _rest(life: Life, resting: bool, t_ns: int, timing: Timing) -> Next:
    if timing.role is not Role.MASTER:  # it isn't ours to stop
        return life, ()
    life = replace(life, resting=resting)
    if resting and life.state in _STARTED:
        life = _enter(life, NodeState.STOPPED, t_ns, _RESTING)
        return replace(life, nmt=NMT_STOPPED, started_ns=t_ns), (Action.POWER_DOWN,)
    if not resting and life.state is NodeState.STOPPED:
        return _boot(life, t_ns, "needed again", timing)
    return life, ()


def _beats(life: Life, twice: bool, t_ns: int, timing: Timing) -> Next:
    if not twice:
        return replace(life, twins=False, due_ns=t_ns if life.twins else life.due_ns), ()
    if life.state is NodeState.ABSENT or timing.role is not Role.MASTER:  # others may set its heartbeat, too
        return life, ()
    life = _enter(life, NodeState.FAULTED, t_ns, _TWINS)
    return replace(life, twins=True, attempt=life.attempt + 1, due_ns=t_ns + timing.retry_last_ns), ()


def _babble(life: Life, times: int, t_ns: int, timing: Timing) -> Next:
    if not times:
        return replace(life, babbles=False, due_ns=t_ns if life.babbles else life.due_ns), ()
    if life.state not in _STARTED or timing.role is not Role.MASTER:  # others may make it send as they like
        return life, ()
    life = _enter(life, NodeState.FAULTED, t_ns, _BABBLES.format(times))
    return replace(life, babbles=True, attempt=life.attempt + 1, due_ns=t_ns + timing.retry_last_ns), ()


def _tick(life: Life, t_ns: int, timing: Timing) -> Next:
    if life.heartbeat_ns is not None and is_supervised(life):
        quiet_ns = t_ns - life.heartbeat_ns
        if quiet_ns > timing.heartbeat_timeout_ns:
            return _lost(life, quiet_ns, t_ns, timing), ()
    if t_ns < life.due_ns:
        return life, ()
    if life.state is NodeState.ABSENT and timing.role is Role.LISTENER:
        return replace(life, due_ns=_NEVER_NS), ()
    if life.state is NodeState.ABSENT:
        probes = life.probes + 1
        return replace(life, probes=probes, due_ns=t_ns + timing.pause_ns(probes)), (Action.PROBE,)
    if life.state is NodeState.FAULTED:
        # It stays FAULTED, with its reason, until an attempt gets further.
        life = replace(life, attempt=life.attempt + 1, due_ns=t_ns + timing.retry_last_ns)
        return life, () if life.twins or life.babbles else _identify(life, timing)
    if life.state is NodeState.SETTLING:
        return _enter(life, NodeState.STALE, t_ns, "started, but no sample came: is there a SYNC?"), ()
    return life, ()


def _lost(life: Life, quiet_ns: int, t_ns: int, timing: Timing) -> Life:
    """No heartbeat for too long."""
    if life.must_beat and timing.role is not Role.LISTENER:
        # alive, for it was just configured: tried again less and less often
        failures = life.failures + 1
        life = _enter(life, NodeState.FAULTED, t_ns, _NO_HEARTBEAT)
        return replace(life, heartbeat_ns=None, failures=failures, due_ns=t_ns + timing.pause_ns(failures))
    told = f"lost: no heartbeat for {quiet_ns / 1e6:.0f} ms; {LOOK_AT}"
    life = replace(_enter(life, NodeState.ABSENT, t_ns, told), heartbeat_ns=None, nmt=None)
    return replace(life, must_beat=True, failures=0, due_ns=t_ns + timing.pause_ns(0))
