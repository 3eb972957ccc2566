"""Payloads about the state of pads, joints and the daemon: `Health`, `JointPositions`, `Service`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Health:
    """`health/<hand>/<link>`: state of a pad and its node; at every change and once a second."""

    v: int
    session: int
    seq: int
    t_ns: int
    hand: str
    link: str
    bus: str
    node_id: int
    state: str
    """PadState, as text"""
    node_state: str
    """absent, booting, identified, configuring, settling, operational, stale, faulted or stopped"""
    node_state_since_ns: int
    """when the node entered this state"""
    sampling: str
    """sync: samples with every SYNC; event: on change; off: switched off"""
    reason: str
    """cause and remedy as text; empty without a fault"""
    serial: int | None
    rate_hz: float
    """samples per second over the last second"""
    samples: int
    missed_samples: int
    """ticks without the sample of their SYNC: late or lost"""
    age_s: float | None
    reboots: int
    """boot-up messages of its node after the first"""
    heartbeats_missed: int
    emergencies: tuple[str, ...]
    """latest EMCY messages as text, newest last"""
    retained: bool
    calibration_state: str = ""
    """default, calibrated, quarantined or manual_required; this and the next are empty without supervision"""
    calibration_id: str = ""
    """the active calibration, as in its contacts"""
    calibration_progress: str = ""
    """progress of the automatic calibration, as text"""
    diagnoses: tuple[dict[str, Any], ...] = ()
    """maps of kind, cause, evidence, remedy, since_ns, confidence, pad_m, size_m"""


@dataclass(frozen=True, slots=True)
class JointPositions:
    """`joints/<hand>`: joint positions as received from the robot; at most 30 a second."""

    v: int
    session: int
    seq: int
    t_ns: int
    hand: str
    names: tuple[str, ...]
    """joints that move the hand's links, as named in the URDF"""
    position_rad: tuple[float | None, ...]
    """in the order of names; metres for a prismatic joint, None without any joint state"""
    age_s: tuple[float | None, ...]
    """of the nearest joint state"""
    retained: bool


@dataclass(frozen=True, slots=True)
class Service:
    """`service`: the daemon's heartbeat, twice a second; after three missed ones it is disconnected."""

    v: int
    session: int
    seq: int
    t_ns: int
    wall_offset_ns: int
    """add to a t_ns for nanoseconds since 1970 UTC"""
    version: str
    pid: int
    uptime_s: float
    period_s: float
    hands: dict[str, Any]
    """hand -> list of its links"""
    ticks: int
    overruns: int
    """periods without a tick because the daemon was late"""
    rate_hz: float
    tick_us: dict[str, Any]
    """median, p99 and max of the last half second's ticks, from the last sample to the last message"""
    loop: dict[str, Any]
    """time of the loop's stages: histograms, and the stages that made ticks late"""
    contacts: int
    """begun since the daemon started"""
    rejected: dict[str, Any]
    """cause -> rejected connections and requests"""
    process: dict[str, Any]
    """memory, CPU time, garbage collections, suppressed log messages"""
    buses: dict[str, Any]
    """bus -> load (fraction of the bit rate) and counters by cause"""
    congestion_episodes: dict[str, Any]
    """stream -> times that a message found the queue of a subscriber full"""
    subscriptions: tuple[str, ...]
    retained: bool
    supervisor: dict[str, Any] | None = None
    """state of the supervisor process; None without supervision"""
    inputs: dict[str, Any] | None = None
    """statistics of the inputs endpoint: received, age_s, dropped, problem"""
    stopping: bool = False
    """the last message of the session: the daemon was asked to stop"""
