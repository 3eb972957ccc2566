"""The table of topics and their payloads; encode and decode two-part messages [topic, msgpack map].

Payloads are what is felt (`touch`: `Contact`, `HandFrame`, `Percept`), how all fares (`condition`: `Health`,
`Joints`, `Service`) and what it is made from (`source`: `Raw`, `TickInputs`, `State`, `Config`). `Message` is
one of these, `Outgoing` one of these or `Packed`: both are in `topics`, with the table. `encode` and `decode`
are in `codec`. Import all of them from here.
`docs/wire.md` describes every field for readers in other languages. SI units; `t_ns` is the host's monotonic
clock; a number that isn't known is nil, never NaN. Fields with a default are left out of a message that has
none of them.
"""

from handtouch.wire.codec import SCHEMA_VERSION, WireError, decode, encode, plain
from handtouch.wire.condition import Health, Joints, Service
from handtouch.wire.source import Config, Raw, State, TickInputs
from handtouch.wire.topics import COLUMNS, INPUTS, TOPICS, Message, Outgoing, Packed, Topic, topic_of
from handtouch.wire.touch import Contact, Floats9, HandFrame, PadState, Percept, Placing, Vector3

__all__ = [
    "COLUMNS",
    "INPUTS",
    "SCHEMA_VERSION",
    "TOPICS",
    "Config",
    "Contact",
    "Floats9",
    "HandFrame",
    "Health",
    "Joints",
    "Message",
    "Outgoing",
    "Packed",
    "PadState",
    "Percept",
    "Placing",
    "Raw",
    "Service",
    "State",
    "TickInputs",
    "Topic",
    "Vector3",
    "WireError",
    "decode",
    "encode",
    "plain",
    "topic_of",
]
