"""What the life of a CANopen node is made of: its states, what may happen, and what is then to be done.

Public names: `Life` with its `NodeState`; `Event`, one of those defined here; `Action`; `Role` and `Timing`,
by which `lifecycle.advance` goes on. Times are in ns.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum, auto


class NodeState(IntEnum):
    """Where a node is in its life. Samples are to be trusted in OPERATIONAL only."""

    ABSENT = 0  # never heard, or lost: its heartbeat timed out
    BOOTING = 1  # heard; its identity is being read
    IDENTIFIED = 2  # it is who it should be; its PDO mapping is being read
    CONFIGURING = 3  # its heartbeat and PDO are being set and read back
    SETTLING = 4  # started; its first samples are discarded
    OPERATIONAL = 5
    STALE = 6  # it is alive, but no samples come
    FAULTED = 7  # it can't be used, for the reason given; tried again from time to time
    STOPPED = 8  # by us: handtouch has ended, or nobody needs the node now


class Action(Enum):
    """What the machine wants done. IDENTIFY, READ_MAPPING and CONFIGURE end in a `Done` or a `Failed`."""

    PROBE = auto()  # ask over SDO, without waiting, whether anybody is there
    IDENTIFY = auto()
    READ_MAPPING = auto()
    CONFIGURE = auto()
    ENTER_PREOPERATIONAL = auto()  # these three: NMT, to this node alone
    START = auto()
    STOP = auto()
    POWER_DOWN = auto()  # excitation off, where it can be, then STOP
    PACE = auto()  # event-driven or synchronous; asked for by the master itself


NMT_BOOT_UP, NMT_STOPPED, NMT_OPERATIONAL, NMT_PREOPERATIONAL = 0, 4, 5, 127
NMT_NAMES = {NMT_STOPPED: "stopped", NMT_OPERATIONAL: "operational", NMT_PREOPERATIONAL: "pre-operational"}


class Role(Enum):
    """What part we take on a node's bus."""

    MASTER = "master"  # we configure and start the node
    GUEST = "guest"  # we configure it; another NMT master starts it
    LISTENER = "listener"  # we send nothing


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of one node [ns], and our part on its bus."""

    heartbeat_ns: int
    heartbeat_timeout_ns: int
    role: Role = Role.MASTER
    settle_samples: int = 3
    settle_timeout_ns: int = 1_000_000_000
    retry_first_ns: int = 100_000_000
    retry_last_ns: int = 5_000_000_000

    def pause_ns(self, failures: int) -> int:
        """Pause after that many failures in a row: doubled with each, up to the longest."""
        return min(self.retry_first_ns << min(max(failures - 1, 0), 16), self.retry_last_ns)


LOOK_AT = "check its power, cable, node id and the bit rate and termination of the bus"


@dataclass(frozen=True, slots=True)
class Life:
    """A node's life so far."""

    state: NodeState = NodeState.ABSENT
    since_ns: int = 0
    reason: str = f"not heard yet; {LOOK_AT}"
    nmt: int | None = None  # NMT state that it last told
    heard_ns: int | None = None  # boot-up, heartbeat or answer
    heartbeat_ns: int | None = None  # the last one, or since when one is due; None: not supervised
    started_ns: int = 0
    due_ns: int = 0  # next probe (ABSENT), attempt (FAULTED) or end of patience (SETTLING)
    attempt: int = 0  # which boot this is; results of others are void
    failures: int = 0  # attempts in a row; they set the pause before the next
    probes: int = 0  # unanswered in a row; they set the pause before the next
    discard: int = 0  # samples still to be discarded
    reboots: int = 0
    must_beat: bool = False  # lost for want of heartbeats: not trusted before it has sent one
    stranger: bool = False  # at its last identification it was not the configured node
    twins: bool = False  # two nodes have its id
    babbles: bool = False  # it sends many samples for one SYNC
    because: str = ""  # why the present boot began
    resting: bool = False  # not needed now: configured, but stopped instead of started


@dataclass(frozen=True, slots=True)
class BootUp:
    """The node has (re)started: heartbeat identifier with a 0."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A heartbeat with the node's NMT state."""

    nmt: int


@dataclass(frozen=True, slots=True)
class Answer:
    """An SDO answer to a probe."""


@dataclass(frozen=True, slots=True)
class Done:
    """A step of attempt `attempt` has succeeded."""

    step: Action
    attempt: int


@dataclass(frozen=True, slots=True)
class Failed:
    """A step of attempt `attempt` has failed. `silent`: no answer. `stranger`: not the configured node."""

    step: Action
    attempt: int
    reason: str
    silent: bool = False
    stranger: bool = False


@dataclass(frozen=True, slots=True)
class Sample:
    """A sample has arrived."""


@dataclass(frozen=True, slots=True)
class Silence:
    """No sample for too long, this many ns."""

    age_ns: int


@dataclass(frozen=True, slots=True)
class Beats:
    """How often its heartbeats came over a while: `twice`, as if two nodes had its id, or as they should."""

    twice: bool


@dataclass(frozen=True, slots=True)
class Babble:
    """How many samples came for each SYNC over a while; 0 where it is one, as it should be."""

    times: int


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed."""


@dataclass(frozen=True, slots=True)
class Rest:
    """The node isn't needed for now (`resting`), or is again."""

    resting: bool


@dataclass(frozen=True, slots=True)
class Stop:
    """The node is not wanted any more."""


Event = BootUp | Heartbeat | Answer | Done | Failed | Sample | Silence | Beats | Babble | Rest | Tick | Stop
