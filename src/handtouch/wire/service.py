"""Payload about the daemon, and the maps inside of it: `Service`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypedDict


class DurationPercentiles(TypedDict, total=False):
    """`tick_us` and `jitter_us`: empty where there are no values."""

    p50: float
    """median"""
    p99: float
    """99th percentile"""
    max: float
    """maximum"""


class DurationHistogram(TypedDict):
    """Histogram of durations."""

    sum_s: float
    """sum of all durations"""
    counts: list[int]
    """element k, from 0, counts the durations below 1.024 us x 2^k that are in no earlier element; trailing
    zeros are left out"""


class LoopStatistics(TypedDict):
    """`loop`: timing since the daemon started."""

    latency: DurationHistogram
    """time from the last sample of a tick to its last message"""
    stages: dict[str, DurationHistogram]
    """stage of the loop -> time per period; the stages are `sync`, `wait`, `receive`, `tick`, `send`,
    `percepts`, `settle`, `supervise`, `nodes`, `report` and `requests`"""
    late: dict[str, int]
    """longest stage (or `wake_up_delay`: the thread was not scheduled in time) -> late ticks, whose messages
    were sent more than a period after their SYNC or never"""


class ProcessStatistics(TypedDict):
    """`process`: resources of the daemon."""

    memory_bytes: int
    """resident memory"""
    cpu_s: float
    """CPU time of all threads"""
    loop_cpu_s: float
    """CPU time of the loop"""
    collections: list[int]
    """garbage collections, by generation"""
    log_dropped: int
    """log messages lost"""
    log_suppressed: int
    """log messages suppressed as repetitions"""


class SyncStatistics(TypedDict):
    """`sync` of a bus."""

    by: Literal["kernel", "loop", "other_producer"]
    """producer of SYNC: `kernel`, `loop` or `other_producer`"""
    jitter_us: DurationPercentiles
    """deviation of SYNC intervals from the period, over the last second; empty: fewer than two SYNCs"""
    other_syncs: int
    """SYNCs of another producer while the daemon is one"""
    problem: str
    """cause and remedy as text; empty without a fault"""


class BusStatistics(TypedDict):
    """One of `buses`."""

    load: float
    """fraction of the bit rate, over the last half second, for worst-case bit stuffing"""
    lost_hz: float
    """frames lost per second on this host, over the last half second: the rate of `overflow`"""
    state: Literal["active", "warning", "passive", "bus-off", "down"]
    """`active`, `warning` (an error counter at 96 or more), `passive` (128), `bus-off`, `down`"""
    since_ns: int
    """since when, on the clock of `t_ns`; 0: from the start"""
    problem: str
    """why it isn't active, a full transmit queue or a malformed frame, each with a remedy; empty without a
    fault"""
    causes: dict[str, int]
    """cause reported by error frames -> count: `bus-off`, `restarted`, `no acknowledge`, `bit error`, `stuff
    error`, `form error`, `CRC error`, `lost arbitration`, `controller receive overflow` ..."""
    transmit_errors: int
    """the controller's transmit error counter, as last reported"""
    receive_errors: int
    """its receive error counter"""
    sync: SyncStatistics
    """SYNC on this bus"""
    frames: int
    """data frames received"""
    sent: int
    """frames sent by the daemon (not by the kernel)"""
    bits: int
    """bits of both"""
    samples: int
    """frames with channels"""
    wrong_length: int
    """frames of a known identifier and a wrong length"""
    unknown_frames: int
    """frames with an identifier of no known node"""
    error_frames: int
    """error frames"""
    queue_full: int
    """frames not sent because the transmit queue was full"""
    send_failures: int
    """frames not sent for any other reason"""
    receive_failures: int
    """failures of the interface"""
    overflow: int
    """frames lost in the kernel's queue or the daemon's"""


class InputStatistics(TypedDict):
    """`inputs`: statistics of the inputs endpoint."""

    received: dict[str, int]
    """topic -> messages used"""
    age_s: dict[str, float]
    """topic -> age of the newest"""
    dropped: dict[str, int]
    """cause -> messages, or parts of them"""
    problem: str
    """the latest cause, with the message's topic and values; empty before the first"""


class SupervisorStatistics(TypedDict):
    """`supervisor`: the supervisor process."""

    state: str
    """state of the process"""
    pid: int | None
    """its process id"""
    restarts: int
    """restarts after it exited"""
    exit_reason: str
    """reason of the last exit"""
    lag_s: float | None
    """how far it is behind the tick"""
    dropped: int
    """blocks of samples dropped"""
    malformed: int
    """malformed messages from it"""
    late: int
    """messages from it that came too late"""
    summary: str
    """summary of the calibration states"""
    store_error: str
    """fault of the calibration store; empty without one"""


class PerceptStatistics(TypedDict):
    """`percepts`: the percept process."""

    state: Literal["stopped", "starting", "running", "waiting"]
    """state of the process: `stopped` while no percept is requested that needs it, `starting`, `running`,
    `waiting` for its next restart"""
    pid: int | None
    """its process id"""
    restarts: int
    """restarts after it exited or hung"""
    exit_reason: str
    """reason of the last exit"""
    lag_s: float | None
    """how far it is behind the tick"""
    dropped: int
    """`percept_input` messages dropped because its queue was full"""
    malformed: int
    """malformed messages from it"""


@dataclass(frozen=True, slots=True)
class Service:
    """`service`: the daemon's heartbeat, twice a second; after three missed ones it is disconnected."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication"""
    wall_offset_ns: int
    """add it to a `t_ns` for nanoseconds since 1970 UTC"""
    version: str
    """version of handtouch"""
    pid: int
    """process of the daemon"""
    uptime_s: float
    """time since the daemon started"""
    period_s: float
    """period of SYNC and of the tick"""
    hands: Annotated[dict[str, Any], dict[str, list[str]]]
    """hand -> its links"""
    ticks: int
    """since the daemon started"""
    overruns: int
    """periods without a tick because the daemon was late; `late` of `loop` counts them by cause"""
    rate_hz: float
    """ticks per second, over the last half second"""
    core_compiled: bool
    """false: the stages of a tick run uncompiled, some fifty times slower per contact"""
    tick_us: Annotated[dict[str, Any], DurationPercentiles]
    """the last half second's ticks, from the last sample to the last message"""
    loop: Annotated[dict[str, Any], LoopStatistics]
    """timing since the daemon started"""
    contacts: int
    """begun since the daemon started"""
    rejected: Annotated[dict[str, Any], dict[str, int]]
    """cause -> rejected connections; `unknown_topic` -> subscriptions to prefixes of no topic,
    `subscription_flood` -> connections cut off for too many, `connection_flood` -> requests to connect that
    were dropped as clients connected too fast, `request` -> refused requests"""
    process: Annotated[dict[str, Any], ProcessStatistics]
    """resources of the daemon"""
    buses: Annotated[dict[str, Any], dict[str, BusStatistics]]
    """bus -> its state and counters"""
    congestion_episodes: Annotated[dict[str, Any], dict[str, int]]
    """stream (`live`, `complete`) -> times that a message found the queue of a subscriber full; each may cost
    that subscriber many messages"""
    subscriptions: tuple[str, ...]
    """subscribed prefixes, 100 of them at most"""
    retained: bool
    supervisor: Annotated[dict[str, Any], SupervisorStatistics] | None = None
    """the supervisor process; absent without supervision"""
    percepts: Annotated[dict[str, Any], PerceptStatistics] | None = None
    """the percept process"""
    inputs: Annotated[dict[str, Any], InputStatistics] | None = None
    """statistics of the inputs endpoint"""
    replay: bool = False
    """true: `handtouch replay --publish` publishes it, so that the ages of all data are of their reception"""
    frame_period_s: float = 0.0
    """time between two `hand` frames as planned: `period_s`, or longer while the hand is idle or its scenes
    ask for fewer; published at once when it grows. 0 or absent: `period_s`"""
    stopping: bool = False
    """true in the last message of a session, before contacts end and nodes are stopped; absent in the
    others"""
