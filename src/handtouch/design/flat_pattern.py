"""Flat pattern of a pad's sheet: where points of its rectangle lie on the film that it is cut from.

Public name: `FlatPattern`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.design.layout import BoundaryLengths
from handtouch.field import ConeSurface, CylinderSurface, PlaneSurface, PrismSurface, Surface
from handtouch.field.network import perimeter_point
from handtouch.field.outline_surface import OutlineOnSphere, OutlineSurface

_MAX_MITRE = 2.0  # length of a mitre over the offset, at a corner
_BOUNDARY_STEPS = 240


@dataclass(frozen=True)
class FlatPattern:
    """The film of a surface, in mm: x from electrode x0, y from the centre line."""

    surface: Surface
    boundary: BoundaryLengths

    @property
    def note(self) -> str:
        """How true the pattern is to the surface."""
        if isinstance(self.surface, PlaneSurface | CylinderSurface | PrismSurface | ConeSurface):
            return "developed, all lengths true"
        if isinstance(self.surface, OutlineOnSphere):
            return "stereographic, angles and the middle true"
        if isinstance(self.surface, OutlineSurface):
            return "developed, all lengths true"
        return "not developable, parallels and centre line true: form the film"

    def points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the points (k, 2) [mm] of positions (k,) on the rectangle."""
        surface = self.surface
        u, v = surface.from_rectangle(x, y)
        if isinstance(surface, OutlineSurface):
            return 1e3 * np.column_stack([u, v - surface.extent_m[1] / 2])
        width = surface.from_rectangle(x, np.full_like(x, surface.b))[1]
        if not isinstance(surface, ConeSurface) or np.ptp(surface.side_lengths_m()[1:]) < 1e-9:
            return 1e3 * np.column_stack([u, v - width / 2])
        length, near, far = surface.side_lengths_m()
        # a sector: widths grow in proportion to the distance from the apex
        apex = near * length / (near - far)
        angle = (y / surface.b - 0.5) * (near - far) / length
        distance = apex - u
        return 1e3 * np.column_stack([apex - distance * np.cos(angle), distance * np.sin(angle)])

    def stretch(self, begin_m: float, end_m: float) -> FloatArray:
        """Return points (k, 2) [mm] of the boundary from one length along it to another, corners
        included."""
        whole = self.boundary.perimeter_m
        corners = (self.boundary.corners_m[:-1] + whole * np.arange(-1, 3)[:, None]).ravel()
        steps = max(2, round((end_m - begin_m) / whole * _BOUNDARY_STEPS))
        at = np.union1d(np.linspace(begin_m, end_m, steps), corners[(corners > begin_m) & (corners < end_m)])
        position = self.boundary.on_rectangle(at)
        return self.points(*perimeter_point(self.surface.a, self.surface.b, position))

    @cached_property
    def outline(self) -> FloatArray:
        """The sensing area (k, 2) [mm], counter-clockwise, closed."""
        return self.stretch(0.0, self.boundary.perimeter_m)

    def band(self, begin_m: float, end_m: float, width_mm: float) -> FloatArray:
        """Return the strip (k, 2) [mm] of a width outside a stretch of the boundary, as a closed polygon."""
        inner = self.stretch(begin_m, end_m)
        return np.concatenate([inner, offset(inner, width_mm)[::-1], inner[:1]])


def offset(line: FloatArray, distance: float) -> FloatArray:
    """Return a line (k, 2) moved to its right, outward of a counter-clockwise boundary, with mitred
    corners."""
    steps = np.diff(line, axis=0)
    lengths = np.hypot(*steps.T)
    normals = np.column_stack([steps[:, 1], -steps[:, 0]]) / np.maximum(lengths, 1e-12)[:, None]
    before, after = np.concatenate([normals[:1], normals]), np.concatenate([normals, normals[-1:]])
    middle = before + after
    middle /= np.maximum(np.hypot(*middle.T), 1e-9)[:, None]
    mitre = 1 / np.maximum((middle * after).sum(axis=1), 1 / _MAX_MITRE)
    return np.asarray(line + distance * mitre[:, None] * middle)
