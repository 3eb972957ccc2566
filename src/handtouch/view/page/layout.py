"""What the page draws of a deployment: links with their bodies, pads on them, and where to look from.

Public names: `describe`. Plain values for JSON; metres, radians, rotations row by row. Without a URDF the
pads of a hand stand side by side, each facing the viewer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment, Hand, Pad
from handtouch.hand import urdf
from handtouch.hand.pads import mount_of, surface_of
from handtouch.hand.urdf import Description
from handtouch.view.page.meshes import Mesh, body_mesh, outline_m, packed, pad_mesh

FloatArray = NDArray[np.float64]
Pose = tuple[FloatArray, FloatArray]
_BETWEEN_M = 0.06
"""Between hands; pads that stand in a row are nearer."""
_GAP_M = 0.008
_ASIDE, _ABOVE = 0.75, 0.3
"""The viewer stands a little to the side of what most pads face, and above: curled fingers hide less so."""
_FACING = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).T
"""Of a pad without a URDF: its x points up, its z to a viewer at -y."""


class _Scene:
    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.poses: list[Pose] = []
        """in the world, joints at 0"""
        self.bodies: list[dict[str, Any]] = []
        self.pads: list[dict[str, Any]] = []
        self.columns: list[list[int]] = []
        self.points: list[FloatArray] = []
        self.faces: list[tuple[FloatArray, FloatArray]] = []
        """middle of each pad and its normal"""
        self.problems: list[str] = []

    def node(self, parent: int, pose: Pose, **joint: Any) -> int:
        rotation, translation = pose
        above = self.poses[parent] if parent >= 0 else (np.eye(3), np.zeros(3))
        self.poses.append((above[0] @ rotation, above[0] @ translation + above[1]))
        self.nodes.append(
            {"parent": parent, "turn": rotation.ravel().tolist(), "at": translation.tolist(), **joint}
        )
        return len(self.nodes) - 1

    def body(self, node: int, mesh: Mesh) -> None:
        rotation, translation = self.poses[node]
        self.points.append(mesh.corners_m @ rotation.T + translation)
        self.bodies.append({"node": node, **packed(mesh)})

    def pad(self, hand: Hand, pad: Pad, node: int) -> int:
        surface, (turn, at) = surface_of(pad), mount_of(pad)
        mesh = pad_mesh(surface, turn, at)
        rotation, translation = self.poses[node]
        self.points.append(mesh.corners_m @ rotation.T + translation)
        self.faces.append((rotation @ at + translation, rotation @ turn[:, 2]))
        self.pads.append(
            {
                "key": f"{hand.name}/{pad.link}",
                "link": pad.link,
                "node": node,
                "middle": at.tolist(),
                "outline": outline_m(surface).round(6).tolist(),
                "where": f"node {pad.node_id} on {pad.bus}",
                **packed(mesh),
            }
        )
        return len(self.pads) - 1


def describe(deployment: Deployment, files: dict[str, bytes]) -> dict[str, Any]:
    """The scene; `files` (path -> bytes) are those that the deployment names."""
    scene = _Scene()
    offset = 0.0
    for hand in deployment.hands:
        first = len(scene.points)
        robot = _robot(hand, files, scene.problems)
        numbers = _with_robot(scene, hand, robot, offset) if robot else _in_a_row(scene, hand, offset)
        across = np.concatenate(scene.points[first:])[:, 1]
        offset = float(across.max()) + _BETWEEN_M
        scene.columns.extend(numbers)
    camera, right = _camera(scene)
    middle = [np.mean([scene.faces[pad][0] @ right for pad in column]) for column in scene.columns]
    return {
        "nodes": scene.nodes,
        "bodies": scene.bodies,
        "pads": scene.pads,
        "columns": [scene.columns[k] for k in np.argsort(middle)],
        "camera": camera,
        "problems": scene.problems,
    }


def _robot(hand: Hand, files: dict[str, bytes], problems: list[str]) -> Description | None:
    if not hand.urdf or hand.urdf not in files:
        return None
    try:
        return urdf.parse(files[hand.urdf], Path(hand.urdf))
    except urdf.UrdfError as error:
        problems.append(f"{hand.name}: {hand.urdf} {error}; its pads are shown side by side")
        return None


def _with_robot(scene: _Scene, hand: Hand, robot: Description, offset_m: float) -> list[list[int]]:
    numbers = {robot.root: scene.node(-1, (np.eye(3), np.array([0.0, offset_m, 0.0])))}
    waiting = list(robot.joints.values())
    while waiting:  # a parent may come later in the file than its child
        waiting = [joint for joint in waiting if not _add_joint(scene, hand, joint, numbers)]
    missing = []
    for link, number in numbers.items():
        for shape in robot.bodies[link]:
            mesh = body_mesh(shape, robot.path.parent)
            if mesh is None:
                missing.append(shape.file)
            else:
                scene.body(number, mesh)
    if missing:
        scene.problems.append(
            f"{hand.name}: {len(missing)} meshes can't be read here, such as {missing[0]}; they are looked "
            "for beside the URDF, and read with pip install 'handtouch[view]'"
        )
    return _columns(hand, [scene.pad(hand, pad, numbers[pad.mount.link or pad.link]) for pad in hand.pads])


def _add_joint(scene: _Scene, hand: Hand, joint: urdf.Joint, numbers: dict[str, int]) -> bool:
    if joint.parent not in numbers:
        return False
    moved: dict[str, Any] = {}
    if joint.kind in urdf.MOVABLE:
        name, factor, offset = joint.mimic or (joint.name, 1.0, 0.0)
        moved = {
            "joint": f"{hand.name}/{name}",
            "factor": factor,
            "offset": offset,
            "axis": joint.axis.tolist(),
            "slides": joint.kind == "prismatic",
        }
    pose = joint.rotation, joint.translation_m
    numbers[joint.child] = scene.node(numbers[joint.parent], pose, **moved)
    return True


def _in_a_row(scene: _Scene, hand: Hand, offset_m: float) -> list[list[int]]:
    """Pads of a hand without a URDF: those whose names begin alike above one another."""
    sizes = [np.ptp(outline_m(surface_of(pad)), axis=0) for pad in hand.pads]
    columns, x = _columns(hand, range(len(hand.pads))), 0.0
    first = len(scene.pads)
    for column in columns:
        width = max(sizes[k][1] for k in column)
        z = 0.0
        for k in column:
            turn, at = mount_of(hand.pads[k])
            middle = np.array([x + width / 2, offset_m, z + sizes[k][0] / 2])
            rotation = _FACING @ turn.T
            scene.pad(hand, hand.pads[k], scene.node(-1, (rotation, middle - rotation @ at)))
            z += sizes[k][0] + _GAP_M
        x += width + _GAP_M
    order = [k for column in columns for k in column]
    return [[first + order.index(k) for k in column] for column in columns]


def _columns(hand: Hand, numbers: Any) -> list[list[int]]:
    """Numbers of pads, those of one digit together: their names begin alike."""
    digits: dict[str, list[int]] = {}
    for pad, number in zip(hand.pads, numbers, strict=True):
        digits.setdefault(pad.link.split("_")[0], []).append(number)
    return list(digits.values())


def _camera(scene: _Scene) -> tuple[dict[str, Any], FloatArray]:
    """Where to look from, and which way is right there."""
    facing = np.mean([normal for _, normal in scene.faces], axis=0)
    facing[2] = 0.0
    long = float(np.linalg.norm(facing))
    toward = facing / long if long > 0.05 else np.array([0.0, -1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(up, toward)
    flat = all(node["parent"] < 0 for node in scene.nodes)
    toward = toward + (0 if flat else _ASIDE) * right + (0.05 if flat else _ABOVE) * up
    toward /= np.linalg.norm(toward)
    right = np.cross(up, toward) / np.linalg.norm(np.cross(up, toward))
    axes = np.stack([right, np.cross(toward, right), toward])
    seen = np.concatenate(scene.points) @ axes.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    far = float(np.linalg.norm(seen - middle, axis=1).max())
    return {"middle": (middle @ axes).tolist(), "toward": toward.tolist(), "radius": far}, right
