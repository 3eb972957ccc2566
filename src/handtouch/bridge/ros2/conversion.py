"""The daemon's messages as ROS 2 messages.

Public names: `Stamper`, `encode_contacts`, `encode_wrench`, `encode_sum`, `encode_plain_wrench`,
`object_pose`, `contact_markers`, `unknown_markers`, `removed_markers`, `pad_status`, `bus_status`,
`daemon_status`, `bridge_status`.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from cyclonedds.idl.types import float64
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.bridge.ros2 import messages as ros
from handtouch.bridge.ros2.cdr import ENCAPSULATION, Layout
from handtouch.bridge.ros2.contact_messages import ContactArray, RosContact, RosContactPart
from handtouch.wire import ContactRadiusStatus, ForceStatus, FrameStatus, PositionStatus, StatusCode
from handtouch.wire.declarations import declared_fields

_CONTACTS, _CONTACT, _WRENCH = Layout(ContactArray), Layout(RosContact), Layout(ros.WrenchStamped)
_PART = Layout(RosContactPart)
_EVENTS = {event: number for number, event in enumerate(typing.get_args(wire.ContactEvent))}
_LATER: dict[type[StatusCode], int] = {
    PositionStatus: PositionStatus.UNRELIABLE,
    ForceStatus: ForceStatus.UNRELIABLE,
    ContactRadiusStatus: ContactRadiusStatus.ASSUMED,
    FrameStatus: FrameStatus.NOT_COMPUTED,
}
"""Codes for a status that a later version added: such values may not be relied on."""

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus"""
_PAD_LEVELS = {"clear": OK, "touched": OK, "starting": WARN, "off": OK, "stale": STALE}
"""Any other state is an error"""
_BUS_LEVELS = {"active": OK, "warning": WARN, "passive": WARN}

_ARROW, _SPHERE, _DELETE = 0, 2, 2
_MARKER_NAMESPACES = ("contact", "force", "ellipse")
_POINT_SIZE_M, _SHAFT_M, _HEAD_M, _MIN_ARROW_M, _ARROW_M_PER_N = 3e-3, 1.5e-3, 3e-3, 5e-3, 1e-2
_ELLIPSE_SIGMA = math.sqrt(5.991)
"""Half axes of the ellipse that contains 95 % of a normal distribution in two dimensions"""
_MIN_AXIS_M = 1e-4
_PART_LIFETIME = 0, 200_000_000
"""Seconds and nanoseconds for which points of two contacts on one pad are shown"""
_VALID_COLOR, _UNRELIABLE_COLOR, _UNKNOWN_COLOR = (0.1, 0.8, 0.3), (0.95, 0.6, 0.1), (0.5, 0.5, 0.5)


class Stamper:
    """ROS time and frames; `wall_offset_ns` is that of the daemon's `service`, None before the first."""

    def __init__(self, frame_prefix: str = "") -> None:
        self.wall_offset_ns: int | None = None
        self._prefix = frame_prefix

    def stamp(self, t_ns: int) -> tuple[int, int]:
        """Return a time of the daemon's clock as ROS time, in seconds and nanoseconds."""
        return divmod(t_ns + (self.wall_offset_ns or 0), 1_000_000_000)

    def frame(self, link: str) -> str:
        """Return the name of a link's frame; empty if `link` is."""
        return self._prefix + link if link else ""

    def header(self, t_ns: int, link: str) -> ros.Header:
        """Return a header with a link's frame; without one if `link` is empty."""
        return ros.Header(ros.Time(*self.stamp(t_ns)), self.frame(link))

    def monotonic_ns(self, stamp: ros.Time) -> int | None:
        """Return a ROS time on the daemon's clock; None for 0, which means unknown, or before `service`."""
        wall_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        return wall_ns - self.wall_offset_ns if wall_ns and self.wall_offset_ns is not None else None


def encode_contacts(
    contacts: Sequence[wire.Contact], frame: wire.HandFrame, palm_link: str, stamper: Stamper
) -> bytes:
    """Return the encoded `ContactArray` of the contacts of a tick; what is unknown is NaN."""
    header = (*stamper.stamp(frame.t_ns), stamper.frame(palm_link))
    data = _CONTACTS.encode((*header, frame.session, frame.tick, frame.hand, len(contacts)))
    for contact in contacts:
        data += _CONTACT.encode(_contact_values(contact, stamper), len(data))
        for part in contact.parts:
            data += _PART.encode(_part_values(part), len(data))
    return ENCAPSULATION + data


def _contact_values(contact: wire.Contact, stamper: Stamper) -> list[Any]:
    """Return the values of the fields of `RosContact`, in their order."""
    values = [*stamper.stamp(contact.t_ns), stamper.frame(contact.frame), _EVENTS[contact.event]]
    for name, convert in _CONTACT_FIELDS:
        value = getattr(contact, name)
        values += convert(value) if name != "begin_ns" else stamper.stamp(value)
    return values


def _part_values(part: wire.ContactPart) -> list[Any]:
    """Return the values of the fields of `RosContactPart`, in their order."""
    return [value for name, convert in _PART_FIELDS for value in convert(part.get(name))]


def _converter(hint: Any, name: str) -> Callable[[Any], Iterable[Any]]:
    """Return a function that returns the values of a field of a type; NaN where it is unknown."""
    if name in _STATUS_CODES:
        return _STATUS_CODES[name]
    count = _LENGTHS.get(hint) or getattr(getattr(hint, "__metadata__", (None,))[0], "length", 0)
    if count:
        unknown = (math.nan,) * count
        return lambda value: value or unknown
    if hint is float64:
        return lambda value: (math.nan if value is None else value,)
    if name == "parts":
        return lambda value: (len(value),)
    return lambda value: (0 if value is None else value,)


def _status_code(codes: type[StatusCode], later: int) -> Callable[[Any], Iterable[Any]]:
    numbers = {status.text: int(status) for status in codes}
    return lambda text: (numbers.get(text, later),)


_LENGTHS: dict[Any, int] = {ros.Point: 3, ros.Vector3: 3}
_STATUS_CODES = {
    field.name: _status_code(codes, _LATER[codes])
    for field in declared_fields(wire.Contact)
    for codes in _LATER
    if field.codes is codes
}
_CONTACT_FIELDS, _PART_FIELDS = (
    [
        ("begin_ns" if name == "begin" else name, _converter(hint, name))
        for name, hint in typing.get_type_hints(kind, include_extras=True).items()
        if name not in ("header", "event")
    ]
    for kind in (RosContact, RosContactPart)
)
"""Field of the wire, and its conversion, of each field of a ROS message behind header and event."""


def encode_wrench(contact: wire.Contact, stamper: Stamper) -> bytes | None:
    """Return the encoded `ros.WrenchStamped` on the link, about its frame's origin: zero once it is released,
    None where force or position is unknown or the contact has no new sample."""
    if contact.event == "end":
        is_released = contact.end_reason == "released"
        return encode_plain_wrench(contact.t_ns, contact.frame, 0.0, stamper) if is_released else None
    whole = contact.force_vector_n if contact.force_vector_status == "valid" else None
    wrench = _wrench(contact.position_m, contact.normal, contact.force_n, whole) if contact.fresh else None
    return _encode_wrench(contact.t_ns, contact.frame, wrench, stamper) if wrench else None


def encode_sum(contacts: Iterable[wire.Contact], t_ns: int, palm_link: str, stamper: Stamper) -> bytes | None:
    """Return the encoded sum of the wrenches of all active contacts of a hand, about its palm's origin; None
    where the force or the palm position of any is unknown."""
    wrenches: list[Sequence[float]] = [(0.0,) * 6]
    for contact in contacts:
        whole = contact.palm_force_vector_n if contact.force_vector_status == "valid" else None
        wrench = _wrench(contact.palm_position_m, contact.palm_normal, contact.force_n, whole)
        if wrench is None or not contact.fresh:
            return None
        wrenches.append(wrench)
    return _encode_wrench(t_ns, palm_link, [sum(values) for values in zip(*wrenches, strict=True)], stamper)


def encode_plain_wrench(t_ns: int, link: str, value: float, stamper: Stamper) -> bytes:
    """Return an encoded wrench with one value everywhere: 0 of a link that isn't touched, NaN if unknown."""
    return _encode_wrench(t_ns, link, (value,) * 6, stamper)


def _encode_wrench(t_ns: int, link: str, wrench: Sequence[float], stamper: Stamper) -> bytes:
    return ENCAPSULATION + _WRENCH.encode((*stamper.stamp(t_ns), stamper.frame(link), *wrench))


def object_pose(percept: wire.Percept, palm_link: str, stamper: Stamper) -> ros.PoseWithCovarianceStamped:
    """Return the likeliest pose of a known object, in the palm's frame."""
    pose = percept.poses[0]
    placed = ros.Pose(ros.Point(*pose["palm_position_m"]), ros.Quaternion(*pose["palm_quaternion"]))
    return ros.PoseWithCovarianceStamped(
        stamper.header(percept.t_ns, palm_link), ros.PoseWithCovariance(placed, list(pose["palm_covariance"]))
    )


def contact_markers(contact: wire.Contact, number: int, stamper: Stamper) -> list[ros.Marker]:
    """Return the markers of an active contact with a position: point, force, and ellipse of 95 %.

    `number` is that of the pad on its hand. Two contacts on it have further points, which expire.
    """
    if contact.position_m is None or contact.normal is None:
        return removed_markers(contact.frame, contact.t_ns, number, stamper)
    header = stamper.header(contact.t_ns, contact.frame)
    position, normal = np.array(contact.position_m), np.array(contact.normal)
    at, color = ros.Point(*contact.position_m), _color(contact)
    length_m = _MIN_ARROW_M + _ARROW_M_PER_N * (contact.force_n or 0.0)
    size = ros.Vector3(*[_POINT_SIZE_M] * 3)
    markers = [
        ros.Marker(header, "contact", number, _SPHERE, pose=ros.Pose(at), scale=size, color=color),
        ros.Marker(
            header,
            "force",
            number,
            _ARROW,
            scale=ros.Vector3(_SHAFT_M, _HEAD_M, 0.0),
            color=color,
            points=[ros.Point(*(position + length_m * normal).tolist()), at],
        ),
    ]
    if contact.covariance_m2 is None:
        markers.append(ros.Marker(header, "ellipse", number, action=_DELETE))
    else:
        markers.append(_ellipse(header, number, at, np.reshape(contact.covariance_m2, (3, 3)), color))
    for k, part in enumerate(contact.parts):
        at = ros.Point(*part["position_m"])
        point = ros.Marker(
            header, "part", 2 * number + k, _SPHERE, pose=ros.Pose(at), scale=size, color=color
        )
        point.lifetime = ros.Duration(*_PART_LIFETIME)
        markers.append(point)
    for marker in markers:
        marker.frame_locked = True  # links move on between two messages
    return markers


def unknown_markers(contact: wire.Contact, number: int, stamper: Stamper) -> list[ros.Marker]:
    """Return the markers of a contact whose pad isn't sampled any more: a grey point where it was."""
    markers = removed_markers(contact.frame, contact.t_ns, number, stamper)
    if contact.position_m is not None:
        header, size = stamper.header(contact.t_ns, contact.frame), ros.Vector3(*[_POINT_SIZE_M] * 3)
        pose, color = ros.Pose(ros.Point(*contact.position_m)), ros.ColorRGBA(*_UNKNOWN_COLOR, 1.0)
        markers[0] = ros.Marker(header, "contact", number, _SPHERE, pose=pose, scale=size, color=color)
        markers[0].frame_locked = True
    return markers


def removed_markers(link: str, t_ns: int, number: int, stamper: Stamper) -> list[ros.Marker]:
    """Return messages that remove the markers of a pad."""
    header = stamper.header(t_ns, link)
    return [ros.Marker(header, name, number, action=_DELETE) for name in _MARKER_NAMESPACES]


def pad_status(health: wire.Health) -> ros.DiagnosticStatus:
    """Return the status of a pad and its node."""
    level = _PAD_LEVELS.get(health.state, ERROR)
    if level == OK and (health.diagnoses or health.calibration_state in ("quarantined", "manual_required")):
        level = WARN
    found = ", ".join(str(diagnosis.get("kind", "")) for diagnosis in health.diagnoses)
    values = {
        name: getattr(health, name)
        for name in (
            "state",
            "node_state",
            "bus",
            "node_id",
            "sampling",
            "rate_hz",
            "samples",
            "missed_samples",
            "age_s",
            "reboots",
            "heartbeats_missed",
            "error_register",
            "calibration_state",
            "calibration_id",
        )
    }
    text = "; ".join(filter(None, (health.state, health.reason, found)))
    name = f"handtouch: {health.hand}/{health.link}"
    serial = "" if health.serial is None else str(health.serial)
    return _status(level, name, text, serial, {**values, "diagnoses": found})


def bus_status(name: str, bus: Mapping[str, Any]) -> ros.DiagnosticStatus:
    """Return the status of a bus, from `buses` of a `service` message."""
    state = str(bus["state"])
    values = {key: bus[key] for key in ("load", "lost_hz", "frames", "error_frames", "overflow")}
    text = "; ".join(filter(None, (state, str(bus["problem"]))))
    return _status(_BUS_LEVELS.get(state, ERROR), f"handtouch: bus {name}", text, name, values)


def daemon_status(service: wire.Service | None, problem: str = "disconnected") -> ros.DiagnosticStatus:
    """Return the status of the daemon; None: it has the problem."""
    if service is None:
        return _status(ERROR, "handtouch: daemon", problem, "", {})
    values = {
        name: getattr(service, name) for name in ("version", "uptime_s", "rate_hz", "ticks", "overruns")
    }
    level, text = (OK, "running") if service.core_compiled else (WARN, "running; its core is uncompiled")
    return _status(level, "handtouch: daemon", text, "", values)


def inputs_status(inputs: Mapping[str, Any], dropped_before: int) -> ros.DiagnosticStatus:
    """Return the status of joint states and other inputs, from `inputs` of a `service` message.

    It is a warning while messages are dropped: `dropped_before` is their number in the former message.
    """
    values = {
        f"{kind} {name}": value
        for kind in ("received", "age_s", "dropped")
        for name, value in inputs[kind].items()
    }
    problem = str(inputs["problem"])
    if sum(inputs["dropped"].values()) > dropped_before:
        return _status(WARN, "handtouch: inputs", problem, "", values)
    text = f"all used; the last problem was: {problem}" if problem else "all used"
    return _status(OK, "handtouch: inputs", text, "", values)


def bridge_status(relayed: int, replaced: int, lost: int, *, is_behind: bool) -> ros.DiagnosticStatus:
    """Return the status of the bridge itself, from its counts of messages."""
    values = {"relayed": relayed, "replaced": replaced, "lost": lost}
    level, text = (WARN, "too slow: drops outdated updates") if is_behind else (OK, "running")
    return _status(level, "handtouch: bridge", text, "", values)


def _status(
    level: int, name: str, message: str, hardware_id: str, values: Mapping[str, Any]
) -> ros.DiagnosticStatus:
    pairs = [ros.KeyValue(key, "" if value is None else str(value)) for key, value in values.items()]
    return ros.DiagnosticStatus(level, name, message, hardware_id, pairs)


def _wrench(
    position: Sequence[float] | None,
    normal: Sequence[float] | None,
    force_n: float | None,
    vector_n: Sequence[float] | None,
) -> tuple[float, ...] | None:
    """Return force and torque of a force vector, or without one of a force against the outward normal; None
    where one of them is unknown."""
    if position is None or normal is None or force_n is None:
        return None
    x, y, z = position
    force_x, force_y, force_z = vector_n or [-force_n * component for component in normal]
    torque = y * force_z - z * force_y, z * force_x - x * force_z, x * force_y - y * force_x
    return force_x, force_y, force_z, *torque


def _ellipse(header: ros.Header, number: int, at: ros.Point, covariance: Any, color: Any) -> ros.Marker:
    variance, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    lengths = np.maximum(2 * _ELLIPSE_SIGMA * np.sqrt(np.maximum(variance, 0.0)), _MIN_AXIS_M)
    pose = ros.Pose(at, ros.Quaternion(*Rotation.from_matrix(axes).as_quat().tolist()))
    shade = ros.ColorRGBA(color.r, color.g, color.b, 0.35)
    return ros.Marker(
        header, "ellipse", number, _SPHERE, pose=pose, scale=ros.Vector3(*lengths.tolist()), color=shade
    )


def _color(contact: wire.Contact) -> ros.ColorRGBA:
    is_valid = contact.position_status == contact.force_status == "valid"
    return ros.ColorRGBA(*(_VALID_COLOR if is_valid else _UNRELIABLE_COLOR), 1.0)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
