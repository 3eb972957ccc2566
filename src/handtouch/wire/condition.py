"""How pads, joints and the daemon fare: `Health`, `Joints`, `Service`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Health:
    """`health/<hand>/<link>`: a pad and its node; sent at every change and once a second."""

    v: int
    run: int
    seq: int
    t_ns: int
    hand: str
    link: str
    bus: str
    node_id: int
    state: str
    """the pad, as PadState in small letters"""
    node: str
    """absent, booting, identified, configuring, settling, operational, stale, faulted or stopped"""
    since_ns: int
    """when the node entered its state"""
    pace: str
    """sync: it samples with SYNC; event: when something moves; off: switched off"""
    reason: str
    """cause and remedy in plain words, empty when all is well"""
    serial: int | None
    rate_hz: float
    """samples per second over the last second"""
    samples: int
    missed: int
    """ticks that had to do without the sample of their SYNC: late or lost"""
    age_s: float | None
    reboots: int
    """boot-up messages of its node, after the first"""
    heartbeats_missed: int
    emergencies: tuple[str, ...]
    """latest EMCY messages as text, newest last"""
    repeat: bool
    trust: str = ""
    """nominal, trusted, quarantined or person, who has to calibrate it; this and the next are empty where
    nobody supervises"""
    calibration: str = ""
    """what its readings are corrected by; the name is that of its contacts"""
    calibrating: str = ""
    """how far its calibration by itself is, in words"""
    findings: tuple[dict[str, Any], ...] = ()
    """what the supervisor has found: maps of kind, cause, evidence, remedy, since_ns, confidence, pad_m,
    size_m"""


@dataclass(frozen=True, slots=True)
class Joints:
    """`joints/<hand>`: where the joints are, as the robot told; at most 30 a second."""

    v: int
    run: int
    seq: int
    t_ns: int
    hand: str
    names: tuple[str, ...]
    """joints that move its links, as the URDF calls them"""
    position_rad: tuple[float | None, ...]
    """as names; metres where a joint slides, None where nobody told"""
    age_s: tuple[float | None, ...]
    """of the nearest joint state"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class Service:
    """`service`: the daemon's own heartbeat, twice a second; three missed ones mean that it is gone."""

    v: int
    run: int
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
    """periods that passed without a tick because the daemon was late"""
    rate_hz: float
    tick_us: dict[str, Any]
    """median, p99 and max of the last half second's ticks, from the last sample to the last message"""
    loop: dict[str, Any]
    """where its time goes: histograms, and which part made ticks late"""
    contacts: int
    """begun since it started"""
    refused: dict[str, Any]
    """cause -> connections and requests that were refused"""
    process: dict[str, Any]
    """memory, processor time, garbage collections, log messages not said"""
    buses: dict[str, Any]
    """bus -> load (part of the bit rate) and counters by cause"""
    drops: dict[str, Any]
    """stream -> messages that some subscriber's full queue couldn't take"""
    subscriptions: tuple[str, ...]
    repeat: bool
    supervisor: dict[str, Any] | None = None
    """how the slow half of the supervisor fares; None where there is none"""
    inputs: dict[str, Any] | None = None
    """what came to the inputs endpoint: received, age_s, dropped, problem"""
