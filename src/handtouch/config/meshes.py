"""Triangles of STL files that a deployment names, for surfaces of the simulator and handled objects.

Public names: `SurfaceTriangles`, `surface_triangles`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from handtouch import field
from handtouch.field.embedded_file import read_embedded

if TYPE_CHECKING:
    SurfaceTriangles = field.Triangulation
    """The triangles of a file, which the simulator builds a geometry of its own from."""


def surface_triangles(file: str, metres_per_unit: float) -> SurfaceTriangles:
    """Return the triangles [m] of an STL file, by its path or embedded. Raises ValueError."""
    surface = field.parse_stl(read_embedded(file))
    return field.Triangulation(metres_per_unit * surface.points, surface.triangles)
