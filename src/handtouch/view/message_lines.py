"""Messages as plain text lines, for pipes, logs and simple terminals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from handtouch import wire

DISCONNECTED_TEXT = "daemon disconnected; start `handtouch run FILE` again"
UNCALIBRATED_STATES = ("quarantined", "manual_required")
"""Calibration states of a pad whose forces aren't calibrated."""
_FULL_RATE = 0.9
"""Share of the nominal rate of ticks from which on the nominal one isn't named: one late tick in ten shows"""
_BUSY_SHARE = 0.05
"""Share of late periods of a daemon that is behind. With fewer a low rate is wanted: an idle hand has one"""
_MAX_NAMES = 4
_DIGITS = str.maketrans("", "", "0123456789.")


def tick_rate_text(*, rate_hz: float, period_s: float, overruns: int, uptime_s: float) -> str:
    """Format the rate of ticks of a `service` message: "200", or "17 of 200" where the daemon is late."""
    is_behind = rate_hz * period_s < _FULL_RATE and overruns * period_s > _BUSY_SHARE * uptime_s
    return f"{rate_hz:.0f}" + (f" of {1 / period_s:.0f}" if is_behind else "")


def names_text(names: Sequence[str]) -> str:
    """Format a list of pads: all of them, or the first ones and the number of the others."""
    hidden = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {hidden} more" if hidden > 0 else "")


def is_same_reason(reason: str, other: str) -> bool:
    """Return True for texts that differ in their numbers only, as reasons of pads with one cause do."""
    return reason.translate(_DIGITS) == other.translate(_DIGITS)


def contact_line(contact: wire.Contact) -> str:
    """Format a contact: event, position, force and their standard deviations."""
    parts = [
        f"{contact.t_ns * 1e-9:14.4f}  {contact.event:6}  {contact.hand}/{contact.link:<16}  #{contact.id:<4}"
    ]
    if contact.position_m is not None:
        x, y, z = (1e3 * value for value in contact.position_m)
        parts.append(f"at ({x:7.2f}, {y:7.2f}, {z:7.2f}) mm +- {1e3 * position_std_m(contact):.3f}")
    else:
        parts.append(f"position {contact.position_status}".ljust(40))
    if contact.palm_status != "not_computed":
        parts.append(palm_position_text(contact))
    parts.append(force_text(contact))
    if contact.force_vector_n is not None:
        fx, fy, fz = contact.force_vector_n
        parts.append(f"vector ({fx:6.2f}, {fy:6.2f}, {fz:6.2f}) N")
    elif contact.force_vector_status != "not_computed":
        parts.append(f"vector {contact.force_vector_status}")
    if contact.parts:
        parts.append(f"{len(contact.parts)} contacts: {' and '.join(map(part_text, contact.parts))}")
    if contact.event == "end":
        peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
        parts.append(f"{contact.end_reason} after {contact.duration_s:.2f} s{peak}")
    return "  ".join(parts)


def part_text(part: wire.ContactPart) -> str:
    """Format one of two contacts on a pad."""
    x, y, z = (1e3 * value for value in part["position_m"])
    force = "" if part["force_n"] is None else f" {part['force_n']:.2f} +- {part['force_std_n'] or 0.0:.2f} N"
    return f"({x:.2f}, {y:.2f}, {z:.2f}) mm{force}"


def palm_position_text(contact: wire.Contact) -> str:
    """Format the position in the palm, or its status."""
    if contact.palm_position_m is None:
        age = "" if contact.joints_age_s is None else f", joints {contact.joints_age_s:.2f} s old"
        return f"palm {contact.palm_status}{age}".ljust(37)
    x, y, z = (1e3 * value for value in contact.palm_position_m)
    return f"palm ({x:7.2f}, {y:7.2f}, {z:7.2f}) mm"


def force_text(contact: wire.Contact) -> str:
    """Format the force and its standard deviation, or its status."""
    if contact.force_n is None:
        return f"force {contact.force_status}"
    if contact.force_status == "lower_bound":
        return f"> {contact.force_n:.2f} N (saturated)"
    return f"{contact.force_n:6.2f} +- {contact.force_std_n or 0.0:.2f} N"


def position_std_m(contact: wire.Contact) -> float:
    """Return the root of the summed variances of the position [m]; NaN without a position."""
    if contact.covariance_m2 is None:
        return float("nan")
    xx, yy, zz = contact.covariance_m2[0], contact.covariance_m2[4], contact.covariance_m2[8]
    return math.sqrt(max(0.0, xx + yy + zz))


def active_errors(health: wire.Health) -> list[str]:
    """Return the errors that the pad's node has reported by EMCY and not cleared."""
    return [f"EMCY {e.get('text')}" for e in health.emergencies if e.get("cleared_ns") is None]


def health_news(before: wire.Health | None, health: wire.Health) -> Iterator[tuple[str, str]]:
    """Yield text and status of what is new about a pad: diagnoses, and that it is calibrated again."""
    known = {diagnosis.get("kind") for diagnosis in before.diagnoses} if before else set()
    for diagnosis in health.diagnoses:
        if diagnosis.get("kind") not in known:
            yield diagnosis_text(diagnosis), "unreliable"
    was_uncalibrated = before is not None and before.calibration_state in UNCALIBRATED_STATES
    if was_uncalibrated and health.calibration_state not in UNCALIBRATED_STATES:
        yield f"{health.calibration_state} again", "clear"


def health_line(health: wire.Health) -> str:
    """Format a pad and its node."""
    serial = "" if health.serial is None else f" serial {health.serial}"
    why = f": {health.reason}" if health.reason else ""
    mode = " (event)" if health.sampling == "event" else ""
    if health.calibration_state in UNCALIBRATED_STATES:
        mode += f" {health.calibration_state}"
    why += "".join(f"; {diagnosis_text(diagnosis)}" for diagnosis in health.diagnoses)
    why += "".join(f"; {text}" for text in active_errors(health))
    return (
        f"{health.t_ns * 1e-9:14.4f}  health  {health.hand}/{health.link:<16}  {health.state:8} "
        f"node {health.node_id} on {health.bus} {health.node_state}{mode}{serial}, {health.rate_hz:.0f} Hz, "
        f"{health.missed_samples} missed{why}"
    )


def percept_line(percept: wire.Percept) -> str:
    """Format an estimate with its confidence and evidence, or a request with its reason."""
    source = f"{percept.hand}/{percept.link}" if percept.link else percept.hand
    head = f"{percept.t_ns * 1e-9:14.4f}  {percept.kind:8}  {source:<22}  #{percept.contact_id:<4}"
    values = ", ".join(
        _value_text(name, value, percept.values.get(f"{name}_std"))
        for name, value in percept.values.items()
        if not name.endswith("_std") and value is not None
    )
    if percept.kind == "action_request":
        left_s = (percept.expires_ns - percept.t_ns) * 1e-9
        return (
            f"{head}  {percept.label} ({values}) within {left_s:.1f} s: {percept.question}? {percept.reason}"
        )
    confidence = "" if percept.confidence is None else f" {percept.confidence:.0%}"
    result = (
        f"{percept.label}{confidence}"
        if percept.state == "estimated"
        else f"{percept.state}: {percept.reason}"
    )
    if percept.poses:
        values = "; ".join([*map(pose_text, percept.poses), values])
    evidence = ", ".join(f"{_number_text(count)} {name}" for name, count in percept.evidence.items())
    return f"{head}  {result:<16}  {values}" + (f"  [{evidence}]" if evidence else "")


def pose_text(pose: wire.ObjectPose) -> str:
    """Format the weight of a pose, and position and z axis in the palm."""
    x, y, z, w = pose["palm_quaternion"]
    axis = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    at = ", ".join(f"{1e3 * value:.1f}" for value in pose["palm_position_m"])
    return f"{pose['weight']:.0%} at ({at}) mm, z to ({', '.join(f'{value:.2f}' for value in axis)})"


_MAIN_VALUE = {
    "motion": "slip_distance_m",
    "shape": "radius_m",
    "friction": "ratio",
    "object": "position_std_m",
    "stiffness": "modulus_per_radius_pa_per_m",
}
"""Kind of a percept -> its principal value."""
_CONFIDENCE_STEP = 0.05
"""Resolution of a displayed probability; finer steps would only flicker."""


def percept_summary(percept: wire.Percept) -> str:
    """Summarise a percept by class, confidence and principal value; "" while undetermined."""
    values = percept.values
    if percept.kind == "action_request":
        amounts = ", ".join(
            _value_text(name, value, None)
            for name, value in values.items()
            if name != "expected_information_bits" and not name.endswith("_std") and value is not None
        )
        return f"{percept.question}? {percept.label}" + (f" ({amounts})" if amounts else "")
    if percept.state == "invalid":
        return f"{percept.kind}: {percept.reason}"
    if percept.state != "estimated" or not percept.label:
        return ""
    text = percept.label if percept.kind == "motion" else f"{percept.kind} {percept.label}"
    if percept.confidence is not None:
        text += f" {_CONFIDENCE_STEP * round(percept.confidence / _CONFIDENCE_STEP):.0%}"
    name = _MAIN_VALUE.get(percept.kind, "")
    if isinstance(value := values.get(name), float):
        text += f", {_value_text(name, value, None)}"
    return text


def _number_text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_number_text, value)) + ")"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


_DISPLAY_UNITS = {
    "_m_per_s": ("mm/s", 1e3),
    "_n_per_s": ("N/s", 1.0),
    "_n_per_m": ("N/mm", 1e-3),
    "_m": ("mm", 1e3),
    "_n": ("N", 1.0),
    "_s": ("s", 1.0),
}
"""Ending of a key -> displayed unit, and its factor from the SI unit."""


def _value_text(name: str, value: Any, std: Any) -> str:
    """Format a named value, with its standard deviation if known, in display units."""
    end = next((end for end in _DISPLAY_UNITS if name.endswith(end)), "")
    unit, scale = _DISPLAY_UNITS.get(end, ("", 1.0))
    label = name.removesuffix(end).replace("_", " ")
    spread = "" if std is None else f" +- {_number_text(_scaled(std, scale))}"
    return f"{label} {_number_text(_scaled(value, scale))}{spread} {unit}".rstrip()


def _scaled(value: Any, scale: float) -> Any:
    if isinstance(value, list | tuple):
        return [_scaled(item, scale) for item in value]
    return value * scale if isinstance(value, float) else value


def diagnosis_text(diagnosis: Mapping[str, Any]) -> str:
    """Format cause, evidence and remedy of a diagnosis; any key may be missing."""
    evidence = f" ({diagnosis['evidence']})" if diagnosis.get("evidence") else ""
    remedy = f": {diagnosis['remedy']}" if diagnosis.get("remedy") else ""
    return f"{diagnosis.get('cause') or diagnosis.get('kind', '?')}{evidence}{remedy}"


def message_line(message: wire.Message) -> str:
    """Format a message of any topic as one line."""
    if isinstance(message, wire.Contact):
        return contact_line(message)
    if isinstance(message, wire.Health):
        return health_line(message)
    if isinstance(message, wire.Percept):
        return percept_line(message)
    head = f"{message.t_ns * 1e-9:14.4f}  "
    if isinstance(message, wire.HandFrame):
        touched = sum(state == wire.PadState.TOUCHED for state in message.state)
        return f"{head}hand    {message.hand}  tick {message.tick}, {touched} of {len(message.links)} touched"
    if isinstance(message, wire.Raw):
        return f"{head}raw     {message.hand}  tick {message.tick}, {sum(message.fresh)} fresh"
    if isinstance(message, wire.Service):
        return (
            f"{head}service handtouch {message.version}, up {message.uptime_s:.0f} s, "
            f"{message.rate_hz:.0f} ticks/s, {message.overruns} overruns"
            f"{', stopping' if message.stopping else ''}"
        )
    return f"{head}{wire.topic_of(message)}"
