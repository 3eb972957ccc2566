"""What the master is told of a node and what it tells.

Public names: `NodeSpec`, `node_specs`, `checked`, `NodeStatus`, `NodeEvent`, `SerialChanged`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from handtouch.canbus.objects.channels import (
    STANDARD_CHANNELS,
    Channels,
    Object,
    channels_of,
    in_order,
    written,
)
from handtouch.canbus.objects.eds import EdsError
from handtouch.canbus.objects.emergency import Emergency
from handtouch.canbus.objects.mapping import from_eds
from handtouch.config import ConfigError, Deployment, Node, Problem

from .boot import Identity, Idle
from .life import NodeState


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node as the configuration describes it; identity fields left None are not checked.

    `channels` are those of the electrodes x0, xa, y0, yb. `remap`: they may be mapped to a TPDO over SDO.
    `event_timer_ms`: how often it sends if it can't follow SYNC. `foreign`: serial numbers that belong to
    other pads.
    """

    slot: int
    bus: str
    node_id: int
    name: str
    eds: str | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    foreign: frozenset[int] = frozenset()
    revision: int | None = None
    channels: Channels = STANDARD_CHANNELS
    remap: bool = True
    idle: Idle | None = None
    excitation: Object | None = None
    heartbeat_ms: int = 100
    heartbeat_timeout_ms: int = 350
    event_timer_ms: int = 5


def node_specs(deployment: Deployment) -> list[NodeSpec]:
    """What a deployment says of every node, in the order of its pads. Raises EdsError."""
    pads = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
    specs = []
    for slot, (hand, pad) in enumerate(pads):
        kind = deployment.nodes[pad.node]
        specs.append(
            NodeSpec(
                slot=slot,
                bus=pad.bus,
                node_id=pad.node_id,
                name=f"{hand}/{pad.link}",
                eds=kind.eds,
                vendor_id=kind.vendor_id,
                product_code=kind.product_code,
                revision=kind.revision,
                serial=pad.serial,
                channels=in_order(channels_of(kind.channels, kind.eds), pad.electrodes),
                remap=kind.remap,
                idle=_idle(kind, deployment.daemon.sync_period_ms),
                excitation=written(kind.excitation) if kind.excitation else None,
                heartbeat_ms=kind.heartbeat_ms,
                heartbeat_timeout_ms=kind.heartbeat_timeout_ms,
                event_timer_ms=max(1, round(deployment.daemon.sync_period_ms)),
            )
        )
    return specs


def checked(deployment: Deployment, file: str) -> Deployment:
    """The deployment, if nodes can have the objects that it names. Raises ConfigError with all mistakes."""
    problems = [*_problems(deployment)]
    if problems:
        raise ConfigError(file, tuple(problems))
    return deployment


def _problems(deployment: Deployment) -> Iterator[Problem]:
    listened = {bus.name for bus in deployment.buses if bus.role == "listener"}
    for name, kind in deployment.nodes.items():
        place = f"[node.{name}]: "
        try:
            channels = channels_of(kind.channels, kind.eds)
            for hand in deployment.hands:
                for pad in hand.pads:
                    if pad.node == name and pad.bus in listened:
                        from_eds(kind.eds, pad.node_id, channels)
        except EdsError as error:
            yield Problem(f"{place}channels", "", str(error))
        if kind.excitation is not None:
            yield from _unwritable(f"{place}excitation", kind.excitation)
        if kind.idle is not None:
            place = f"[node.{name}.idle]: "
            for text in kind.idle.delta_objects:
                yield from _unwritable(f"{place}delta_objects", text, kind.idle.delta_counts)
            if kind.idle.enable_object:
                yield from _unwritable(f"{place}enable_object", kind.idle.enable_object)


def _unwritable(place: str, text: str, value: int = 1) -> Iterator[Problem]:
    try:
        size = written(text).size
    except EdsError as error:
        yield Problem(place, "", str(error))
        return
    if value >= 1 << 8 * size:
        yield Problem(place, "", f'"{text}": delta_counts = {value} is beyond its type; choose a smaller one')


def _idle(kind: Node, sync_period_ms: float) -> Idle | None:
    """Events come no faster than samples would."""
    if kind.idle is None:
        return None
    enable, deltas = kind.idle.enable_object, tuple(map(written, kind.idle.delta_objects))
    return Idle(
        kind.idle.delta_counts,
        kind.idle.period_ms,
        round(sync_period_ms * 10),
        deltas,
        written(enable) if enable else None,
    )


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """A node as it is now. `identity` and `cob_ids` are what was last read from it, None and () before.

    `guarded`: it has no heartbeat, and is asked for its state instead. `idle`: it is event-driven for now.
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

    @property
    def serial(self) -> int | None:
        """Serial number read from the node, None where it told none yet."""
        return self.identity.serial if self.identity else None


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """A change in a node's life, or a new reason for the state it is in (`old` equals `new` then)."""

    slot: int
    t_ns: int
    old: NodeState
    new: NodeState
    reason: str

    def __str__(self) -> str:
        return f"{self.old.name.lower()} -> {self.new.name.lower()}: {self.reason}"


@dataclass(frozen=True, slots=True)
class SerialChanged:
    """Another unit answers in a node's place: its calibration is another's."""

    slot: int
    t_ns: int
    before: int | None
    after: int | None

    def __str__(self) -> str:
        return f"serial number was {self.before}, is {self.after}: another unit, not the one calibrated here"
