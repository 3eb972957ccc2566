"""A node managed by the master: its data, its boot steps over SDO as run by a worker, and its identifiers.

Public names: `ManagedNode`, `make_managed_node`, `run_step`, `send_nmt`, `StepOutcome`, `StepResult`;
`find_owners` (which node sends what on each bus, and what is ignored), `IGNORED`, `NMT_COMMAND`,
`UNKNOWN_SENDER`.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from handtouch.canbus import cia301
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import IDENTIFIER_COUNT
from handtouch.canbus.nodes import boot
from handtouch.canbus.nodes.lifecycle_types import (
    CABLELESS_REMEDY,
    CONNECTION_REMEDY,
    BusRole,
    Lifecycle,
    NodeAction,
    NodeState,
    NodeTiming,
    StepDone,
    StepFailed,
)
from handtouch.canbus.nodes.spec import Identity, NodeSpec, NodeStatus
from handtouch.canbus.objects.emergency import ErrorLog, ReportedErrors
from handtouch.canbus.objects.mapping import PdoMapping, mapping_from_eds, read_mapping, tpdo_numbers
from handtouch.canbus.objects.sdo import BootStepCancelled, BootStepError, NodeSdoClient, SdoTransport
from handtouch.config.eds import EdsError

StepOutcome = StepDone | StepFailed
StepResult = boot.Identification | ReportedErrors | PdoMapping | boot.NodeConfigured | bool
"""Of SET_TRANSMISSION: the node is event-driven now, not synchronous."""

NMT_COMMANDS = {
    NodeAction.START: cia301.START_NODE,
    NodeAction.STOP: cia301.STOP_NODE,
    NodeAction.ENTER_PREOPERATIONAL: cia301.ENTER_PREOPERATIONAL,
    NodeAction.RESET_COMMUNICATION: cia301.RESET_COMMUNICATION,
}
_STATES_WITH_BOOT_REASON = (NodeState.IDENTIFIED, NodeState.CONFIGURING, NodeState.SETTLING)
_INACTIVE_STATES = (NodeState.ABSENT, NodeState.STOPPED)


@dataclass(slots=True, eq=False)
class ManagedNode:
    """Data of a node. Only the receiving thread changes them."""

    spec: NodeSpec
    port: Port
    timing: NodeTiming
    tpdo_numbers: tuple[int, ...]
    sdo: SdoTransport
    lifecycle: Lifecycle = field(default_factory=Lifecycle)
    excused_ns: int = 0  # sum of the loop's pauses that its timeouts include
    identity: Identity | None = None
    mapping: PdoMapping | None = None
    claimed_ids: frozenset[int] = frozenset()  # COB-IDs of the TPDOs that carry its channels, routed or not
    sdo_lock: threading.Lock = field(default_factory=threading.Lock)  # one transfer at a time
    booted: bool = False  # and not configured since
    guarded: bool = False
    next_guard_ns: int = 0  # time of the next guarding request
    heartbeats: int = 0
    missed_heartbeats: int = 0
    can_idle: bool = False  # it can be made event-driven
    idle: bool = False  # it is event-driven
    transmission_pending: bool = False  # a change of `idle` is in progress
    request_ns: int = 0  # time of the receiving thread's own request for the change, 0 for none
    request_data: bytes = b""  # data of that request
    heartbeat_window: tuple[int, int, int] | None = None
    """its start, and `heartbeats` and repeated samples then"""
    doubled_windows: int = 0  # consecutive windows with a doubled heartbeat rate
    event_timed: bool = False  # it sends by its event timer, not with SYNC
    errors: ErrorLog = field(default_factory=ErrorLog)

    def status(self) -> NodeStatus:
        """Return the present status."""
        reason = self.lifecycle.reason
        if self.lifecycle.boot_reason and self.lifecycle.state in _STATES_WITH_BOOT_REASON:
            reason = f"{self.lifecycle.boot_reason}; {reason}"
        return NodeStatus(
            slot=self.spec.slot,
            name=self.spec.name,
            bus=self.spec.bus,
            node_id=self.spec.node_id,
            state=self.lifecycle.state,
            since_ns=self.lifecycle.since_ns,
            reason=reason,
            identity=self.identity,
            cob_ids=tuple(tpdo.cob_id for tpdo in self.mapping.tpdos) if self.mapping else (),
            guarded=self.guarded,
            idle=self.idle,
            heartbeats=self.heartbeats,
            heartbeats_missed=self.missed_heartbeats,
            reboots=self.lifecycle.reboots,
            emergencies=self.errors.emergencies,
            error_register=self.errors.register,
            error_history=self.errors.history,
        )


def make_managed_node(spec: NodeSpec, ports: Mapping[str, Port], sync_period_ns: int) -> ManagedNode:
    """Make a node on one of the ports. Raises EdsError, and ValueError for an invalid spec."""
    if spec.bus not in ports:
        raise ValueError(f'node "{spec.name}" is on bus "{spec.bus}", which is not open')
    if not 1 <= spec.node_id <= 127:
        raise ValueError(f'node "{spec.name}": node id {spec.node_id} is outside 1 to 127')
    port = ports[spec.bus]
    if not 0 <= spec.slot < port.slab.size:
        raise ValueError(f'node "{spec.name}": slot {spec.slot} is outside the slab of {port.slab.size}')
    timing = NodeTiming(
        heartbeat_period_ns=spec.heartbeat_ms * 1_000_000,
        heartbeat_timeout_ns=spec.heartbeat_timeout_ms * 1_000_000,
        settle_timeout_ns=max(1_000_000_000, 2 * sync_period_ns),
        role=BusRole(port.bus.role),
        allow_nmt_reset=spec.allow_nmt_reset,
        connection_remedy=CABLELESS_REMEDY if port.bus.is_cableless else CONNECTION_REMEDY,
    )
    sdo = SdoTransport(spec.node_id, port.send, received_until_ns=lambda: port.received_until_ns)
    node = ManagedNode(spec, port, timing, tpdo_numbers(spec.eds, spec.channels), sdo)
    node.lifecycle = Lifecycle(reason=f"no message received yet; {timing.connection_remedy}")
    if timing.role is BusRole.LISTENER:  # it can't be read from the node
        node.mapping = mapping_from_eds(spec.eds, spec.node_id, spec.channels, spec.channel_states)
    return node


def run_step(
    node: ManagedNode, step: NodeAction, attempt: int, idle: bool
) -> tuple[StepOutcome | None, StepResult | None]:
    """Run a step until the node has responded; return None, None if the step is cancelled."""

    def is_cancelled() -> bool:
        lifecycle = node.lifecycle
        if lifecycle.attempt != attempt:
            return True
        if step is NodeAction.ENTER_STANDBY:
            return not lifecycle.standby
        return lifecycle.state in _INACTIVE_STATES

    result: StepResult | None = None
    outcome: StepOutcome = StepDone(step, attempt)
    responses = node.sdo.responses
    try:
        result = _perform_step(node, NodeSdoClient(node.sdo, is_cancelled), step, idle)
        if isinstance(result, boot.Identification):  # published even if it is that of a wrong device
            boot.check_identity(result.identity, node.spec)
    except BootStepCancelled:
        return None, None
    except BootStepError as error:
        answered = node.sdo.responses > responses
        outcome = StepFailed(step, attempt, str(error), error.timed_out, error.wrong_device, answered)
    except Exception as error:  # noqa: BLE001 - the future would hide it; here it becomes the node's reason
        outcome = StepFailed(step, attempt, f"unexpected {type(error).__name__}: {error}")
    return outcome, result


def _perform_step(node: ManagedNode, sdo: NodeSdoClient, step: NodeAction, idle: bool) -> StepResult | None:
    spec = node.spec
    if step is NodeAction.IDENTIFY:
        return boot.identify_node(sdo, spec)
    if step is NodeAction.READ_ERRORS:
        return boot.read_errors(sdo, with_behaviour=True)

    def enter_preoperational() -> None:
        if node.lifecycle.nmt_state != cia301.PREOPERATIONAL and node.timing.role is BusRole.MASTER:
            send_nmt(node, NodeAction.ENTER_PREOPERATIONAL)

    if step is NodeAction.READ_MAPPING:
        before_remapping = enter_preoperational if spec.allow_pdo_remapping else None
        return read_mapping(
            sdo, spec.node_id, node.tpdo_numbers, spec.channels, before_remapping, spec.channel_states
        )
    if step is NodeAction.ENTER_STANDBY:
        try:
            boot.set_excitation(sdo, spec.excitation, False)
        finally:
            if not sdo.is_cancelled():
                send_nmt(node, NodeAction.STOP)
        return None
    if node.mapping is None:
        raise BootStepError("no PDO mapping to configure")
    if step is NodeAction.CHECK_SETTINGS:
        if not node.transmission_pending:
            heartbeat_ms = None if node.guarded else spec.heartbeat_ms
            boot.check_settings(sdo, node.mapping, heartbeat_ms, node.idle or node.event_timed)
        return None
    if step is NodeAction.SET_TRANSMISSION:
        boot.set_transmission(sdo, node.mapping.tpdos[0], idle)
        return idle
    return boot.configure_node(sdo, node.mapping, spec, enter_preoperational, node.booted)


def send_nmt(node: ManagedNode, action: NodeAction) -> None:
    """Send an NMT command to one node; node id 0, which addresses all, is never sent."""
    node.port.send(cia301.NMT, bytes((NMT_COMMANDS[action], node.spec.node_id)))


UNKNOWN_SENDER, IGNORED, NMT_COMMAND = -1, -2, -3
_SHARED_IDS = (cia301.SYNC, cia301.TIME, cia301.LSS_RESPONSE, cia301.LSS_REQUEST)
_PDO_IDS = range(0x180, 0x501, 0x80)


def find_owners(ports: Mapping[str, Port], nodes: Sequence[ManagedNode]) -> dict[str, list[int]]:
    """Return for each bus and identifier the index in `nodes`, or one of the constants.

    Raises ValueError for nodes that contradict each other, EdsError for an identifier that two of them send.
    """
    owners = {name: [UNKNOWN_SENDER] * IDENTIFIER_COUNT for name in ports}
    for table in owners.values():
        table[cia301.NMT] = NMT_COMMAND
        for can_id in _SHARED_IDS:
            table[can_id] = IGNORED
    slots: set[int] = set()
    senders: dict[tuple[str, int], str] = {}  # nodes on listener buses by the identifiers of their samples
    for number, node in enumerate(nodes):
        spec, table = node.spec, owners[node.spec.bus]
        if table[cia301.NMT_ERROR_CONTROL + spec.node_id] != UNKNOWN_SENDER or spec.slot in slots:
            raise ValueError(f'node "{spec.name}": node id {spec.node_id} or slot {spec.slot} is given twice')
        slots.add(spec.slot)
        for tpdo in node.mapping.tpdos if node.mapping else ():
            other = senders.setdefault((spec.bus, tpdo.cob_id), spec.name)
            if other != spec.name:
                raise EdsError(
                    f'nodes "{other}" and "{spec.name}" both send 0x{tpdo.cob_id:X} by their EDS; '
                    "give each an EDS or DCF with its own COB-IDs"
                )
        for service in (cia301.EMCY, cia301.SDO_RESPONSE, cia301.NMT_ERROR_CONTROL):
            table[service + spec.node_id] = number
        for service in (cia301.SDO_REQUEST, *_PDO_IDS):  # echoes of requests; PDOs before they are routed
            table[service + spec.node_id] = IGNORED
    return owners
