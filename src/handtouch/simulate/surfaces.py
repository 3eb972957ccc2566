"""Geometry of a simulated pad by the kind of its surface in the deployment.

Public name: `simulated_surface`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from handtouch import config
from handtouch.host.plugins import load_plugins
from handtouch.simulate.mesh_geometry import SimulatedMesh
from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.pad_geometry import (
    SimulatedPrism,
    SimulatedRevolution,
    SimulatedSurface,
    profile_length_m,
)


def simulated_surface(surface: config.SurfaceTable) -> SimulatedSurface:
    """Return the geometry of a pad's `surface` table. Raises ValueError for a kind without one."""
    if surface.kind in _OUTLINE_FORMS:
        return SimulatedOutline.from_table(surface, _OUTLINE_FORMS[surface.kind])
    build = _BUILDERS.get(surface.kind) or load_plugins("handtouch.simulated_surfaces").get(surface.kind)
    if build is None:
        raise ValueError(
            f'surface kind "{surface.kind}" has no simulated geometry; its package adds one by an entry '
            f'point "{surface.kind}" of the group handtouch.simulated_surfaces (docs/extend.md)'
        )
    built: SimulatedSurface = build(surface)
    return replace(built, resistivity_ratio=surface.resistivity_ratio)


def _plane(table: Any) -> SimulatedSurface:
    return SimulatedSurface(table.length_mm * 1e-3, table.width_mm * 1e-3, 1.0, flat=True)


def _cylinder(table: Any) -> SimulatedSurface:
    return SimulatedSurface(table.length_mm * 1e-3, math.radians(table.arc_deg), table.radius_mm * 1e-3)


def _cone(table: Any) -> SimulatedSurface:
    slope = (table.far_radius_mm - table.near_radius_mm) / table.slant_mm
    arc = math.radians(table.arc_deg)
    return SimulatedSurface(table.slant_mm * 1e-3, arc, table.near_radius_mm * 1e-3, slope)


def _sphere(table: Any) -> SimulatedSurface:
    radius = table.radius_mm * 1e-3
    length = radius * math.radians(table.to_deg - table.from_deg)
    start = math.radians(table.from_deg)
    return SimulatedSurface(length, math.radians(table.arc_deg), radius, sphere_from_rad=start)


def _prism(table: Any) -> SimulatedSurface:
    corners = _pairs(table.section_aside_mm, table.section_up_mm)
    width = sum(math.dist(a, b) for a, b in itertools.pairwise(corners))
    return SimulatedPrism(table.length_mm * 1e-3, width, 1.0, flat=True, corners_m=corners)


def _revolution(table: Any) -> SimulatedSurface:
    forward = 1 if table.profile_axial_mm[-1] >= table.profile_axial_mm[0] else -1
    points = _pairs([forward * axial for axial in table.profile_axial_mm], table.profile_radius_mm)
    length = profile_length_m(points)
    return SimulatedRevolution(length, math.radians(table.arc_deg), points[0][1], points_m=points)


def _pairs(first_mm: Any, second_mm: Any) -> tuple[tuple[float, float], ...]:
    return tuple((1e-3 * a, 1e-3 * b) for a, b in zip(first_mm, second_mm, strict=True))


_BUILDERS: Mapping[str, Callable[[Any], SimulatedSurface]] = MappingProxyType(
    {
        "plane": _plane,
        "cylinder": _cylinder,
        "cone": _cone,
        "sphere": _sphere,
        "prism": _prism,
        "revolution": _revolution,
        "mesh": SimulatedMesh.from_table,
    }
)
"""By `kind` of the deployment's `surface` table."""
_OUTLINE_FORMS: Mapping[str, str] = MappingProxyType(
    {"outline": "plane", "outline_on_cylinder": "cylinder", "outline_on_sphere": "sphere"}
)
