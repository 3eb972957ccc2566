"""Conversion to Foxglove's 3-D scenes and logs: contacts on their links, frames, and events.

Public name: `FoxgloveConverter`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any, NamedTuple

from handtouch.hand import urdf
from handtouch.record.link_frames import LinkFrames, LinkTransform, quaternion

SCENE_TOPIC, LOG_TOPIC, FRAMES_TOPIC, HAND_TOPIC = (
    "/handtouch/scene",
    "/handtouch/log",
    "/handtouch/frames",
    "/handtouch/hand",
)
_SCENE_PERIOD_NS = 33_000_000
_FRAMES_PERIOD_NS = 1_000_000_000
_HAND_PERIOD_NS = 5_000_000_000
_ARROW_M_PER_N = 0.01
_INFO, _WARNING = 2, 3
_COLOR_OF_STATUS = {"valid": (0.1, 0.6, 0.9, 0.9), "lower_bound": (0.9, 0.2, 0.1, 0.9)}
_DEFAULT_COLOR = (0.6, 0.6, 0.6, 0.9)
_BODY_COLOR = dict(zip("rgba", (0.36, 0.4, 0.46, 1.0), strict=True))
_IDENTITY_ROTATION = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


class FoxgloveMessage(NamedTuple):
    """A message for Foxglove: topic, name of the schema, JSON."""

    topic: str
    schema: str
    data: bytes


class FoxgloveConverter:
    """Converter of contacts, health, service, config and joints to Foxglove's messages.

    Contacts at up to 30 Hz, log lines, frames of links as they move, and the hand's bodies.
    """

    def __init__(self) -> None:
        self._contacts: dict[str, dict[str, Any]] = {}
        self._shown_contacts: set[str] = set()
        self._scene_wall_ns = self._frames_wall_ns = self._hand_wall_ns = 0
        self._links = LinkFrames()
        self._links_known = False
        self._pad_states: dict[str, tuple[str, str]] = {}

    def convert(self, topic: str, payload: dict[str, Any], t_ns: int) -> list[FoxgloveMessage]:
        """Return the messages to add after one recorded at `t_ns` [ns since 1970]."""
        prefix, _, name = topic.partition("/")
        made = []
        if prefix == "contact":
            if payload["event"] != "update":
                self._scene_wall_ns = 0  # no delay
                made.append(_log_message(t_ns, _INFO, name, _contact_text(payload)))
            if payload["event"] == "end":
                self._contacts.pop(name, None)
            else:
                self._contacts[name] = payload
        elif prefix == "health":
            state = payload["state"].replace("touched", "clear"), payload["reason"]
            if self._pad_states.get(name) not in (None, state):
                text = f"{payload['state']}: {payload['reason']}".removesuffix(": ")
                made.append(_log_message(t_ns, _WARNING if payload["reason"] else _INFO, name, text))
            self._pad_states[name] = state
        elif prefix == "service":
            self._links.set_links(payload["hands"])
            self._links_known = True
        elif prefix == "config":
            self._links.set_deployment(payload)
            self._hand_wall_ns = 0
        elif prefix == "joints":
            self._links.set_joints(payload)
            if self._links_known:
                made.append(_frame_transforms(t_ns, self._links.frames(name)))
        if t_ns - self._frames_wall_ns >= _FRAMES_PERIOD_NS and self._links_known:
            self._frames_wall_ns = t_ns
            made.append(_frame_transforms(t_ns, self._links.frames()))
        if t_ns - self._hand_wall_ns >= _HAND_PERIOD_NS and self._links_known:
            self._hand_wall_ns = t_ns
            entities = [_body_entity(frame, shapes, t_ns) for frame, shapes in self._links.bodies()]
            if entities:
                made.append(
                    FoxgloveMessage(
                        HAND_TOPIC, "foxglove.SceneUpdate", _json({"deletions": [], "entities": entities})
                    )
                )
        if t_ns - self._scene_wall_ns >= _SCENE_PERIOD_NS and (self._contacts or self._shown_contacts):
            self._scene_wall_ns = t_ns
            made.append(FoxgloveMessage(SCENE_TOPIC, "foxglove.SceneUpdate", _json(self._scene_update(t_ns))))
        return made

    def _scene_update(self, t_ns: int) -> dict[str, Any]:
        entities = [
            _contact_entity(name, self._links.frame_name(contact["hand"], contact["frame"]), contact, t_ns)
            for name, contact in self._contacts.items()
        ]
        shown = {entity["id"] for entity in entities}
        deleted = [
            {"timestamp": _time(t_ns), "type": 0, "id": old} for old in sorted(self._shown_contacts - shown)
        ]
        self._shown_contacts = shown
        return {"deletions": deleted, "entities": entities}


def _frame_transforms(t_ns: int, frames: Iterable[LinkTransform]) -> FoxgloveMessage:
    transforms = [
        {
            "timestamp": _time(t_ns),
            "parent_frame_id": frame.parent,
            "child_frame_id": frame.child,
            "translation": _vector(frame.translation_m),
            "rotation": dict(zip("xyzw", frame.rotation, strict=True)),
        }
        for frame in frames
    ]
    return FoxgloveMessage(FRAMES_TOPIC, "foxglove.FrameTransforms", _json({"transforms": transforms}))


def _empty_entity(frame: str, name: str, t_ns: int, **metadata: str) -> dict[str, Any]:
    """Return an entity without primitives."""
    return {
        "timestamp": _time(t_ns),
        "frame_id": frame,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [{"key": key, "value": value} for key, value in metadata.items()],
        **{kind: [] for kind in ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles")},
        "texts": [],
        "models": [],
    }


def _body_entity(frame: str, shapes: list[urdf.BodyShape], t_ns: int) -> dict[str, Any]:
    """Return a link's bodies; without meshes."""
    made = _empty_entity(frame, f"body of {frame}", t_ns)
    for shape in shapes:
        turn = dict(zip("xyzw", quaternion(shape.rotation), strict=True))
        pose = {"position": _vector(shape.translation_m.tolist()), "orientation": turn}
        if shape.kind == "box":
            made["cubes"].append({"pose": pose, "size": _vector(shape.size_m), "color": _BODY_COLOR})
            continue
        if shape.kind == "mesh":
            continue
        wide = 2 * shape.size_m[0]
        ball = {"size": _vector((wide, wide, wide)), "color": _BODY_COLOR}
        if shape.kind == "sphere":
            made["spheres"].append({"pose": pose, **ball})
            continue
        long = shape.size_m[1]
        ends = {"bottom_scale": 1.0, "top_scale": 1.0}
        made["cylinders"].append(
            {"pose": pose, "size": _vector((wide, wide, long)), **ends, "color": _BODY_COLOR}
        )
        for sign in (-0.5, 0.5) if shape.kind == "capsule" else ():
            end = shape.translation_m + sign * long * shape.rotation[:, 2]
            made["spheres"].append(
                {"pose": {"position": _vector(end.tolist()), "orientation": _IDENTITY_ROTATION}, **ball}
            )
    return made


def _contact_entity(name: str, frame: str, contact: dict[str, Any], t_ns: int) -> dict[str, Any]:
    position, normal, force_n = contact["position_m"], contact["normal"], contact["force_n"]
    about = {key: str(contact[key]) for key in ("hand", "link", "force_status")}
    made = _empty_entity(frame, name, t_ns, **about)
    if position is None or normal is None:
        return made
    color = dict(zip("rgba", _COLOR_OF_STATUS.get(contact["force_status"], _DEFAULT_COLOR), strict=True))
    flat = {"position": _vector(position), "orientation": _IDENTITY_ROTATION}
    made["spheres"] = [{"pose": flat, "size": _vector((0.003, 0.003, 0.003)), "color": color}]
    if force_n is not None:
        pose = {"position": _vector(position), "orientation": _rotation_from_x(normal)}
        made["arrows"] = [
            {
                "pose": pose,
                "shaft_length": force_n * _ARROW_M_PER_N,
                "shaft_diameter": 0.001,
                "head_length": 0.002,
                "head_diameter": 0.002,
                "color": color,
            }
        ]
        made["texts"] = [
            {
                "pose": flat,
                "billboard": True,
                "font_size": 12.0,
                "scale_invariant": True,
                "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                "text": f"{contact['link']} {force_n:.2f} N",
            }
        ]
    return made


def _contact_text(contact: dict[str, Any]) -> str:
    text = f"contact {contact['id']} {contact['event']}"
    if contact["event"] == "begin":
        return text
    peak = "" if contact["peak_force_n"] is None else f", peak {contact['peak_force_n']:.2f} N"
    return f"{text} ({contact['end_reason']}) after {contact['duration_s']:.2f} s{peak}"


def _log_message(t_ns: int, level: int, name: str, text: str) -> FoxgloveMessage:
    log = {"timestamp": _time(t_ns), "level": level, "message": text, "name": name, "file": "", "line": 0}
    return FoxgloveMessage(LOG_TOPIC, "foxglove.Log", _json(log))


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def _time(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 1_000_000_000, "nsec": t_ns % 1_000_000_000}


def _vector(xyz: Any) -> dict[str, float]:
    return dict(zip("xyz", xyz, strict=True))


def _rotation_from_x(normal: Any) -> dict[str, float]:
    """Return the rotation of the x axis, the direction of arrows, to a unit vector."""
    x, y, z = normal
    if x < -1 + 1e-9:
        return {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}
    scale = (2 * (1 + x)) ** 0.5
    return {"x": 0.0, "y": -z / scale, "z": y / scale, "w": scale / 2}
