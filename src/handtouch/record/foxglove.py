"""What Foxglove shows in 3-D and as a log, made from our messages: contacts on their links, and events.

Public names: `Foxglove`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any, NamedTuple

from handtouch.hand import urdf
from handtouch.record.links import Frame, Links, quaternion

SCENE, LOG, FRAMES, HAND = "/handtouch/scene", "/handtouch/log", "/handtouch/frames", "/handtouch/hand"
_SCENES_NS = 33_000_000
_FRAMES_NS = 1_000_000_000
_HAND_NS = 5_000_000_000
_M_PER_N = 0.01  # of an arrow
_INFO, _WARNING = 2, 3
_COLORS = {"valid": (0.1, 0.6, 0.9, 0.9), "saturated": (0.9, 0.2, 0.1, 0.9)}
_UNKNOWN = (0.6, 0.6, 0.6, 0.9)
_BODY = dict(zip("rgba", (0.36, 0.4, 0.46, 1.0), strict=True))
_STILL = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


class Made(NamedTuple):
    """A message to add: topic, name of the schema, JSON."""

    topic: str
    schema: str
    data: bytes


class Foxglove:
    """Takes contacts, health, service, config and joints; gives what Foxglove shows.

    Contacts thirty times a second at most, log lines, frames of links as they move, and the hand's bodies.
    """

    def __init__(self) -> None:
        self._touching: dict[str, dict[str, Any]] = {}
        self._shown: set[str] = set()
        self._scene_ns = self._frames_ns = self._hand_ns = 0
        self._links = Links()
        self._known = False
        self._states: dict[str, tuple[str, str]] = {}

    def take(self, topic: str, payload: dict[str, Any], t_ns: int) -> list[Made]:
        """What is to be added after a message that was recorded at `t_ns` [ns since 1970]."""
        prefix, _, of = topic.partition("/")
        made = []
        if prefix == "contact":
            if payload["event"] != "update":
                self._scene_ns = 0  # at once
                made.append(_log(t_ns, _INFO, of, _contact_words(payload)))
            if payload["event"] == "end":
                self._touching.pop(of, None)
            else:
                self._touching[of] = payload
        elif prefix == "health":
            told = payload["state"].replace("touched", "clear"), payload["reason"]
            if self._states.get(of) not in (None, told):
                words = f"{payload['state']}: {payload['reason']}".removesuffix(": ")
                made.append(_log(t_ns, _WARNING if payload["reason"] else _INFO, of, words))
            self._states[of] = told
        elif prefix == "service":
            self._links.tell(payload["hands"])
            self._known = True
        elif prefix == "config":
            self._links.configure(payload)
            self._hand_ns = 0
        elif prefix == "joints":
            self._links.move(payload)
            if self._known:
                made.append(_frames(t_ns, self._links.frames(of)))
        if t_ns - self._frames_ns >= _FRAMES_NS and self._known:
            self._frames_ns = t_ns
            made.append(_frames(t_ns, self._links.frames()))
        if t_ns - self._hand_ns >= _HAND_NS and self._known:
            self._hand_ns = t_ns
            entities = [_body(frame, shapes, t_ns) for frame, shapes in self._links.bodies()]
            if entities:
                made.append(
                    Made(HAND, "foxglove.SceneUpdate", _json({"deletions": [], "entities": entities}))
                )
        if t_ns - self._scene_ns >= _SCENES_NS and (self._touching or self._shown):
            self._scene_ns = t_ns
            made.append(Made(SCENE, "foxglove.SceneUpdate", _json(self._scene(t_ns))))
        return made

    def _scene(self, t_ns: int) -> dict[str, Any]:
        entities = [
            _entity(of, self._links.name(contact["hand"], contact["frame"]), contact, t_ns)
            for of, contact in self._touching.items()
        ]
        shown = {entity["id"] for entity in entities}
        gone = [{"timestamp": _time(t_ns), "type": 0, "id": name} for name in sorted(self._shown - shown)]
        self._shown = shown
        return {"deletions": gone, "entities": entities}


def _frames(t_ns: int, frames: Iterable[Frame]) -> Made:
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
    return Made(FRAMES, "foxglove.FrameTransforms", _json({"transforms": transforms}))


def _blank(frame: str, name: str, t_ns: int, **metadata: str) -> dict[str, Any]:
    """An entity without anything to see."""
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


def _body(frame: str, shapes: list[urdf.Shape], t_ns: int) -> dict[str, Any]:
    """A link; meshes are left out."""
    made = _blank(frame, f"body of {frame}", t_ns)
    for shape in shapes:
        turn = dict(zip("xyzw", quaternion(shape.rotation), strict=True))
        pose = {"position": _vector(shape.translation_m.tolist()), "orientation": turn}
        if shape.kind == "box":
            made["cubes"].append({"pose": pose, "size": _vector(shape.size_m), "color": _BODY})
            continue
        if shape.kind == "mesh":
            continue
        wide = 2 * shape.size_m[0]
        ball = {"size": _vector((wide, wide, wide)), "color": _BODY}
        if shape.kind == "sphere":
            made["spheres"].append({"pose": pose, **ball})
            continue
        long = shape.size_m[1]
        ends = {"bottom_scale": 1.0, "top_scale": 1.0}
        made["cylinders"].append({"pose": pose, "size": _vector((wide, wide, long)), **ends, "color": _BODY})
        for sign in (-0.5, 0.5) if shape.kind == "capsule" else ():
            end = shape.translation_m + sign * long * shape.rotation[:, 2]
            made["spheres"].append(
                {"pose": {"position": _vector(end.tolist()), "orientation": _STILL}, **ball}
            )
    return made


def _entity(of: str, frame: str, contact: dict[str, Any], t_ns: int) -> dict[str, Any]:
    position, normal, force_n = contact["position_m"], contact["normal"], contact["force_n"]
    about = {key: str(contact[key]) for key in ("hand", "link", "strength")}
    made = _blank(frame, of, t_ns, **about)
    if position is None or normal is None:
        return made
    color = dict(zip("rgba", _COLORS.get(contact["strength"], _UNKNOWN), strict=True))
    flat = {"position": _vector(position), "orientation": _STILL}
    made["spheres"] = [{"pose": flat, "size": _vector((0.003, 0.003, 0.003)), "color": color}]
    if force_n is not None:
        pose = {"position": _vector(position), "orientation": _along(normal)}
        made["arrows"] = [
            {
                "pose": pose,
                "shaft_length": force_n * _M_PER_N,
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


def _contact_words(contact: dict[str, Any]) -> str:
    words = f"contact {contact['id']} {contact['event']}"
    if contact["event"] == "begin":
        return words
    peak = "" if contact["peak_force_n"] is None else f", at most {contact['peak_force_n']:.2f} N"
    return f"{words} ({contact['reason']}) after {contact['duration_s']:.2f} s{peak}"


def _log(t_ns: int, level: int, name: str, words: str) -> Made:
    told = {"timestamp": _time(t_ns), "level": level, "message": words, "name": name, "file": "", "line": 0}
    return Made(LOG, "foxglove.Log", _json(told))


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def _time(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 1_000_000_000, "nsec": t_ns % 1_000_000_000}


def _vector(xyz: Any) -> dict[str, float]:
    return dict(zip("xyz", xyz, strict=True))


def _along(normal: Any) -> dict[str, float]:
    """The rotation that turns the x axis, which arrows point along, into a unit vector."""
    x, y, z = normal
    if x < -1 + 1e-9:
        return {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}
    scale = (2 * (1 + x)) ** 0.5
    return {"x": 0.0, "y": -z / scale, "z": y / scale, "w": scale / 2}
