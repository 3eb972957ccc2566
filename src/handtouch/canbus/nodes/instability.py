"""Nodes that don't stay operational: refusals, departures, boot loops and illegal NMT states.

They are *faulted*, with their cause and the errors that they report, and retried with growing delays.
Public names: `on_departure`, `on_faulted_heartbeat`, `on_illegal_state`, `on_boot_loop`, `on_fault_due`,
`on_errors`, `is_boot_loop`, `has_illegal_state`, `was_commanded`.
"""

from __future__ import annotations

from handtouch.canbus import cia301
from handtouch.canbus.nodes.lifecycle_types import (
    BusRole,
    Lifecycle,
    NmtFault,
    NodeAction,
    NodeState,
    NodeTiming,
)
from handtouch.canbus.nodes.transitions import Transition, begin_boot, count_restart, enter, identify_actions

MAX_QUICK_RESTARTS = 3
"""Restarts of an unstable node that are followed by a boot at once."""
_RESETS_BEGIN = 2
"""Refusals after which one NMT reset communication is sent."""
_RESET_TIMEOUT_NS = 1_000_000_000
_ERROR_REMEDY = "clear the error in the node, whose manual explains it"
_NO_ERROR_REMEDY = "look for the cause in the node's firmware"
_BOOT_LOOP_REMEDY = "check its supply voltage, watchdog and firmware"
_ILLEGAL_STATE_REMEDY = "check its firmware, and that no other device sends with its COB-ID"


def was_commanded(life: Lifecycle, commands: tuple[int, ...], now_ns: int, timing: NodeTiming) -> bool:
    """Return True if another master has sent one of these NMT commands recently."""
    return life.foreign_nmt in commands and now_ns - life.foreign_nmt_ns <= timing.max_retry_ns


def has_illegal_state(life: Lifecycle) -> bool:
    """Return True if the node's last heartbeat has an NMT state that CiA 301 doesn't define."""
    return life.nmt_state is not None and life.nmt_state not in cia301.NMT_NAMES


def on_departure(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Handle a heartbeat of a started node that isn't operational: `life.nmt_state` has its state."""
    name = cia301.NMT_NAMES[life.nmt_state or 0]
    if was_commanded(life, (cia301.STOP_NODE, cia301.ENTER_PREOPERATIONAL), now_ns, timing):
        return begin_boot(life, now_ns, f"made {name} by an NMT command of another master", timing)
    confirmed = life.confirmed
    life = count_restart(life, now_ns, timing)
    if not confirmed:
        return _refuse(life, now_ns, timing)
    if life.restarts <= MAX_QUICK_RESTARTS:
        errors = f", {life.errors}" if life.errors else ""
        return begin_boot(life, now_ns, f"left OPERATIONAL by itself, is {name}{errors}", timing)
    delay_ns = timing.retry_delay_ns(life.restarts - MAX_QUICK_RESTARTS)
    life = life._replace(fault=NmtFault.LEAVES_OPERATIONAL, due_ns=now_ns + delay_ns)
    return _explain(life, now_ns)


def _refuse(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Enter FAULTED, or stay there, after a start without effect."""
    delay_ns = timing.retry_delay_ns(life.restarts)
    life = life._replace(fault=NmtFault.REFUSES_OPERATIONAL, start_pending=False, due_ns=now_ns + delay_ns)
    return _explain(life, now_ns)


def _explain(life: Lifecycle, now_ns: int) -> Transition:
    """Enter FAULTED, and read the node's errors, which a stopped one doesn't serve."""
    life = enter(life._replace(attempt=life.attempt + 1), NodeState.FAULTED, now_ns, _fault_reason(life))
    if life.nmt_state == cia301.STOPPED:
        return life, (NodeAction.ENTER_PREOPERATIONAL, NodeAction.READ_ERRORS)
    return life, (NodeAction.READ_ERRORS,)


def _fault_reason(life: Lifecycle) -> str:
    assert life.fault is not None
    if life.errors:
        return f"{life.fault.value}, {life.errors}; {_ERROR_REMEDY}"
    return f"{life.fault.value}, reports no error; {_NO_ERROR_REMEDY}"


def on_errors(life: Lifecycle, errors: str, now_ns: int) -> Transition:
    """Note the errors that the node reports, and complete the reason of its fault."""
    life = life._replace(errors=errors)
    if life.state is NodeState.FAULTED and life.fault is not None:
        return enter(life, NodeState.FAULTED, now_ns, _fault_reason(life)), ()
    return life, ()


def on_faulted_heartbeat(life: Lifecycle, now_ns: int, timing: NodeTiming, settled: bool) -> Transition:
    """Handle a heartbeat of a FAULTED node that refused to become operational."""
    if life.fault is not NmtFault.REFUSES_OPERATIONAL or life.standby:
        return life, ()
    if life.nmt_state == cia301.OPERATIONAL:
        life = enter(life, NodeState.SETTLING, now_ns, "became operational after refusals")
        return life._replace(
            fault=None,
            start_pending=False,
            confirmed=True,
            started_ns=now_ns,
            samples_to_discard=timing.settle_samples,
            due_ns=now_ns + timing.settle_timeout_ns,
        ), ()
    if life.start_pending and settled:
        return _refuse(count_restart(life, now_ns, timing), now_ns, timing)
    return life, ()


def on_fault_due(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Retry a FAULTED node. It stays FAULTED, with its reason, until that succeeds."""
    refuses = life.fault is NmtFault.REFUSES_OPERATIONAL and not life.standby
    quiet_ns = now_ns - (life.last_frame_ns or 0)
    illegal = has_illegal_state(life) and quiet_ns <= timing.heartbeat_timeout_ns
    may_reset = (
        timing.role is BusRole.MASTER and timing.allow_nmt_reset and life.identified and not life.reset_sent
    )
    if may_reset and (illegal or (refuses and life.restarts >= _RESETS_BEGIN)):
        life = life._replace(reset_sent=True, reset_pending=True, due_ns=now_ns + _RESET_TIMEOUT_NS)
        return life, (NodeAction.RESET_COMMUNICATION,)
    if illegal:
        life = count_restart(life, now_ns, timing)
        return life._replace(due_ns=now_ns + timing.retry_delay_ns(life.restarts)), ()
    life = life._replace(due_ns=now_ns + timing.max_retry_ns)
    if refuses:
        return life._replace(start_pending=True, started_ns=now_ns, foreign_nmt=None), (NodeAction.START,)
    life = life._replace(attempt=life.attempt + 1)
    return life, () if life.duplicate_id or life.babbling else identify_actions(life, timing)


def on_illegal_state(before: Lifecycle, life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Handle a heartbeat with an illegal NMT state; `before` is the lifecycle before it."""
    in_standby = life.state is NodeState.STOPPED
    if in_standby or life.duplicate_id or life.babbling or life.wrong_device:
        return life, ()
    if life.state is NodeState.FAULTED and has_illegal_state(before):
        return life, ()
    life = count_restart(life, now_ns, timing)
    life = life._replace(
        fault=None,
        start_pending=False,
        attempt=life.attempt + 1,
        due_ns=now_ns + timing.retry_delay_ns(life.restarts),
    )
    reason = f"heartbeat with illegal NMT state {life.nmt_state}; {_ILLEGAL_STATE_REMEDY}"
    return enter(life, NodeState.FAULTED, now_ns, reason), ()


def is_boot_loop(life: Lifecycle, timing: NodeTiming) -> bool:
    """Return True if an unstable node has booted too often to be booted at once."""
    return life.boot_ups > MAX_QUICK_RESTARTS and timing.role is not BusRole.LISTENER


def on_boot_loop(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Handle a further boot-up message: the node is booted when none has come for the retry delay."""
    seconds = (now_ns - life.unstable_ns) * 1e-9
    reason = f"boot loop: {life.boot_ups} boot-up messages in {seconds:.1f} s; {_BOOT_LOOP_REMEDY}"
    life = enter(life, NodeState.FAULTED, now_ns, reason)._replace(
        fault=None,
        start_pending=False,
        attempt=life.attempt + 1,
        boot_reason=reason,
        due_ns=now_ns + timing.retry_delay_ns(life.boot_ups - MAX_QUICK_RESTARTS),
    )
    return life, ()
