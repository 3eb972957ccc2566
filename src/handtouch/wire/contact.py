"""Payloads about contacts: `Contact`, `HandFrame`, `Percept`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from handtouch.wire.columns import Column
from handtouch.wire.declarations import CLOSED
from handtouch.wire.status import (
    ForceStatus,
    ForceStatusName,
    FrameStatus,
    FrameStatusName,
    PadState,
    PositionStatus,
    PositionStatusName,
)

Vector3 = tuple[float, float, float]
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
EndReason = Literal["released", "stale", "lost", "faulted", "off", "restarted", "stopped", ""]
ContactEvent = Literal["begin", "update", "end"]

PerceptKind = Literal["motion", "shape", "friction", "action_request"]
PERCEPT_KINDS = ("motion", "shape", "friction")
"""Kinds of percepts, each a topic `percept/<hand>/<kind>`."""
ACTION_REQUEST = "action_request"
"""Kind of percept that requests an action of the robot"""
EXPERIMENTAL_PERCEPTS = frozenset({"shape", ACTION_REQUEST})
"""Kinds of percepts of which too little is known in the world `default` to rely on them."""


@dataclass(frozen=True, slots=True)
class ContactPart:
    """One of two contacts on a pad at once."""

    position_m: Vector3
    """contact position in the link's frame"""
    normal: Vector3
    """outward unit normal of the pad at the position"""
    covariance_m2: Matrix3
    """covariance of `position_m`, row by row; includes that of the mount"""
    force_n: float | None
    """normal force by the contact law, without compensation of the sheet's behaviour; nil if the scene
    requests no forces, or there is only a lower bound"""
    force_std_n: float | None
    """standard deviation of `force_n`"""
    palm_position_m: Vector3 | None = None
    """in the palm's frame; this and the two that follow are absent unless the contact's `palm_status` is
    `valid`"""
    palm_normal: Vector3 | None = None
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: Matrix3 | None = None
    """covariance of `palm_position_m`, row by row; includes the stated uncertainty of mounts and joints"""
    base_position_m: Vector3 | None = None
    """in the base's frame; absent, with the two that follow, unless `base_status` is `valid`"""
    base_normal: Vector3 | None = None
    """outward unit normal, in the base's frame"""
    base_covariance_m2: Matrix3 | None = None
    """covariance of `base_position_m`, row by row"""
    id: int = 0
    """of this one among all that the pad has had: the same while it is followed by nearness, also through
    samples in which the currents show one contact only. Both keep their order, too"""


@dataclass(frozen=True, slots=True)
class Contact:
    """`contact/<hand>/<link>`: begin, update or end of one contact."""

    v: int
    session: int
    seq: int
    t_ns: int
    """the sample; in `end` the SYNC of the tick in which the contact ended"""
    event: Annotated[ContactEvent, CLOSED]
    """`begin`, `update` or `end`"""
    id: int
    """constant from begin to end; unique in the `session`"""
    hand: str
    """name of the hand"""
    link: str
    """link that carries the pad"""
    frame: str
    """frame of `position_m`, `normal` and `covariance_m2`: the link's name"""
    begin_ns: int
    """first sample above the upper threshold; `begin` is published some samples later, and describes the
    sample at its own `t_ns`"""
    duration_s: float
    """from `begin_ns` to `t_ns`"""
    age_s: float
    """age of the newest sample at publication"""
    position_m: Vector3 | None
    """contact position in the link's frame"""
    normal: Vector3 | None
    """outward unit normal of the pad at the position"""
    covariance_m2: Matrix3 | None
    """covariance of `position_m`, row by row; includes the stated uncertainty of the mount, without which it
    is singular along the normal; larger than from noise alone where `residual` indicates that the contact is
    no point, or that gains are wrong"""
    pad_m: tuple[float, float] | None
    """arc lengths on the pad, from the electrodes x0 and y0"""
    position_status: Annotated[PositionStatusName, PositionStatus]
    """status of the position"""
    force_n: float | None
    """normal force, for a single contact patch of the radius configured in the deployment; a lower bound
    where `force_status` is `lower_bound`"""
    force_std_n: float | None
    """standard deviation of `force_n`; nil unless `force_status` is `valid` or `unreliable`"""
    peak_force_n: float | None
    """maximum force since the contact began, or since the pad's calibration changed"""
    force_status: Annotated[ForceStatusName, ForceStatus]
    """status of the force"""
    total_current_a: float
    """total current of the pad"""
    residual: float | None
    """excess of the two x currents over those of a point contact there, as a fraction of the total; positive:
    elongated along x; nil of pads with other electrodes than x0, xa, y0, yb"""
    residual_std: float | None
    """its standard deviation for a point contact: beyond a few of these, the contact is not a point"""
    begin_threshold_n: float
    """force above which a contact begins"""
    end_threshold_n: float
    """force below which it ends"""
    calibration_id: str
    """the calibration by which currents were converted to newtons"""
    end_reason: EndReason
    """`released`; `stale`, `lost`, `faulted` or `off` as its pad; `restarted` (the node), `stopped` (the
    daemon); empty before the end"""
    retained: bool
    group: int = 0
    """the same for contacts on one hand that are so close that one object may bridge them; the id of one of
    its contacts, constant while any of them lasts"""
    palm_status: Annotated[FrameStatusName, FrameStatus] = FrameStatus.NOT_COMPUTED.text
    """status of the three that follow"""
    palm_position_m: Vector3 | None = None
    """in the palm's frame, with the joint positions at the sample; nil unless `palm_status` is `valid`"""
    palm_normal: Vector3 | None = None
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: Matrix3 | None = None
    """covariance of `palm_position_m`, row by row; includes the stated uncertainty of mounts and joints"""
    base_status: Annotated[FrameStatusName, FrameStatus] = FrameStatus.NOT_COMPUTED.text
    """status of the three that follow"""
    base_position_m: Vector3 | None = None
    """in the base's frame"""
    base_normal: Vector3 | None = None
    """outward unit normal, in the base's frame"""
    base_covariance_m2: Matrix3 | None = None
    """covariance of `base_position_m`, row by row"""
    joints_age_s: float | None = None
    """time from the sample to the nearest joint state, of the joint in between with the oldest one"""
    uncompensated_force_n: float | None = None
    """force by the contact law alone, without compensation of the sheet's behaviour; nil where none is
    configured"""
    diagnoses: tuple[str, ...] = ()
    """kinds of the `diagnoses` in `health` that make position or force unreliable or invalid; absent if there
    are none"""
    fresh: bool = True
    """false while samples of the pad are missing: the contact continues with the values of its last sample,
    at `t_ns`; absent where true"""
    force_vector_status: Annotated[ForceStatusName, ForceStatus] = ForceStatus.NOT_COMPUTED.text
    """status of the force vector: `not_computed` of a pad without a shear pad; `lower_bound` and `unreliable`
    as `force_status`, `unreliable` also where `position_status` is, as with several contacts; `invalid` while
    the rest position of the shear pad isn't known, or if its currents are those of no displacement"""
    force_vector_n: Vector3 | None = None
    """force of the object on the pad, in the link's frame: tangential by the shear pad, normal `force_n`"""
    force_vector_covariance_n2: Matrix3 | None = None
    """its covariance, row by row; nil where the status is `lower_bound`"""
    palm_force_vector_n: Vector3 | None = None
    """the force in the palm's frame; nil unless `palm_status` is `valid`"""
    base_force_vector_n: Vector3 | None = None
    """the force in the base's frame"""
    parts: Annotated[tuple[dict[str, Any], ...], tuple[ContactPart, ...]] = ()
    """two contacts, each in the place of the one before that was nearest, where the currents of a pad of
    six or more electrodes support two, not one, at the sheet's `pair_false_alarm`; then `position_m` and
    `force_n` are those of one contact that replaces both, and `position_status` isn't `valid`; absent
    otherwise"""
    mount_covariance_m2: Matrix3 | None = None
    """part of `covariance_m2` by the pad's mount on its link, row by row: the same error in all contacts of
    the pad, so that the difference of two positions has the rest"""


@dataclass(frozen=True, slots=True)
class HandFrame:
    """`hand/<hand>`: the whole hand as columns, one message per tick; one row per link.

    Optional columns are empty where no scene requests them. Float columns are NaN where unknown.
    """

    v: int
    session: int
    seq: int
    t_ns: int
    """the tick's SYNC; `sample_ns` has the samples"""
    tick: int
    """number of the tick"""
    hand: str
    """name of the hand"""
    links: tuple[str, ...]
    """row names of all columns"""
    state: Annotated[bytes, Column("<u1", codes=PadState)]
    """state of the pad"""
    contact_id: Annotated[bytes, Column("<u4")]
    """id of the contact, 0 for none"""
    sample_ns: Annotated[bytes, Column("<i8")]
    """time of the row's sample, 0 before the first; its age is `t_ns` minus this"""
    total_current_a: Annotated[bytes, Column("<f4")]
    """total current of the newest sample"""
    position_m: Annotated[bytes, Column("<f4", 3)]
    """in the link's frame; this and the following are NaN without contact"""
    normal: Annotated[bytes, Column("<f4", 3)]
    """outward unit normal of the pad at the position"""
    covariance_m2: Annotated[bytes, Column("<f4", 9)]
    """covariance of `position_m`, row by row, with that of the mount"""
    pad_m: Annotated[bytes, Column("<f4", 2)]
    """arc lengths on the pad, from the electrodes x0 and y0"""
    position_status: Annotated[bytes, Column("<u1", codes=PositionStatus)]
    """status of the position"""
    force_n: Annotated[bytes, Column("<f4")]
    """normal force"""
    force_std_n: Annotated[bytes, Column("<f4")]
    """its standard deviation; NaN where `force_n` is a lower bound"""
    force_status: Annotated[bytes, Column("<u1", codes=ForceStatus)]
    """status of the force"""
    residual: Annotated[bytes, Column("<f4")]
    """as in `contact`"""
    residual_std: Annotated[bytes, Column("<f4")]
    """as in `contact`"""
    retained: bool
    group: Annotated[bytes, Column("<u4")] = b""
    """as in `contact`, 0 without contact"""
    palm_status: Annotated[bytes, Column("<u1", codes=FrameStatus)] = b""
    """status in the palm's frame"""
    palm_position_m: Annotated[bytes, Column("<f4", 3)] = b""
    """in the palm's frame"""
    palm_normal: Annotated[bytes, Column("<f4", 3)] = b""
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: Annotated[bytes, Column("<f4", 9)] = b""
    """covariance of `palm_position_m`, row by row"""
    base_status: Annotated[bytes, Column("<u1", codes=FrameStatus)] = b""
    """status in the base's frame"""
    base_position_m: Annotated[bytes, Column("<f4", 3)] = b""
    """in the base's frame"""
    base_normal: Annotated[bytes, Column("<f4", 3)] = b""
    """outward unit normal, in the base's frame"""
    base_covariance_m2: Annotated[bytes, Column("<f4", 9)] = b""
    """covariance of `base_position_m`, row by row"""
    joints_age_s: Annotated[bytes, Column("<f4")] = b""
    """as in `contact`"""
    force_vector_status: Annotated[bytes, Column("<u1", codes=ForceStatus)] = b""
    """as in `contact`; this and the following are empty for a hand without shear pads"""
    force_vector_n: Annotated[bytes, Column("<f4", 3)] = b""
    """force of the object on the pad, in the link's frame"""
    force_vector_covariance_n2: Annotated[bytes, Column("<f4", 9)] = b""
    """its covariance, row by row; NaN where the status is LOWER_BOUND"""
    palm_force_vector_n: Annotated[bytes, Column("<f4", 3)] = b""
    """the force in the palm's frame"""
    base_force_vector_n: Annotated[bytes, Column("<f4", 3)] = b""
    """the force in the base's frame"""
    mount_covariance_m2: Annotated[bytes, Column("<f4", 9)] = b""
    """as in `contact`"""


@dataclass(frozen=True, slots=True)
class Percept:
    """`percept/<hand>/<kind>`: an estimate from contacts (motion, shape, ...), or an action request."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication"""
    hand: str
    """name of the hand"""
    kind: PerceptKind
    """as in the topic"""
    link: str
    """link that carries the pad; empty: the whole hand"""
    contact_id: int
    """id of the contact, 0 for none"""
    state: Literal["undetermined", "estimated", "invalid", "open"]
    """`undetermined`: too little data yet, `reason` states what is missing; `estimated`; `invalid`; of an
    action request `open`"""
    label: str
    """the most probable class, of an action request the action; empty where there are no classes"""
    confidence: float | None
    """probability of `label`"""
    probabilities: Annotated[dict[str, Any], dict[str, float]]
    """class -> probability; of an action request: the hypotheses that it would separate"""
    values: dict[str, Any]
    """name, ending with its unit, -> float, list of floats, str or nil; of an action request: the action's
    parameters and `expected_information_bits`"""
    evidence: Annotated[dict[str, Any], dict[str, float]]
    """counts of what the estimate is based on: `samples`, `contacts`, `span_s` ..."""
    reason: str
    """what is missing; of an action request: why it is requested, as text"""
    retained: bool
    question: str = ""
    """of an action request only: the question that it would answer"""
    expires_ns: int = 0
    """of an action request only: it is void from then on"""
    experimental: bool = False
    """don't rely on it: such estimates are rare, unproven or sometimes wrong in the world `default`"""
