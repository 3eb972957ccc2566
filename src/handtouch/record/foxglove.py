"""What Foxglove shows in 3-D and as a log, made from our messages: contacts on their links, and events.

Public names: `Foxglove`.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

SCENE, LOG, FRAMES = "/handtouch/scene", "/handtouch/log", "/handtouch/frames"
_ROOT = "handtouch"
_SCENES_NS = 33_000_000
_FRAMES_NS = 1_000_000_000
_SPACING_M = 0.05
_M_PER_N = 0.01  # of an arrow
_INFO, _WARNING = 2, 3
_COLORS = {"valid": (0.1, 0.6, 0.9, 0.9), "saturated": (0.9, 0.2, 0.1, 0.9)}
_UNKNOWN = (0.6, 0.6, 0.6, 0.9)


class Made(NamedTuple):
    """A message to add: topic, name of the schema, JSON."""

    topic: str
    schema: str
    data: bytes


class Foxglove:
    """Takes contacts, health and service; gives scene updates thirty times a second, frames and log lines.

    Nobody tells where links are to one another, so each pad's link has a frame of its own in a row.
    """

    def __init__(self) -> None:
        self._touching: dict[str, dict[str, Any]] = {}
        self._shown: set[str] = set()
        self._scene_ns = self._frames_ns = 0
        self._links: dict[str, list[str]] = {}
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
            self._links = payload["hands"]
        if t_ns - self._frames_ns >= _FRAMES_NS and self._links:
            self._frames_ns = t_ns
            made.append(Made(FRAMES, "foxglove.FrameTransforms", _json(self._transforms(t_ns))))
        if t_ns - self._scene_ns >= _SCENES_NS and (self._touching or self._shown):
            self._scene_ns = t_ns
            made.append(Made(SCENE, "foxglove.SceneUpdate", _json(self._scene(t_ns))))
        return made

    def _scene(self, t_ns: int) -> dict[str, Any]:
        entities = [_entity(of, contact, t_ns) for of, contact in self._touching.items()]
        shown = {entity["id"] for entity in entities}
        gone = [{"timestamp": _time(t_ns), "type": 0, "id": name} for name in sorted(self._shown - shown)]
        self._shown = shown
        return {"deletions": gone, "entities": entities}

    def _transforms(self, t_ns: int) -> dict[str, Any]:
        made = []
        for row, links in enumerate(self._links.values()):
            for column, link in enumerate(links):
                made.append(
                    {
                        "timestamp": _time(t_ns),
                        "parent_frame_id": _ROOT,
                        "child_frame_id": link,
                        "translation": _vector((column * _SPACING_M, row * _SPACING_M, 0.0)),
                        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    }
                )
        return {"transforms": made}


def _entity(of: str, contact: dict[str, Any], t_ns: int) -> dict[str, Any]:
    position, normal, force_n = contact["position_m"], contact["normal"], contact["force_n"]
    made: dict[str, Any] = {
        "timestamp": _time(t_ns),
        "frame_id": contact["frame"],
        "id": of,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [{"key": key, "value": str(contact[key])} for key in ("hand", "link", "strength")],
        **{kind: [] for kind in ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles")},
        "texts": [],
        "models": [],
    }
    if position is None or normal is None:
        return made
    color = dict(zip("rgba", _COLORS.get(contact["strength"], _UNKNOWN), strict=True))
    flat = {"position": _vector(position), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
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
