"""What the master is told of a node and what it tells: `NodeSpec`, `NodeStatus`, `NodeEvent`."""

from __future__ import annotations

from dataclasses import dataclass

from .boot import Identity
from .emergency import Emergency
from .lifecycle import NodeState


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node as the configuration describes it; identity fields left None are not checked."""

    slot: int
    bus: str
    node_id: int
    name: str
    eds: str | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    heartbeat_ms: int = 100
    heartbeat_timeout_ms: int = 350


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """A node as it is now. `identity` and `cob_id` are what was last read from it, None before."""

    slot: int
    name: str
    bus: str
    node_id: int
    state: NodeState
    since_ns: int
    reason: str
    identity: Identity | None
    cob_id: int | None
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
