"""Types of a CANopen node's lifecycle: states, events, actions, timing.

Public names: `Lifecycle` with its `NodeState` and `NmtFault`; `LifecycleEvent`, a union of the event
classes; `NodeAction`; `BusRole` and `NodeTiming`, the parameters of `lifecycle.advance`. Times are in ns.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import NamedTuple


class NodeState(IntEnum):
    """State of a node; samples are valid in OPERATIONAL only."""

    ABSENT = 0  # no message received yet, or lost: its heartbeat timed out
    BOOTING = 1  # present; its identity is being read
    IDENTIFIED = 2  # the configured device; its PDO mapping is being read
    CONFIGURING = 3  # its heartbeat and PDOs are being written and read back
    SETTLING = 4  # started; its first samples are discarded
    OPERATIONAL = 5
    STALE = 6  # present, but sends no samples
    FAULTED = 7  # unusable for the reason given; retried
    STOPPED = 8  # by handtouch: at its end, or because the scene doesn't need the node


class NodeAction(Enum):
    """Action for the caller. IDENTIFY, READ_MAPPING and CONFIGURE end in a StepDone or a StepFailed."""

    PROBE = auto()  # request an object over SDO, without waiting, to find out if a node is there
    IDENTIFY = auto()
    READ_MAPPING = auto()
    CONFIGURE = auto()
    ENTER_PREOPERATIONAL = auto()  # these three: NMT commands to this node alone
    START = auto()
    STOP = auto()
    ENTER_STANDBY = auto()  # excitation off, where the node supports it, then STOP
    RESET_COMMUNICATION = auto()  # NMT reset communication to this node alone
    READ_ERRORS = auto()  # error register and history over SDO, to explain a refusal
    CHECK_SETTINGS = auto()  # read back what was configured; a StepFailed names the difference
    SET_TRANSMISSION = auto()  # event-driven or synchronous; started by the master itself


class NmtFault(Enum):
    """Fault in a node's NMT behaviour; its reason ends with the errors that the node reports."""

    REFUSES_OPERATIONAL = "refuses OPERATIONAL"
    LEAVES_OPERATIONAL = "leaves OPERATIONAL by itself"


class BusRole(Enum):
    """Role of handtouch on a node's bus."""

    MASTER = "master"  # configures and starts the node
    GUEST = "guest"  # configures the node; another NMT master starts it
    LISTENER = "listener"  # sends nothing


CONNECTION_REMEDY = "check its power, cable, node id and the bit rate and termination of the bus"
CABLELESS_REMEDY = "check that its program runs, its node id, and the host's load"


@dataclass(frozen=True, slots=True)
class NodeTiming:
    """Times of one node [ns], handtouch's role on its bus, and what to check when nothing is heard of it."""

    heartbeat_period_ns: int
    heartbeat_timeout_ns: int
    role: BusRole = BusRole.MASTER
    settle_samples: int = 3
    settle_timeout_ns: int = 1_000_000_000
    min_retry_ns: int = 100_000_000
    max_retry_ns: int = 5_000_000_000
    """also: a node that has operated for so long is stable, and its next restart is the first again"""
    allow_nmt_reset: bool = True
    connection_remedy: str = CONNECTION_REMEDY

    def retry_delay_ns(self, failures: int) -> int:
        """Return the delay after that many consecutive failures: doubled with each, up to `max_retry_ns`."""
        return min(self.min_retry_ns << min(max(failures - 1, 0), 16), self.max_retry_ns)


class Lifecycle(NamedTuple):
    """State of a node and all that its next transition depends on.

    A named tuple because each heartbeat makes a new one: a changed copy of a dataclass takes six times as
    long.
    """

    state: NodeState = NodeState.ABSENT
    since_ns: int = 0
    reason: str = f"no message received yet; {CONNECTION_REMEDY}"
    nmt_state: int | None = None  # as last reported by the node
    last_frame_ns: int | None = None  # boot-up, heartbeat or SDO response
    last_heartbeat_ns: int | None = None  # the last one, or the start of supervision; None: not supervised
    heartbeat_ns: int | None = None  # arrival of the last heartbeat
    heartbeat_gap_ns: int = 0  # between the last two
    is_heartbeat_slow: bool = False  # later than its timeout, while samples arrive
    started_ns: int = 0
    due_ns: int = 0  # next probe (ABSENT), next attempt (FAULTED) or settling timeout (SETTLING)
    attempt: int = 0  # number of the boot; results of other attempts are void
    failures: int = 0  # consecutive failed attempts
    unanswered_probes: int = 0  # consecutive
    samples_to_discard: int = 0
    reboots: int = 0
    heartbeat_required: bool = False  # lost by heartbeat timeout: unusable until it sends a heartbeat
    wrong_device: bool = False  # not the configured node, at its last identification
    duplicate_id: bool = False  # two nodes have its id
    babbling: bool = False  # sends many samples per SYNC
    identified: bool = False  # as the configured node, since its last boot-up
    fault: NmtFault | None = None
    errors: str = ""  # errors that the node reports, as text
    confirmed: bool = False  # it was operational after its start
    operational_ns: int = 0  # when it became operational after its start, 0 before
    restarts: int = 0  # consecutive boot-ups, refusals and departures of an unstable node
    boot_ups: int = 0  # those of them that are boot-ups
    unstable_ns: int = 0  # time of the first of them
    start_pending: bool = False  # FAULTED, and started again: its next heartbeat shows the effect
    reset_sent: bool = False  # one NMT reset communication, since it was last stable
    reset_pending: bool = False  # its boot-up message hasn't arrived
    foreign_nmt: int | None = None  # last NMT command of another master, and its time
    foreign_nmt_ns: int = 0
    silence: str = ""  # STALE, ABSENT: what is missing
    bus_cause: str = ""  # STALE, ABSENT: its cause in the host or the bus, empty if it is the node's
    alone_ns: int | None = None  # ABSENT: since when others of its bus are heard again, after a common cause
    checks: int = 0  # checks of its settings, in close succession
    check_ns: int = -(1 << 62)  # time of the next one
    repairs: int = 0  # repairs of changed settings, in close succession
    repaired_ns: int = 0  # time of the last one
    boot_reason: str = ""  # cause of the present boot
    standby: bool = False  # not needed now: configured, but stopped instead of started


@dataclass(frozen=True, slots=True)
class BootUpReceived:
    """Boot-up message: the node has started or restarted."""


@dataclass(frozen=True, slots=True)
class HeartbeatReceived:
    """Heartbeat with the node's NMT state."""

    nmt_state: int


@dataclass(frozen=True, slots=True)
class ForeignNmtCommand:
    """NMT command of another master to this node, or to all."""

    command: int


@dataclass(frozen=True, slots=True)
class ErrorsReported:
    """Errors that the node reports, by EMCY, error register and history; empty for none."""

    errors: str


@dataclass(frozen=True, slots=True)
class ProbeAnswered:
    """SDO response to a probe."""


@dataclass(frozen=True, slots=True)
class StepDone:
    """Success of a step of attempt `attempt`."""

    step: NodeAction
    attempt: int


@dataclass(frozen=True, slots=True)
class StepFailed:
    """Failure of a step of attempt `attempt`.

    `timed_out`: the node didn't respond. `wrong_device`: it is not the configured node. `answered`: it has
    responded to other requests of the step.
    """

    step: NodeAction
    attempt: int
    reason: str
    timed_out: bool = False
    wrong_device: bool = False
    answered: bool = False


@dataclass(frozen=True, slots=True)
class SampleReceived:
    """A sample."""


@dataclass(frozen=True, slots=True)
class SamplesMissing:
    """No sample for `age_ns`; `bus_cause`: cause of it in the host or the bus, empty if it is the node's."""

    age_ns: int
    bus_cause: str = ""


@dataclass(frozen=True, slots=True)
class HeartbeatRate:
    """Heartbeat rate over a window; `doubled`: twice the configured one, as if two nodes had its id.

    `samples_single`: meanwhile it sent one sample per SYNC, so that it is one node with fast heartbeats.
    """

    doubled: bool
    samples_single: bool = False


@dataclass(frozen=True, slots=True)
class SampleRate:
    """Samples per SYNC over a window; 0 for the regular one.

    `is_contrary`: in most cycles there were two of different contents, as of two devices.
    """

    samples_per_sync: int
    is_contrary: bool = False


@dataclass(frozen=True, slots=True)
class TimerExpired:
    """The time returned by `lifecycle.due_ns` has come.

    Causes in the host or the bus, empty for none: `bus_cause` of missing heartbeats or first samples,
    `sample_cause` of missing samples of a stale node.
    """

    bus_cause: str = ""
    sample_cause: str = ""
    sample_age_ns: int = 1 << 62
    """since the node's last sample"""


@dataclass(frozen=True, slots=True)
class IdentifierClash:
    """Another node, or a device that isn't configured, sends with the COB-ID of its samples; `reason` says
    which."""

    reason: str


@dataclass(frozen=True, slots=True)
class LoopPaused:
    """The receiving loop paused: timeouts are extended by `excused_ns`."""

    excused_ns: int


@dataclass(frozen=True, slots=True)
class BusRecovered:
    """The bus carries frames again after it was down or bus-off: timeouts start again."""


@dataclass(frozen=True, slots=True)
class StandbyRequested:
    """The scene doesn't need the node (`standby`), or needs it again."""

    standby: bool


@dataclass(frozen=True, slots=True)
class StopRequested:
    """The master stops."""


LifecycleEvent = (
    BootUpReceived
    | HeartbeatReceived
    | IdentifierClash
    | ForeignNmtCommand
    | ErrorsReported
    | ProbeAnswered
    | StepDone
    | StepFailed
    | SampleReceived
    | SamplesMissing
    | HeartbeatRate
    | SampleRate
    | StandbyRequested
    | TimerExpired
    | LoopPaused
    | BusRecovered
    | StopRequested
)
