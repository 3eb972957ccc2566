"""Lifecycle of one CANopen node as a pure state machine.

Public names: `advance`, `due_ns`, `is_supervised`. It uses no clock and no bus: time is an argument in ns;
the caller performs the actions and reports their results as events.
"""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from handtouch.canbus import cia301
from handtouch.canbus.nodes.lifecycle_types import (
    CONNECTION_REMEDY,
    BootUpReceived,
    BusRole,
    HeartbeatRate,
    HeartbeatReceived,
    Lifecycle,
    LifecycleEvent,
    LoopPaused,
    NodeAction,
    NodeState,
    NodeTiming,
    ProbeAnswered,
    SampleRate,
    SampleReceived,
    SamplesMissing,
    StandbyRequested,
    StepDone,
    StepFailed,
    StopRequested,
    TimerExpired,
)

Transition = tuple[Lifecycle, tuple[NodeAction, ...]]

_NEVER_NS = 1 << 62
_NO_HEARTBEAT_REASON = (
    "answers over SDO, but sends no heartbeat although its heartbeat time is set (0x1017): "
    "its firmware may hang; power-cycle it"
)
_DUPLICATE_ID_REASON = (
    "two nodes have its id: heartbeats come twice as often as configured; unplug one and give it "
    "another id (`handtouch scan` lists the serial numbers)"
)
_BABBLING_REASON = (
    "babbling: it sends {} samples per SYNC, or another device sends with its identifier; "
    "power-cycle or unplug it"
)
_TPDO_REMEDY = "check transmission type and COB-ID of its TPDO (0x1800 to 0x19FF)"
_STANDBY_REASON = "outside the scene: in standby until needed"

_BOOT_STEPS = frozenset({NodeAction.IDENTIFY, NodeAction.READ_MAPPING, NodeAction.CONFIGURE})
_IN_BOOT = frozenset({NodeState.BOOTING, NodeState.IDENTIFIED, NodeState.CONFIGURING})
_STARTED = frozenset({NodeState.SETTLING, NodeState.OPERATIONAL, NodeState.STALE})


def advance(life: Lifecycle, event: LifecycleEvent, now_ns: int, timing: NodeTiming) -> Transition:
    """Return the lifecycle after an event at `now_ns`, and the actions to perform."""
    if life.state is NodeState.STOPPED and not life.standby:
        return life, ()
    match event:
        case HeartbeatReceived(nmt):
            return _on_heartbeat(life, nmt, now_ns, timing)
        case BootUpReceived():
            return _on_boot_up(life, now_ns, timing)
        case ProbeAnswered():
            return _on_probe_answered(life, now_ns, timing)
        case StepDone():
            return _on_step_done(life, event, now_ns, timing)
        case StepFailed():
            return _on_step_failed(life, event, now_ns, timing)
        case SampleReceived():
            return _on_sample(life, now_ns, timing)
        case SamplesMissing(age_ns, bus_cause):
            return _on_samples_missing(life, age_ns, bus_cause, now_ns)
        case HeartbeatRate(doubled):
            return _on_heartbeat_rate(life, doubled, now_ns, timing)
        case SampleRate(samples_per_sync):
            return _on_sample_rate(life, samples_per_sync, now_ns, timing)
        case StandbyRequested(standby):
            return _on_standby_requested(life, standby, now_ns, timing)
        case TimerExpired(bus_cause):
            return _on_timer_expired(life, bus_cause, now_ns, timing)
        case LoopPaused(excused_ns):
            return _extend_timeouts(life, excused_ns), ()
        case StopRequested():
            # a wrong device at its id is left alone
            stop = timing.role is BusRole.MASTER and not life.wrong_device
            reason = "stopped by handtouch" if stop else "left as it was when handtouch ended"
            life = replace(_enter(life, NodeState.STOPPED, now_ns, reason), standby=False)
            return life, (NodeAction.STOP,) if stop else ()
        case _:
            assert_never(event)


def due_ns(life: Lifecycle, timing: NodeTiming) -> int | None:
    """Return the time of the next TimerExpired; None if no timer runs."""
    dues = []
    if life.state in (NodeState.ABSENT, NodeState.FAULTED, NodeState.SETTLING):
        dues.append(life.due_ns)
    if life.last_heartbeat_ns is not None and is_supervised(life):
        dues.append(life.last_heartbeat_ns + timing.heartbeat_timeout_ns)
    return min(dues, default=None)


def is_supervised(life: Lifecycle) -> bool:
    """Return True if a missing heartbeat makes the node lost."""
    ended = life.state is NodeState.STOPPED and not life.standby
    return life.last_heartbeat_ns is not None and life.state is not NodeState.ABSENT and not ended


def _enter(life: Lifecycle, state: NodeState, now_ns: int, reason: str) -> Lifecycle:
    since_ns = life.since_ns if state is life.state else now_ns
    return replace(life, state=state, since_ns=since_ns, reason=reason)


def _begin_boot(life: Lifecycle, now_ns: int, reason: str, timing: NodeTiming) -> Transition:
    """Boot the node, beginning with its identity, which a listener can't check."""
    if timing.role is BusRole.LISTENER:
        life = _enter(
            life, NodeState.SETTLING, now_ns, f"{reason}; listening only: its identity isn't checked"
        )
        return replace(
            life, started_ns=now_ns, samples_to_discard=timing.settle_samples, due_ns=_NEVER_NS
        ), ()
    life = _enter(life, NodeState.BOOTING, now_ns, reason)
    life = replace(
        life,
        attempt=life.attempt + 1,
        unanswered_probes=0,
        duplicate_id=False,
        babbling=False,
        boot_reason=reason,
    )
    return life, _identify_actions(life, timing)


def _identify_actions(life: Lifecycle, timing: NodeTiming) -> tuple[NodeAction, ...]:
    """Return the actions to identify a node; a stopped one doesn't serve SDO and becomes pre-operational."""
    if life.nmt_state == cia301.STOPPED and not life.wrong_device and timing.role is BusRole.MASTER:
        return NodeAction.ENTER_PREOPERATIONAL, NodeAction.IDENTIFY
    return (NodeAction.IDENTIFY,)


def _on_heartbeat(life: Lifecycle, nmt: int, now_ns: int, timing: NodeTiming) -> Transition:
    if life.last_heartbeat_ns is not None or timing.role is BusRole.LISTENER:
        life = replace(life, last_heartbeat_ns=max(now_ns, life.last_heartbeat_ns or 0))
    just_stopped = nmt == cia301.STOPPED != life.nmt_state
    left_stopped = life.nmt_state == cia301.STOPPED != nmt
    report = f"heartbeat: node is {cia301.NMT_NAMES.get(nmt, f'in NMT state {nmt}')}"
    boot_reason = _with_loss_reason(life, report)
    life = replace(life, nmt_state=nmt, last_frame_ns=now_ns, heartbeat_required=False)
    if life.state is NodeState.ABSENT or (life.state in _IN_BOOT and just_stopped):
        return _begin_boot(life, now_ns, boot_reason, timing)
    if life.state is NodeState.FAULTED and left_stopped and not (life.duplicate_id or life.babbling):
        life = replace(life, due_ns=now_ns)  # while stopped it couldn't respond
    # A heartbeat sent before the NMT command may still arrive after it.
    settled = now_ns - life.started_ns > 2 * timing.heartbeat_period_ns
    if life.state is NodeState.STOPPED and nmt != cia301.STOPPED and settled:
        return replace(life, started_ns=now_ns), (NodeAction.ENTER_STANDBY,)
    if life.state in _STARTED and timing.role is not BusRole.MASTER:
        return _track_other_master(life, report, now_ns, timing, settled), ()
    if life.state in _STARTED and nmt != cia301.OPERATIONAL and settled:
        return _begin_boot(life, now_ns, f"{report}, although it was started", timing)
    return life, ()


def _track_other_master(
    life: Lifecycle, report: str, now_ns: int, timing: NodeTiming, settled: bool
) -> Lifecycle:
    """Update the state of a node that another NMT master starts and stops."""
    if life.nmt_state != cia301.OPERATIONAL and settled:
        life = _enter(life, NodeState.SETTLING, now_ns, f"{report}; another master has to start it")
        return replace(life, samples_to_discard=timing.settle_samples, due_ns=_NEVER_NS)
    if life.nmt_state == cia301.OPERATIONAL and life.state is NodeState.SETTLING and life.due_ns == _NEVER_NS:
        life = _enter(life, NodeState.SETTLING, now_ns, "started by another master")
        return replace(life, due_ns=now_ns + timing.settle_timeout_ns)
    return life


def _on_boot_up(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    by_itself = life.state is not NodeState.ABSENT
    reason = _with_loss_reason(life, "rebooted by itself" if by_itself else "boot-up message")
    life = replace(
        life,
        nmt_state=cia301.PREOPERATIONAL,
        last_frame_ns=now_ns,
        last_heartbeat_ns=None,  # after a restart the heartbeat time is the node's default, perhaps 0
        heartbeat_required=False,
        failures=0,  # of boots before the restart
        reboots=life.reboots + by_itself,
    )
    return _begin_boot(life, now_ns, reason, timing)


def _on_probe_answered(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    life = replace(life, last_frame_ns=now_ns)
    if life.state is not NodeState.ABSENT:
        return life, ()
    return _begin_boot(
        replace(life, nmt_state=None), now_ns, _with_loss_reason(life, "answers over SDO"), timing
    )


def _with_loss_reason(life: Lifecycle, reason: str) -> str:
    """Append why a node was lost, since it may be back before that was published."""
    was_lost = life.state is NodeState.ABSENT and life.heartbeat_required
    return f"{reason}, but was {life.reason.partition(';')[0]}" if was_lost else reason


def _on_step_done(life: Lifecycle, event: StepDone, now_ns: int, timing: NodeTiming) -> Transition:
    if event.attempt != life.attempt:
        return life, ()
    life = replace(life, last_frame_ns=now_ns)
    match event.step:
        case NodeAction.IDENTIFY if life.state in (NodeState.BOOTING, NodeState.FAULTED):
            life = replace(
                _enter(life, NodeState.IDENTIFIED, now_ns, "identity as expected"), wrong_device=False
            )
            return life, (NodeAction.READ_MAPPING,)
        case NodeAction.READ_MAPPING if life.state is NodeState.IDENTIFIED:
            life = _enter(life, NodeState.CONFIGURING, now_ns, "PDO mapping as expected")
            return life, (NodeAction.CONFIGURE,)
        case NodeAction.CONFIGURE if life.state is NodeState.CONFIGURING:
            return _start_node(life, now_ns, timing)
        case NodeAction.ENTER_STANDBY if life.state is NodeState.STOPPED:
            return _enter(life, NodeState.STOPPED, now_ns, _STANDBY_REASON), ()
    return life, ()


def _start_node(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Start a configured node, or stop it in standby; its first samples are discarded.

    A node found running is started, too: it may have been made pre-operational to be configured.
    """
    if life.standby:
        life = replace(life, last_heartbeat_ns=now_ns, started_ns=now_ns)
        return _on_standby_requested(_enter(life, NodeState.SETTLING, now_ns, ""), True, now_ns, timing)
    running = life.nmt_state == cia301.OPERATIONAL
    ours = timing.role is BusRole.MASTER
    reason = "started" if ours else "configured; another master has to start it"
    life = _enter(life, NodeState.SETTLING, now_ns, "found running" if running else reason)
    life = replace(
        life,
        last_heartbeat_ns=now_ns,
        started_ns=now_ns,
        samples_to_discard=timing.settle_samples,
        due_ns=now_ns + timing.settle_timeout_ns if running or ours else _NEVER_NS,
    )
    return life, (NodeAction.START,) if ours else ()


def _on_step_failed(life: Lifecycle, event: StepFailed, now_ns: int, timing: NodeTiming) -> Transition:
    if event.attempt != life.attempt:
        return life, ()
    if event.step is NodeAction.SET_TRANSMISSION and event.timed_out and life.state in _STARTED:
        # its TPDO may be disabled now
        return _begin_boot(life, now_ns, event.reason, timing)
    if event.step is NodeAction.ENTER_STANDBY and life.state is NodeState.STOPPED:
        return _enter(life, NodeState.STOPPED, now_ns, f"{_STANDBY_REASON}, but {event.reason}"), ()
    if event.step not in _BOOT_STEPS or life.state not in _IN_BOOT | {NodeState.FAULTED}:
        return life, ()
    quiet_ns = now_ns - life.last_frame_ns if life.last_frame_ns is not None else now_ns
    is_lost = event.timed_out and quiet_ns > timing.heartbeat_timeout_ns
    life = _enter(life, NodeState.ABSENT if is_lost else NodeState.FAULTED, now_ns, event.reason)
    failures = life.failures + 1
    life = replace(
        life,
        failures=failures,
        wrong_device=life.wrong_device or event.wrong_device,
        due_ns=now_ns + timing.retry_delay_ns(failures),
        last_heartbeat_ns=None if is_lost else life.last_heartbeat_ns,
    )
    return life, ()


def _on_sample(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    if life.state is NodeState.ABSENT and timing.role is BusRole.LISTENER and not life.heartbeat_required:
        return _begin_boot(life, now_ns, "samples received", timing)
    if life.state not in (NodeState.SETTLING, NodeState.STALE):
        return life, ()
    if life.samples_to_discard == 0 and not life.heartbeat_required:
        return replace(_enter(life, NodeState.OPERATIONAL, now_ns, ""), failures=0), ()
    if life.state is NodeState.STALE:
        life = _enter(life, NodeState.SETTLING, now_ns, "samples received")
    return replace(
        life, samples_to_discard=max(life.samples_to_discard - 1, 0), due_ns=now_ns + timing.settle_timeout_ns
    ), ()


def _extend_timeouts(life: Lifecycle, excused_ns: int) -> Lifecycle:
    if life.last_heartbeat_ns is not None:
        life = replace(life, last_heartbeat_ns=life.last_heartbeat_ns + excused_ns)
    if life.state is NodeState.SETTLING and life.due_ns != _NEVER_NS:
        life = replace(life, due_ns=life.due_ns + excused_ns)
    return life


def _on_samples_missing(life: Lifecycle, age_ns: int, bus_cause: str, now_ns: int) -> Transition:
    if life.state is not NodeState.OPERATIONAL:
        return life, ()
    heartbeat = "heartbeat present" if life.last_heartbeat_ns is not None else "no heartbeat either"
    cause = bus_cause or f"{heartbeat}; {_TPDO_REMEDY}"
    return _enter(life, NodeState.STALE, now_ns, f"no sample for {age_ns / 1e6:.0f} ms, {cause}"), ()


def _on_standby_requested(life: Lifecycle, standby: bool, now_ns: int, timing: NodeTiming) -> Transition:
    if timing.role is not BusRole.MASTER:  # only the NMT master stops nodes
        return life, ()
    life = replace(life, standby=standby)
    if standby and life.state in _STARTED:
        life = _enter(life, NodeState.STOPPED, now_ns, _STANDBY_REASON)
        return replace(life, nmt_state=cia301.STOPPED, started_ns=now_ns), (NodeAction.ENTER_STANDBY,)
    if not standby and life.state is NodeState.STOPPED:
        return _begin_boot(life, now_ns, "needed again", timing)
    return life, ()


def _on_heartbeat_rate(life: Lifecycle, doubled: bool, now_ns: int, timing: NodeTiming) -> Transition:
    if not doubled:
        return replace(life, duplicate_id=False, due_ns=now_ns if life.duplicate_id else life.due_ns), ()
    # where another master is present, that one may set the heartbeat time
    if life.state is NodeState.ABSENT or timing.role is not BusRole.MASTER:
        return life, ()
    life = _enter(life, NodeState.FAULTED, now_ns, _DUPLICATE_ID_REASON)
    return replace(life, duplicate_id=True, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns), ()


def _on_sample_rate(life: Lifecycle, samples_per_sync: int, now_ns: int, timing: NodeTiming) -> Transition:
    if not samples_per_sync:
        return replace(life, babbling=False, due_ns=now_ns if life.babbling else life.due_ns), ()
    # another master may configure any transmission
    if life.state not in _STARTED or timing.role is not BusRole.MASTER:
        return life, ()
    life = _enter(life, NodeState.FAULTED, now_ns, _BABBLING_REASON.format(samples_per_sync))
    return replace(life, babbling=True, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns), ()


def _on_timer_expired(life: Lifecycle, bus_cause: str, now_ns: int, timing: NodeTiming) -> Transition:
    if life.last_heartbeat_ns is not None and is_supervised(life):
        quiet_ns = now_ns - life.last_heartbeat_ns
        if quiet_ns > timing.heartbeat_timeout_ns:
            return _on_heartbeat_timeout(life, quiet_ns, bus_cause, now_ns, timing), ()
    if now_ns < life.due_ns:
        return life, ()
    if life.state is NodeState.ABSENT and timing.role is BusRole.LISTENER:
        return replace(life, due_ns=_NEVER_NS), ()
    if life.state is NodeState.ABSENT:
        probes = life.unanswered_probes + 1
        return replace(life, unanswered_probes=probes, due_ns=now_ns + timing.retry_delay_ns(probes)), (
            NodeAction.PROBE,
        )
    if life.state is NodeState.FAULTED:
        # It stays FAULTED, with its reason, until an attempt gets past the failed step.
        life = replace(life, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns)
        return life, () if life.duplicate_id or life.babbling else _identify_actions(life, timing)
    if life.state is NodeState.SETTLING:
        cause = f", {bus_cause}" if bus_cause else f"; {_TPDO_REMEDY}"
        return _enter(life, NodeState.STALE, now_ns, f"started, but no sample received{cause}"), ()
    return life, ()


def _on_heartbeat_timeout(
    life: Lifecycle, quiet_ns: int, bus_cause: str, now_ns: int, timing: NodeTiming
) -> Lifecycle:
    """Return the lifecycle of a node whose heartbeat has timed out."""
    if life.heartbeat_required and timing.role is not BusRole.LISTENER and not bus_cause:
        # present, since it was just configured: retried with growing delays
        failures = life.failures + 1
        life = _enter(life, NodeState.FAULTED, now_ns, _NO_HEARTBEAT_REASON)
        return replace(
            life, last_heartbeat_ns=None, failures=failures, due_ns=now_ns + timing.retry_delay_ns(failures)
        )
    cause = f", {bus_cause}" if bus_cause else f"; {CONNECTION_REMEDY}"
    reason = f"lost: no heartbeat for {quiet_ns / 1e6:.0f} ms{cause}"
    life = replace(_enter(life, NodeState.ABSENT, now_ns, reason), last_heartbeat_ns=None, nmt_state=None)
    return replace(life, heartbeat_required=True, failures=0, due_ns=now_ns + timing.retry_delay_ns(0))
