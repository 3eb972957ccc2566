"""Conversion to Foxglove's 3-D scenes and logs: contacts on their links, frames, and events.

Public names: `FoxgloveConverter`; `LinkFrames`, `LinkTransform`, `quaternion` (link frames from the recorded
URDF and joint states, else links in a row). Needs the extra `foxglove`: Foxglove's own messages, encoders and
schemas.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from foxglove import Schema
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    KeyValuePair,
    Log,
    LogLevel,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)
from scipy.spatial.transform import Rotation

from handtouch.arrays import FloatArray
from handtouch.hand import urdf
from handtouch.record.schemas import MessageFormat, SceneMessage

OBJECT_TOPIC = "/handtouch/object"
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
_CONTACT_LIFETIME = Duration(sec=1)
"""Contacts of a daemon that ended without a message disappear."""
_COLOR_OF_STATUS = {
    "valid": Color(r=0.1, g=0.6, b=0.9, a=0.9),
    "lower_bound": Color(r=0.9, g=0.2, b=0.1, a=0.9),
}
_DEFAULT_COLOR = Color(r=0.6, g=0.6, b=0.6, a=0.9)
_TEXT_COLOR = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_BODY_COLOR = Color(r=0.36, g=0.4, b=0.46, a=1.0)
_ELLIPSOID_CHI2 = 7.815
"""95 % of a normal distribution in three dimensions"""
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


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

    def convert(self, topic: str, payload: dict[str, Any], t_ns: int) -> list[SceneMessage]:
        """Return the messages to add after one recorded at `t_ns` [ns since 1970]."""
        prefix, _, name = topic.partition("/")
        made = []
        if prefix == "contact":
            if payload["event"] != "update":
                self._scene_wall_ns = 0  # no delay
                made.append(_log_message(t_ns, LogLevel.Info, name, _contact_text(payload)))
            if payload["event"] != "end":
                self._contacts[name] = payload
            elif payload["end_reason"] == "released" or name not in self._contacts:
                self._contacts.pop(name, None)
            else:  # whether it is touched isn't known until the pad is sampled again
                self._contacts[name] = payload
        elif prefix == "health":
            if payload["state"] == "clear":
                self._contacts.pop(name, None)
            state = payload["state"].replace("touched", "clear"), payload["reason"]
            if self._pad_states.get(name) not in (None, state):
                level = LogLevel.Warning if payload["reason"] else LogLevel.Info
                text = f"{payload['state']}: {payload['reason']}".removesuffix(": ")
                made.append(_log_message(t_ns, level, name, text))
            self._pad_states[name] = state
        elif prefix == "service":
            self._links.set_links(payload["hands"])
            self._links_known = True
        elif prefix == "config":
            self._links.set_deployment(payload)
            self._hand_wall_ns = 0
        elif prefix == "percept" and payload["kind"] == "object":
            frame = self._links.palm_frame(payload["hand"])
            made += _object_messages(payload, frame, t_ns) if frame else []
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
                made.append(_encoded(HAND_TOPIC, SceneUpdate(entities=entities)))
        if t_ns - self._scene_wall_ns >= _SCENE_PERIOD_NS and (self._contacts or self._shown_contacts):
            self._scene_wall_ns = t_ns
            made.append(_encoded(SCENE_TOPIC, self._scene_update(t_ns)))
        return made

    def _scene_update(self, t_ns: int) -> SceneUpdate:
        entities = [
            _contact_entity(name, self._links.frame_name(contact["hand"], contact["frame"]), contact, t_ns)
            for name, contact in self._contacts.items()
        ]
        deletions = [
            SceneEntityDeletion(timestamp=_time(t_ns), id=name)
            for name in sorted(self._shown_contacts - self._contacts.keys())
        ]
        self._shown_contacts = set(self._contacts)
        return SceneUpdate(deletions=deletions, entities=entities)


class EncodableMessage(Protocol):
    """A message of `foxglove.messages`."""

    @staticmethod
    def get_schema() -> Schema: ...

    def encode(self) -> bytes: ...


def _encoded(topic: str, message: EncodableMessage) -> SceneMessage:
    return SceneMessage(topic, _format_of(type(message)), message.encode())


@cache
def _format_of(kind: type[EncodableMessage]) -> MessageFormat:
    schema = kind.get_schema()
    return MessageFormat("protobuf", schema.name, schema.encoding, schema.data)


def _frame_transforms(t_ns: int, frames: Iterable[LinkTransform]) -> SceneMessage:
    transforms = [
        FrameTransform(
            timestamp=_time(t_ns),
            parent_frame_id=frame.parent,
            child_frame_id=frame.child,
            translation=_vector(frame.translation_m),
            rotation=_rotation(frame.rotation),
        )
        for frame in frames
    ]
    return _encoded(FRAMES_TOPIC, FrameTransforms(transforms=transforms))


def _body_entity(frame: str, shapes: list[urdf.BodyShape], t_ns: int) -> SceneEntity:
    """Return a link's bodies; without meshes."""
    cubes, spheres, cylinders = [], [], []
    for shape in shapes:
        if shape.kind == "mesh":
            continue
        pose = _pose(shape.translation_m.tolist(), quaternion(shape.rotation))
        if shape.kind == "box":
            cubes.append(CubePrimitive(pose=pose, size=_vector(shape.size_m), color=_BODY_COLOR))
            continue
        wide = 2 * shape.size_m[0]
        ball_size = _vector((wide, wide, wide))
        if shape.kind == "sphere":
            spheres.append(SpherePrimitive(pose=pose, size=ball_size, color=_BODY_COLOR))
            continue
        long = shape.size_m[1]
        size = _vector((wide, wide, long))
        cylinders.append(
            CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=_BODY_COLOR)
        )
        for sign in (-0.5, 0.5) if shape.kind == "capsule" else ():
            end = shape.translation_m + sign * long * shape.rotation[:, 2]
            spheres.append(SpherePrimitive(pose=_pose(end.tolist()), size=ball_size, color=_BODY_COLOR))
    return SceneEntity(
        timestamp=_time(t_ns),
        frame_id=frame,
        id=f"body of {frame}",
        frame_locked=True,
        cubes=cubes,
        spheres=spheres,
        cylinders=cylinders,
    )


def _object_messages(percept: dict[str, Any], frame: str, t_ns: int) -> list[SceneMessage]:
    """Return the likeliest pose of a known object while it is determined, and all hypotheses as a scene."""
    poses = percept.get("poses", ())
    made = []
    if percept["state"] == "estimated" and poses:
        pose = _pose(poses[0]["palm_position_m"], poses[0]["palm_quaternion"])
        placed = PoseInFrame(timestamp=_time(t_ns), frame_id=frame, pose=pose)
        made.append(_encoded(f"{OBJECT_TOPIC}/{percept['hand']}", placed))
    spheres, arrows = [], []
    for hypothesis in poses:
        color = Color(r=1.0, g=0.9, b=0.6, a=0.1 + 0.6 * hypothesis["weight"])
        variances, axes = np.linalg.eigh(np.reshape(hypothesis["palm_covariance"], (6, 6))[:3, :3])
        axes[:, 0] *= np.linalg.det(axes)  # right-handed
        wide = 2 * np.sqrt(np.maximum(variances, 0.0) * _ELLIPSOID_CHI2)
        ellipsoid = _pose(hypothesis["palm_position_m"], quaternion(axes))
        spheres.append(SpherePrimitive(pose=ellipsoid, size=_vector(wide.tolist()), color=color))
        z = Rotation.from_quat(hypothesis["palm_quaternion"]).apply([0.0, 0.0, 1.0])
        arrows.append(
            ArrowPrimitive(
                pose=_pose(hypothesis["palm_position_m"], _rotation_from_x(z.tolist())),
                shaft_length=0.03,
                shaft_diameter=0.002,
                head_length=0.008,
                head_diameter=0.005,
                color=color,
            )
        )
    entity = SceneEntity(
        timestamp=_time(t_ns),
        frame_id=frame,
        id=f"object in {percept['hand']}",
        lifetime=_CONTACT_LIFETIME,
        frame_locked=True,
        spheres=spheres,
        arrows=arrows,
    )
    return [*made, _encoded(SCENE_TOPIC, SceneUpdate(entities=[entity]))]


def _contact_entity(name: str, frame: str, contact: dict[str, Any], t_ns: int) -> SceneEntity:
    position, normal, force_n = contact["position_m"], contact["normal"], contact["force_n"]
    spheres, arrows, texts = [], [], []
    color = _COLOR_OF_STATUS.get(contact["force_status"], _DEFAULT_COLOR)
    parts = contact.get("parts", ())  # two contacts on one pad
    if contact["event"] == "end" or not contact.get("fresh", True):  # not sampled: a grey point where it was
        force_n, color, parts = None, _DEFAULT_COLOR, ()
    size = _vector((0.003, 0.003, 0.003))
    for part in parts:
        spheres.append(SpherePrimitive(pose=_pose(part["position_m"]), size=size, color=color))
        texts += [] if part["force_n"] is None else [_force_text(part["position_m"], "", part["force_n"])]
    if position is not None and normal is not None:
        spheres.append(SpherePrimitive(pose=_pose(position), size=size, color=color))
        if force_n is not None:
            arrows.append(
                ArrowPrimitive(
                    pose=_pose(position, _rotation_from_x(normal)),
                    shaft_length=force_n * _ARROW_M_PER_N,
                    shaft_diameter=0.001,
                    head_length=0.002,
                    head_diameter=0.002,
                    color=color,
                )
            )
            texts.append(_force_text(position, f"{contact['link']} ", force_n))
    return SceneEntity(
        timestamp=_time(t_ns),
        frame_id=frame,
        id=name,
        lifetime=_CONTACT_LIFETIME,
        frame_locked=True,
        metadata=[KeyValuePair(key=key, value=str(contact[key])) for key in ("hand", "link", "force_status")],
        spheres=spheres,
        arrows=arrows,
        texts=texts,
    )


def _force_text(position: Iterable[float], name: str, force_n: float) -> TextPrimitive:
    return TextPrimitive(
        pose=_pose(position),
        billboard=True,
        font_size=12.0,
        scale_invariant=True,
        color=_TEXT_COLOR,
        text=f"{name}{force_n:.2f} N",
    )


def _contact_text(contact: dict[str, Any]) -> str:
    text = f"contact {contact['id']} {contact['event']}"
    if contact["event"] == "begin":
        return text
    peak = "" if contact["peak_force_n"] is None else f", peak {contact['peak_force_n']:.2f} N"
    return f"{text} ({contact['end_reason']}) after {contact['duration_s']:.2f} s{peak}"


def _log_message(t_ns: int, level: LogLevel, name: str, text: str) -> SceneMessage:
    return _encoded(LOG_TOPIC, Log(timestamp=_time(t_ns), level=level, message=text, name=name))


def _time(t_ns: int) -> Timestamp:
    return Timestamp(t_ns // 1_000_000_000, t_ns % 1_000_000_000)


def _vector(xyz: Iterable[float]) -> Vector3:
    x, y, z = xyz
    return Vector3(x=x, y=y, z=z)


def _rotation(xyzw: Iterable[float]) -> Quaternion:
    x, y, z, w = xyzw
    return Quaternion(x=x, y=y, z=z, w=w)


def _pose(position: Iterable[float], xyzw: Iterable[float] = _NO_ROTATION) -> Pose:
    return Pose(position=_vector(position), orientation=_rotation(xyzw))


def _rotation_from_x(normal: Iterable[float]) -> tuple[float, float, float, float]:
    """Return the rotation (x, y, z, w) of the x axis, the direction of arrows, to a unit vector."""
    x, y, z = normal
    if x < -1 + 1e-9:
        return 0.0, 0.0, 1.0, 0.0
    scale = (2 * (1 + x)) ** 0.5
    return 0.0, -z / scale, y / scale, scale / 2


ROOT_FRAME = "handtouch"
_HAND_SPACING_M = 0.3
"""Distance of hands."""
_LINK_SPACING_M = 0.05
"""Distance of links of a hand without URDF."""


class LinkTransform(NamedTuple):
    """A frame in its parent; rotation as x, y, z, w."""

    parent: str
    child: str
    translation_m: tuple[float, ...]
    rotation: tuple[float, ...]


class LinkFrames:
    """Frames and bodies of links, from payloads of `config`, `service` and `joints`."""

    def __init__(self) -> None:
        self._hands: dict[str, list[str]] = {}
        self._robots: dict[str, urdf.RobotDescription] = {}
        self._palms: dict[str, str] = {}
        self._joints: dict[str, dict[str, float]] = {}

    def set_deployment(self, payload: dict[str, Any]) -> None:
        """Read the URDFs of a deployment; a malformed one is ignored."""
        tables = json.loads(payload["deployment"])
        self._robots.clear()
        self._palms.clear()
        for hand in tables["hand"]:
            data = payload["files"].get(hand.get("urdf"))
            if data is None:
                continue
            try:
                robot = self._robots[hand["name"]] = urdf.parse_urdf(data, Path(hand["urdf"]))
                self._palms[hand["name"]] = hand.get("palm_link") or robot.root
            except urdf.UrdfError:  # the daemon has reported it
                continue

    def set_links(self, hands: dict[str, list[str]]) -> None:
        """Set the links of each hand that carry pads."""
        self._hands = hands

    def set_joints(self, payload: dict[str, Any]) -> None:
        """Set the joint positions of a hand."""
        known = zip(payload["names"], payload["position_rad"], strict=True)
        self._joints[payload["hand"]] = {name: value for name, value in known if value is not None}

    def frame_name(self, hand: str, link: str) -> str:
        """Return the name of a link's frame; with the hand's name if there are several."""
        return link if len(self._hands) < 2 else f"{hand}/{link}"

    def palm_frame(self, hand: str) -> str:
        """Return the name of a hand's palm frame; empty without a URDF."""
        return self.frame_name(hand, self._palms[hand]) if hand in self._palms else ""

    def frames(self, moved: str = "") -> Iterator[LinkTransform]:
        """Yield all frames, or the movable ones of a hand that moved."""
        for number, (hand, links) in enumerate(self._hands.items()):
            if moved and hand != moved:
                continue
            robot = self._robots.get(hand)
            if robot is None:
                if not moved:
                    for index, link in enumerate(links):
                        at = index * _LINK_SPACING_M, number * _LINK_SPACING_M, 0.0
                        yield LinkTransform(ROOT_FRAME, self.frame_name(hand, link), at, (0.0, 0.0, 0.0, 1.0))
                continue
            if not moved:
                at = 0.0, number * _HAND_SPACING_M, 0.0
                yield LinkTransform(ROOT_FRAME, self.frame_name(hand, robot.root), at, (0.0, 0.0, 0.0, 1.0))
            for joint in robot.joints.values():
                if not moved or joint.kind in urdf.MOVABLE_JOINT_TYPES:
                    yield self._joint_frame(hand, joint)

    def bodies(self) -> Iterator[tuple[str, list[urdf.BodyShape]]]:
        """Yield frame and shapes of each link with a body."""
        for hand, robot in self._robots.items():
            for link, shapes in robot.bodies.items():
                if shapes:
                    yield self.frame_name(hand, link), list(shapes)

    def _joint_frame(self, hand: str, joint: urdf.UrdfJoint) -> LinkTransform:
        rotation, translation = joint.pose(self._joints.get(hand, {}))
        parent, child = self.frame_name(hand, joint.parent), self.frame_name(hand, joint.child)
        return LinkTransform(parent, child, tuple(translation.tolist()), quaternion(rotation))


def quaternion(rotation: FloatArray) -> tuple[float, ...]:
    """Return x, y, z, w of a rotation matrix (3, 3), with w >= 0."""
    return tuple(Rotation.from_matrix(rotation).as_quat(canonical=True).tolist())
