"""The table of topics and their payloads; encode and decode two-part messages [topic, msgpack map].

Public names: the payloads `Contact`, `HandFrame`, `Health`, `Percept`, `Raw`, `Joints`, `Service`,
`TickInputs`, `State`, `Config`; `Message`, one of these, and `Outgoing`, or one that is `Packed`; `encode`,
`decode`, `plain`, `topic_of`, `WireError`, `PadState`, `Placing`, `COLUMNS`, `INPUTS`.
`docs/wire.md` describes every field for readers in other languages. SI units; `t_ns` is the host's monotonic
clock; a number that isn't known is nil, never NaN. Fields with a default are left out of a message that has
none of them.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from enum import IntEnum
from operator import attrgetter
from typing import Any, Union

import msgpack

SCHEMA_VERSION = 1
"""When it goes up: docs/wire.md, "Versions"."""

Vector3 = tuple[float, float, float]
Floats9 = tuple[float, float, float, float, float, float, float, float, float]


class WireError(ValueError):
    """A message that doesn't keep the contract."""


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


@dataclass(frozen=True, slots=True)
class Raw:
    """`raw/<hand>`: the counts as they came, one per tick."""

    v: int
    run: int
    seq: int
    t_ns: int
    tick: int
    hand: str
    links: tuple[str, ...]
    counts: bytes
    """int64 x 4 (x0, xa, y0, yb), little-endian, one row per link"""
    sample_ns: bytes
    """int64"""
    fresh: bytes
    """uint8, 1 where the sample belongs to this tick"""
    repeat: bool


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


@dataclass(frozen=True, slots=True)
class TickInputs:
    """`tick`: all that one tick of all hands was made from; with `state` and `config` it can be made again.

    Columns are as INPUTS; their rows are the pads in the order of `config`.
    """

    v: int
    run: int
    seq: int
    t_ns: int
    """SYNC of the tick's cycle"""
    tick: int
    previous_ns: int
    """SYNC of the cycle before"""
    now_ns: int
    """when the tick was"""
    until_ns: int | None
    """samples that arrived from then on are of the next cycle"""
    stopped: bool
    """no tick, but the end of all contacts: the daemon stopped"""
    counts: bytes
    arrived_ns: bytes
    fresh: bytes
    node_state: bytes
    """uint8, PadState.CLEAR where the node is up, else what its pad is instead"""
    synchronous: bytes
    period_ns: bytes
    paced_ns: bytes
    limits: bytes | None
    """int64 x 8, counts at the bottom and at the top of the four channels, when they have changed"""
    others: dict[str, Any]
    """inputs of other kinds, by name"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class State:
    """`state`: all that is kept from tick to tick, as it was after the tick `tick`."""

    v: int
    run: int
    seq: int
    t_ns: int
    tick: int
    state: bytes
    """msgpack map: path of each value inside the pipeline -> value; of the same build only"""
    limits: bytes
    """as of `tick`"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class Config:
    """`config`: the deployment that the daemon serves, and the build that serves it."""

    v: int
    run: int
    seq: int
    t_ns: int
    deployment: str
    """as JSON, with the keys of the deployment file"""
    files: dict[str, Any]
    """path of each file that it names -> its bytes"""
    build: dict[str, Any]
    """versions of what computes, and the processor"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class Packed:
    """A message whose payload is encoded already; `decode(encode(it))` tells what it is."""

    topic: str
    payload: bytes


Message = Contact | HandFrame | Health | Percept | Raw | Joints | Service | TickInputs | State | Config
Outgoing = Message | Packed

_F4 = ("<f4", 1)
COLUMNS: dict[type[Any], dict[str, tuple[str, int]]] = {
    HandFrame: {
        "state": ("<u1", 1),
        "contact": ("<u4", 1),
        "sample_ns": ("<i8", 1),
        "current_a": _F4,
        "position_m": ("<f4", 3),
        "normal": ("<f4", 3),
        "covariance_m2": ("<f4", 9),
        "pad_m": ("<f4", 2),
        "force_n": _F4,
        "force_std_n": _F4,
        "saturated": ("<u1", 1),
        "residual": _F4,
        "residual_std": _F4,
        "group": ("<u4", 1),
        "palm": ("<u1", 1),
        "palm_position_m": ("<f4", 3),
        "palm_normal": ("<f4", 3),
        "palm_covariance_m2": ("<f4", 9),
        "base": ("<u1", 1),
        "base_position_m": ("<f4", 3),
        "base_normal": ("<f4", 3),
        "base_covariance_m2": ("<f4", 9),
        "joints_age_s": _F4,
        "unestimated": ("<u1", 1),
        "doubtful": ("<u1", 1),
    },
    Raw: {"counts": ("<i8", 4), "sample_ns": ("<i8", 1), "fresh": ("<u1", 1)},
}
"""Payload -> column -> (type of its elements: order, kind, bytes; elements per row)."""

INPUTS = {
    "counts": ("<i8", 4),
    "arrived_ns": ("<i8", 1),
    "fresh": ("<u1", 1),
    "node_state": ("<u1", 1),
    "synchronous": ("<u1", 1),
    "period_ns": ("<i8", 1),
    "paced_ns": ("<i8", 1),
}
"""Columns of `TickInputs`, as in COLUMNS."""


@dataclass(frozen=True)
class Topic:
    """A row of the table: how a topic starts, how many parts follow, what it carries."""

    prefix: str
    parts: int
    payload: type[Any]
    rate: str


TOPICS = (
    Topic("contact", 2, Contact, "at each tick while touched, and at begin and end"),
    Topic("hand", 1, HandFrame, "one per tick"),
    Topic("health", 2, Health, "at every change, and once a second"),
    Topic("percept", 2, Percept, "at every change, and while there is something to tell"),
    Topic("raw", 1, Raw, "one per tick"),
    Topic("joints", 1, Joints, "thirty a second, where the hand has a URDF"),
    Topic("service", 0, Service, "twice a second"),
    Topic("tick", 0, TickInputs, "one per tick"),
    Topic("state", 0, State, "to who subscribes, and when something other than a tick changes it"),
    Topic("config", 0, Config, "to who subscribes, and when it is read again"),
)
_ALONE: dict[type[Any], str] = {topic.payload: topic.prefix for topic in TOPICS if not topic.parts}
_BY_PREFIX = {topic.prefix: topic for topic in TOPICS}
_DEFAULTS = {
    topic.payload: {f.name: f.default for f in fields(topic.payload) if f.default is not MISSING}
    for topic in TOPICS
}
_FIELDS = {
    kind: (names := [f.name for f in fields(kind) if f.name not in defaults], attrgetter(*names))
    for kind, defaults in _DEFAULTS.items()
}


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Of several attributes, or of one: `attrgetter` makes a tuple of several only."""
    get = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


_OPTIONAL = {
    kind: (names := list(defaults), _getter(names), tuple(defaults.values()))
    for kind, defaults in _DEFAULTS.items()
    if defaults
}
_PACKER = msgpack.Packer()


def topic_of(message: Outgoing) -> str:
    """Topic that a message belongs to."""
    if isinstance(message, Packed):
        return message.topic
    if isinstance(message, Contact):
        return f"contact/{message.hand}/{message.link}"
    if isinstance(message, Health):
        return f"health/{message.hand}/{message.link}"
    if isinstance(message, HandFrame):
        return f"hand/{message.hand}"
    if isinstance(message, Percept):
        return f"percept/{message.hand}/{message.kind}"
    if isinstance(message, Joints):
        return f"joints/{message.hand}"
    return f"raw/{message.hand}" if isinstance(message, Raw) else _ALONE[type(message)]


def encode(message: Outgoing) -> list[bytes]:
    """The two parts of a message, ready for a ZeroMQ multipart send."""
    if isinstance(message, Packed):
        return [message.topic.encode(), message.payload]
    return [topic_of(message).encode(), _PACKER.pack(plain(message))]


def plain(message: Outgoing) -> dict[str, Any]:
    """The map that a message is sent as."""
    if isinstance(message, Packed):
        return dict(msgpack.unpackb(message.payload))
    kind = type(message)
    names, values = _FIELDS[kind]
    told = dict(zip(names, values(message), strict=True))
    if kind in _OPTIONAL:
        names, get, defaults = _OPTIONAL[kind]
        if (optional := get(message)) != defaults:
            pairs = zip(names, optional, defaults, strict=True)
            told.update((name, value) for name, value, default in pairs if value != default)
    return told


def decode(parts: typing.Sequence[bytes]) -> Message:
    """The message in the two parts of a ZeroMQ message; unknown keys of the map are ignored.

    Raises WireError naming what is wrong with a malformed message, whatever its bytes.
    """
    if len(parts) != 2:
        raise WireError(f"{len(parts)} parts instead of [topic, payload]")
    name = parts[0].decode("utf-8", "replace")
    prefix, *rest = name.split("/")
    row = _BY_PREFIX.get(prefix)
    if row is None or len(rest) != row.parts:
        raise WireError(f"unknown topic {name[:80]!r}")
    try:
        payload = msgpack.unpackb(parts[1])
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"{name}: payload isn't msgpack: {error}") from error
    if not isinstance(payload, dict):
        raise WireError(f"{name}: payload isn't a map")
    if payload.get("v") != SCHEMA_VERSION:
        raise WireError(f"{name}: schema version {payload.get('v')!r}, this reader knows {SCHEMA_VERSION}")
    message = row.payload(**_checked(name, payload, row.payload))
    for column, (kind, elements) in COLUMNS.get(row.payload, {}).items():
        size = len(getattr(message, column))
        if size == 0 and column in _DEFAULTS[row.payload]:
            continue
        if size != len(message.links) * elements * int(kind[-1]):
            raise WireError(f"{name}: {column} doesn't have one row of {elements} {kind} per link")
    if topic_of(message) != name:
        raise WireError(f"{name}: payload belongs to {topic_of(message)}")
    return typing.cast(Message, message)


def _checked(topic: str, payload: dict[Any, Any], kind: type[Any]) -> dict[str, Any]:
    values = {}
    for name, check in _CHECKS[kind]:
        if name not in payload:
            if name in _DEFAULTS[kind]:
                continue
            raise WireError(f"{topic}: {name} is missing")
        try:
            values[name] = check(payload[name])
        except (TypeError, ValueError):
            given = type(payload[name]).__name__  # not the value: it may be nested too deeply to be told
            raise WireError(f"{topic}: {name} can't be this {given}") from None
    return values


def _check(kind: Any) -> Callable[[Any], Any]:
    """A function that returns a value of the annotated type or raises TypeError."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        inner = next(_check(argument) for argument in arguments if argument is not type(None))
        return lambda value: None if value is None else inner(value)
    if origin is tuple:
        item = _check(arguments[0])
        length = None if arguments[-1] is Ellipsis else len(arguments)
        return lambda value: _tuple(value, item, length)
    accepted = {float: (float, int)}.get(kind, (origin or kind,))
    return lambda value: _scalar(value, accepted, kind is bool)


def _tuple(value: Any, item: Callable[[Any], Any], length: int | None) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or (length is not None and len(value) != length):
        raise TypeError
    return tuple(item(element) for element in value)


def _scalar(value: Any, accepted: tuple[type, ...], boolean: bool) -> Any:
    if not isinstance(value, accepted) or (isinstance(value, bool) and not boolean):
        raise TypeError
    if accepted[0] is not float:
        return value
    number = float(typing.cast(float, value))
    if not math.isfinite(number):
        raise ValueError
    return number


_CHECKS = {
    payload: tuple((name, _check(hint)) for name, hint in typing.get_type_hints(payload).items())
    for payload in _FIELDS
}
