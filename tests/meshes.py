"""STL files of discs on spheres, beside which closed forms exist."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtouch.config import SurfaceTable, surface_table

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

BALL_MM, DISC_MM = 12.0, 9.0
"""Radii of a sphere and of the disc that is its drawing, as `outline_on_sphere` in `simulate/surfaces.py`."""
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def disc(rings: int) -> tuple[FloatArray, IntArray]:
    """Points (n, 2) and triangles of a disc of radius 1 about 0, 6 k points on ring k."""
    rounds = [2 * np.pi * np.arange(6 * k) / (6 * k) for k in range(1, rings + 1)]
    z = np.concatenate([[0], *(k / rings * np.exp(1j * q) for k, q in enumerate(rounds, 1))])

    def number(ring: int, place: int) -> int:
        return 1 + 3 * ring * (ring - 1) + place % (6 * ring) if ring else 0

    triangles = []
    for ring in range(1, rings + 1):
        for sector in range(6):
            for j in range(ring):
                outer, inner = sector * ring + j, sector * (ring - 1) + j
                triangles.append((number(ring, outer), number(ring, outer + 1), number(ring - 1, inner)))
                if j < ring - 1:
                    between = number(ring - 1, inner), number(ring, outer + 1), number(ring - 1, inner + 1)
                    triangles.append(between)
    return np.stack([z.real, z.imag], axis=1), np.array(triangles)


def lifted(flat_mm: FloatArray) -> FloatArray:
    """Return points (n, 3) of the sphere, which touches the plane at 0, that the drawing projects."""
    squared = (flat_mm**2).sum(axis=1) / (2 * BALL_MM)
    scale = 1 / (1 + squared / (2 * BALL_MM))
    return np.column_stack([scale[:, None] * flat_mm, -scale * squared])


def stl_bytes(points: FloatArray, triangles: IntArray) -> bytes:
    """Return a binary STL file."""
    records = np.zeros(len(triangles), _RECORD)
    records["corners"] = points[triangles]
    return bytes(80) + len(triangles).to_bytes(4, "little") + records.tobytes()


def disc_on_ball(file: Path, rings: int = 14) -> SurfaceTable:
    """Write the STL file of the disc on the sphere, and return the surface with corners at 45 degrees."""
    flat, triangles = disc(rings)
    file.write_bytes(stl_bytes(lifted(DISC_MM * flat), triangles))
    angles = math.pi / 4 * np.array([-3, -1, 1, 3])
    corners = lifted(DISC_MM * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    return mesh_table(file, corners)


def mesh_table(file: Path, corners_mm: FloatArray) -> SurfaceTable:
    """Return the surface of a file with these corners (4, 3)."""
    x, y, z = (tuple(axis) for axis in corners_mm.T.tolist())
    return surface_table("mesh", file=str(file), corner_x_mm=x, corner_y_mm=y, corner_z_mm=z)
