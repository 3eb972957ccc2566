"""Bodies of links and pads as triangles for the page to draw.

Public names: `Mesh`, `body_mesh`, `pad_mesh`, `outline_m`, `packed`. Metres; triangles wind counter-clockwise
seen from outside.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.field.surface import Surface
from handtouch.hand.body import find_mesh, triangles_of
from handtouch.hand.urdf import Shape

FloatArray = NDArray[np.float64]
_ROUND = 40
"""Corners of a circle."""
_GRID = 14
"""Patches of a pad along each side."""
_LIFT_M = 4e-4
"""A pad is drawn so far above its body, which it would flicker through otherwise."""


class Mesh(NamedTuple):
    """Triangles as corners and their normals, (3k, 3) each."""

    corners_m: FloatArray
    normals: FloatArray


def body_mesh(shape: Shape, folder: Path) -> Mesh | None:
    """A shape of a link in the link's frame; None for a mesh file that can't be found or read."""
    made = _of(shape, folder)
    if made is None:
        return None
    return Mesh(made.corners_m @ shape.rotation.T + shape.translation_m, made.normals @ shape.rotation.T)


def pad_mesh(surface: Surface, rotation: FloatArray, translation_m: FloatArray) -> Mesh:
    """The sensing surface of a pad, in the frame of its link."""
    x, y = np.meshgrid(np.linspace(0, surface.a, _GRID + 1), np.linspace(0, surface.b, _GRID + 1))
    points = np.moveaxis(surface.point(x, y), 0, -1)
    along, around = surface.tangents(x, y)
    normals = np.moveaxis(np.cross(along, around, axis=0), 0, -1)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    flat = _quads(points + _LIFT_M * normals, normals)
    return Mesh(flat.corners_m @ rotation.T + translation_m, flat.normals @ rotation.T)


def outline_m(surface: Surface) -> FloatArray:
    """The pad's edge unrolled, (k, 2): arc length from x0, and across from the middle line."""
    x = np.linspace(0, surface.a, _GRID + 1)
    u, widest = surface.from_rectangle(x, np.full_like(x, surface.b))
    upper = np.stack([u, widest / 2], axis=1)
    return np.concatenate([upper, (upper * [1, -1])[::-1]])


def packed(mesh: Mesh) -> dict[str, str]:
    """For JSON: little-endian float32 in base64."""
    return {
        name: base64.b64encode(values.astype("<f4").tobytes()).decode()
        for name, values in (("corners", mesh.corners_m), ("normals", mesh.normals))
    }


def _of(shape: Shape, folder: Path) -> Mesh | None:
    """In the shape's own frame."""
    if shape.kind == "mesh":
        path = find_mesh(shape.file, folder)
        triangles = triangles_of(path, shape.size_m) if path else None
        return None if triangles is None else _faceted(triangles)
    if shape.kind == "box":
        return _box(np.array(shape.size_m) / 2)
    quarter = np.linspace(0, np.pi / 2, 9)
    if shape.kind == "sphere":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return _turned(shape.size_m[0] * circle, circle)
    radius, length = shape.size_m
    top = np.array([0.0, length / 2])
    if shape.kind == "capsule":
        upper = np.stack([np.cos(quarter), np.sin(quarter)], axis=1)
        profile = np.concatenate([(radius * upper + top)[::-1] * [1, -1], radius * upper + top])
        return _turned(profile, np.concatenate([upper[::-1] * [1, -1], upper]))
    side = _turned(np.array([[radius, -length / 2], [radius, length / 2]]), np.array([[1.0, 0], [1, 0]]))
    caps = [
        _turned(np.array([[0, end], [radius, end]])[::sign], np.array([[0.0, -sign], [0, -sign]]))
        for sign, end in ((1, -length / 2), (-1, length / 2))
    ]
    return Mesh(*(np.concatenate(parts) for parts in zip(side, *caps, strict=True)))


def _turned(profile: FloatArray, normals: FloatArray) -> Mesh:
    """A profile (k, 2) of distance from z and height, turned about z; its inside is to the left."""
    angle = np.linspace(0, 2 * np.pi, _ROUND + 1)[:, None]

    def turn(line: FloatArray) -> FloatArray:
        height = np.broadcast_to(line[:, 1], (len(angle), len(line)))
        return np.stack([np.cos(angle) * line[:, 0], np.sin(angle) * line[:, 0], height], axis=-1)

    points, directions = turn(profile), turn(normals)
    return _quads(points.swapaxes(0, 1), directions.swapaxes(0, 1))


def _quads(points: FloatArray, normals: FloatArray) -> Mesh:
    """Triangles of a grid (n, m, 3)."""

    def corners(grid: FloatArray) -> FloatArray:
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        return np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3)

    return Mesh(corners(points), corners(normals))


def _box(half: FloatArray) -> Mesh:
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.roll(np.eye(3), axis, axis=1)[1:]
            square = np.array([-u - v, u - v, u + v, -u - v, u + v, -u + v])[:: int(sign)]
            faces.append((square + sign * np.eye(3)[axis]) * half)
    return _faceted(np.concatenate(faces).reshape(-1, 3, 3))


def _faceted(triangles: FloatArray) -> Mesh:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(triangles.reshape(-1, 3), np.repeat(normals / np.where(length > 0, length, 1.0), 3, axis=0))
