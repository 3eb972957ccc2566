"""Scene graph of a deployment for the page: links with their bodies, pads on them, and a camera.

Public names: `scene_of`; `TriangleMesh`, `body_mesh`, `pad_mesh`, `outline_m`, `to_base64`. Plain values for
JSON; metres, radians, rotations row by row; triangles are counter-clockwise seen from outside. Without a URDF
the pads of a hand stand side by side, each facing the viewer.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.config import Deployment, HandTable, Pad
from handtouch.field.surface_base import Surface
from handtouch.hand import urdf
from handtouch.hand.body_distance import find_mesh, load_triangles
from handtouch.hand.pads import mount_transform, pad_surface
from handtouch.hand.urdf import BodyShape, RobotDescription
from handtouch.host.installation import extra_command

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


_CIRCLE_SEGMENTS = 40
"""Segments of a circle."""
_PAD_GRID_CELLS = 14
"""Cells of a pad along each side."""
_PAD_OFFSET_M = 4e-4
"""Distance of a pad from its body, against z-fighting."""


class TriangleMesh(NamedTuple):
    """Triangles as corners and their normals, (3k, 3) each."""

    corners_m: FloatArray
    normals: FloatArray


def body_mesh(shape: BodyShape, folder: Path) -> TriangleMesh | None:
    """Return a shape of a link in the link's frame; None for a missing or unreadable mesh file."""
    made = _shape_mesh(shape, folder)
    if made is None:
        return None
    return TriangleMesh(
        made.corners_m @ shape.rotation.T + shape.translation_m, made.normals @ shape.rotation.T
    )


def pad_mesh(surface: Surface, rotation: FloatArray, translation_m: FloatArray) -> TriangleMesh:
    """Return the sensing surface of a pad, in the frame of its link."""
    x, y = np.meshgrid(*surface.grid_lines(_PAD_GRID_CELLS))
    points = np.moveaxis(surface.point(x, y), 0, -1)
    along, around = surface.tangents(x, y)
    normals = np.moveaxis(np.cross(along, around, axis=0), 0, -1)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    flat = _triangulate_grid(points + _PAD_OFFSET_M * normals, normals)
    return TriangleMesh(flat.corners_m @ rotation.T + translation_m, flat.normals @ rotation.T)


def outline_m(surface: Surface) -> FloatArray:
    """Return the edge of the unrolled pad, (k, 2): arc length from x0, and distance from the centre line."""
    return surface.edge_m(_PAD_GRID_CELLS)


def to_base64(mesh: TriangleMesh) -> dict[str, str]:
    """Encode a mesh for JSON: little-endian float32 in base64."""
    return {
        name: base64.b64encode(values.astype("<f4").tobytes()).decode()
        for name, values in (("corners", mesh.corners_m), ("normals", mesh.normals))
    }


def _shape_mesh(shape: BodyShape, folder: Path) -> TriangleMesh | None:
    """Return a shape's mesh in its own frame."""
    if shape.kind == "mesh":
        path = find_mesh(shape.file, folder)
        triangles = load_triangles(path, shape.size_m) if path else None
        return None if triangles is None else _flat_shaded(triangles)
    if shape.kind == "box":
        return _box_mesh(np.array(shape.size_m) / 2)
    quarter = np.linspace(0, np.pi / 2, 9)
    if shape.kind == "sphere":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return _revolve(shape.size_m[0] * circle, circle)
    radius, length = shape.size_m
    top = np.array([0.0, length / 2])
    if shape.kind == "capsule":
        upper = np.stack([np.cos(quarter), np.sin(quarter)], axis=1)
        profile = np.concatenate([(radius * upper + top)[::-1] * [1, -1], radius * upper + top])
        return _revolve(profile, np.concatenate([upper[::-1] * [1, -1], upper]))
    side = _revolve(np.array([[radius, -length / 2], [radius, length / 2]]), np.array([[1.0, 0], [1, 0]]))
    caps = [
        _revolve(np.array([[0, end], [radius, end]])[::sign], np.array([[0.0, -sign], [0, -sign]]))
        for sign, end in ((1, -length / 2), (-1, length / 2))
    ]
    return TriangleMesh(*(np.concatenate(parts) for parts in zip(side, *caps, strict=True)))


def _revolve(profile: FloatArray, normals: FloatArray) -> TriangleMesh:
    """Revolve a profile (k, 2) of distance from z and height about z; its inside is to the left."""
    angle = np.linspace(0, 2 * np.pi, _CIRCLE_SEGMENTS + 1)[:, None]

    def turn(line: FloatArray) -> FloatArray:
        height = np.broadcast_to(line[:, 1], (len(angle), len(line)))
        return np.stack([np.cos(angle) * line[:, 0], np.sin(angle) * line[:, 0], height], axis=-1)

    points, directions = turn(profile), turn(normals)
    return _triangulate_grid(points.swapaxes(0, 1), directions.swapaxes(0, 1))


def _triangulate_grid(points: FloatArray, normals: FloatArray) -> TriangleMesh:
    """Return the triangles of a grid (n, m, 3)."""

    def corners(grid: FloatArray) -> FloatArray:
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        return np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3)

    return TriangleMesh(corners(points), corners(normals))


def _box_mesh(half: FloatArray) -> TriangleMesh:
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.roll(np.eye(3), axis, axis=1)[1:]
            square = np.array([-u - v, u - v, u + v, -u - v, u + v, -u + v])[:: int(sign)]
            faces.append((square + sign * np.eye(3)[axis]) * half)
    return _flat_shaded(np.concatenate(faces).reshape(-1, 3, 3))


def _flat_shaded(triangles: FloatArray) -> TriangleMesh:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return TriangleMesh(
        triangles.reshape(-1, 3), np.repeat(normals / np.where(length > 0, length, 1.0), 3, axis=0)
    )
