"""The wire contract: topics, their payloads, and the codec of two-part messages [topic, msgpack map].

Import all names from here, but those of inputs from `handtouch.wire.inputs`. Payloads about contacts:
`Contact`, `HandFrame`, `Percept`; about pads, joints and the daemon: `Health`, `JointPositions`, `Service`;
for recorders: `Raw`, `TickInputs`, `StateSnapshot`, `Config`; for the percept process: `PerceptInput`.

docs/wire.md describes every field for readers in other languages. SI units; `t_ns` is of the host's monotonic
clock; an unknown number is nil, never NaN. Optional fields are left out where they have their default.
"""

from handtouch.wire.codec import (
    SCHEMA_VERSION,
    SequenceTracker,
    UnknownTopicError,
    WireError,
    decode,
    encode,
    from_datagram,
    from_map,
    to_datagram,
    to_map,
)
from handtouch.wire.columns import Column
from handtouch.wire.contact import (
    EXPERIMENTAL_PERCEPTS,
    MAX_POSES,
    PERCEPT_KINDS,
    Contact,
    ContactEvent,
    ContactPart,
    EndReason,
    Matrix3,
    ObjectPose,
    Percept,
    PerceptKind,
    Vector3,
)
from handtouch.wire.hand_frame import HandFrame
from handtouch.wire.health import (
    AdaptationStatusName,
    Health,
    JointPositions,
    NodeStateName,
    SecondSheetStatusName,
    ShearStatusName,
)
from handtouch.wire.percept_input import PerceptInput
from handtouch.wire.recording import Config, Raw, StateSnapshot, TickInputs
from handtouch.wire.service import Service
from handtouch.wire.status import (
    ContactRadiusStatus,
    ForceStatus,
    FrameStatus,
    PadState,
    PadStateName,
    PositionStatus,
    StatusCode,
)
from handtouch.wire.topics import (
    COLUMNS,
    HEALTH,
    INTERNAL_TOPICS,
    JOINTS,
    SERVICE,
    TOPICS,
    EncodedMessage,
    Message,
    OutgoingMessage,
    Topic,
    topic_of,
    topics_of,
)

__all__ = [
    "COLUMNS",
    "EXPERIMENTAL_PERCEPTS",
    "HEALTH",
    "INTERNAL_TOPICS",
    "JOINTS",
    "MAX_POSES",
    "PERCEPT_KINDS",
    "SCHEMA_VERSION",
    "SERVICE",
    "TOPICS",
    "AdaptationStatusName",
    "Column",
    "Config",
    "Contact",
    "ContactEvent",
    "ContactPart",
    "ContactRadiusStatus",
    "EncodedMessage",
    "EndReason",
    "ForceStatus",
    "FrameStatus",
    "HandFrame",
    "Health",
    "JointPositions",
    "Matrix3",
    "Message",
    "NodeStateName",
    "ObjectPose",
    "OutgoingMessage",
    "PadState",
    "PadStateName",
    "Percept",
    "PerceptInput",
    "PerceptKind",
    "PositionStatus",
    "Raw",
    "SecondSheetStatusName",
    "SequenceTracker",
    "Service",
    "ShearStatusName",
    "StateSnapshot",
    "StatusCode",
    "TickInputs",
    "Topic",
    "UnknownTopicError",
    "Vector3",
    "WireError",
    "decode",
    "encode",
    "from_datagram",
    "from_map",
    "to_datagram",
    "to_map",
    "topic_of",
    "topics_of",
]
