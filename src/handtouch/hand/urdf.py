"""Reads a robot's description (URDF): its tree of links and joints, and the bodies of the links.

Public names: `read`, `parse`, `Description`, `Joint`, `Shape`, `UrdfError`. SI units, as in URDF. What can't
be used is named with the element that is wrong. Format: http://wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.pads import rotation_of

FloatArray = NDArray[np.float64]
MOVABLE = ("revolute", "continuous", "prismatic")


class UrdfError(ValueError):
    """A description that can't be used; the text names what is wrong and what would be right."""


@dataclass(frozen=True)
class Shape:
    """A body of a link: box (x, y, z), cylinder or capsule (radius, length in z), sphere (radius), mesh."""

    kind: str
    size_m: tuple[float, ...]
    """of a mesh: its scale"""
    rotation: FloatArray
    """(3, 3), into the link's frame"""
    translation_m: FloatArray
    """(3,), in the link's frame"""
    file: str = ""
    """of a mesh, as the description names it"""


class Joint(NamedTuple):
    """A joint between two links."""

    name: str
    kind: str
    """revolute, continuous, prismatic or fixed"""
    parent: str
    child: str
    rotation: FloatArray
    """(3, 3), from the joint's frame into the parent link's"""
    translation_m: FloatArray
    axis: FloatArray
    """(3,), unit, in the joint's frame"""
    limits: tuple[float, float]
    """radians or metres; infinite where there is none"""
    mimic: tuple[str, float, float] | None
    """name of the joint that it follows, multiplier, offset"""


class Description:
    """A robot as a tree: `joints` by name, `root`, `bodies` (link -> its shapes, collision or visual)."""

    def __init__(self, path: Path, joints: dict[str, Joint], bodies: dict[str, tuple[Shape, ...]]) -> None:
        self.path, self.joints, self.bodies = path, joints, bodies
        self._to: dict[str, Joint] = {}
        for joint in joints.values():
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in bodies:
                    raise UrdfError(f'joint "{joint.name}" has {role} "{link}", and there is no such link')
            if other := self._to.get(joint.child):
                raise UrdfError(
                    f'link "{joint.child}" is the child of joints "{other.name}" and "{joint.name}"; '
                    "the links must make a tree"
                )
            self._to[joint.child] = joint
        roots = [link for link in bodies if link not in self._to]
        if len(roots) != 1:
            trouble = f"has the roots {', '.join(map(repr, roots))}" if roots else "goes round in a circle"
            raise UrdfError(f"{trouble}; the links must make one tree, with one root")
        (self.root,) = roots
        for link in bodies:
            self.chain(link)  # a circle beside the tree has no root

    def chain(self, link: str) -> list[Joint]:
        """Joints from the root to a link, the nearest to the root first. Raises UrdfError, KeyError."""
        found: list[Joint] = []
        self.bodies[link]
        while joint := self._to.get(link):
            found.append(joint)
            link = joint.parent
            if len(found) > len(self.joints):
                raise UrdfError(f'the joints above link "{link}" go round in a circle; they must make a tree')
        return found[::-1]

    def between(self, link: str, other: str) -> list[Joint]:
        """Joints that move one of two links against the other."""
        one, two = self.chain(link), self.chain(other)
        return [joint for joint in one if joint not in two] + [joint for joint in two if joint not in one]


def read(path: Path) -> Description:
    """The robot in a URDF file. Raises UrdfError."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise UrdfError(
            f"{error.strerror}; give its path, starting at the folder of the deployment file"
        ) from error
    return parse(text, path)


def parse(text: bytes | str, path: Path = Path("robot.urdf")) -> Description:
    """The robot in the text of a URDF file; meshes are beside `path`. Raises UrdfError."""
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UrdfError(
            f"isn't XML ({error}); mend it there, or make it anew: xacro FILE.xacro > FILE"
        ) from error
    if robot.tag != "robot":
        raise UrdfError(f"holds a <{robot.tag}> and no <robot>; give a URDF file")
    links: dict[str, tuple[Shape, ...]] = {}
    for element in robot.findall("link"):
        name = _name(element, links)
        links[name] = _bodies(element, f'link "{name}"')
    if not links:
        raise UrdfError("has no link; give the URDF of the robot, not an empty one or a part to include")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = _name(element, joints)
        joints[name] = _joint(element, name)
    for joint in joints.values():
        if joint.mimic and joint.mimic[0] not in joints:
            raise UrdfError(f'joint "{joint.name}" mimics "{joint.mimic[0]}", and there is no such joint')
        if joint.mimic and joints[joint.mimic[0]].mimic:
            raise UrdfError(
                f'joint "{joint.name}" mimics "{joint.mimic[0]}", which mimics another one itself'
            )
    return Description(path, joints, links)


def _name(element: Element, taken: object) -> str:
    name = element.get("name")
    if not name:
        raise UrdfError(f"has a <{element.tag}> without a name")
    if name in taken:  # type: ignore[operator]
        raise UrdfError(f'has two <{element.tag}> of the name "{name}"; names must differ')
    return name


def _joint(element: Element, name: str) -> Joint:
    place, kind = f'joint "{name}"', element.get("type", "")
    if kind not in (*MOVABLE, "fixed"):
        known = ", ".join((*MOVABLE, "fixed"))
        raise UrdfError(f'{place} is of type "{kind}"; joints between palm, base and pads may be {known}')
    parent, child = (_child(element, tag, place).get("link", "") for tag in ("parent", "child"))
    axis = np.array([1.0, 0.0, 0.0])
    if (given := element.find("axis")) is not None:
        axis = np.array(_numbers(given, "xyz", 3, place))
        if kind in MOVABLE and not np.linalg.norm(axis) > 0:
            raise UrdfError(f"{place}: its axis has no length")
        axis /= np.linalg.norm(axis) or 1.0
    lower, upper = -math.inf, math.inf
    if kind in ("revolute", "prismatic") and (given := element.find("limit")) is not None:
        (lower,), (upper,) = (_numbers(given, key, 1, place, "0") for key in ("lower", "upper"))
    mimic = None
    if (given := element.find("mimic")) is not None:
        (factor,) = _numbers(given, "multiplier", 1, place, "1")
        (offset,) = _numbers(given, "offset", 1, place, "0")
        mimic = given.get("joint", ""), factor, offset
    return Joint(name, kind, parent, child, *_origin(element, place), axis, (lower, upper), mimic)


def _bodies(link: Element, place: str) -> tuple[Shape, ...]:
    """Of what it collides with; of what is seen where that isn't told."""
    for tag in ("collision", "visual"):
        if shapes := tuple(_shapes(link, tag, place)):
            return shapes
    return ()


def _shapes(link: Element, tag: str, place: str) -> Iterator[Shape]:
    for element in link.findall(tag):
        at = f"{place}, <{tag}>"
        rotation, translation = _origin(element, at)
        for shape in _child(element, "geometry", at):
            size: tuple[float, ...]
            if shape.tag == "box":
                size = tuple(_numbers(shape, "size", 3, at))
            elif shape.tag in ("cylinder", "capsule"):
                size = _numbers(shape, "radius", 1, at)[0], _numbers(shape, "length", 1, at)[0]
            elif shape.tag == "sphere":
                size = tuple(_numbers(shape, "radius", 1, at))
            elif shape.tag == "mesh":
                size = tuple(_numbers(shape, "scale", 3, at, "1 1 1"))
            else:
                raise UrdfError(
                    f"{at} has a <{shape.tag}>; known are box, cylinder, capsule, sphere and mesh"
                )
            yield Shape(shape.tag, size, rotation, translation, shape.get("filename", ""))


def _origin(element: Element, place: str) -> tuple[FloatArray, FloatArray]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    rpy = _numbers(origin, "rpy", 3, place, "0 0 0")
    return rotation_of(rpy), np.array(_numbers(origin, "xyz", 3, place, "0 0 0"))


def _child(element: Element, tag: str, place: str) -> Element:
    if (found := element.find(tag)) is None:
        raise UrdfError(f"{place} has no <{tag}>")
    return found


def _numbers(element: Element, key: str, count: int, place: str, usual: str | None = None) -> list[float]:
    text = element.get(key, usual)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise UrdfError(f'{place}: <{element.tag} {key}="{text or ""}"> must be {wanted}')
    return numbers
