"""Transitions that several events of a node's lifecycle share: entering a state, and the beginning of a boot.

Public names: `Transition`, `enter`, `begin_boot`, `identify_actions`, `count_restart`, `forget_if_stable`.
"""

from __future__ import annotations

from handtouch.canbus import cia301
from handtouch.canbus.nodes.lifecycle_types import BusRole, Lifecycle, NodeAction, NodeState, NodeTiming

Transition = tuple[Lifecycle, tuple[NodeAction, ...]]

NEVER_NS = 1 << 62
STARTED = frozenset({NodeState.SETTLING, NodeState.OPERATIONAL, NodeState.STALE})


def enter(life: Lifecycle, state: NodeState, now_ns: int, reason: str) -> Lifecycle:
    """Return the lifecycle in a state, perhaps the present one, with a reason."""
    since_ns = life.since_ns if state is life.state else now_ns
    return life._replace(state=state, since_ns=since_ns, reason=reason)


def begin_boot(life: Lifecycle, now_ns: int, reason: str, timing: NodeTiming) -> Transition:
    """Boot the node, beginning with its identity, which a listener can't check."""
    life = forget_if_stable(life, now_ns, timing)._replace(fault=None, start_pending=False, confirmed=False)
    if timing.role is BusRole.LISTENER:
        life = enter(
            life, NodeState.SETTLING, now_ns, f"{reason}; listening only: its identity isn't checked"
        )
        return life._replace(started_ns=now_ns, samples_to_discard=timing.settle_samples, due_ns=NEVER_NS), ()
    life = enter(life, NodeState.BOOTING, now_ns, reason)
    life = life._replace(
        attempt=life.attempt + 1,
        unanswered_probes=0,
        duplicate_id=False,
        babbling=False,
        reset_pending=False,
        boot_reason=reason,
    )
    return life, identify_actions(life, timing)


def identify_actions(life: Lifecycle, timing: NodeTiming) -> tuple[NodeAction, ...]:
    """Return the actions to identify a node; a stopped one doesn't serve SDO and becomes pre-operational."""
    if life.nmt_state == cia301.STOPPED and not life.wrong_device and timing.role is BusRole.MASTER:
        return NodeAction.ENTER_PREOPERATIONAL, NodeAction.IDENTIFY
    return (NodeAction.IDENTIFY,)


def count_restart(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Lifecycle:
    """Count a boot-up, refusal or departure; the first again if the node was stable before."""
    life = forget_if_stable(life, now_ns, timing)
    since_ns = life.unstable_ns if life.restarts else now_ns
    return life._replace(restarts=life.restarts + 1, unstable_ns=since_ns)


def forget_if_stable(life: Lifecycle, now_ns: int, timing: NodeTiming) -> Lifecycle:
    """End the node's operation; forget earlier restarts if it was stable."""
    operated_ns = now_ns - life.operational_ns if life.operational_ns else 0
    if operated_ns > timing.max_retry_ns:
        life = life._replace(restarts=0, boot_ups=0, reset_sent=False)
    return life._replace(operational_ns=0)
