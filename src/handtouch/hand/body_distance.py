"""Signed distance of a point from the body of a link: negative inside.

Public names: `signed_distance_m`, `squared_distance_from_triangles`, `find_mesh`, `load_triangles`,
`unreadable_mesh`, `can_read_meshes`. Meshes are read by Coal, the extra `handtouch[urdf]`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.hand.urdf import BodyShape

_LFS_POINTER = b"version https://git-lfs"


def signed_distance_m(shapes: Sequence[BodyShape], points_m: FloatArray, folder: Path) -> FloatArray:
    """Return the signed distance (n,) of points (n, 3) in the link frame from the union of its shapes.

    Exact outside; inside a union a bound on the depth. Infinite without shapes; meshes that can't be found or
    read are skipped.
    """
    found = np.full(len(points_m), np.inf)
    for shape in shapes:
        local = (points_m - shape.translation_m) @ shape.rotation
        found = np.minimum(found, _distance_from_shape(shape, local, folder))
    return found


def find_mesh(file: str, folder: Path) -> Path | None:
    """Return the file of a mesh that a description in `folder` names by a path, file:// or package://.

    A package is searched beside the description and beside each folder above it, then by ROS's paths.
    """
    scheme, _, path = file.rpartition("://")
    if scheme == "package":
        package, _, inside = path.partition("/")
        places = [above / path for above in (folder, *folder.resolve().parents)]
        places += [prefix / "share" / path for prefix in _folders_of("AMENT_PREFIX_PATH")]
        for place in _folders_of("ROS_PACKAGE_PATH"):
            places += [place / path, *([place / inside] if place.name == package else [])]
    else:
        places = [folder / path]
    return next((place for place in places if place.is_file()), None)


def _folders_of(variable: str) -> list[Path]:
    """Return the folders that an environment variable lists."""
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def unreadable_mesh(path: Path, scale: tuple[float, ...]) -> str:
    """Return why a mesh can't be read, empty if it can."""
    if load_triangles(path, scale) is not None:
        return ""
    with path.open("rb") as file:
        is_pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
    if is_pointer:
        return f"{path} is a Git LFS pointer; run git lfs pull"
    return f"{path} can't be read; convert it to STL, OBJ or COLLADA"


def _unit_m(path: Path) -> float:
    """Return the length of a mesh file's unit [m]: as COLLADA states it, else 1."""
    if path.suffix.lower() != ".dae":
        return 1.0
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag.rpartition("}")[2] == "unit":
                return float(element.get("meter", "1"))
    except (ElementTree.ParseError, ValueError):
        return 1.0
    return 1.0


def _distance_from_shape(shape: BodyShape, points: FloatArray, folder: Path) -> FloatArray:
    """Return the distance of points (n, 3) in the shape's own frame.

    After I. Quilez, "Distance functions" (primitives).
    """
    if shape.kind == "sphere":
        return np.asarray(np.linalg.norm(points, axis=1) - shape.size_m[0])
    if shape.kind == "box":
        return _distance_from_excess(np.abs(points) - np.array(shape.size_m) / 2)
    if shape.kind == "mesh":
        path = find_mesh(shape.file, folder)
        triangles = load_triangles(path, shape.size_m) if path else None
        return (
            np.full(len(points), np.inf) if triangles is None else _distance_from_triangles(triangles, points)
        )
    radius, length = shape.size_m
    around, along = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2]) - length / 2
    if shape.kind == "capsule":
        return np.asarray(np.hypot(around, np.maximum(along, 0.0)) - radius)
    return _distance_from_excess(np.stack([around - radius, along], axis=1))


def _distance_from_excess(excess: FloatArray) -> FloatArray:
    """Return the distance from a box or cylinder, given each coordinate's excess over its size (n, k)."""
    return np.asarray(np.linalg.norm(np.maximum(excess, 0.0), axis=1) + np.minimum(excess.max(axis=1), 0.0))


def can_read_meshes() -> bool:
    """Return True if Coal is installed."""
    return find_spec("coal") is not None


@lru_cache(maxsize=64)
def load_triangles(path: Path, scale: tuple[float, ...]) -> FloatArray | None:
    """Return the corners (k, 3, 3) of a mesh; None if Coal isn't installed or can't read it."""
    try:
        import coal
    except ImportError:
        return None
    try:
        mesh = coal.MeshLoader().load(str(path), np.array(scale) * _unit_m(path))
    except (ValueError, RuntimeError):
        return None
    corners = np.asarray(mesh.vertices(), np.float64)
    numbers = [[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)]
    return np.asarray(corners[np.array(numbers, dtype=np.intp)]) if numbers else None


def _distance_from_triangles(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Return distances, signed by the winding number: the sum of solid angles.

    Van Oosterom and Strackee, 1983.
    """
    found = []
    for point in points:
        a, b, c = (triangles - point).transpose(1, 0, 2)
        near = np.sqrt(squared_distance_from_triangles(a, b, c).min())
        la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
        dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        solid = 2 * np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
        found.append(-near if abs(solid.sum()) > 2 * np.pi else near)
    return np.array(found)


def squared_distance_from_triangles(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return squared distances (k,) of the origin from triangles: from the interior, or the nearest edge."""
    sides = np.stack(
        [
            _squared_distance_from_edges(a, b),
            _squared_distance_from_edges(b, c),
            _squared_distance_from_edges(c, a),
        ]
    ).min(axis=0)
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = np.einsum("ij,ij->i", normal, a) / square
    foot = height[:, None] * normal
    turns = [np.einsum("ij,ij->i", np.cross(v - u, foot - u), normal) for u, v in ((a, b), (b, c), (c, a))]
    over = (np.stack(turns) >= 0).all(axis=0) & (square > 0)
    return np.asarray(np.where(over, height**2 * square, sides))


def _squared_distance_from_edges(u: FloatArray, v: FloatArray) -> FloatArray:
    """Return squared distances of the origin from the edges u to v."""
    way = v - u
    square = np.einsum("ij,ij->i", way, way)
    part = -np.einsum("ij,ij->i", u, way) / np.where(square > 0, square, 1.0)
    foot = u + np.clip(part, 0.0, 1.0)[:, None] * way
    return np.asarray(np.einsum("ij,ij->i", foot, foot))
