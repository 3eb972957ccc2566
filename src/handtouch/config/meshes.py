"""Triangles of STL files that a deployment names, for surfaces of the simulator and handled objects.

Public names: `SurfaceTriangles`, `surface_triangles`.
"""

from __future__ import annotations

from handtouch.field.embedded_file import read_embedded
from handtouch.field.triangulation import Triangulation, parse_stl

SurfaceTriangles = Triangulation
"""The triangles of a file, which the simulator builds a geometry of its own from."""


def surface_triangles(file: str, metres_per_unit: float) -> SurfaceTriangles:
    """Return the triangles [m] of an STL file, by its path or embedded. Raises ValueError."""
    surface = parse_stl(read_embedded(file))
    return Triangulation(metres_per_unit * surface.points, surface.triangles)
