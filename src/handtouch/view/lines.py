"""Messages as plain lines, for pipes, logs and terminals that can do no more."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from handtouch import wire

DOUBTED = ("quarantined", "person")
"""Trust in a pad whose calibration isn't its own."""


def contact_line(contact: wire.Contact) -> str:
    """One touch in one line: what happened where, how hard, how sure."""
    parts = [
        f"{contact.t_ns * 1e-9:14.4f}  {contact.event:6}  {contact.hand}/{contact.link:<16}  #{contact.id:<4}"
    ]
    if contact.position_m is not None:
        x, y, z = (1e3 * value for value in contact.position_m)
        parts.append(f"at ({x:7.2f}, {y:7.2f}, {z:7.2f}) mm +- {1e3 * location_std_m(contact):.3f}")
    else:
        parts.append("location invalid" + " " * 24)
    if contact.palm != "skipped":
        parts.append(palm_text(contact))
    parts.append(strength_text(contact))
    if contact.event == "end":
        peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
        parts.append(f"{contact.reason} after {contact.duration_s:.2f} s{peak}")
    return "  ".join(parts)


def palm_text(contact: wire.Contact) -> str:
    """Where in the palm, or why that isn't known."""
    if contact.palm_position_m is None:
        age = "" if contact.joints_age_s is None else f", joints {contact.joints_age_s:.2f} s old"
        return f"palm {contact.palm}{age}".ljust(37)
    x, y, z = (1e3 * value for value in contact.palm_position_m)
    return f"palm ({x:7.2f}, {y:7.2f}, {z:7.2f}) mm"


def strength_text(contact: wire.Contact) -> str:
    """How hard, and how sure."""
    if contact.force_n is None:
        return "strength invalid"
    if contact.strength == "saturated":
        return f"> {contact.force_n:.2f} N (saturated)"
    return f"{contact.force_n:6.2f} +- {contact.force_std_n or 0.0:.2f} N"


def location_std_m(contact: wire.Contact) -> float:
    """Root of the summed variances of the position [m]; NaN without a location."""
    if contact.covariance_m2 is None:
        return float("nan")
    xx, yy, zz = contact.covariance_m2[0], contact.covariance_m2[4], contact.covariance_m2[8]
    return math.sqrt(max(0.0, xx + yy + zz))


def health_line(health: wire.Health) -> str:
    """A pad and its node in one line."""
    serial = "" if health.serial is None else f" serial {health.serial}"
    why = f": {health.reason}" if health.reason else ""
    pace = " (event)" if health.pace == "event" else ""
    if health.trust in DOUBTED:
        pace += f" {health.trust}"
    why += "".join(f"; {finding_text(finding)}" for finding in health.findings)
    return (
        f"{health.t_ns * 1e-9:14.4f}  health  {health.hand}/{health.link:<16}  {health.state:8} "
        f"node {health.node_id} on {health.bus} {health.node}{pace}{serial}, {health.rate_hz:.0f} Hz, "
        f"{health.missed} missed{why}"
    )


def percept_line(percept: wire.Percept) -> str:
    """What is felt of a contact, how sure, by how much evidence; or what to do, and why."""
    where = f"{percept.hand}/{percept.link}" if percept.link else percept.hand
    head = f"{percept.t_ns * 1e-9:14.4f}  {percept.kind:8}  {where:<22}  #{percept.contact:<4}"
    values = ", ".join(
        _measure(name, value, percept.values.get(f"{name}_std"))
        for name, value in percept.values.items()
        if not name.endswith("_std") and value is not None
    )
    if percept.kind == "ask":
        left_s = (percept.expires_ns - percept.t_ns) * 1e-9
        return (
            f"{head}  {percept.label} ({values}) within {left_s:.1f} s: {percept.question}? {percept.reason}"
        )
    sure = "" if percept.confidence is None else f" {percept.confidence:.0%}"
    said = f"{percept.label}{sure}" if percept.state == "estimated" else f"{percept.state}: {percept.reason}"
    evidence = ", ".join(f"{_number(count)} {name}" for name, count in percept.evidence.items())
    return f"{head}  {said:<16}  {values}" + (f"  [{evidence}]" if evidence else "")


_MAIN = {"motion": "slipped_m", "hardness": "stiffness_n_per_m", "shape": "radius_m", "texture": "period_m"}
"""Kind of a percept -> the number that says most."""
_SURE_STEP = 0.05
"""Steps of a probability told live: finer ones would only flicker."""


def percept_words(percept: wire.Percept) -> str:
    """A percept in a few words: class, how sure, the number that says most; "" while nothing is known."""
    values = percept.values
    if percept.kind == "ask":
        amounts = ", ".join(
            _measure(name, value, None)
            for name, value in values.items()
            if name != "bits" and not name.endswith("_std") and value is not None
        )
        return f"{percept.question}? {percept.label}" + (f" ({amounts})" if amounts else "")
    if percept.state == "invalid":
        return f"{percept.kind}: {percept.reason}"
    if percept.state != "estimated" or not percept.label:
        return ""
    words = percept.label if percept.kind in ("motion", "hardness") else f"{percept.kind} {percept.label}"
    if percept.confidence is not None:
        words += f" {_SURE_STEP * round(percept.confidence / _SURE_STEP):.0%}"
    name = _MAIN.get(percept.kind, "")
    if isinstance(value := values.get(name), float):
        words += f", {_measure(name, value, None)}"
    return words


def _number(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_number, value)) + ")"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


_UNITS = {
    "_m_per_s": ("mm/s", 1e3),
    "_n_per_s": ("N/s", 1.0),
    "_n_per_m": ("N/mm", 1e-3),
    "_m": ("mm", 1e3),
    "_n": ("N", 1.0),
    "_s": ("s", 1.0),
}
"""End of a name -> unit for people, how many of it in the SI unit."""


def _measure(name: str, value: Any, std: Any) -> str:
    """A value by name, with its deviation if there is one, in units that people use."""
    end = next((end for end in _UNITS if name.endswith(end)), "")
    unit, scale = _UNITS.get(end, ("", 1.0))
    words = name.removesuffix(end).replace("_", " ")
    spread = "" if std is None else f" +- {_number(_scaled(std, scale))}"
    return f"{words} {_number(_scaled(value, scale))}{spread} {unit}".rstrip()


def _scaled(value: Any, scale: float) -> Any:
    if isinstance(value, list | tuple):
        return [_scaled(item, scale) for item in value]
    return value * scale if isinstance(value, float) else value


def finding_text(finding: Mapping[str, Any]) -> str:
    """What a supervisor found, why it thinks so and what helps, in a sentence; whatever keys are missing."""
    evidence = f" ({finding['evidence']})" if finding.get("evidence") else ""
    remedy = f": {finding['remedy']}" if finding.get("remedy") else ""
    return f"{finding.get('cause') or finding.get('kind', '?')}{evidence}{remedy}"


def line(message: wire.Message) -> str:
    """Any message in one line."""
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
        )
    return f"{head}{wire.topic_of(message)}"
