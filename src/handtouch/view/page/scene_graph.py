"""Scene graph of a deployment for the page: links with their bodies, pads on them, and a camera.

Public names: `scene_of`. Plain values for JSON; metres, radians, rotations row by row. Without a URDF the
pads of a hand stand side by side, each facing the viewer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.config import Deployment, HandTable, Pad
from handtouch.hand import urdf
from handtouch.hand.pads import mount_transform, pad_surface
from handtouch.hand.urdf import RobotDescription
from handtouch.host.installation import extra_command
from handtouch.view.page.meshes import (
    TriangleMesh,
    body_mesh,
    outline_m,
    pad_mesh,
    to_base64,
)

Pose = tuple[FloatArray, FloatArray]
_MAX_CORNERS = 150_000
"""Corners of a link's visual shapes above which its collision shapes are drawn: 50,000 triangles, 3.6 MB"""
_HAND_SPACING_M = 0.06
"""Between hands."""
_PAD_GAP_M = 0.008
_CAMERA_SIDE_OFFSET, _CAMERA_HEIGHT_OFFSET = 0.75, 0.3
"""Offset of the camera from the mean pad normal over its distance: curled fingers hide less then."""
_VIEWER_ROTATION = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).T
"""Rotation of a pad without a URDF: its x points up, its z to a viewer at -y."""


class _SceneGraph:
    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.poses: list[Pose] = []
        """in the world frame, with all joints at 0"""
        self.bodies: list[dict[str, Any]] = []
        self.pads: list[dict[str, Any]] = []
        self.columns: list[list[int]] = []
        self.points: list[FloatArray] = []
        self.faces: list[tuple[FloatArray, FloatArray]] = []
        """centre of each pad and its normal"""
        self.problems: list[str] = []
        self.palms: dict[str, int] = {}
        """node of each hand's palm, of hands with a URDF"""

    def add_node(self, parent: int, pose: Pose, **joint: Any) -> int:
        rotation, translation = pose
        above = self.poses[parent] if parent >= 0 else (np.eye(3), np.zeros(3))
        self.poses.append((above[0] @ rotation, above[0] @ translation + above[1]))
        self.nodes.append(
            {
                "parent": parent,
                "rotation": rotation.ravel().tolist(),
                "translation": translation.tolist(),
                **joint,
            }
        )
        return len(self.nodes) - 1

    def add_body(self, node: int, mesh: TriangleMesh) -> None:
        rotation, translation = self.poses[node]
        self.points.append(mesh.corners_m @ rotation.T + translation)
        self.bodies.append({"node": node, **to_base64(mesh)})

    def add_pad(self, hand: HandTable, pad: Pad, node: int) -> int:
        surface, (turn, at) = pad_surface(pad), mount_transform(pad)
        mesh = pad_mesh(surface, turn, at)
        rotation, translation = self.poses[node]
        self.points.append(mesh.corners_m @ rotation.T + translation)
        self.faces.append((rotation @ at + translation, rotation @ turn[:, 2]))
        self.pads.append(
            {
                "key": f"{hand.name}/{pad.link}",
                "link": pad.link,
                "hand": hand.name,
                "name": pad.link,
                "node": node,
                "centre": at.tolist(),
                "outline": outline_m(surface).round(6).tolist(),
                "node_text": f"node {pad.node_id} on {pad.bus}",
                **to_base64(mesh),
            }
        )
        return len(self.pads) - 1


def scene_of(deployment: Deployment, files: dict[str, bytes]) -> dict[str, Any]:
    """Return the scene; `files` (path -> bytes) are those named in the deployment."""
    scene = _SceneGraph()
    offset = 0.0
    for hand in deployment.hands:
        first = len(scene.points)
        robot = _parse_robot(hand, files, scene.problems)
        numbers = _add_robot(scene, hand, robot, offset) if robot else _add_row(scene, hand, offset)
        across = np.concatenate(scene.points[first:])[:, 1]
        offset = float(across.max()) + _HAND_SPACING_M
        scene.columns.extend(numbers)
    if len(deployment.hands) > 1:
        for shown in scene.pads:
            shown["name"] = shown["key"]
    camera, right = _camera(scene)
    middle = [np.mean([scene.faces[pad][0] @ right for pad in column]) for column in scene.columns]
    return {
        "nodes": scene.nodes,
        "bodies": scene.bodies,
        "pads": scene.pads,
        "columns": [scene.columns[k] for k in np.argsort(middle)],
        "camera": camera,
        "problems": scene.problems,
        "palms": scene.palms,
    }


def _parse_robot(hand: HandTable, files: dict[str, bytes], problems: list[str]) -> RobotDescription | None:
    if not hand.urdf or hand.urdf not in files:
        return None
    try:
        return urdf.parse_urdf(files[hand.urdf], Path(hand.urdf))
    except urdf.UrdfError as error:
        problems.append(f"{hand.name}: {hand.urdf} {error}; its pads are shown side by side")
        return None


def _add_robot(
    scene: _SceneGraph, hand: HandTable, robot: RobotDescription, offset_m: float
) -> list[list[int]]:
    numbers = {robot.root: scene.add_node(-1, (np.eye(3), np.array([0.0, offset_m, 0.0])))}
    waiting = list(robot.joints.values())
    while waiting:  # a parent may come later in the file than its child
        waiting = [joint for joint in waiting if not _add_joint(scene, hand, joint, numbers)]
    scene.palms[hand.name] = numbers[hand.palm_link or robot.root]
    missing: list[str] = []
    for link, number in numbers.items():
        for mesh in _body_meshes(robot, link, missing):
            scene.add_body(number, mesh)
    if missing:
        scene.problems.append(
            f"{hand.name}: {len(missing)} meshes can't be loaded, such as {missing[0]}; put them beside the "
            f"URDF, and {extra_command('view')}"
        )
    return _group_by_digit(
        hand, [scene.add_pad(hand, pad, numbers[pad.mount.link or pad.link]) for pad in hand.pads]
    )


def _body_meshes(robot: RobotDescription, link: str, missing: list[str]) -> list[TriangleMesh]:
    """Return the visual shapes of a link where all can be loaded and drawn, else its collision shapes.

    `missing` is extended by the files of collision shapes that can't be loaded.
    """
    folder = robot.path.parent
    seen = [body_mesh(shape, folder) for shape in robot.visible.get(link, ())]
    loaded = [mesh for mesh in seen if mesh is not None]
    if loaded and len(loaded) == len(seen) and sum(len(mesh.corners_m) for mesh in loaded) < _MAX_CORNERS:
        return loaded
    found = [(shape, body_mesh(shape, folder)) for shape in robot.bodies[link]]
    missing.extend(shape.file for shape, mesh in found if mesh is None)
    return [mesh for _, mesh in found if mesh is not None]


def _add_joint(scene: _SceneGraph, hand: HandTable, joint: urdf.UrdfJoint, numbers: dict[str, int]) -> bool:
    if joint.parent not in numbers:
        return False
    moved: dict[str, Any] = {}
    if joint.kind in urdf.MOVABLE_JOINT_TYPES:
        name, factor, offset = joint.mimic or (joint.name, 1.0, 0.0)
        moved = {
            "joint": f"{hand.name}/{name}",
            "factor": factor,
            "offset": offset,
            "axis": joint.axis.tolist(),
            "prismatic": joint.kind == "prismatic",
        }
    pose = joint.rotation, joint.translation_m
    numbers[joint.child] = scene.add_node(numbers[joint.parent], pose, **moved)
    return True


def _add_row(scene: _SceneGraph, hand: HandTable, offset_m: float) -> list[list[int]]:
    """Place the pads of a hand without a URDF side by side, those of one digit above one another."""
    sizes = [np.ptp(outline_m(pad_surface(pad)), axis=0) for pad in hand.pads]
    columns, x = _group_by_digit(hand, range(len(hand.pads))), 0.0
    first = len(scene.pads)
    for column in columns:
        width = max(sizes[k][1] for k in column)
        z = 0.0
        for k in column:
            turn, at = mount_transform(hand.pads[k])
            middle = np.array([x + width / 2, offset_m, z + sizes[k][0] / 2])
            rotation = _VIEWER_ROTATION @ turn.T
            scene.add_pad(hand, hand.pads[k], scene.add_node(-1, (rotation, middle - rotation @ at)))
            z += sizes[k][0] + _PAD_GAP_M
        x += width + _PAD_GAP_M
    order = [k for column in columns for k in column]
    return [[first + order.index(k) for k in column] for column in columns]


def _group_by_digit(hand: HandTable, numbers: Any) -> list[list[int]]:
    """Group numbers of pads by digit, the first part of the link name."""
    digits: dict[str, list[int]] = {}
    for pad, number in zip(hand.pads, numbers, strict=True):
        digits.setdefault(pad.link.split("_")[0], []).append(number)
    return list(digits.values())


def _camera(scene: _SceneGraph) -> tuple[dict[str, Any], FloatArray]:
    """Return the camera, and the direction that is right in its image."""
    facing = np.mean([normal for _, normal in scene.faces], axis=0)
    facing[2] = 0.0
    long = float(np.linalg.norm(facing))
    toward = facing / long if long > 0.05 else np.array([0.0, -1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(up, toward)
    flat = all(node["parent"] < 0 for node in scene.nodes)
    toward = (
        toward + (0 if flat else _CAMERA_SIDE_OFFSET) * right + (0.05 if flat else _CAMERA_HEIGHT_OFFSET) * up
    )
    toward /= np.linalg.norm(toward)
    right = np.cross(up, toward) / np.linalg.norm(np.cross(up, toward))
    axes = np.stack([right, np.cross(toward, right), toward])
    seen = np.concatenate(scene.points) @ axes.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    far = float(np.linalg.norm(seen - middle, axis=1).max())
    return {"centre": (middle @ axes).tolist(), "direction": toward.tolist(), "radius": far}, right
