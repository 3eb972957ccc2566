"""Where links are, for Foxglove: by the URDFs of the recorded deployment and the joints, else in a row.

Public names: `Links`, `Frame`, `quaternion`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.hand import urdf

FloatArray = NDArray[np.float64]
ROOT = "handtouch"
_BETWEEN_M = 0.3
"""From one hand to the next."""
_SPACING_M = 0.05
"""From link to link where nobody tells how they are mounted."""


class Frame(NamedTuple):
    """A frame in its parent; rotation as x, y, z, w."""

    parent: str
    child: str
    translation_m: tuple[float, ...]
    rotation: tuple[float, ...]


class Links:
    """Takes payloads of `config`, `service` and `joints`; gives frames, and the bodies of links."""

    def __init__(self) -> None:
        self._hands: dict[str, list[str]] = {}
        self._robots: dict[str, urdf.Description] = {}
        self._joints: dict[str, dict[str, float]] = {}

    def configure(self, payload: dict[str, Any]) -> None:
        """Take the robots of a deployment. One that can't be read is as if there were none."""
        told = json.loads(payload["deployment"])
        self._robots.clear()
        for hand in told["hand"]:
            data = payload["files"].get(hand.get("urdf"))
            if data is None:
                continue
            try:
                self._robots[hand["name"]] = urdf.parse(data, Path(hand["urdf"]))
            except urdf.UrdfError:  # the daemon has told its user; links stand in a row
                continue

    def tell(self, hands: dict[str, list[str]]) -> None:
        """Links of each hand that carry pads."""
        self._hands = hands

    def move(self, payload: dict[str, Any]) -> None:
        """Joints of a hand have moved."""
        known = zip(payload["names"], payload["position_rad"], strict=True)
        self._joints[payload["hand"]] = {name: value for name, value in known if value is not None}

    def name(self, hand: str, link: str) -> str:
        """Of a link's frame: with the hand's where there are several."""
        return link if len(self._hands) < 2 else f"{hand}/{link}"

    def frames(self, moved: str = "") -> Iterator[Frame]:
        """All frames, or those of a hand that moved, which follow from its joints."""
        for number, (hand, links) in enumerate(self._hands.items()):
            if moved and hand != moved:
                continue
            robot = self._robots.get(hand)
            if robot is None:
                if not moved:
                    for place, link in enumerate(links):
                        at = place * _SPACING_M, number * _SPACING_M, 0.0
                        yield Frame(ROOT, self.name(hand, link), at, (0.0, 0.0, 0.0, 1.0))
                continue
            if not moved:
                at = 0.0, number * _BETWEEN_M, 0.0
                yield Frame(ROOT, self.name(hand, robot.root), at, (0.0, 0.0, 0.0, 1.0))
            for joint in robot.joints.values():
                if not moved or joint.kind in urdf.MOVABLE:
                    yield self._frame(hand, joint)

    def bodies(self) -> Iterator[tuple[str, list[urdf.Shape]]]:
        """Frame and shapes of each link that has some."""
        for hand, robot in self._robots.items():
            for link, shapes in robot.bodies.items():
                if shapes:
                    yield self.name(hand, link), list(shapes)

    def _frame(self, hand: str, joint: urdf.Joint) -> Frame:
        rotation, translation = joint.rotation, joint.translation_m
        if joint.kind in urdf.MOVABLE:
            name, factor, offset = joint.mimic or (joint.name, 1.0, 0.0)
            at = factor * self._joints.get(hand, {}).get(name, 0.0) + offset
            if joint.kind == "prismatic":
                translation = translation + rotation @ joint.axis * at
            else:
                rotation = rotation @ _turn(joint.axis, at)
        parent, child = self.name(hand, joint.parent), self.name(hand, joint.child)
        return Frame(parent, child, tuple(translation.tolist()), quaternion(rotation))


def quaternion(rotation: FloatArray) -> tuple[float, ...]:
    """x, y, z, w of a rotation matrix (3, 3); w isn't negative."""
    # the eigenvector of Bar-Itzhack's matrix for its largest eigenvalue, which is sound for every rotation
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    k = [
        [a - e - i, 0, 0, 0],
        [d + b, e - a - i, 0, 0],
        [g + c, h + f, i - a - e, 0],
        [h - f, c - g, d - b, a + e + i],
    ]
    found = np.linalg.eigh(np.array(k) / 3)[1][:, -1]
    return tuple((found * math.copysign(1.0, found[3])).tolist())


def _turn(axis: FloatArray, angle: float) -> FloatArray:
    """Rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
