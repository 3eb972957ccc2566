"""Parser of robot descriptions (URDF): the tree of links and joints, and the bodies of the links.

Public names: `read_urdf`, `parse_urdf`, `RobotDescription`, `UrdfJoint`, `BodyShape`, `UrdfError`. SI units,
as in URDF. Errors name the faulty element. Format: http://wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.hand.pads import rotation_from_rpy
from handtouch.hand.rotations import rotation_matrices

MOVABLE_JOINT_TYPES = ("revolute", "continuous", "prismatic")
_OTHER_JOINT_TYPES = ("fixed", "floating", "planar")
_SHAPES = ("box", "cylinder", "capsule", "sphere", "mesh")


class UrdfError(ValueError):
    """A description that can't be used; the text names the error and its remedy."""


@dataclass(frozen=True)
class BodyShape:
    """A body of a link: box (x, y, z), cylinder or capsule (radius, length in z), sphere (radius), mesh."""

    kind: str
    size_m: tuple[float, ...]
    """for a mesh: its scale"""
    rotation: FloatArray
    """(3, 3), into the link's frame"""
    translation_m: FloatArray
    """(3,), in the link's frame"""
    file: str = ""
    """of a mesh, as named in the description"""


class UrdfJoint(NamedTuple):
    """A joint between two links."""

    name: str
    kind: str
    """revolute, continuous, prismatic, fixed, floating or planar"""
    parent: str
    child: str
    rotation: FloatArray
    """(3, 3), from the joint's frame into the parent link's"""
    translation_m: FloatArray
    axis: FloatArray
    """(3,), unit, in the joint's frame"""
    limits: tuple[float, float]
    """radians or metres; infinite without limit"""
    mimic: tuple[str, float, float] | None
    """name of the mimicked joint, multiplier, offset"""

    def pose(self, positions: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Return rotation (3, 3) and translation (3,) of the child link in the parent's frame.

        positions: of joints, by name; 0 of others.
        """
        rotation, translation = self.rotation, self.translation_m
        if self.kind not in MOVABLE_JOINT_TYPES:
            return rotation, translation
        name, factor, offset = self.mimic or (self.name, 1.0, 0.0)
        at = factor * positions.get(name, 0.0) + offset
        if self.kind == "prismatic":
            return rotation, translation + rotation @ self.axis * at
        turn = np.append(math.sin(at / 2) * self.axis, math.cos(at / 2))
        return rotation @ rotation_matrices(turn[None])[0], translation


class RobotDescription:
    """A robot as a tree: `joints` by name, `root`, `bodies` (link -> its collision or visual shapes).

    `visible`: visual shapes of links that have other collision shapes. `warnings`: what is doubtful about it.
    """

    def __init__(
        self,
        path: Path,
        joints: dict[str, UrdfJoint],
        bodies: dict[str, tuple[BodyShape, ...]],
        visible: dict[str, tuple[BodyShape, ...]] | None = None,
        warnings: Iterable[str] = (),
    ) -> None:
        self.path, self.joints, self.bodies = path, joints, bodies
        self.visible, self.warnings = visible or {}, tuple(warnings)
        self._joint_to_link: dict[str, UrdfJoint] = {}
        for joint in joints.values():
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in bodies:
                    raise UrdfError(f'joint "{joint.name}" has {role} "{link}", which does not exist')
            if other := self._joint_to_link.get(joint.child):
                raise UrdfError(
                    f'link "{joint.child}" is the child of joints "{other.name}" and "{joint.name}"; '
                    "the links must form a tree"
                )
            self._joint_to_link[joint.child] = joint
        roots = [link for link in bodies if link not in self._joint_to_link]
        if len(roots) != 1:
            trouble = f"has the roots {', '.join(map(repr, roots))}" if roots else "contains a cycle"
            raise UrdfError(f"{trouble}; the links must form one tree with one root")
        (self.root,) = roots
        for link in bodies:
            self.joint_chain(link)  # a separate cycle has no root

    def joint_chain(self, link: str) -> list[UrdfJoint]:
        """Return the joints from the root to a link, in this order. Raises UrdfError, KeyError."""
        found: list[UrdfJoint] = []
        self.bodies[link]
        while joint := self._joint_to_link.get(link):
            found.append(joint)
            link = joint.parent
            if len(found) > len(self.joints):
                raise UrdfError(f'the joints above link "{link}" form a cycle; they must form a tree')
        return found[::-1]

    def default_base(self, palm: str) -> str:
        """Return the link that is the base unless one is stated: the root, or the child of the last floating
        or planar joint above the palm, since nobody reports how that moves."""
        free = [joint for joint in self.joint_chain(palm) if joint.kind in ("floating", "planar")]
        return free[-1].child if free else self.root


def read_urdf(path: Path) -> RobotDescription:
    """Read a URDF file. Raises UrdfError."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise UrdfError(
            f"{error.strerror}; give its path, relative to the folder of the deployment file"
        ) from error
    return parse_urdf(text, path)


def parse_urdf(text: bytes | str, path: Path = Path("robot.urdf")) -> RobotDescription:
    """Parse the text of a URDF file; meshes are searched beside `path`. Raises UrdfError."""
    robot = _parse_xml(text.encode(), "utf-8") if isinstance(text, str) else _parse_xml(text)
    _remove_namespace(robot)
    if robot.tag != "robot":
        raise UrdfError(f"contains a <{robot.tag}> and no <robot>; give a URDF file")
    if any("xacro}" in element.tag for element in robot.iter()):
        raise UrdfError("has tags of xacro; convert it: xacro FILE.xacro > FILE")
    warnings: list[str] = []
    links: dict[str, tuple[BodyShape, ...]] = {}
    visible: dict[str, tuple[BodyShape, ...]] = {}
    for element in robot.findall("link"):
        name = _unique_name(element, links)
        collision, visual = (
            tuple(_parse_shapes(element, tag, f'link "{name}"', warnings)) for tag in ("collision", "visual")
        )
        links[name] = collision or visual
        if collision and visual:
            visible[name] = visual
    if not links:
        raise UrdfError("has no link; give the URDF of the robot, not an empty one or a part to include")
    joints: dict[str, UrdfJoint] = {}
    for element in robot.findall("joint"):
        name = _unique_name(element, joints)
        joints[name] = _parse_joint(element, name)
    found = {name: _follow_mimics(joint, joints, warnings) for name, joint in joints.items()}
    return RobotDescription(path, found, links, visible, dict.fromkeys(warnings))


def _parse_xml(text: bytes, encoding: str | None = None) -> Element:
    """Parse XML as exporters write it: with text before its declaration, and prefixes declared nowhere.

    encoding: None, the one that the text declares.
    """
    before, declaration, rest = text.partition(b"<?xml")
    if declaration and b"<robot" not in before:
        text = declaration + rest
    try:
        try:
            return ElementTree.fromstring(text, ElementTree.XMLParser(encoding=encoding))
        except ElementTree.ParseError as error:
            if error.code != expat.errors.codes[expat.errors.XML_ERROR_UNBOUND_PREFIX]:
                raise
        return ElementTree.fromstring(_declare_prefixes(text), ElementTree.XMLParser(encoding=encoding))
    except ElementTree.ParseError as error:
        raise UrdfError(
            f"isn't valid XML ({error}); correct it, or generate it again: xacro FILE.xacro > FILE"
        ) from error


def _declare_prefixes(text: bytes) -> bytes:
    """Return the text with all prefixes declared in its root."""
    declared = set(re.findall(rb"xmlns:([\w.-]+)", text))
    prefixes = set(re.findall(rb"[<\s/]([A-Za-z_][\w.-]*):[A-Za-z_]", text)) - declared - {b"xml", b"xmlns"}
    names = b"".join(b' xmlns:%b="undeclared:%b"' % (prefix, prefix) for prefix in sorted(prefixes))
    return re.sub(rb"<robot\b", b"<robot" + names, text, count=1)


def _remove_namespace(robot: Element) -> None:
    """Remove the namespace of the root, which exporters state as the default one, from all elements."""
    namespace, brace, _ = robot.tag.rpartition("}")
    for element in robot.iter() if brace else ():
        element.tag = element.tag.removeprefix(namespace + brace)


def _follow_mimics(joint: UrdfJoint, joints: dict[str, UrdfJoint], warnings: list[str]) -> UrdfJoint:
    """Return a joint that mimics none that itself mimics one, or is fixed; factors of a chain multiply.

    A joint that mimics one that doesn't exist moves by itself, which is added to `warnings`.
    """
    factor, offset, leader, passed = 1.0, 0.0, joint, [joint.name]
    while leader.mimic:
        name, by, shift = leader.mimic
        if name not in joints:
            warnings.append(
                f'joint "{leader.name}" mimics "{name}", which does not exist: it moves by itself'
            )
            break
        if name in passed:
            raise UrdfError(f"joints {', '.join(passed)} mimic each other; one must move by itself")
        passed.append(name)
        if joints[name].kind in ("floating", "planar"):
            warnings.append(
                f'joint "{leader.name}" mimics "{name}", which has more than one position: it moves by itself'
            )
            break
        factor, offset, leader = factor * by, factor * shift + offset, joints[name]
    if leader is joint:
        return joint._replace(mimic=None)
    if leader.kind == "fixed":
        return _fix_joint(joint, offset)
    return joint._replace(mimic=(leader.name, factor, offset))


def _fix_joint(joint: UrdfJoint, position: float) -> UrdfJoint:
    """Return a fixed joint at a position [rad, m if prismatic] of a movable one."""
    rotation, translation = joint.rotation, joint.translation_m
    if joint.kind == "prismatic":
        translation = translation + rotation @ joint.axis * position
    else:
        x, y, z = joint.axis
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + np.sin(position) * across + (1 - np.cos(position)) * across @ across
        rotation = rotation @ turn
    return joint._replace(kind="fixed", rotation=rotation, translation_m=translation, mimic=None)


def _unique_name(element: Element, taken: object) -> str:
    name = element.get("name")
    if not name:
        raise UrdfError(f"contains a <{element.tag}> without a name")
    if name in taken:  # type: ignore[operator]
        raise UrdfError(f'contains two <{element.tag}> named "{name}"; names must differ')
    return name


def _parse_joint(element: Element, name: str) -> UrdfJoint:
    location, kind = f'joint "{name}"', element.get("type", "")
    if kind not in (*MOVABLE_JOINT_TYPES, *_OTHER_JOINT_TYPES):
        known = ", ".join((*MOVABLE_JOINT_TYPES, *_OTHER_JOINT_TYPES))
        raise UrdfError(f'{location} is of type "{kind}"; known are {known}')
    parent, child = (_required_child(element, tag, location).get("link", "") for tag in ("parent", "child"))
    axis = np.array([1.0, 0.0, 0.0])
    moves = kind in MOVABLE_JOINT_TYPES
    if moves and (given := element.find("axis")) is not None:
        axis = np.array(_parse_numbers(given, "xyz", 3, location))
        if not np.linalg.norm(axis) > 0:
            raise UrdfError(f"{location}: its axis has no length")
        axis /= np.linalg.norm(axis)
    lower, upper = -math.inf, math.inf
    if kind in ("revolute", "prismatic") and (given := element.find("limit")) is not None:
        (lower,), (upper,) = (_parse_numbers(given, key, 1, location, "0") for key in ("lower", "upper"))
    mimic = None
    if moves and (given := element.find("mimic")) is not None:
        (factor,) = _parse_numbers(given, "multiplier", 1, location, "1")
        (offset,) = _parse_numbers(given, "offset", 1, location, "0")
        mimic = given.get("joint", ""), factor, offset
    return UrdfJoint(
        name, kind, parent, child, *_parse_origin(element, location), axis, (lower, upper), mimic
    )


def _parse_shapes(link: Element, tag: str, location: str, warnings: list[str]) -> Iterator[BodyShape]:
    """Yield the shapes of a link; a faulty one is left out, which is added to `warnings`."""
    for element in link.findall(tag):
        at = f"{location}, <{tag}>"
        try:
            yield from _parse_geometry(element, at)
        except UrdfError as error:
            warnings.append(f"{error}; this body isn't used")


def _parse_geometry(element: Element, at: str) -> Iterator[BodyShape]:
    rotation, translation = _parse_origin(element, at)
    shapes = list(_required_child(element, "geometry", at))
    known = [shape for shape in shapes if shape.tag in _SHAPES]
    if not known:
        tags = ", ".join(f"<{shape.tag}>" for shape in shapes) or "nothing"
        raise UrdfError(f"{at} has {tags} in its <geometry>; known are {', '.join(_SHAPES)}")
    for shape in known:
        size: tuple[float, ...]
        if shape.tag == "box":
            size = tuple(_parse_numbers(shape, "size", 3, at))
        elif shape.tag in ("cylinder", "capsule"):
            size = _parse_numbers(shape, "radius", 1, at)[0], _parse_numbers(shape, "length", 1, at)[0]
        elif shape.tag == "sphere":
            size = tuple(_parse_numbers(shape, "radius", 1, at))
        else:
            size = tuple(_parse_numbers(shape, "scale", 3, at, "1 1 1"))
        yield BodyShape(shape.tag, size, rotation, translation, shape.get("filename", ""))


def _parse_origin(element: Element, location: str) -> tuple[FloatArray, FloatArray]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    rpy = _parse_numbers(origin, "rpy", 3, location, "0 0 0")
    return rotation_from_rpy(rpy), np.array(_parse_numbers(origin, "xyz", 3, location, "0 0 0"))


def _required_child(element: Element, tag: str, location: str) -> Element:
    if (found := element.find(tag)) is None:
        raise UrdfError(f"{location} has no <{tag}>")
    return found


def _parse_numbers(
    element: Element, key: str, count: int, location: str, usual: str | None = None
) -> list[float]:
    text = element.get(key, usual)
    try:
        numbers = [float(token) for token in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        expected = "a number" if count == 1 else f"{count} numbers"
        raise UrdfError(f'{location}: <{element.tag} {key}="{text or ""}"> must be {expected}')
    return numbers
