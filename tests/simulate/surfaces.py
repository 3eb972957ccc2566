"""Surfaces of every kind that a deployment can have, and one with an anisotropic sheet."""

from __future__ import annotations

from handtouch.config import surface_table

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
