"""What the master is told of a node and what it tells.

Public names: `NodeSpec`, `NodeStatus`, `NodeEvent`, `SerialChanged`.
"""

from __future__ import annotations

from dataclasses import dataclass

from .boot import Identity
from .channels import STANDARD_CHANNELS, Channels
from .emergency import Emergency
from .lifecycle import NodeState


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node as the configuration describes it; identity fields left None are not checked.

    `channels` are those of the electrodes x0, xa, y0, yb. `remap`: they may be mapped to a TPDO over SDO.
    """

    slot: int
    bus: str
    node_id: int
    name: str
    eds: str | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    revision: int | None = None
    channels: Channels = STANDARD_CHANNELS
    remap: bool = True
    heartbeat_ms: int = 100
    heartbeat_timeout_ms: int = 350


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """A node as it is now. `identity` and `cob_ids` are what was last read from it, None and () before.

    `guarded`: it has no heartbeat, and is asked for its state instead.
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
