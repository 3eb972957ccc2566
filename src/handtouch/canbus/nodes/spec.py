"""Nodes of a deployment as the master gets them, and their status and events as it reports them.

Public names: `Identity`, `IdleSettings`, `NodeSpec`, `node_specs`, `sync_overflows`, `check_nodes`,
`check_mapping`, `NodeStatus`; `MasterEvent`, a union of `NodeEvent`, `ErrorChanged` and `SerialChanged`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.objects.mapping import mapping_from_eds
from handtouch.config import (
    ConfigError,
    Deployment,
    Node,
    Pad,
    Problem,
)
from handtouch.config.channels import (
    STANDARD_CHANNELS,
    Channels,
    WritableObject,
    channel_states,
    integer_limits,
    node_channels,
    order_by_electrode,
    order_channels,
    parse_writable_object,
)
from handtouch.config.eds import EdsError
from handtouch.wire.health import Emergency


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 0x1018; None where the node doesn't have the sub-index."""

    vendor_id: int
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class IdleSettings:
    """Event-driven transmission while a pad is untouched: on changes beyond the delta, and by event timer."""

    delta_counts: int
    period_ms: int
    inhibit_100us: int
    delta_objects: tuple[WritableObject, ...]
    enable_object: WritableObject | None


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node of the deployment; identity fields that are None are not checked.

    `channels` : those of the electrodes, in their order, then those of the shear pad's
    `allow_pdo_remapping` : they may be mapped to a TPDO over SDO
    `allow_nmt_reset` : one NMT reset communication may be sent when it refuses to run
    `event_timer_ms` : period of a node that can't follow SYNC
    `channel_states` : of a pad with a schedule, the state in which each channel is measured
    `sync_overflow` : last value of the counter in SYNC, 0 where SYNC has none
    `serials_of_other_pads` : serial numbers configured for other pads, which are not accepted, with the
    pads' names and buses
    """

    slot: int
    bus: str
    node_id: int
    name: str
    eds: str | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    serials_of_other_pads: Mapping[int, str] = field(default_factory=dict, compare=False)
    revision: int | None = None
    channels: Channels = STANDARD_CHANNELS
    allow_pdo_remapping: bool = True
    allow_nmt_reset: bool = True
    idle: IdleSettings | None = None
    excitation: WritableObject | None = None
    heartbeat_ms: int = 100
    heartbeat_timeout_ms: int = 350
    event_timer_ms: int = 5
    channel_states: tuple[int, ...] = ()
    sync_overflow: int = 0


def sync_overflows(deployment: Deployment) -> dict[str, int]:
    """Return the last value of the counter in SYNC, a multiple of the states of every schedule, by the names
    of the buses that have pads with one."""
    overflows: dict[str, int] = {}
    for _, pad in deployment.pads:
        if pad.switch_states:
            overflows[pad.bus] = math.lcm(overflows.get(pad.bus, 1), len(pad.switch_states))
    return overflows


def node_specs(deployment: Deployment) -> list[NodeSpec]:
    """Return the nodes of a deployment in the order of its pads. Raises EdsError."""
    pads, overflows = deployment.pads, sync_overflows(deployment)
    owners = {entry.pad.serial: f"{entry.name} on {entry.pad.bus}" for entry in pads if entry.pad.serial}
    specs = []
    for slot, entry in enumerate(pads):
        pad, kind = entry.pad, deployment.nodes[entry.pad.node]
        specs.append(
            NodeSpec(
                slot=slot,
                bus=pad.bus,
                node_id=pad.node_id,
                name=entry.name,
                eds=kind.eds,
                vendor_id=kind.vendor_id,
                product_code=kind.product_code,
                revision=kind.revision,
                serial=pad.serial,
                serials_of_other_pads={
                    serial: owner for serial, owner in owners.items() if serial != pad.serial
                },
                channels=order_channels(node_channels(kind), pad),
                allow_pdo_remapping=kind.allow_pdo_remapping,
                allow_nmt_reset=kind.allow_nmt_reset,
                idle=_idle_settings(kind, deployment.daemon.sync_period_ms),
                excitation=parse_writable_object(kind.excitation_object) if kind.excitation_object else None,
                heartbeat_ms=kind.heartbeat_ms,
                heartbeat_timeout_ms=kind.heartbeat_timeout_ms,
                event_timer_ms=max(1, round(deployment.daemon.sync_period_ms)),
                channel_states=channel_states(pad),
                sync_overflow=overflows.get(pad.bus, 0),
            )
        )
    return specs


def check_nodes(deployment: Deployment, file: str) -> Deployment:
    """Check the objects that a deployment names, and return it. Raises ConfigError with all problems."""
    problems = [*_find_problems(deployment)]
    if problems:
        raise ConfigError(file, tuple(problems))
    return deployment


def _find_problems(deployment: Deployment) -> Iterator[Problem]:
    listener_buses = {bus.name for bus in deployment.buses if bus.role == "listener"}
    for name, kind in deployment.nodes.items():
        prefix = f"[node.{name}]: "
        try:
            channels = node_channels(kind)
            for hand in deployment.hands:
                for pad in hand.pads:
                    if pad.node == name and pad.switch_states:
                        yield from _find_wide_states(f"{hand.name}/{pad.link}", pad, channels)
                    if pad.node == name and pad.bus in listener_buses:
                        check_mapping(kind, pad)
        except EdsError as error:
            yield Problem(f"{prefix}channels", "", str(error))
        else:
            if any(channel.counts_per_unit for channel in channels) and kind.full_scale_counts is None:
                text = "missing; REAL32 channels have no greatest count"
                yield Problem(f"{prefix}full_scale_counts", "", text)
            most = min(integer_limits(channel.bits, channel.signed)[1] for channel in channels)
            if kind.max_count is not None and kind.max_count > most:
                text = f"more than its channels carry, {most}; correct it or the type of the channels"
                yield Problem(f"{prefix}max_count", f" = {kind.max_count}", text)
        if kind.excitation_object is not None:
            yield from _find_unwritable(f"{prefix}excitation_object", kind.excitation_object)
        if kind.idle is not None:
            prefix = f"[node.{name}.idle]: "
            for text in kind.idle.delta_objects:
                yield from _find_unwritable(f"{prefix}delta_objects", text, kind.idle.delta_counts)
            if kind.idle.enable_object:
                yield from _find_unwritable(f"{prefix}enable_object", kind.idle.enable_object)


def check_mapping(kind: Node, pad: Pad) -> None:
    """Check that TPDOs carry a pad's channels by its node's EDS, or without one. Raises EdsError."""
    channels, states = node_channels(kind), channel_states(pad)
    ordered = order_by_electrode(channels, pad) if states else channels
    mapping_from_eds(kind.eds, pad.node_id, ordered, states)


def _find_wide_states(name: str, pad: Pad, channels: Channels) -> Iterator[Problem]:
    """Yield a problem unless the channels of each state fit into a PDO."""
    if len(channels) != len(pad.electrode_names) or sorted(pad.electrodes) != sorted(pad.electrode_names):
        return
    bits = [channel.bits for channel in order_by_electrode(channels, pad)]
    widest = max(sum(bits[number] for number in state) for state in pad.state_numbers)
    if widest > 64:
        text = f"a state has channels of {widest} bits, but a TPDO carries 64; use narrower channels"
        yield Problem(f'[[hand.pad]] "{name}": switch_states', "", text)


def _find_unwritable(key: str, text: str, value: int = 1) -> Iterator[Problem]:
    try:
        size = parse_writable_object(text).size_bytes
    except EdsError as error:
        yield Problem(key, "", str(error))
        return
    if value >= 1 << 8 * size:
        yield Problem(key, "", f'"{text}": delta_counts = {value} is beyond its type; choose a smaller value')


def _idle_settings(kind: Node, sync_period_ms: float) -> IdleSettings | None:
    """Return a kind's idle settings, with the SYNC period as inhibit time."""
    if kind.idle is None:
        return None
    enable, deltas = kind.idle.enable_object, tuple(map(parse_writable_object, kind.idle.delta_objects))
    return IdleSettings(
        kind.idle.delta_counts,
        kind.idle.period_ms,
        round(sync_period_ms * 10),
        deltas,
        parse_writable_object(enable) if enable else None,
    )


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """Present status of a node. `identity` and `cob_ids` are as last read from it, None and () before.

    `error_register` (0x1001) and `error_history` (0x1003, the latest first): as last received.
    `guarded`: it has no heartbeat and is guarded instead. `idle`: it is event-driven now.
    """

    slot: int
    name: str
    bus: str
    node_id: int
    state: NodeState
    since_ns: int
    reason: str
    identity: Identity | None
    cob_ids: tuple[int, ...]
    guarded: bool
    idle: bool
    heartbeats: int
    heartbeats_missed: int
    reboots: int
    emergencies: tuple[Emergency, ...]  # the latest, oldest first
    error_register: int | None
    error_history: tuple[int, ...]

    @property
    def serial(self) -> int | None:
        """Serial number read from the node, None before."""
        return self.identity.serial if self.identity else None


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """A change of a node's state or, with `old_state` equal to `new_state`, of its reason."""

    slot: int
    event_ns: int
    old_state: NodeState
    new_state: NodeState
    reason: str

    def __str__(self) -> str:
        states = [self.old_state.name.lower(), self.new_state.name.lower()]
        change = " -> ".join(dict.fromkeys(states))
        return f"{change}: {self.reason}" if self.reason else change


@dataclass(frozen=True, slots=True)
class ErrorChanged:
    """An error that a node has reported by EMCY, or has cleared (`emergency.cleared_ns` is set)."""

    slot: int
    event_ns: int
    emergency: Emergency

    def __str__(self) -> str:
        error = self.emergency
        text = f"EMCY {error.text}"
        if error.cleared_ns is None:
            return f"{text}, manufacturer-specific {error.manufacturer}"
        return f"{text}: cleared after {(error.cleared_ns - error.arrival_ns) * 1e-9:.1f} s"


@dataclass(frozen=True, slots=True)
class SerialChanged:
    """A node was replaced: the pad's calibration is that of another node."""

    slot: int
    event_ns: int
    old_serial: int | None
    new_serial: int | None

    def __str__(self) -> str:
        return f"node replaced: serial number {self.old_serial} -> {self.new_serial}, uncalibrated"


MasterEvent = NodeEvent | ErrorChanged | SerialChanged
