"""State shown by the page, updated by messages; each page receives the changes since its last update.

Public names: `VersionedValues`, `PageModel`, `PerceptSummaries` (percepts as text). Uses no clock and no
socket: times are those of the messages. Values are plain, for JSON.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.arrays import FloatArray
from handtouch.client import columns
from handtouch.config import Deployment
from handtouch.view.message_lines import (
    UNCALIBRATED_STATES,
    active_errors,
    diagnosis_text,
    health_news,
    percept_summary,
    tick_rate_text,
)
from handtouch.view.page.scene_graph import scene_of

_MAX_MESSAGES = 60
_PAD_STATES = tuple(state.name.lower() for state in wire.PadState)
_OK_STATES = ("clear", "touched")
_FAULT_STATES = ("stale", "lost", "faulted")
_MERGE_WINDOW_NS = 1_000_000_000
_REPEAT_WINDOW_NS = 60_000_000_000
_MERGED_LINES = 8
"""Latest lines among which a repeated event is searched."""
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_ELLIPSE_95_SIGMA = 2.4477
"""Half axes of the 95 % ellipse of a two-dimensional Gaussian, in standard deviations."""


@dataclass(eq=False)
class _MessageLine:
    """A line of the message list: one event of one or several pads, once or several times."""

    kind: tuple[str, str]
    """text without its numbers, and status"""
    text: str = ""
    t_ns: int = 0
    wall_s: float | None = None
    times: Counter[str] = field(default_factory=Counter)
    """link, or "" -> number of times"""

    def is_repeated_by(self, kind: tuple[str, str], link: str, t_ns: int) -> bool:
        """Return True if the event happens again to a pad of this line."""
        return self.kind == kind and link in self.times and t_ns - self.t_ns < _REPEAT_WINDOW_NS

    def is_shared_by(self, kind: tuple[str, str], link: str, t_ns: int) -> bool:
        """Return True if the event happens to another pad at about the same time."""
        return self.kind == kind and bool(link) and t_ns - self.t_ns < _MERGE_WINDOW_NS

    def values(self) -> dict[str, Any]:
        """Return plain values for the page."""
        return {
            "wall_s": self.wall_s,
            "links": [link for link in self.times if link],
            "text": self.text,
            "status": self.kind[1],
            "count": max(self.times.values()),
        }


class VersionedValues:
    """Values by key, each with the version at which it changed last."""

    def __init__(self) -> None:
        self.version = 0
        self._values: dict[str, tuple[int, Any]] = {}

    def set_value(self, key: str, value: Any) -> None:
        """Set a value; equal values are no change."""
        if key not in self._values or self._values[key][1] != value:
            self.version += 1
            self._values[key] = self.version, value

    def clear_prefix(self, prefix: str) -> None:
        """Set the values of all keys with this prefix to None."""
        for key in [key for key in self._values if key.startswith(prefix)]:
            self.set_value(key, None)

    def changes_since(self, version: int) -> dict[str, Any]:
        """Return the values that changed after a version."""
        return {key: value for key, (changed, value) in self._values.items() if changed > version}


class PageModel:
    """Collects messages by `add_message`; `update_values` writes the resulting state to `values`.

    Keys of `values`: `scene` (as `scene_graph.scene_of`), `joints/<hand>`, `pad/<hand>/<link>`,
    `contact/<hand>/<link>` (None: no contact), `percepts/<hand>/<link>` (as `PerceptSummaries.current`),
    `percepts_enabled` (else the page shows how to subscribe to them), `service`, `alive`, `messages`,
    `time_s`.
    """

    def __init__(self, values: VersionedValues | None = None) -> None:
        self.values = VersionedValues() if values is None else values
        self._session: int | None = None
        self._deployment = ""
        self._has_hands = False
        self._frames: dict[str, wire.HandFrame] = {}
        self._short_contacts: dict[str, tuple[wire.HandFrame, int]] = {}
        self._health: dict[str, wire.Health] = {}
        self._percepts = PerceptSummaries()
        self._faults: dict[str, tuple[str, str]] = {}
        self._messages: deque[_MessageLine] = deque(maxlen=_MAX_MESSAGES)
        self._wall_offset_ns = 0

    def add_message(self, message: wire.Message) -> None:
        """Process a message of any topic."""
        if self._session is not None and message.session != self._session:
            self._reset(message.t_ns)
        self._session = message.session
        if isinstance(message, wire.HandFrame):
            self._add_frame(message)
        elif isinstance(message, wire.JointPositions):
            angles = zip(message.names, message.position_rad, strict=False)
            known = {name: round(angle, 4) for name, angle in angles if angle is not None}
            self.values.set_value(f"joints/{message.hand}", known)
        elif isinstance(message, wire.Percept):
            self._percepts.add_percept(message)
        elif isinstance(message, wire.Health):
            self._add_health(message)
        elif isinstance(message, wire.Service):
            self._wall_offset_ns = message.wall_offset_ns
            self.values.set_value("service", _service_values(message))
        elif isinstance(message, wire.Config):
            self._add_config(message)

    def update_values(self, alive: bool) -> None:
        """Write the state after the messages since the last call; `alive`: the daemon is connected."""
        self.values.set_value("alive", alive)
        if not alive:
            self._frames.clear()
            self._short_contacts.clear()
            self._percepts.clear()
            self.values.clear_prefix("contact/")
            self.values.clear_prefix("percepts/")
            return
        touched: dict[str, int] = {}
        for hand, frame in self._frames.items():
            values = columns(frame)
            for row, link in enumerate(frame.links):
                key = f"{hand}/{link}"
                code = values["state"][row]
                self._set_pad(key, _PAD_STATES[code] if code < len(_PAD_STATES) else "faulted")
                touched[key] = int(values["contact_id"][row])
                shown = (frame, row) if touched[key] else self._short_contacts.get(key)
                self.values.set_value(f"contact/{key}", _contact_values(*shown) if shown else None)
            self.values.set_value("time_s", round(frame.t_ns * 1e-9, 3))
        if self._frames:
            now_ns = max(frame.t_ns for frame in self._frames.values())
            for key, summary in self._percepts.current(touched, now_ns).items():
                self.values.set_value(f"percepts/{key}", summary)
        self._frames.clear()
        self._short_contacts.clear()

    def _add_frame(self, frame: wire.HandFrame) -> None:
        """Store a frame; a contact that ends before the next update is shown in that update."""
        before = self._frames.get(frame.hand)
        if before is not None and before.links == frame.links:
            was, now = columns(before)["contact_id"], columns(frame)["contact_id"]
            for row in np.flatnonzero((was != 0) & (was != now)).tolist():
                self._short_contacts[f"{frame.hand}/{frame.links[row]}"] = before, row
        self._frames[frame.hand] = frame

    def _add_config(self, message: wire.Config) -> None:
        content = f"{message.deployment}{sorted(message.files)}"
        if content == self._deployment:
            return
        self._deployment = content
        try:
            deployment = Deployment.model_validate_json(message.deployment)
        except ValidationError as error:
            self._append_message(message.t_ns, f"can't read the daemon's deployment: {error}", "lost")
            return
        self._has_hands = len(deployment.hands) > 1
        scene = scene_of(deployment, message.files)
        self.values.set_value("scene", scene)
        for problem in scene["problems"]:
            self._append_message(message.t_ns, problem, "stale")

    def _add_health(self, health: wire.Health) -> None:
        key = f"{health.hand}/{health.link}"
        name = key if self._has_hands else health.link
        before, self._health[key] = self._health.get(key), health
        if health.state in _FAULT_STATES and self._faults.get(key) != (health.state, health.reason):
            self._faults[key] = health.state, health.reason
            reason = health.reason.removeprefix(f"{health.state}: ")
            why = f": {reason}" if reason else f", node {health.node_state}"
            self._append_message(health.t_ns, f"{health.state}{why}", health.state, name)
        elif health.state in _OK_STATES and key in self._faults:
            del self._faults[key]
            self._append_message(health.t_ns, "recovered", "clear", name)
        for text, status in health_news(before, health):
            self._append_message(health.t_ns, text, status, name)
        self._set_pad(key, health.state)

    def _set_pad(self, key: str, state: str) -> None:
        """Set state and health of a pad; `status` selects its colour."""
        health = self._health.get(key)
        value: dict[str, Any] = {"state": state, "status": "clear" if state == "touched" else state}
        if health is not None:
            unreliable = health.calibration_state in UNCALIBRATED_STATES or health.diagnoses
            if unreliable and state in _OK_STATES:
                value["status"] = "unreliable"
            value |= {
                "node_state": health.node_state,
                "rate_hz": round(health.rate_hz),
                "reason": "; ".join(filter(None, [health.reason, *active_errors(health)])),
                "diagnoses": [diagnosis_text(diagnosis) for diagnosis in health.diagnoses],
                "calibration_state": health.calibration_state,
                "calibration_progress": health.calibration_progress,
            }
        self.values.set_value(f"pad/{key}", value)

    def _reset(self, t_ns: int) -> None:
        """Discard the state of the previous session; the scene may still be valid."""
        self._frames.clear()
        self._short_contacts.clear()
        self._health.clear()
        self._faults.clear()
        self._percepts.clear()
        self.values.clear_prefix("contact/")
        self.values.clear_prefix("percepts/")
        self._append_message(t_ns, "daemon restarted", "starting")

    def _append_message(self, t_ns: int, text: str, status: str, link: str = "") -> None:
        """Append a line. The same event of several pads within a second, and one that comes again while the
        lines before it are recent, are one line with its pads and its number of times."""
        kind = _NUMBER.sub("#", text), status
        recent = list(self._messages)[-_MERGED_LINES:]
        line = next((old for old in reversed(recent) if old.is_repeated_by(kind, link, t_ns)), None)
        if line is None and recent and recent[-1].is_shared_by(kind, link, t_ns):
            line = recent[-1]
        if line is None:
            line = _MessageLine(kind)
        else:
            self._messages.remove(line)
        line.text, line.t_ns = text, t_ns
        line.times[link] += 1
        line.wall_s = round((t_ns + self._wall_offset_ns) * 1e-9, 2) if self._wall_offset_ns else None
        self._messages.append(line)
        self.values.set_value("messages", [old.values() for old in self._messages])


def _service_values(service: wire.Service) -> dict[str, Any]:
    supervisor = service.supervisor or {}
    return {
        "version": service.version,
        "tick_rate": tick_rate_text(
            rate_hz=service.rate_hz,
            period_s=service.period_s,
            overruns=service.overruns,
            uptime_s=service.uptime_s,
        ),
        "tick_us": service.tick_us.get("p50"),
        "congestion_episodes": sum(service.congestion_episodes.values()),
        "overruns": service.overruns,
        "supervisor": supervisor.get("state"),
        "buses": {
            name: {
                "load": round(bus.get("load", 0.0), 2),
                "state": bus.get("state", "?"),
                "problem": bus.get("problem", ""),
            }
            for name, bus in sorted(service.buses.items())
        },
    }


def _contact_values(frame: wire.HandFrame, row: int) -> dict[str, Any]:
    """Return a contact with the half axes of the 95 % ellipse of its position, in the link frame."""
    values = columns(frame)
    position = values["position_m"][row]
    value: dict[str, Any] = {
        "id": int(values["contact_id"][row]),
        "force_n": _rounded_number(values["force_n"][row], 3),
        "force_std_n": _rounded_number(values["force_std_n"][row], 3),
        "position_status": _status_text(wire.PositionStatus, values["position_status"][row]),
        "force_status": _status_text(wire.ForceStatus, values["force_status"][row]),
    }
    if np.isfinite(position).all():
        variance, axes = np.linalg.eigh(
            np.nan_to_num(values["covariance_m2"][row]).reshape(3, 3).astype(float)
        )
        half = axes * (_ELLIPSE_95_SIGMA * np.sqrt(np.maximum(variance, 0.0)))
        value |= {
            "position_m": _rounded_vector(position),
            "normal": _rounded_vector(values["normal"][row]),
            "axes_m": [_rounded_vector(half[:, 2]), _rounded_vector(half[:, 1])],
            "pad_m": _rounded_vector(values["pad_m"][row]),
        }
    return value


def _status_text(codes: type[wire.PositionStatus] | type[wire.ForceStatus], code: int) -> str:
    return codes(code).text if code < len(codes) else "unreliable"  # a code of a newer daemon


def _rounded_vector(values: FloatArray) -> list[float]:
    return [round(value, 7) for value in values.tolist()]


def _rounded_number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


_ELLIPSOID_CHI2 = 7.815
"""95 % of a normal distribution in three dimensions"""
_DEFAULT_LABELS = ("sticking", "point")
"""Usual classes: listed, but not shown next to the pad."""
_PERCEPT_TIMEOUT_NS = 3_000_000_000
"""A current percept is repeated twice a second; one of the whole hand expires after this time."""


class _HeldPercept(NamedTuple):
    contact_id: int
    expires_ns: int
    label: str
    text: str
    missing: str
    poses: list[dict[str, Any]]


def _drawn_pose(pose: wire.ObjectPose) -> dict[str, Any]:
    """Return a hypothesis as it is drawn in the palm: half axes of the position's 95 % ellipsoid, and z."""
    variances, axes = np.linalg.eigh(np.reshape(pose["palm_covariance"], (6, 6))[:3, :3])
    half_m = np.sqrt(np.maximum(variances, 0.0) * _ELLIPSOID_CHI2)
    rotation = Rotation.from_quat(pose["palm_quaternion"]).as_matrix()
    return {
        "weight": pose["weight"],
        "position_m": pose["palm_position_m"],
        "axes_m": (axes * half_m).T.tolist(),
        "z": rotation[:, 2].tolist(),
    }


class PerceptSummaries:
    """Collects percepts; `current` returns the valid ones as plain values."""

    def __init__(self) -> None:
        self._pads: dict[str, dict[str, _HeldPercept]] = {}

    def add_percept(self, percept: wire.Percept) -> None:
        """Store a percept message of any kind."""
        pad = self._pads.setdefault(f"{percept.hand}/{percept.link}", {})
        is_request = percept.kind == "action_request"
        shown = percept.state == "estimated" and percept.label not in _DEFAULT_LABELS
        pad[f"{percept.kind} {percept.question}" if is_request else percept.kind] = _HeldPercept(
            percept.contact_id,
            percept.expires_ns if is_request else percept.t_ns + _PERCEPT_TIMEOUT_NS,
            percept.label if is_request or shown else "",
            percept_summary(percept),
            f"{percept.kind}: {percept.reason}" if percept.state == "undetermined" else "",
            [_drawn_pose(pose) for pose in percept.poses],
        )

    def current(self, contacts: dict[str, int], now_ns: int) -> dict[str, dict[str, Any] | None]:
        """Return hand/link (hand/: the whole hand) -> its valid percepts, None where the last one ended.

        `contacts`: contact id of each pad in the latest frames, 0 for none; percepts of other contacts ended.
        """
        return {key: self._summarise_pad(key, contacts.get(key), now_ns) for key in list(self._pads)}

    def clear(self) -> None:
        """Discard all percepts."""
        self._pads.clear()

    def _summarise_pad(self, key: str, contact_id: int | None, now_ns: int) -> dict[str, Any] | None:
        is_hand = key.endswith("/")
        valid = {
            kind: held
            for kind, held in self._pads[key].items()
            if now_ns < held.expires_ns and (contact_id is None or is_hand or held.contact_id == contact_id)
        }
        if not valid:
            del self._pads[key]
            return None
        self._pads[key] = valid
        estimates = [valid[kind] for kind in wire.PERCEPT_KINDS if kind in valid]
        poses = [pose for held in estimates for pose in held.poses]
        return ({"poses": poses} if poses else {}) | {
            "labels": [held.label for held in estimates if held.label],
            "lines": [held.text for held in estimates if held.text],
            "requests": [held.text for kind, held in valid.items() if kind not in wire.PERCEPT_KINDS],
            "missing": [held.missing for held in estimates if held.missing],
        }
