"""Lifecycle of one CANopen node as a pure state machine.

Public names: `advance`, `due_ns`, `is_supervised`. It uses no clock and no bus: time is an argument in ns;
the caller performs the actions and reports their results as events.
"""

from __future__ import annotations

from typing import assert_never

from handtouch.canbus import cia301
from handtouch.canbus.nodes import instability, silence
from handtouch.canbus.nodes.lifecycle_types import (
    BootUpReceived,
    BusRecovered,
    BusRole,
    ErrorsReported,
    ForeignNmtCommand,
    HeartbeatRate,
    HeartbeatReceived,
    IdentifierClash,
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
from handtouch.canbus.nodes.transitions import (
    NEVER_NS,
    STARTED,
    Transition,
    begin_boot,
    count_restart,
    enter,
)

_REPAIRED = "; repaired"
_REPAIR_MEMORY_NS = 60_000_000_000
"""Time since the last repair after which the next one isn't one in a row."""
_DUPLICATE_ID_REASON = (
    "duplicate node id: heartbeats come twice as often as configured; unplug one node and give it "
    "another id (`handtouch scan` lists the serial numbers)"
)
_BABBLING_REASON = (
    "babbling: it sends {} samples per SYNC, or another device sends with its COB-ID; "
    "power-cycle or unplug it"
)
_CONTRARY_REASON = (
    "two different samples per SYNC: another device sends with its COB-ID, or has its node id; unplug one, "
    "or give it another COB-ID or id"
)
_SETTINGS_UNCHANGED = "its PDO and heartbeat settings are as configured; check its sampling and firmware"
_STANDBY_REASON = "outside the scene: in standby until needed"

MAX_REPAIRS = 3
"""Times that changed settings are repaired, before that is only reported."""
_BOOT_STEPS = frozenset({NodeAction.IDENTIFY, NodeAction.READ_MAPPING, NodeAction.CONFIGURE})
_IN_BOOT = frozenset({NodeState.BOOTING, NodeState.IDENTIFIED, NodeState.CONFIGURING})


def advance(life: Lifecycle, event: LifecycleEvent, now_ns: int, timing: NodeTiming) -> Transition:
    """Return the lifecycle after an event at `now_ns`, and the actions to perform."""
    if life.state is NodeState.STOPPED and not life.standby:
        return life, ()
    match event:
        case HeartbeatReceived(nmt):
            return _on_heartbeat(life, nmt, now_ns, timing)
        case BootUpReceived():
            return _on_boot_up(life, now_ns, timing)
        case ForeignNmtCommand(command):
            return life._replace(foreign_nmt=command, foreign_nmt_ns=now_ns), ()
        case ErrorsReported(errors):
            return instability.on_errors(life, errors, now_ns)
        case ProbeAnswered():
            return _on_probe_answered(life, now_ns, timing)
        case StepDone():
            return _on_step_done(life, event, now_ns, timing)
        case StepFailed():
            return _on_step_failed(life, event, now_ns, timing)
        case SampleReceived():
            return _on_sample(life, now_ns, timing)
        case SamplesMissing(age_ns, bus_cause):
            return silence.on_samples_missing(life, age_ns, bus_cause, now_ns, timing)
        case IdentifierClash(reason):
            return _on_identifier_clash(life, reason, now_ns, timing)
        case HeartbeatRate():
            return _on_heartbeat_rate(life, event, now_ns, timing)
        case SampleRate():
            return _on_sample_rate(life, event, now_ns, timing)
        case StandbyRequested(standby):
            return _on_standby_requested(life, standby, now_ns, timing)
        case TimerExpired():
            return _on_timer_expired(life, event, now_ns, timing)
        case LoopPaused(excused_ns):
            return _extend_timeouts(life, excused_ns), ()
        case BusRecovered():
            return _restart_timeouts(life, now_ns, timing), ()
        case StopRequested():
            # a node that wasn't identified, or is another device, is left alone
            stop = timing.role is BusRole.MASTER and life.identified
            reason = "stopped by handtouch" if stop else "left as it was when handtouch ended"
            life = enter(life, NodeState.STOPPED, now_ns, reason)._replace(standby=False)
            # it sends no PDOs in PRE-OPERATIONAL, either, and other programs can read its objects
            return life, (NodeAction.ENTER_PREOPERATIONAL,) if stop else ()
        case _:
            assert_never(event)


def due_ns(life: Lifecycle, timing: NodeTiming) -> int | None:
    """Return the time of the next TimerExpired; None if no timer runs."""
    dues = []
    if life.state in (NodeState.ABSENT, NodeState.FAULTED, NodeState.SETTLING, NodeState.STALE):
        dues.append(life.due_ns)
    if life.last_heartbeat_ns is not None and is_supervised(life):
        dues.append(life.last_heartbeat_ns + timing.heartbeat_timeout_ns)
    return min(dues, default=None)


def is_supervised(life: Lifecycle) -> bool:
    """Return True if a missing heartbeat makes the node lost."""
    ended = life.state is NodeState.STOPPED and not life.standby
    return life.last_heartbeat_ns is not None and life.state is not NodeState.ABSENT and not ended


def _on_heartbeat(life: Lifecycle, nmt: int, now_ns: int, timing: NodeTiming) -> Transition:
    just_stopped = nmt == cia301.STOPPED != life.nmt_state
    left_stopped = life.nmt_state == cia301.STOPPED != nmt
    legal = nmt in cia301.NMT_NAMES
    report = (
        f"heartbeat: node is {cia301.NMT_NAMES[nmt]}" if legal else f"heartbeat with illegal NMT state {nmt}"
    )
    boot_reason = _with_loss_reason(life, report)
    before, heartbeat_ns = life, life.last_heartbeat_ns
    life = silence.measure_heartbeat(life, now_ns, timing)
    if heartbeat_ns is not None or timing.role is BusRole.LISTENER:
        heartbeat_ns = max(now_ns, heartbeat_ns or 0)
    life = life._replace(
        nmt_state=nmt, last_frame_ns=now_ns, last_heartbeat_ns=heartbeat_ns, heartbeat_required=False
    )
    if not legal and timing.role is BusRole.MASTER:
        return instability.on_illegal_state(before, life, now_ns, timing)
    if life.state is NodeState.ABSENT or (life.state in _IN_BOOT and just_stopped):
        return begin_boot(life, now_ns, boot_reason, timing)
    # A heartbeat sent before the NMT command may still arrive after it.
    settled = now_ns - life.started_ns > 2 * timing.heartbeat_period_ns
    if life.state is NodeState.FAULTED and life.fault is not None:
        return instability.on_faulted_heartbeat(life, now_ns, timing, settled)
    if life.state is NodeState.FAULTED and left_stopped and not (life.duplicate_id or life.babbling):
        life = life._replace(due_ns=now_ns)  # while stopped it couldn't respond
    if life.state is NodeState.STOPPED and nmt != cia301.STOPPED and settled:
        return life._replace(started_ns=now_ns), (NodeAction.ENTER_STANDBY,)
    if life.state in STARTED and timing.role is not BusRole.MASTER:
        return _track_other_master(life, report, now_ns, timing, settled), ()
    if life.state in STARTED and settled:
        if nmt != cia301.OPERATIONAL:
            return instability.on_departure(life, now_ns, timing)
        if not life.confirmed:
            life = life._replace(confirmed=True)
    return life, ()


def _track_other_master(
    life: Lifecycle, report: str, now_ns: int, timing: NodeTiming, settled: bool
) -> Lifecycle:
    """Update the state of a node that another NMT master starts and stops."""
    if life.nmt_state != cia301.OPERATIONAL and settled:
        life = enter(life, NodeState.SETTLING, now_ns, f"{report}; another master has to start it")
        return life._replace(samples_to_discard=timing.settle_samples, due_ns=NEVER_NS)
    if life.nmt_state == cia301.OPERATIONAL and life.state is NodeState.SETTLING and life.due_ns == NEVER_NS:
        life = enter(life, NodeState.SETTLING, now_ns, "started by another master")
        return life._replace(due_ns=now_ns + timing.settle_timeout_ns)
    return life


def _on_boot_up(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    known = life.state is not NodeState.ABSENT
    by_itself, report = False, "boot-up message"
    if instability.was_commanded(life, (cia301.RESET_NODE, cia301.RESET_COMMUNICATION), now_ns, timing):
        report = "reset by an NMT command of another master"
    elif life.reset_pending:
        report = "reset by handtouch (NMT reset communication)"
    elif known:
        by_itself, report = True, "rebooted by itself"
        life = count_restart(life, now_ns, timing)
    reason = _with_loss_reason(life, report)
    life = life._replace(
        nmt_state=cia301.PREOPERATIONAL,
        last_frame_ns=now_ns,
        last_heartbeat_ns=None,  # after a restart the heartbeat time is the node's default, perhaps 0
        heartbeat_required=False,
        failures=0,  # failed boots before the restart
        reboots=life.reboots + known,
        boot_ups=life.boot_ups + by_itself,
        identified=False,
        foreign_nmt=None,
    )
    if by_itself and instability.is_boot_loop(life, timing):
        return instability.on_boot_loop(life, now_ns, timing)
    return begin_boot(life, now_ns, reason, timing)


def _on_probe_answered(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    life = life._replace(last_frame_ns=now_ns)
    if life.state is not NodeState.ABSENT:
        return life, ()
    return begin_boot(
        life._replace(nmt_state=None), now_ns, _with_loss_reason(life, "answers over SDO"), timing
    )


def _with_loss_reason(life: Lifecycle, reason: str) -> str:
    """Append why a node was lost, since it may be back before that was published."""
    was_lost = life.state is NodeState.ABSENT and life.heartbeat_required
    return f"{reason}, but was {life.reason.partition(';')[0]}" if was_lost else reason


def _on_step_done(life: Lifecycle, event: StepDone, now_ns: int, timing: NodeTiming) -> Transition:
    if event.attempt != life.attempt:
        return life, ()
    life = life._replace(last_frame_ns=now_ns)
    match event.step:
        case NodeAction.IDENTIFY if life.state in (NodeState.BOOTING, NodeState.FAULTED):
            life = enter(life, NodeState.IDENTIFIED, now_ns, "identity as expected")._replace(
                wrong_device=False,
                identified=True,
                fault=None,
            )
            return life, (NodeAction.READ_MAPPING,)
        case NodeAction.READ_MAPPING if life.state is NodeState.IDENTIFIED:
            life = enter(life, NodeState.CONFIGURING, now_ns, "PDO mapping as expected")
            return life, (NodeAction.CONFIGURE,)
        case NodeAction.CONFIGURE if life.state is NodeState.CONFIGURING:
            return _start_node(life, now_ns, timing)
        case NodeAction.ENTER_STANDBY if life.state is NodeState.STOPPED:
            return enter(life, NodeState.STOPPED, now_ns, _STANDBY_REASON), ()
        case NodeAction.CHECK_SETTINGS if life.state is NodeState.STALE:
            in_vain = not life.operational_ns and life.boot_reason.endswith(_REPAIRED)
            remedy = f"{life.boot_reason}, without effect" if in_vain else _SETTINGS_UNCHANGED
            return enter(life, NodeState.STALE, now_ns, silence.explain_silence(life, remedy)), ()
    return life, ()


def _start_node(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Start a configured node, or stop it in standby; its first samples are discarded.

    A node found operational is started, too: it may have been made pre-operational to be configured. What was
    measured of its heartbeats was before it was configured.
    """
    life = life._replace(
        last_heartbeat_ns=now_ns,
        started_ns=now_ns,
        heartbeat_ns=None,
        heartbeat_gap_ns=0,
        is_heartbeat_slow=False,
    )
    if life.standby:
        return _on_standby_requested(enter(life, NodeState.SETTLING, now_ns, ""), True, now_ns, timing)
    running = life.nmt_state == cia301.OPERATIONAL
    ours = timing.role is BusRole.MASTER
    reason = "started" if ours else "configured; another master has to start it"
    life = enter(life, NodeState.SETTLING, now_ns, "already operational" if running else reason)
    life = life._replace(
        samples_to_discard=timing.settle_samples,
        foreign_nmt=None,
        confirmed=False,
        due_ns=now_ns + timing.settle_timeout_ns if running or ours else NEVER_NS,
    )
    return life, (NodeAction.START,) if ours else ()


def _on_step_failed(life: Lifecycle, event: StepFailed, now_ns: int, timing: NodeTiming) -> Transition:
    if event.attempt != life.attempt:
        return life, ()
    if event.step is NodeAction.SET_TRANSMISSION and event.timed_out and life.state in STARTED:
        # its TPDO may be disabled now
        return begin_boot(life, now_ns, event.reason, timing)
    if event.step is NodeAction.CHECK_SETTINGS and life.state is NodeState.STALE:
        if event.timed_out:
            reason = silence.explain_silence(life, f"its settings can't be read: {event.reason}")
            return enter(life, NodeState.STALE, now_ns, reason), ()
        return _repair_settings(life, event.reason, now_ns, timing)
    if event.step is NodeAction.CHECK_SETTINGS and life.is_heartbeat_slow:
        if event.timed_out:  # soon again
            return life._replace(check_ns=now_ns + timing.retry_delay_ns(3)), ()
        return _repair_settings(life, event.reason, now_ns, timing)
    if event.step is NodeAction.ENTER_STANDBY and life.state is NodeState.STOPPED:
        return enter(life, NodeState.STOPPED, now_ns, f"{_STANDBY_REASON}, but {event.reason}"), ()
    if event.step not in _BOOT_STEPS or life.state not in _IN_BOOT | {NodeState.FAULTED}:
        return life, ()
    quiet_ns = now_ns - life.last_frame_ns if life.last_frame_ns is not None else now_ns
    failures = life.failures + 1
    life = life._replace(
        failures=failures,
        wrong_device=life.wrong_device or event.wrong_device,
        identified=life.identified and not event.wrong_device,
        fault=None,
        due_ns=now_ns + timing.retry_delay_ns(failures),
    )
    present = event.answered or life.state in (NodeState.IDENTIFIED, NodeState.CONFIGURING)
    if event.timed_out and not present and quiet_ns > timing.heartbeat_timeout_ns:
        reason = f"lost: no message for {quiet_ns / 1e6:.0f} ms; {timing.connection_remedy}"
        return enter(life, NodeState.ABSENT, now_ns, reason)._replace(last_heartbeat_ns=None), ()
    return enter(life, NodeState.FAULTED, now_ns, event.reason), ()


def _repair_settings(life: Lifecycle, difference: str, now_ns: int, timing: NodeTiming) -> Transition:
    """Configure a node again whose settings have changed, a few times."""
    life = life._replace(checks=0, check_ns=now_ns + timing.retry_delay_ns(3))
    if now_ns - life.repaired_ns > _REPAIR_MEMORY_NS:
        life = life._replace(repairs=0)
    if life.repairs >= MAX_REPAIRS:
        reason = (
            f"{difference}, again after {MAX_REPAIRS} repairs; does another master or a configuration tool "
            "write it?"
        )
        if life.state is NodeState.OPERATIONAL:  # it is used as it is
            return enter(life, NodeState.OPERATIONAL, now_ns, reason), ()
        return enter(life, NodeState.STALE, now_ns, f"no samples: {reason}")._replace(due_ns=NEVER_NS), ()
    life = life._replace(repairs=life.repairs + 1, repaired_ns=now_ns)
    return begin_boot(life, now_ns, f"settings changed since its boot: {difference}{_REPAIRED}", timing)


def _on_sample(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    if life.state is NodeState.ABSENT and timing.role is BusRole.LISTENER and not life.heartbeat_required:
        return begin_boot(life, now_ns, "samples received", timing)
    if life.state not in (NodeState.SETTLING, NodeState.STALE):
        return life, ()
    if life.samples_to_discard == 0 and not life.heartbeat_required:
        since_ns = life.operational_ns or now_ns
        life = life._replace(failures=0, confirmed=True, operational_ns=since_ns)
        return enter(life, NodeState.OPERATIONAL, now_ns, ""), ()
    if life.state is NodeState.STALE:
        life = enter(life, NodeState.SETTLING, now_ns, "samples received")
    return life._replace(
        samples_to_discard=max(life.samples_to_discard - 1, 0), due_ns=now_ns + timing.settle_timeout_ns
    ), ()


def _extend_timeouts(life: Lifecycle, excused_ns: int) -> Lifecycle:
    if life.last_heartbeat_ns is not None:
        life = life._replace(last_heartbeat_ns=life.last_heartbeat_ns + excused_ns)
    if life.state is NodeState.SETTLING and life.due_ns != NEVER_NS:
        life = life._replace(due_ns=life.due_ns + excused_ns)
    return life


def _restart_timeouts(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Lifecycle:
    if life.last_heartbeat_ns is not None:
        life = life._replace(last_heartbeat_ns=now_ns)
    if life.state is NodeState.SETTLING and life.due_ns != NEVER_NS:
        life = life._replace(due_ns=now_ns + timing.settle_timeout_ns)
    return life


def _on_standby_requested(life: Lifecycle, standby: bool, now_ns: int, timing: NodeTiming) -> Transition:
    if timing.role is not BusRole.MASTER:  # only the NMT master stops nodes
        return life, ()
    life = life._replace(standby=standby)
    if standby and life.state in STARTED:
        life = enter(life, NodeState.STOPPED, now_ns, _STANDBY_REASON)
        return life._replace(nmt_state=cia301.STOPPED, started_ns=now_ns), (NodeAction.ENTER_STANDBY,)
    if not standby and life.state is NodeState.STOPPED:
        return begin_boot(life, now_ns, "needed again", timing)
    return life, ()


def _on_heartbeat_rate(life: Lifecycle, rate: HeartbeatRate, now_ns: int, timing: NodeTiming) -> Transition:
    life = silence.end_fast_heartbeat(life)
    if not rate.doubled:
        return life._replace(duplicate_id=False, due_ns=now_ns if life.duplicate_id else life.due_ns), ()
    # where another master is present, that one may set the heartbeat time
    if life.state is NodeState.ABSENT or timing.role is not BusRole.MASTER:
        return life, ()
    if rate.samples_single and life.state is NodeState.OPERATIONAL:
        return silence.on_fast_heartbeat(life, now_ns, timing)
    life = enter(life, NodeState.FAULTED, now_ns, _DUPLICATE_ID_REASON)
    return life._replace(
        duplicate_id=True, fault=None, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns
    ), ()


def _on_identifier_clash(life: Lifecycle, reason: str, now_ns: int, timing: NodeTiming) -> Transition:
    """Fault a node whose samples can't be told from those of another one; as master, end its PDOs."""
    life = enter(life, NodeState.FAULTED, now_ns, reason)
    life = life._replace(fault=None, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns)
    return life, (NodeAction.ENTER_PREOPERATIONAL,) if timing.role is BusRole.MASTER else ()


def _on_sample_rate(life: Lifecycle, rate: SampleRate, now_ns: int, timing: NodeTiming) -> Transition:
    if not rate.samples_per_sync:
        return life._replace(babbling=False, due_ns=now_ns if life.babbling else life.due_ns), ()
    if life.state not in STARTED or timing.role is BusRole.LISTENER:
        return life, ()
    # another master may configure any transmission
    if timing.role is BusRole.GUEST and not rate.is_contrary:
        return life, ()
    reason = _CONTRARY_REASON if rate.is_contrary else _BABBLING_REASON.format(rate.samples_per_sync)
    life = enter(life, NodeState.FAULTED, now_ns, reason)
    return life._replace(babbling=True, attempt=life.attempt + 1, due_ns=now_ns + timing.max_retry_ns), ()


def _on_timer_expired(life: Lifecycle, event: TimerExpired, now_ns: int, timing: NodeTiming) -> Transition:
    if life.last_heartbeat_ns is not None and is_supervised(life):
        quiet_ns = now_ns - life.last_heartbeat_ns
        sampled = (
            life.state is NodeState.OPERATIONAL and 2 * event.sample_age_ns < timing.heartbeat_timeout_ns
        )
        if quiet_ns > timing.heartbeat_timeout_ns and sampled:
            return silence.on_slow_heartbeat(life, now_ns, timing)
        if quiet_ns > timing.heartbeat_timeout_ns:
            return silence.on_heartbeat_timeout(life, quiet_ns, event.bus_cause, now_ns, timing), ()
    if now_ns < life.due_ns:
        return life, ()
    if life.state is NodeState.ABSENT and timing.role is BusRole.LISTENER:
        life = silence.review_loss(life, event.bus_cause, now_ns, timing)
        return life._replace(due_ns=now_ns + silence.BUS_CAUSE_DELAY_NS if life.bus_cause else NEVER_NS), ()
    if life.state is NodeState.ABSENT:
        life = silence.review_loss(life, event.bus_cause, now_ns, timing)
        probes = life.unanswered_probes + 1
        return life._replace(unanswered_probes=probes, due_ns=now_ns + timing.retry_delay_ns(probes)), (
            NodeAction.PROBE,
        )
    if life.state is NodeState.FAULTED:
        return instability.on_fault_due(life, now_ns, timing)
    if life.state is NodeState.SETTLING:
        return silence.enter_stale(
            life, now_ns, "started, but no sample received", event.bus_cause, timing
        ), ()
    if life.state is NodeState.STALE:
        return silence.on_stale_due(life, event.sample_cause, now_ns, timing)
    return life, ()
