"""Geometry of a simulated pad of any outline, directly from the millimetres of the deployment.

Public name: `SimulatedOutline`. It is independent of `handtouch.field`: the pad is the image of a square by a
transfinite (Coons) map, which isn't conformal, and the sphere is reached by its own projection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.simulate.pad_geometry import SimulatedSurface, SurfaceProjection

_EDGE = 1e-9  # fraction of the pad: corners have no direction
_NEWTON_STEPS = 25
_HULL_POINTS = 96
_PLATE_THICKNESS_M = 4e-3


@dataclass(frozen=True)
class SimulatedOutline(SimulatedSurface):
    """A pad of any outline; its sides are the parts of the outline between the marked corners.

    Its coordinates are fractions of the pad times `length_m` and `arc`, the mean lengths of the sides: each
    side is divided evenly, and the inside by the transfinite map. `length_m` and `arc` are lengths, the
    radius is 1.
    """

    vertices_m: tuple[complex, ...] = ()
    turns_rad: tuple[float, ...] = ()
    corners_m: tuple[float, ...] = ()
    """Lengths along the outline of the corners (x0, y0), (xa, y0), (xa, yb), (x0, yb)."""
    form: str = "plane"
    ball_m: float = 0.0
    """Radius of the cylinder or sphere."""
    grown: tuple[float, float] = (1.0, 1.0)
    """Factors of the drawing along x and y."""

    @classmethod
    def from_table(cls, table: Any, form: str) -> SimulatedOutline:
        """Return the geometry of a pad's `surface` table."""
        vertices = tuple(
            1e-3 * complex(x, y) for x, y in zip(table.outline_x_mm, table.outline_y_mm, strict=True)
        )
        turns = tuple(math.radians(turn) for turn in table.edge_turn_deg)
        corners = tuple(1e-3 * corner for corner in table.corners_mm)
        ball_m = 0.0 if form == "plane" else 1e-3 * table.radius_mm
        made = cls(1.0, 1.0, 1.0, 0.0, None, True, 1.0, vertices, turns, corners, form, ball_m)
        y0, xa, yb, x0 = made.side_lengths_m
        return replace(made, length_m=(y0 + yb) / 2, arc=(x0 + xa) / 2)

    def resized(self, longer_m: float, wider_m: float) -> SimulatedOutline:
        """Return a pad longer along x, and wider along y."""
        if not (longer_m or wider_m):
            return self
        along, across = self.extent_m
        return replace(self, grown=(1 + longer_m / along, 1 + wider_m / across))

    @cached_property
    def _edge_ends(self) -> FloatArray:
        """Lengths along the drawing at the vertices, and the whole."""
        chords = [abs(after - here) for here, after in zip(self.vertices_m, self._next_vertices, strict=True)]
        bends = [turn / 2 / math.sin(turn / 2) if turn else 1.0 for turn in self.turns_rad]
        return np.concatenate([[0.0], np.cumsum(np.array(chords) * bends)])

    @property
    def _next_vertices(self) -> tuple[complex, ...]:
        return (*self.vertices_m[1:], self.vertices_m[0])

    @cached_property
    def side_lengths_m(self) -> tuple[float, float, float, float]:
        """Lengths of the sides y0, xa, yb and x0."""
        whole = float(self._edge_ends[-1])
        first, second, third, fourth = self.corners_m
        return (
            (second - first) % whole,
            (third - second) % whole,
            (fourth - third) % whole,
            (first - fourth) % whole,
        )

    def side_units(self) -> tuple[float, float, float, float]:
        """Return metres along the sides x0, xa, y0, yb per unit of the coordinate along them."""
        y0, xa, yb, x0 = self.side_lengths_m
        return x0 / self.arc, xa / self.arc, y0 / self.length_m, yb / self.length_m

    @cached_property
    def extent_m(self) -> tuple[float, float]:
        """Sides of the bounding box of the drawing in the file."""
        x0, y0, x1, y1 = self._bounds
        return x1 - x0, y1 - y0

    @cached_property
    def _bounds(self) -> tuple[float, float, float, float]:
        edge = self.contour(np.linspace(0, self._edge_ends[-1], 4001))[0]
        edge = np.concatenate([edge, self.vertices_m])
        return float(edge.real.min()), float(edge.imag.min()), float(edge.real.max()), float(edge.imag.max())

    def contour(self, length_m: FloatArray) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return points of the file's outline, and unit tangents, at lengths along it (n,)."""
        ends = self._edge_ends
        length = np.mod(length_m, ends[-1])
        edge = np.clip(np.searchsorted(ends, length, side="right") - 1, 0, len(self.turns_rad) - 1)
        begin = np.array(self.vertices_m)[edge]
        chord = np.array(self._next_vertices)[edge] - begin
        turn = np.array(self.turns_rad)[edge]
        part = (length - ends[edge]) / (ends[edge + 1] - ends[edge])
        heading = chord / np.abs(chord) * np.exp(1j * turn * (part - 0.5))
        # from the begin: a chord of the turn so far, whose direction is the mean of the headings
        over = np.sinc(turn * part / (2 * np.pi)) / np.sinc(turn / (2 * np.pi)) * part
        return begin + chord * over * np.exp(1j * turn * (part - 1) / 2), heading

    def breaks(self, sides: tuple[int, int]) -> list[float]:
        """Return fractions, along two opposite sides (numbers in the order y0, xa, yb, x0), of vertices."""
        found = set()
        whole = self._edge_ends[-1]
        for side in sides:
            length = self.side_lengths_m[side]
            for vertex in self._edge_ends[:-1].tolist():
                part = float((vertex - self.corners_m[side]) % whole / length)
                if 1e-6 < part < 1 - 1e-6:
                    found.add(round(part if side < 2 else 1 - part, 9))
        return sorted(found)

    def drawing(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points (2, ...) of the drawing at fractions of the pad (2, ...), and derivatives (2, 2, ...)
        of x and y by both fractions."""
        p, q = np.asarray(position[0], np.float64), np.asarray(position[1], np.float64)
        y0, xa, yb, x0 = self.side_lengths_m
        c0, c1, c2, c3 = self.corners_m
        bottom, by_bottom = self._side(c0 + y0 * p, y0)
        right, by_right = self._side(c1 + xa * q, xa)
        top, by_top = self._side(c2 + yb * (1 - p), -yb)
        left, by_left = self._side(c3 + x0 * (1 - q), -x0)
        z00, z10, z11, z01 = self.contour(np.array(self.corners_m))[0]
        bilinear = (1 - p) * (1 - q) * z00 + p * (1 - q) * z10 + p * q * z11 + (1 - p) * q * z01
        z = (1 - q) * bottom + q * top + (1 - p) * left + p * right - bilinear
        by_p = (1 - q) * by_bottom + q * by_top - left + right
        by_p -= (1 - q) * (z10 - z00) + q * (z11 - z01)
        by_q = top - bottom + (1 - p) * by_left + p * by_right
        by_q -= (1 - p) * (z01 - z00) + p * (z11 - z10)
        along, across = self.grown
        slopes = np.stack(
            [
                np.stack([along * by_p.real, along * by_q.real]),
                np.stack([across * by_p.imag, across * by_q.imag]),
            ]
        )
        return np.stack([along * z.real, across * z.imag]), slopes

    def _side(
        self, length_m: FloatArray, per_fraction: float
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        z, heading = self.contour(length_m.ravel())
        return z.reshape(length_m.shape), (per_fraction * heading).reshape(length_m.shape)

    def stretch_at(self, position: FloatArray) -> FloatArray:
        """Return metres on the surface per metre of the drawing (...) at fractions of the pad (2, ...)."""
        if self.form != "sphere":
            return np.ones(np.shape(position)[1:])
        x, y = self._from_centre(self.drawing(position)[0])
        return np.asarray(4 * self.ball_m**2 / (4 * self.ball_m**2 + x * x + y * y))

    def _from_centre(self, drawn: FloatArray) -> FloatArray:
        x0, y0, x1, y1 = self._bounds
        middle = np.array([self.grown[0] * (x0 + x1), self.grown[1] * (y0 + y1)]) / 2
        return np.asarray(drawn - middle.reshape(2, *(1,) * (drawn.ndim - 1)))

    def point(self, s_m: float, phi: float) -> FloatArray:
        """Return a position (3,) [m] in the pad's frame."""
        x, y = self._from_centre(self.drawing(np.array([[s_m / self.length_m], [phi / self.arc]]))[0])[:, 0]
        if self.form == "plane":
            return np.array([x, y, 0.0])
        if self.form == "cylinder":
            return np.array(
                [x, self.ball_m * math.sin(y / self.ball_m), self.ball_m * (math.cos(y / self.ball_m) - 1)]
            )
        polar = 2 * math.atan2(math.hypot(x, y), 2 * self.ball_m)
        azimuth = math.atan2(y, x)
        aside = self.ball_m * math.sin(polar)
        return np.array(
            [aside * math.cos(azimuth), aside * math.sin(azimuth), self.ball_m * (math.cos(polar) - 1)]
        )

    def normal(self, s_m: float, phi: float) -> FloatArray:
        """Return the outward unit normal (3,) in the pad's frame."""
        if self.form == "plane":
            return np.array([0.0, 0.0, 1.0])
        outward = self.point(s_m, phi) + np.array([0.0, 0.0, self.ball_m])
        if self.form == "cylinder":
            outward[0] = 0.0
        return np.asarray(outward / self.ball_m)

    def arc_lengths(self, s_m: float, phi: float) -> tuple[float, float]:
        """Return the coordinates of the drawing from the lower left corner of its bounding box."""
        x, y = self.drawing(np.array([[s_m / self.length_m], [phi / self.arc]]))[0][:, 0]
        return float(x - self.grown[0] * self._bounds[0]), float(y - self.grown[1] * self._bounds[1])

    def film_fractions(self, place_m: FloatArray) -> FloatArray:
        """Return the fractions (n, 2) of places (n, 2) of the drawing, as `arc_lengths` counts them."""
        x0, y0, x1, y1 = self._bounds
        middle = np.array([x1 - x0, y1 - y0]) / 2
        return self._fractions_at((place_m - middle).T).T

    def metres_per_fraction(self, x: float, y: float) -> FloatArray:
        """Return the derivatives (2, 2) of positions along the surface by the fractions of the pad."""
        position = np.array([[x], [y]])
        return np.asarray(self.drawing(position)[1][:, :, 0] * self.stretch_at(position)[0])

    def fractions_of(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return short vectors (2, n) [m] along the surface at positions (2, n), in fractions of the pad."""
        slopes = np.moveaxis(self.drawing(position)[1], 2, 0) * self.stretch_at(position)[:, None, None]
        return np.asarray(np.linalg.solve(slopes, vector_m.T[:, :, None])[:, :, 0].T)

    def fractions_beside(self, position: FloatArray, vector_m: FloatArray) -> FloatArray:
        """Return fractions of the pad (k, 2, n) at vectors (k, 2, n) [m] from positions (2, k).

        They are those of the drawing, which is a conformal image of the surface, in metres on the latter.
        Each step begins on the pad: beyond it the drawing may have no slopes.
        """
        count = vector_m.shape[2]
        start = np.repeat(position, count, axis=1)
        vector = vector_m.transpose(1, 0, 2).reshape(2, -1)
        target = self.drawing(start)[0] + vector / self.stretch_at(start)
        found = start + self.fractions_of(start, vector)
        for _ in range(2):
            found = np.clip(found, _EDGE, 1 - _EDGE)
            miss = target - self.drawing(found)[0]
            found = found + self.fractions_of(found, miss * self.stretch_at(found))
        return np.asarray(found.reshape(2, -1, count).transpose(1, 0, 2))

    def project(self, points_m: FloatArray) -> SurfaceProjection:
        """Project points (n, 3) in the pad's frame."""
        x, y, z = points_m.T
        height, normal = z.copy(), np.tile([0.0, 0.0, 1.0], (len(x), 1))
        if self.form == "cylinder":
            away = np.hypot(y, z + self.ball_m)
            angle, height = np.arctan2(y, z + self.ball_m), away - self.ball_m
            normal = np.stack([np.zeros_like(x), np.sin(angle), np.cos(angle)], axis=1)
            y = self.ball_m * angle
        elif self.form == "sphere":
            from_middle = points_m + np.array([0.0, 0.0, self.ball_m])
            away = np.linalg.norm(from_middle, axis=1)
            height, normal = away - self.ball_m, from_middle / away[:, None]
            x, y = 2 * self.ball_m * normal[:, :2].T / (1 + normal[:, 2])
        return SurfaceProjection(self._fractions_at(np.stack([x, y])).T, height, normal)

    def _fractions_at(self, from_centre: FloatArray) -> FloatArray:
        """Return the fractions (2, n) of points of the drawing (2, n), by Newton's method."""
        position = np.full(from_centre.shape, 0.5)
        for _ in range(_NEWTON_STEPS):
            drawn, slopes = self.drawing(position)
            miss = from_centre - self._from_centre(drawn)
            step = np.linalg.solve(np.moveaxis(slopes, 2, 0), miss.T[:, :, None])[:, :, 0].T
            position = np.clip(position + np.clip(step, -0.2, 0.2), -0.2, 1.2)
        return position

    def hull_points(self) -> list[FloatArray]:
        """Return points (3,) in the pad's frame whose convex hull is the body under the surface."""
        way = np.arange(_HULL_POINTS // 4) / (_HULL_POINTS // 4)
        zero, one = np.zeros_like(way), np.ones_like(way)
        edge = np.concatenate([[way, zero], [one, way], [1 - way, one], [zero, 1 - way]], axis=1).T
        top = [self.point(p * self.length_m, q * self.arc) for p, q in [*edge.tolist(), [0.5, 0.5]]]
        return [*top, *(point - np.array([0.0, 0.0, _PLATE_THICKNESS_M]) for point in top)]
