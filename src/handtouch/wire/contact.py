"""Payloads about contacts: `Contact`, `Percept`, and what `HandFrame` has beside the fields of `Contact`.

Encoder, hand frames, clients, ROS messages, pages and schema follow from these declarations: `make tables`.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from handtouch.wire.columns import Column, HandColumn
from handtouch.wire.declarations import CLOSED
from handtouch.wire.status import (
    ContactRadiusStatus,
    ContactRadiusStatusName,
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
List3 = Annotated[list[float], Vector3]
List9 = Annotated[list[float], Matrix3]
List4 = Annotated[list[float], tuple[float, float, float, float]]
Matrix6 = tuple[
    float, float, float, float, float, float,
    float, float, float, float, float, float,
    float, float, float, float, float, float,
    float, float, float, float, float, float,
    float, float, float, float, float, float,
    float, float, float, float, float, float
]  # fmt: skip
List36 = Annotated[list[float], Matrix6]
"""Lists of so many numbers, in a map inside of a payload"""
EndReason = Literal["released", "stale", "lost", "faulted", "off", "restarted", "stopped", ""]
ContactEvent = Literal["begin", "update", "end"]

PerceptKind = Literal["motion", "shape", "friction", "object", "stiffness", "action_request"]
Output = Literal[
    "position", "force", "raw", "palm", "base", "motion", "shape", "friction", "object", "stiffness"
]
"""What a scene may request of a contact"""
PERCEPT_KINDS = ("motion", "shape", "friction", "object", "stiffness")
"""Kinds of percepts, each a topic `percept/<hand>/<kind>`."""
ACTION_REQUEST = "action_request"
"""Kind of percept that requests an action of the robot"""
EXPERIMENTAL_PERCEPTS = frozenset({"shape", "object", "stiffness", ACTION_REQUEST})
"""Kinds of percepts of which too little is known in the world `default` to rely on them."""
MAX_POSES = 8
"""Most hypotheses in `poses`"""


class ContactPart(TypedDict):
    """One of two contacts on a pad at once, in `parts`."""

    position_m: List3
    """contact position in the link's frame"""
    normal: List3
    """outward unit normal of the pad at the position"""
    covariance_m2: List9
    """covariance of `position_m`, row by row; includes that of the mount"""
    force_n: float | None
    """normal force by the contact law, without compensation of the sheet's behaviour; nil if the scene
    requests no forces, or there is only a lower bound"""
    force_std_n: float | None
    """standard deviation of `force_n`"""
    palm_position_m: NotRequired[List3]
    """in the palm's frame; this and the two that follow are absent unless the contact's `palm_status` is
    `valid`"""
    palm_normal: NotRequired[List3]
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: NotRequired[List9]
    """covariance of `palm_position_m`, row by row; includes the stated uncertainty of mounts and joints"""
    base_position_m: NotRequired[List3]
    """in the base's frame; absent, with the two that follow, unless `base_status` is `valid`"""
    base_normal: NotRequired[List3]
    """outward unit normal, in the base's frame"""
    base_covariance_m2: NotRequired[List9]
    """covariance of `base_position_m`, row by row"""
    id: NotRequired[int]
    """of this one among all that the pad has had: the same while it is followed by nearness, also through
    samples in which the currents show one contact only. Both keep their order, too"""


class ObjectPose(TypedDict):
    """One hypothesis about the pose of a known object, in `poses`: orientations as quaternions x, y, z, w,
    covariances (6 x 6), row by row, of position [m] and rotation vector [rad] in the named frame."""

    weight: float
    """probability of this hypothesis"""
    palm_position_m: List3
    """origin of the object's frame, in the palm's frame"""
    palm_quaternion: List4
    """orientation in the palm's frame"""
    palm_covariance: List36
    """covariance of both"""
    base_position_m: NotRequired[List3]
    """in the base's frame; absent, with the two that follow, while the palm's pose in it is unknown"""
    base_quaternion: NotRequired[List4]
    """orientation in the base's frame"""
    base_covariance: NotRequired[List36]
    """covariance of both"""


@dataclass(frozen=True, slots=True)
class Contact:
    """`contact/<hand>/<link>`: begin, update or end of one contact.

    Numbers are those of the same name in a pad's row of values, or in the state of the core. A new field is
    the last, and has a default.
    """

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
    position_m: Annotated[
        Vector3 | None, HandColumn("in the link's frame; this and the following are NaN without contact")
    ]
    """contact position in the link's frame"""
    normal: Annotated[Vector3 | None, HandColumn("outward unit normal of the pad at the position")]
    """outward unit normal of the pad at the position"""
    covariance_m2: Annotated[
        Matrix3 | None, HandColumn("covariance of `position_m`, row by row, with that of the mount")
    ]
    """covariance of `position_m`, row by row; includes the stated uncertainty of the mount, without which it
    is singular along the normal; larger than from noise alone where `residual` indicates that the contact is
    no point, or that gains are wrong"""
    pad_m: Annotated[
        tuple[float, float] | None, HandColumn("arc lengths on the pad, from the electrodes x0 and y0")
    ]
    """arc lengths on the pad, from the electrodes x0 and y0"""
    position_status: Annotated[PositionStatusName, PositionStatus, HandColumn("status of the position")]
    """status of the position"""
    force_n: Annotated[float | None, HandColumn("normal force")]
    """normal force, for a single contact patch of the radius configured in the deployment; a lower bound
    where `force_status` is `lower_bound`"""
    force_std_n: Annotated[
        float | None, HandColumn("its standard deviation; NaN where `force_n` is a lower bound")
    ]
    """standard deviation of `force_n`; nil unless `force_status` is `valid` or `unreliable`"""
    peak_force_n: float | None
    """maximum force since the contact began, or since the pad's calibration changed"""
    force_status: Annotated[ForceStatusName, ForceStatus, HandColumn("status of the force")]
    """status of the force"""
    total_current_a: float
    """total current of the pad"""
    residual: Annotated[float | None, HandColumn()]
    """excess of the two x currents over those of a point contact there, as a fraction of the total; positive:
    elongated along x; nil of pads with other electrodes than x0, xa, y0, yb"""
    residual_std: Annotated[float | None, HandColumn()]
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
    group: Annotated[int, HandColumn("as in `contact`, 0 without contact")] = 0
    """the same for contacts on one hand that are so close that one object may bridge them; the id of one of
    its contacts, constant while any of them lasts"""
    palm_status: Annotated[FrameStatusName, FrameStatus, HandColumn("status in the palm's frame")] = (
        FrameStatus.NOT_COMPUTED.text
    )
    """status of the three that follow"""
    palm_position_m: Annotated[Vector3 | None, HandColumn("in the palm's frame")] = None
    """in the palm's frame, with the joint positions at the sample; nil unless `palm_status` is `valid`"""
    palm_normal: Annotated[Vector3 | None, HandColumn("outward unit normal, in the palm's frame")] = None
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: Annotated[
        Matrix3 | None, HandColumn("covariance of `palm_position_m`, row by row")
    ] = None
    """covariance of `palm_position_m`, row by row; includes the stated uncertainty of mounts and joints"""
    base_status: Annotated[FrameStatusName, FrameStatus, HandColumn("status in the base's frame")] = (
        FrameStatus.NOT_COMPUTED.text
    )
    """status of the three that follow"""
    base_position_m: Annotated[Vector3 | None, HandColumn("in the base's frame")] = None
    """in the base's frame"""
    base_normal: Annotated[Vector3 | None, HandColumn("outward unit normal, in the base's frame")] = None
    """outward unit normal, in the base's frame"""
    base_covariance_m2: Annotated[
        Matrix3 | None, HandColumn("covariance of `base_position_m`, row by row")
    ] = None
    """covariance of `base_position_m`, row by row"""
    joints_age_s: Annotated[float | None, HandColumn()] = None
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
    force_vector_status: Annotated[
        ForceStatusName,
        ForceStatus,
        HandColumn("as in `contact`; this and the following are empty for a hand without shear pads"),
    ] = ForceStatus.NOT_COMPUTED.text
    """status of the force vector: `not_computed` of a pad without a shear pad; `lower_bound` and `unreliable`
    as `force_status`, `unreliable` also where `position_status` is, as with several contacts; `invalid` while
    the rest position of the shear pad isn't known, or if its currents are those of no displacement"""
    force_vector_n: Annotated[
        Vector3 | None, HandColumn("force of the object on the pad, in the link's frame")
    ] = None
    """force of the object on the pad, in the link's frame: tangential by the shear pad, normal `force_n`"""
    force_vector_covariance_n2: Annotated[
        Matrix3 | None, HandColumn("its covariance, row by row; NaN where the status is LOWER_BOUND")
    ] = None
    """its covariance, row by row, with that of the mount's angle; nil where the status is `lower_bound`"""
    palm_force_vector_n: Annotated[Vector3 | None, HandColumn("the force in the palm's frame")] = None
    """the force in the palm's frame; nil unless `palm_status` is `valid`"""
    base_force_vector_n: Annotated[Vector3 | None, HandColumn("the force in the base's frame")] = None
    """the force in the base's frame"""
    parts: tuple[ContactPart, ...] = ()
    """two contacts, each in the place of the one before that was nearest, where the currents of a pad of
    six or more electrodes support two, not one, at the sheet's `pair_false_alarm`; then `position_m` and
    `force_n` are those of one contact that replaces both, and `position_status` isn't `valid`; absent
    otherwise"""
    mount_covariance_m2: Annotated[Matrix3 | None, HandColumn()] = None
    """part of `covariance_m2` by the pad's mount on its link, row by row: the same error in all contacts of
    the pad, so that the difference of two positions has the rest"""
    contact_radius_status: Annotated[
        ContactRadiusStatusName, ContactRadiusStatus, HandColumn("status of the contact's radius")
    ] = ContactRadiusStatus.NOT_COMPUTED.text
    """status of the two that follow"""
    contact_radius_m: Annotated[float | None, HandColumn("radius of the contact")] = None
    """radius of the contact, of a disc as large: estimated with the force on a pad with two sheets, else that
    which `force_n` is for"""
    contact_radius_std_m: Annotated[float | None, HandColumn("its standard deviation")] = None
    """standard deviation of `contact_radius_m`"""
    length_m: Annotated[
        float | None, HandColumn("length of the line that is as elongated; NaN where nothing is known of it")
    ] = None
    """length of the line that is as elongated: 0 of a round contact, of a rectangle the root of the
    difference of its sides' squares. On a pad of four electrodes that of the shortest line that explains the
    currents, along `length_axis`; this and the four that follow are absent where they aren't known, as with
    `parts`"""
    min_length_m: Annotated[float | None, HandColumn("lower end of its interval of 95 %")] = None
    """lower end of the interval of 95 % of `length_m`"""
    max_length_m: Annotated[float | None, HandColumn("upper end of its interval of 95 %")] = None
    """upper end of that interval; absent on a pad of four electrodes, which show one combination of length
    and direction"""
    length_axis: Annotated[Vector3 | None, HandColumn("unit vector along it, in the link's frame")] = None
    """unit vector along the contact, of either sign, in the link's frame; absent if the currents are those of
    a round one"""
    length_axis_std_rad: Annotated[float | None, HandColumn("standard deviation of its direction")] = None
    """standard deviation of its direction in the pad's plane; 0.45 on a pad of four electrodes: within 45
    degrees"""


@dataclass(frozen=True, slots=True)
class HandFrameHead:
    """First fields of `HandFrame`; the fields of `Contact` with a `HandColumn` follow."""

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
    poses: tuple[ObjectPose, ...] = ()
    """of an `object` only: hypotheses about its pose, the likeliest first; also while `undetermined`"""
