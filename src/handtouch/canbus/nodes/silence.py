"""Silence of a node: samples that stay away, a loss, and whose cause it is.

Public names: `on_slow_heartbeat`, `on_fast_heartbeat`, `end_fast_heartbeat`, `measure_heartbeat`,
`on_samples_missing`, `enter_stale`, `explain_silence`, `on_stale_due`, `on_heartbeat_timeout`, `review_loss`,
`BUS_CAUSE_DELAY_NS`. Pure functions, as in `lifecycle`.
"""

from __future__ import annotations

from handtouch.canbus import cia301
from handtouch.canbus.nodes.lifecycle_types import (
    BusRole,
    Lifecycle,
    NodeAction,
    NodeState,
    NodeTiming,
)
from handtouch.canbus.nodes.transitions import NEVER_NS, Transition, enter

_NO_HEARTBEAT_REASON = (
    "answers over SDO, but sends no heartbeat although its heartbeat time is set (0x1017): "
    "its firmware may hang; power-cycle it"
)
_SLOW_HEARTBEAT, _FAST_HEARTBEAT = "slow heartbeat", "fast heartbeat"
_TPDO_REMEDY = "check transmission type and COB-ID of its TPDO (0x1800 to 0x19FF)"
_CHECK_PENDING = "its PDO and heartbeat settings are being checked"

_GAP_JITTER = 0.02
"""Relative change of the time between two heartbeats that is none: 1 % was seen of timers of 10 ms"""
BUS_CAUSE_DELAY_NS = 1_000_000_000
"""Time until the cause is sought in a node whose silence began together with that of others"""


def on_samples_missing(
    life: Lifecycle, age_ns: int, bus_cause: str, now_ns: int, timing: NodeTiming
) -> Transition:
    """Handle samples that stay away from an operational node."""
    if life.state is not NodeState.OPERATIONAL:
        return life, ()
    return enter_stale(life, now_ns, f"no sample for {age_ns / 1e6:.0f} ms", bus_cause, timing), ()


def enter_stale(life: Lifecycle, now_ns: int, silence: str, bus_cause: str, timing: NodeTiming) -> Lifecycle:
    """Enter STALE; the settings are checked soon, or later if the cause seems to be in the host or the bus.

    A check that is due isn't postponed by single samples.
    """
    life = life._replace(silence=silence, bus_cause=bus_cause)
    remedy = _TPDO_REMEDY if timing.role is BusRole.LISTENER else _CHECK_PENDING
    life = enter(life, NodeState.STALE, now_ns, explain_silence(life, remedy))
    soon_ns = timing.retry_delay_ns(1)
    if now_ns - life.check_ns > timing.max_retry_ns:
        life = life._replace(check_ns=now_ns + (BUS_CAUSE_DELAY_NS if bus_cause else soon_ns), checks=0)
    elif not bus_cause:
        life = life._replace(check_ns=min(life.check_ns, now_ns + timing.retry_delay_ns(3)))
    due_ns = max(life.check_ns, now_ns)
    return life._replace(due_ns=min(due_ns, now_ns + soon_ns) if bus_cause else due_ns)


def explain_silence(life: Lifecycle, remedy: str) -> str:
    """Return the reason of a stale node; the remedy applies if the cause is the node's."""
    if life.bus_cause:
        return f"{life.silence}, {life.bus_cause}"
    heartbeat = "heartbeat present" if life.last_heartbeat_ns is not None else "no heartbeat either"
    return f"{life.silence}, {heartbeat}; {remedy}"


def on_stale_due(life: Lifecycle, bus_cause: str, now_ns: int, timing: NodeTiming) -> Transition:
    """Have the settings of a stale node read back, with growing delays.

    A cause in the host or the bus holds only while samples of others are missing, too. Single samples after
    its end may still be on their way, so the reason changes after the check, or for a listener after a delay.
    """
    soon_ns = now_ns + timing.retry_delay_ns(1)
    listens = timing.role is BusRole.LISTENER
    if life.bus_cause and bus_cause and (listens or now_ns < life.check_ns):
        return life._replace(due_ns=soon_ns if listens else min(soon_ns, life.check_ns)), ()
    was_common = bool(life.bus_cause)
    life = life._replace(bus_cause=bus_cause if was_common else "")
    if listens and was_common:
        return life._replace(due_ns=soon_ns), ()
    if listens:
        life = enter(life, NodeState.STALE, now_ns, explain_silence(life, _TPDO_REMEDY))
        return life._replace(due_ns=NEVER_NS), ()
    if life.nmt_state in (cia301.STOPPED, cia301.PREOPERATIONAL):  # its heartbeats decide what follows
        life = enter(life, NodeState.STALE, now_ns, explain_silence(life, _TPDO_REMEDY))
        return life._replace(due_ns=now_ns + timing.max_retry_ns), ()
    checks = life.checks + 1
    check_ns = now_ns + timing.retry_delay_ns(3 * checks)
    return life._replace(checks=checks, check_ns=check_ns, due_ns=check_ns), (NodeAction.CHECK_SETTINGS,)


def on_heartbeat_timeout(
    life: Lifecycle, quiet_ns: int, bus_cause: str, now_ns: int, timing: NodeTiming
) -> Lifecycle:
    """Return the lifecycle of a node whose heartbeat has timed out."""
    if life.heartbeat_required and timing.role is not BusRole.LISTENER and not bus_cause:
        # present, since it was just configured: retried with growing delays
        failures = life.failures + 1
        life = enter(life, NodeState.FAULTED, now_ns, _NO_HEARTBEAT_REASON)
        return life._replace(
            last_heartbeat_ns=None, failures=failures, due_ns=now_ns + timing.retry_delay_ns(failures)
        )
    silence = f"lost: no heartbeat for {quiet_ns / 1e6:.0f} ms"
    cause = f", {bus_cause}" if bus_cause else f"; {timing.connection_remedy}"
    life = enter(life, NodeState.ABSENT, now_ns, silence + cause)
    return life._replace(
        silence=silence,
        bus_cause=bus_cause,
        alone_ns=None,
        last_heartbeat_ns=None,
        nmt_state=None,
        heartbeat_required=True,
        failures=0,
        restarts=0,
        boot_ups=0,
        operational_ns=0,
        fault=None,
        reset_sent=False,
        reset_pending=False,
        due_ns=now_ns + timing.retry_delay_ns(0),
    )


def on_slow_heartbeat(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Handle a heartbeat that is late while the node's samples arrive: it is present.

    Its heartbeat time may have been changed: the settings are checked at once, and again at intervals. A
    check for another cause says nothing of this one.
    """
    check_ns = life.check_ns if life.is_heartbeat_slow else now_ns
    life = life._replace(last_heartbeat_ns=now_ns, is_heartbeat_slow=True, check_ns=check_ns)
    return _check_settings(_with_heartbeat_reason(life, timing), now_ns, timing)


def _check_settings(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Let the settings be checked, unless they were a short time ago or aren't ours."""
    if timing.role is BusRole.LISTENER or now_ns < life.check_ns:
        return life, ()
    return life._replace(check_ns=now_ns + timing.max_retry_ns), (NodeAction.CHECK_SETTINGS,)


def on_fast_heartbeat(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Transition:
    """Report heartbeats that come too often; the node's settings are checked, and again at intervals."""
    every_ms, configured_ms = life.heartbeat_gap_ns / 1e6, timing.heartbeat_period_ns / 1e6
    text = f"every {every_ms:.0f} ms instead of {configured_ms:.0f} ms"
    remedy = f"set heartbeat_ms = {every_ms:.0f}, or the node's 0x1017"
    return _check_settings(life._replace(reason=f"{_FAST_HEARTBEAT}: {text}; {remedy}"), now_ns, timing)


def end_fast_heartbeat(life: Lifecycle) -> Lifecycle:
    """Return the lifecycle without a report of fast heartbeats."""
    return life._replace(reason="") if life.reason.startswith(_FAST_HEARTBEAT) else life


def measure_heartbeat(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Lifecycle:
    """Note the time between two heartbeats; end a report of slow ones when they come in time."""
    gap_ns = 0 if life.heartbeat_ns is None else now_ns - life.heartbeat_ns
    if abs(gap_ns - life.heartbeat_gap_ns) < _GAP_JITTER * life.heartbeat_gap_ns:
        gap_ns = life.heartbeat_gap_ns  # so that a reason doesn't change with each heartbeat
    life = life._replace(heartbeat_ns=now_ns, heartbeat_gap_ns=gap_ns)
    if not life.is_heartbeat_slow:
        return life
    if 0 < gap_ns <= timing.heartbeat_timeout_ns:
        reason = "" if _SLOW_HEARTBEAT in life.reason else life.reason
        return life._replace(is_heartbeat_slow=False, reason=reason)
    return _with_heartbeat_reason(life, timing)


def _with_heartbeat_reason(life: Lifecycle, timing: NodeTiming) -> Lifecycle:
    if life.state is not NodeState.OPERATIONAL:
        return life
    configured_ms = timing.heartbeat_period_ns / 1e6
    if life.heartbeat_gap_ns > timing.heartbeat_timeout_ns:
        period_ms = life.heartbeat_gap_ns / 1e6
        text = f"every {period_ms:.0f} ms instead of {configured_ms:.0f} ms"
        remedy = f"raise heartbeat_timeout_ms above {2 * period_ms:.0f}, or set the node's 0x1017"
    else:
        text, remedy = f"none for {timing.heartbeat_timeout_ns / 1e6:.0f} ms", "check the node's 0x1017"
    return life._replace(reason=f"{_SLOW_HEARTBEAT}: {text}, while its samples arrive; {remedy}")


def review_loss(life: Lifecycle, bus_cause: str, now_ns: int, timing: NodeTiming) -> Lifecycle:
    """Name the node's own connection as the cause when the others of its bus have been back for a while."""
    if bus_cause or not life.bus_cause:
        return life._replace(alone_ns=None)
    if life.alone_ns is None:
        return life._replace(alone_ns=now_ns)
    if now_ns - life.alone_ns < BUS_CAUSE_DELAY_NS:
        return life
    life = enter(life, NodeState.ABSENT, now_ns, f"{life.silence}; {timing.connection_remedy}")
    return life._replace(bus_cause="")
