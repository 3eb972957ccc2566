"""Triangle meshes of link bodies and pads, for the page.

Public names: `TriangleMesh`, `body_mesh`, `pad_mesh`, `outline_m`, `to_base64`. Metres; triangles are
counter-clockwise seen from outside.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field.surface_base import Surface
from handtouch.hand.body_distance import find_mesh, load_triangles
from handtouch.hand.urdf import BodyShape

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
