"""A node that the master looks after: all that is known of it, and what a worker says to it over SDO.

Public names: `Member`, `member`, `outcome`, `command`, `Outcome`, `Result`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from handtouch.canbus.bus.port import Port
from handtouch.canbus.objects import emergency
from handtouch.canbus.objects.mapping import Mapping as PdoMapping
from handtouch.canbus.objects.mapping import from_eds, read_mapping, tpdo_numbers
from handtouch.canbus.objects.sdo import Outdated, Sdo, StepError

from . import boot
from .life import NMT_PREOPERATIONAL, Action, Done, Failed, Life, NodeState, Role, Timing
from .spec import NodeSpec, NodeStatus

EMERGENCIES_KEPT = 16
Outcome = Done | Failed
Result = boot.Identity | PdoMapping | boot.Configured | boot.Paced

_NMT = 0x000
NMT_COMMANDS = {Action.START: 1, Action.STOP: 2, Action.ENTER_PREOPERATIONAL: 128}
_BOOTED_FOR_A_REASON = (NodeState.IDENTIFIED, NodeState.CONFIGURING, NodeState.SETTLING)
_NOBODY_WAITS = (NodeState.ABSENT, NodeState.STOPPED)


@dataclass(slots=True, eq=False)
class Member:
    """All that is known of a node. Only the receiving thread changes it."""

    spec: NodeSpec
    port: Port
    timing: Timing
    tpdos: tuple[int, ...]
    sdo: Sdo
    life: Life = field(default_factory=Life)
    identity: boot.Identity | None = None
    mapping: PdoMapping | None = None
    working: threading.Lock = field(default_factory=threading.Lock)  # one transfer at a time
    booted: bool = False  # and not configured since
    guarded: bool = False
    guard_ns: int = 0  # when to ask a guarded node next
    heartbeats: int = 0
    missed: int = 0
    may_idle: bool = False  # it could be made event-driven
    idle: bool = False  # it is
    pacing: bool = False  # a change of that is under way
    asked_ns: int = 0  # when the receiving thread itself asked for it, 0 if it hasn't
    request: bytes = b""  # and how
    paced_ns: int = 0  # since when it is so
    watched: tuple[int, int] | None = None  # since when its heartbeats are counted, and how many had come
    crowded: int = 0  # times in a row that there were twice as many as there should be
    emergencies: deque[emergency.Emergency] = field(default_factory=lambda: deque(maxlen=EMERGENCIES_KEPT))

    def status(self) -> NodeStatus:
        told = self.life.reason
        if self.life.because and self.life.state in _BOOTED_FOR_A_REASON:
            told = f"{self.life.because}; {told}"
        return NodeStatus(
            self.spec.slot,
            self.spec.name,
            self.spec.bus,
            self.spec.node_id,
            self.life.state,
            self.life.since_ns,
            told,
            self.identity,
            tuple(tpdo.cob_id for tpdo in self.mapping.tpdos) if self.mapping else (),
            self.guarded,
            self.idle,
            self.heartbeats,
            self.missed,
            self.life.reboots,
            tuple(self.emergencies),
        )


def member(spec: NodeSpec, ports: Mapping[str, Port], sync_period_ns: int) -> Member:
    """A node on one of the ports. Raises EdsError and ValueError for a spec that can't be."""
    if spec.bus not in ports:
        raise ValueError(f'node "{spec.name}" is on bus "{spec.bus}", which is not open')
    if not 1 <= spec.node_id <= 127:
        raise ValueError(f'node "{spec.name}": node id {spec.node_id} is outside 1 to 127')
    port = ports[spec.bus]
    if not 0 <= spec.slot < port.slab.size:
        raise ValueError(f'node "{spec.name}": slot {spec.slot} is outside the slab of {port.slab.size}')
    timing = Timing(
        heartbeat_ns=spec.heartbeat_ms * 1_000_000,
        heartbeat_timeout_ns=spec.heartbeat_timeout_ms * 1_000_000,
        settle_timeout_ns=max(1_000_000_000, 2 * sync_period_ns),
        role=Role(port.bus.role),
    )
    node = Member(spec, port, timing, tpdo_numbers(spec.eds, spec.channels), Sdo(spec.node_id, port.send))
    if timing.role is Role.LISTENER:  # nothing can be asked
        node.mapping = from_eds(spec.eds, spec.node_id, spec.channels)
    return node


def outcome(node: Member, step: Action, attempt: int, idle: bool) -> tuple[Outcome | None, Result | None]:
    """Carry out a step; None where nobody waits for it any more. Blocks until the node has answered."""

    def outdated() -> bool:
        gone = not node.life.resting if step is Action.POWER_DOWN else node.life.state in _NOBODY_WAITS
        return gone or node.life.attempt != attempt

    node.sdo.outdated = outdated
    result: Result | None = None
    ended: Outcome = Done(step, attempt)
    try:
        result = _carry_out(node, step, idle)
        if isinstance(result, boot.Identity):  # a stranger's is worth knowing too
            boot.check_identity(result, _expected(node.spec))
    except Outdated:
        return None, None
    except StepError as error:
        ended = Failed(step, attempt, str(error), error.silent, error.stranger)
    except Exception as error:  # noqa: BLE001 - a future would swallow it; here it becomes the node's reason
        ended = Failed(step, attempt, f"unexpected {type(error).__name__}: {error}")
    return ended, result


def _expected(spec: NodeSpec) -> boot.Expected:
    return boot.Expected(spec.vendor_id, spec.product_code, spec.revision, spec.serial, spec.foreign)


def _carry_out(node: Member, step: Action, idle: bool) -> Result | None:
    spec = node.spec
    if step is Action.IDENTIFY:
        return boot.identify(node.sdo)

    def halt() -> None:
        if node.life.nmt != NMT_PREOPERATIONAL and node.timing.role is Role.MASTER:
            command(node, Action.ENTER_PREOPERATIONAL)

    if step is Action.READ_MAPPING:
        may = halt if spec.remap else None
        return read_mapping(node.sdo, spec.node_id, node.tpdos, spec.channels, may)
    if step is Action.POWER_DOWN:
        try:
            boot.excite(node.sdo, spec.excitation, False)
        finally:
            if not node.sdo.outdated():
                command(node, Action.STOP)
        return None
    if node.mapping is None:
        raise StepError("no PDO mapping to configure")
    if step is Action.PACE:
        boot.set_pace(node.sdo, node.mapping.tpdos[0], idle)
        return boot.Paced(idle)
    return boot.configure(node.sdo, node.mapping, spec, halt, node.booted)


def command(node: Member, action: Action) -> None:
    """NMT, to one node: the second byte is never 0, which would mean all."""
    node.port.send(_NMT, bytes((NMT_COMMANDS[action], node.spec.node_id)))
