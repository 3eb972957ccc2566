"""Payloads about contacts: `Contact`, `HandFrame`, `Percept`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from handtouch.wire.columns import Column
from handtouch.wire.status import ForceStatus, FrameStatus, PadState, PositionStatus

Vector3 = tuple[float, float, float]
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]

PERCEPT_KINDS = ("motion", "stiffness", "shape", "texture")
"""Kinds of percepts, each a topic `percept/<hand>/<kind>`."""


@dataclass(frozen=True, slots=True)
class Contact:
    """`contact/<hand>/<link>`: begin, update or end of one contact."""

    v: int
    session: int
    """random number of the daemon's session; in another session, `seq` and `id` start over"""
    seq: int
    """counts the messages of the topic, sent or not: gaps are messages lost to this subscriber"""
    t_ns: int
    event: str
    """begin, update or end"""
    id: int
    """constant from begin to end, unique in the session"""
    hand: str
    link: str
    frame: str
    """frame of position_m, normal and covariance_m2: the link's name"""
    begin_ns: int
    duration_s: float
    age_s: float
    """from the sample to the publication of this message"""
    position_m: Vector3 | None
    normal: Vector3 | None
    covariance_m2: Matrix3 | None
    """of position_m, row by row"""
    pad_m: tuple[float, float] | None
    """arc lengths on the pad from the electrodes x0 and y0"""
    position_status: str
    """PositionStatus, as text"""
    force_n: float | None
    force_std_n: float | None
    peak_force_n: float | None
    force_status: str
    """ForceStatus, as text"""
    total_current_a: float
    residual: float | None
    """excess of the two x currents over those of a point, part of the total; positive: elongated along x"""
    residual_std: float | None
    begin_threshold_n: float
    end_threshold_n: float
    calibration_id: str
    end_reason: str
    """released, stale, lost, faulted, off, restarted or stopped; empty before the end"""
    retained: bool
    """the current state for a late subscriber, with the latest seq of the topic"""
    group: int = 0
    """the same for contacts that one object may bridge; 0: no scene requests palm or base"""
    palm_status: str = FrameStatus.NOT_COMPUTED.text
    """FrameStatus of the three that follow, as text"""
    palm_position_m: Vector3 | None = None
    palm_normal: Vector3 | None = None
    palm_covariance_m2: Matrix3 | None = None
    base_status: str = FrameStatus.NOT_COMPUTED.text
    """FrameStatus of the three that follow, as text"""
    base_position_m: Vector3 | None = None
    base_normal: Vector3 | None = None
    base_covariance_m2: Matrix3 | None = None
    joints_age_s: float | None = None
    """from the sample to the nearest joint state, of the joint with the oldest one"""
    uncompensated_force_n: float | None = None
    """without compensation of the sheet's behaviour; None where that isn't modelled"""
    diagnoses: tuple[str, ...] = ()
    """kinds of the diagnoses (see `Health`) that make position or force unreliable or invalid"""


@dataclass(frozen=True, slots=True)
class HandFrame:
    """`hand/<hand>`: the whole hand as columns, one message per tick; one row per link.

    Optional columns are empty where no scene requests them. Float columns are NaN where unknown.
    """

    v: int
    session: int
    seq: int
    t_ns: int
    tick: int
    hand: str
    links: tuple[str, ...]
    state: Annotated[bytes, Column("<u1", codes=PadState)]
    contact_id: Annotated[bytes, Column("<u4")]
    """0 for none"""
    sample_ns: Annotated[bytes, Column("<i8")]
    """sample time of each pad, 0 before the first"""
    total_current_a: Annotated[bytes, Column("<f4")]
    position_m: Annotated[bytes, Column("<f4", 3)]
    """in the link frame; this and the following are NaN without contact"""
    normal: Annotated[bytes, Column("<f4", 3)]
    covariance_m2: Annotated[bytes, Column("<f4", 9)]
    """of position_m, row by row"""
    pad_m: Annotated[bytes, Column("<f4", 2)]
    """arc lengths on the pad"""
    position_status: Annotated[bytes, Column("<u1", codes=PositionStatus)]
    force_n: Annotated[bytes, Column("<f4")]
    force_std_n: Annotated[bytes, Column("<f4")]
    """NaN where force_n is a lower bound or NaN"""
    force_status: Annotated[bytes, Column("<u1", codes=ForceStatus)]
    residual: Annotated[bytes, Column("<f4")]
    residual_std: Annotated[bytes, Column("<f4")]
    retained: bool
    group: Annotated[bytes, Column("<u4")] = b""
    """0 for none; this and the following are optional, as in `Contact`"""
    palm_status: Annotated[bytes, Column("<u1", codes=FrameStatus)] = b""
    palm_position_m: Annotated[bytes, Column("<f4", 3)] = b""
    palm_normal: Annotated[bytes, Column("<f4", 3)] = b""
    palm_covariance_m2: Annotated[bytes, Column("<f4", 9)] = b""
    base_status: Annotated[bytes, Column("<u1", codes=FrameStatus)] = b""
    base_position_m: Annotated[bytes, Column("<f4", 3)] = b""
    base_normal: Annotated[bytes, Column("<f4", 3)] = b""
    base_covariance_m2: Annotated[bytes, Column("<f4", 9)] = b""
    joints_age_s: Annotated[bytes, Column("<f4")] = b""


@dataclass(frozen=True, slots=True)
class Percept:
    """`percept/<hand>/<kind>`: an estimate from contacts (motion, stiffness, ...), or an action request."""

    v: int
    session: int
    seq: int
    t_ns: int
    hand: str
    kind: str
    """motion, stiffness, shape, texture or action_request"""
    link: str
    """link of its contact; empty: the whole hand"""
    contact_id: int
    """0 for none"""
    state: str
    """undetermined (reason says what is missing), estimated or invalid; action request: open"""
    label: str
    """the most probable class; action request: the action; empty where there are no classes"""
    confidence: float | None
    """probability of the label"""
    probabilities: dict[str, Any]
    """class -> probability; action request: the hypotheses that it would separate"""
    values: dict[str, Any]
    """by name with its unit; action request: parameters of the action"""
    evidence: dict[str, Any]
    """counts of what it is based on"""
    reason: str
    """what is missing, or why the action is requested, as text"""
    retained: bool
    question: str = ""
    """this and the next of an action request only: the question that the action would answer"""
    expires_ns: int = 0
    """the request is void from then on"""
