"""Link frames for Foxglove: from the recorded URDF and joint states, else links in a row.

Public names: `LinkFrames`, `LinkTransform`, `quaternion`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from scipy.spatial.transform import Rotation

from handtouch.arrays import FloatArray
from handtouch.hand import urdf

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
