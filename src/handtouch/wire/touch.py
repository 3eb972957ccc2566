"""What is felt: `Contact`, `HandFrame`, `Percept`; what their `PadState` and `Placing` mean."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

Vector3 = tuple[float, float, float]
Floats9 = tuple[float, float, float, float, float, float, float, float, float]


class PadState(IntEnum):
    """What a subscriber may believe of a pad: no contact, stale and faulted are different things."""

    CLEAR = 0
    """sampled, not touched"""
    TOUCHED = 1
    STALE = 2
    """no sample for three periods"""
    LOST = 3
    """the node's heartbeat timed out"""
    FAULTED = 4
    """samples that can't be trusted: see the pad's health"""
    STARTING = 5
    """the node hasn't been brought up yet"""
    OFF = 6
    """switched off: outside the scene"""


class Placing(IntEnum):
    """Whether a contact is known in the frame of palm or base; messages have the names in small letters."""

    SKIPPED = 0
    """no scene asks for it"""
    VALID = 1
    STALE = 2
    """the joint states that it depends on are too old"""
    INVALID = 3
    """no place on the link, or joints that nobody ever told"""


@dataclass(frozen=True, slots=True)
class Contact:
    """`contact/<hand>/<link>`: one touch at one instant of its life."""

    v: int
    run: int
    """which run of the daemon: another number, another life, and `seq` and `id` begin anew"""
    seq: int
    """counts the instants of the topic, sent or not: a gap tells how many a subscriber missed"""
    t_ns: int
    event: str
    """begin, update or end"""
    id: int
    """the same from begin to end, never used again while the daemon lives"""
    hand: str
    link: str
    frame: str
    """frame of position_m, normal and covariance_m2: the link's name"""
    begin_ns: int
    duration_s: float
    age_s: float
    """from the sample to the sending of this message"""
    position_m: Vector3 | None
    normal: Vector3 | None
    covariance_m2: Floats9 | None
    """of position_m, row by row"""
    pad_m: tuple[float, float] | None
    """arc lengths on the pad from the electrodes x0 and y0"""
    location: str
    """valid, doubtful (told, and not to be relied on), invalid or skipped"""
    force_n: float | None
    force_std_n: float | None
    peak_force_n: float | None
    strength: str
    """valid, saturated (force_n is a lower bound), unestimated (too little is known yet) or invalid"""
    current_a: float
    residual: float | None
    """excess of the two x currents over those of a point, part of the total; positive: elongated along x"""
    residual_std: float | None
    on_n: float
    off_n: float
    calibration: str
    reason: str
    """why a contact ended: released, stale, lost, faulted, off, restarted or stopped; else empty"""
    repeat: bool
    """the present state for a late joiner, under the seq that the topic has reached"""
    group: int = 0
    """the same for contacts that one object may bridge; 0: no scene asks for palm or base"""
    palm: str = "skipped"
    """Placing of the three that follow"""
    palm_position_m: Vector3 | None = None
    palm_normal: Vector3 | None = None
    palm_covariance_m2: Floats9 | None = None
    base: str = "skipped"
    """Placing of the three that follow"""
    base_position_m: Vector3 | None = None
    base_normal: Vector3 | None = None
    base_covariance_m2: Floats9 | None = None
    joints_age_s: float | None = None
    """from the sample to the nearest joint state, the worst of the joints in between"""
    raw_force_n: float | None = None
    """before the behaviour of the sheet was undone; None where that isn't modelled"""
    findings: tuple[str, ...] = ()
    """kinds of what the supervisor has found, see `Health`, and because of which place or force isn't told or
    isn't to be relied on"""


@dataclass(frozen=True, slots=True)
class HandFrame:
    """`hand/<hand>`: the whole hand as columns, one per tick; each column little-endian, one row per link."""

    v: int
    run: int
    seq: int
    t_ns: int
    tick: int
    hand: str
    links: tuple[str, ...]
    state: bytes
    """uint8, PadState"""
    contact: bytes
    """uint32 contact id, 0 for none"""
    sample_ns: bytes
    """int64, sample time of each pad, 0 before the first"""
    current_a: bytes
    """float32, total current"""
    position_m: bytes
    """float32 x 3 in the link frame; this and the following are NaN without contact or when not known"""
    normal: bytes
    """float32 x 3"""
    covariance_m2: bytes
    """float32 x 9, of position_m, row by row"""
    pad_m: bytes
    """float32 x 2, arc lengths on the pad"""
    force_n: bytes
    """float32"""
    force_std_n: bytes
    """float32; NaN unless force_n is a value"""
    saturated: bytes
    """uint8, 1 where force_n is a lower bound"""
    residual: bytes
    """float32"""
    residual_std: bytes
    """float32"""
    repeat: bool
    group: bytes = b""
    """uint32, 0 for none; this and the following: as in `Contact`, no bytes where no scene asks for them"""
    palm: bytes = b""
    """uint8, Placing"""
    palm_position_m: bytes = b""
    """float32 x 3"""
    palm_normal: bytes = b""
    """float32 x 3"""
    palm_covariance_m2: bytes = b""
    """float32 x 9"""
    base: bytes = b""
    """uint8, Placing"""
    base_position_m: bytes = b""
    """float32 x 3"""
    base_normal: bytes = b""
    """float32 x 3"""
    base_covariance_m2: bytes = b""
    """float32 x 9"""
    joints_age_s: bytes = b""
    """float32"""
    unestimated: bytes = b""
    """uint8, 1 where force_n isn't to be relied on yet; no bytes where there is none"""
    doubtful: bytes = b""
    """uint8, 1 where position_m isn't to be relied on, for what the supervisor has found; as above"""


@dataclass(frozen=True, slots=True)
class Percept:
    """`percept/<hand>/<kind>`: what is felt above contacts, or (`ask`) what to do to know more."""

    v: int
    run: int
    seq: int
    t_ns: int
    hand: str
    kind: str
    """motion, hardness, shape, texture or ask"""
    link: str
    """whose contact it is of; empty: of the whole hand"""
    contact: int
    """id of that contact, 0 for none"""
    state: str
    """unestimated (reason says what is missing), estimated or invalid; of an ask: open"""
    label: str
    """the most probable class; of an ask: what to do; empty where there are no classes"""
    confidence: float | None
    """probability of the label"""
    probabilities: dict[str, Any]
    """class -> probability; of an ask: those of the hypotheses it would tell apart"""
    values: dict[str, Any]
    """by name with its unit; of an ask: how much of what to do"""
    evidence: dict[str, Any]
    """what it rests on, counted"""
    reason: str
    """what is missing, or why to ask, in words"""
    repeat: bool
    question: str = ""
    """this and the next of an ask alone: which question it would settle"""
    expires_ns: int = 0
    """the request is void from then on"""
