"""Surfaces of every kind that a deployment can have; of rectangles, one with an anisotropic sheet."""

from __future__ import annotations

import math

from handtouch.config import shipped, surface_table

_BULGE_MM = 8 / math.sin(math.radians(75)) * math.radians(150)

SURFACE_TABLES = {
    "plane": surface_table("plane", length_mm=40.0, width_mm=25.0),
    "cylinder": surface_table("cylinder", radius_mm=11.0, length_mm=30.0, arc_deg=160.0),
    "cone": surface_table("cone", near_radius_mm=12.0, far_radius_mm=7.0, slant_mm=26.0, arc_deg=140.0),
    "sphere": surface_table("sphere", radius_mm=10.0, from_deg=-20.0, to_deg=60.0, arc_deg=140.0),
    "prism": surface_table(
        "prism",
        length_mm=30.0,
        section_aside_mm=(0.0, 6.0, 18.0, 24.0),
        section_up_mm=(0.0, 5.0, 5.0, 0.0),
    ),
    "revolution": surface_table(
        "revolution",
        profile_axial_mm=(0.0, 10.0, 20.0, 30.0),
        profile_radius_mm=(9.0, 11.0, 10.0, 7.0),
        arc_deg=150.0,
    ),
    "anisotropic cylinder": surface_table(
        "cylinder", radius_mm=11.0, length_mm=30.0, arc_deg=160.0, resistivity_ratio=1.7
    ),
}

OUTLINE_TABLES = {
    "outline_on_sphere": surface_table(
        "outline_on_sphere",
        radius_mm=12.0,
        outline_x_mm=(9.0, -9.0),
        outline_y_mm=(0.0, 0.0),
        edge_turn_deg=(180.0, 180.0),
        corners_mm=tuple(9 * math.pi * turn for turn in (1.25, 1.75, 0.25, 0.75)),
    ),
    "outline_on_cylinder": surface_table(
        "outline_on_cylinder",
        radius_mm=9.0,
        outline_x_mm=(0.0, 20.0, 20.0, 0.0),
        outline_y_mm=(0.0, 0.0, 16.0, 16.0),
        edge_turn_deg=(0.0, 150.0, 0.0, 0.0),
        corners_mm=(0.0, 20.0, 20.0 + _BULGE_MM, 40.0 + _BULGE_MM),
    ),
    "outline": surface_table(
        "outline",
        outline_x_mm=(0.0, 10.0, 44.0, 50.0, 44.0, 6.0),
        outline_y_mm=(6.0, 0.0, 0.0, 10.0, 38.0, 38.0),
        edge_turn_deg=(0.0,) * 6,
        corners_mm=(5.83, 51.49, 84.0, 122.0),
    ),
}
"""Pads of any outline."""

MESH_TABLE = surface_table(
    "mesh",
    file=str(shipped.path("fingertip.stl")),
    corner_x_mm=(5.2, 22.8, 22.8, 5.2),
    corner_y_mm=(-6.0, -4.8, 4.8, 6.0),
    corner_z_mm=(3.0, 3.0, 3.0, 3.0),
)
"""The shipped fingertip."""
