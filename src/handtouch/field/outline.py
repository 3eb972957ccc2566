"""Outlines of pads: closed contours of straight segments and circular or elliptic arcs, and holes.

Public name: `Outline`. Points are complex numbers x + iy inside this module and its users.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray
from handtouch.field.surface_base import MIN_CLEARANCE

ComplexArray = npt.NDArray[np.complex128]
Point = tuple[float, float]

_MIN_CORNER_RAD = 0.05  # interior angle at a corner, and its distance from a full turn
_CHECK_POINTS = 65  # per edge, for crossings and clearances
_LENGTH_NODES = 32
_NEAREST_STEPS = 20


@dataclass(frozen=True)
class Edge:
    """A straight segment or an arc of an ellipse, parametrised by s from 0 to 1.

    Segment: start + step s, with sweep = 0. Arc: centre + major cos(theta) + minor sin(theta), theta = angle
    + sweep s; major and minor are conjugate radii (of a circle: r and i r).
    """

    start: complex
    step: complex
    major: complex = 0.0
    minor: complex = 0.0
    angle: float = 0.0
    sweep: float = 0.0

    @property
    def centre(self) -> complex:
        """Centre of an arc."""
        return self.start - self.major * math.cos(self.angle) - self.minor * math.sin(self.angle)

    def point(self, s: npt.ArrayLike) -> ComplexArray:
        """Return the points at s."""
        return np.asarray(self.start + self.chord(0.0, s))

    def chord(self, s: npt.ArrayLike, ahead: npt.ArrayLike) -> ComplexArray:
        """Return point(s + ahead) - point(s), accurate relative to itself however small `ahead` is.

        `ahead` may be complex: point(s) is analytic.
        """
        s, ahead = np.asarray(s, np.float64), np.asarray(ahead)
        if not self.sweep:
            return np.asarray(self.step * ahead)
        middle = self.angle + self.sweep * (s + ahead / 2)
        turn = 2 * np.sin(self.sweep * ahead / 2)
        return np.asarray(turn * (self.minor * np.cos(middle) - self.major * np.sin(middle)))

    def derivative(self, s: npt.ArrayLike) -> ComplexArray:
        """Return d point / d s."""
        s = np.asarray(s, np.float64)
        if not self.sweep:
            return np.full(s.shape, self.step, np.complex128)
        theta = self.angle + self.sweep * s
        return np.asarray(self.sweep * (self.minor * np.cos(theta) - self.major * np.sin(theta)))

    def curvature(self, s: npt.ArrayLike) -> FloatArray:
        """Return the signed curvature, positive where the edge turns left."""
        if not self.sweep:
            return np.zeros(np.shape(s))
        first = self.derivative(s)
        second = -(self.sweep**2) * (self.point(s) - self.centre)
        return np.asarray((np.conj(first) * second).imag / np.abs(first) ** 3)

    def complex_parameters(self, s: float, offset: ComplexArray) -> ComplexArray:
        """Return the complex `ahead`, shape (roots, ...), for which chord(s, ahead) = offset."""
        linear = offset / self.derivative(s)
        if not self.sweep:
            return linear[None]
        # with e = exp(i theta): point - centre = forward e + backward / e
        forward, backward = (self.major - 1j * self.minor) / 2, (self.major + 1j * self.minor) / 2
        if abs(forward) < abs(backward):  # clockwise: run theta the other way
            forward, backward, sign = backward, forward, -1.0
        else:
            sign = 1.0
        from_centre = self.point(s) - self.centre + offset
        root = np.sqrt(from_centre**2 - 4 * forward * backward)
        base = np.exp(1j * sign * (self.angle + self.sweep * s))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.stack([from_centre + root, from_centre - root]) / (2 * forward) / base
            exact = -1j * sign * np.log(ratio) / self.sweep
        exact = np.where(np.isfinite(exact), exact, 1e3)
        return np.where(np.abs(linear) < 1e-6, linear, exact)

    @cached_property
    def length(self) -> float:
        """Arc length."""
        return float(self.length_to(1.0))

    def length_to(self, s: npt.ArrayLike) -> FloatArray:
        """Return the arc length from 0 to s."""
        nodes, weights = np.polynomial.legendre.leggauss(_LENGTH_NODES)
        s = np.asarray(s, np.float64)
        speed = np.abs(self.derivative(s[..., None] * (nodes + 1) / 2))
        return np.asarray(speed @ weights * s / 2)

    def parameter_at(self, length: float) -> float:
        """Return s at an arc length from the start, by Newton's iteration."""
        s = length / self.length
        for _ in range(20):
            step = float((self.length_to(s) - length) / np.abs(self.derivative(s)))
            s -= step
            if abs(step) < 1e-15:
                break
        return s

    def nearest_parameter(self, z: ComplexArray) -> FloatArray:
        """Return s of the points of the edge nearest to points z (n,)."""
        grid = np.linspace(0, 1, _CHECK_POINTS)
        s = grid[np.abs(self.point(grid)[:, None] - z).argmin(axis=0)]
        for _ in range(_NEAREST_STEPS):
            slope, away = self.derivative(s), self.point(s) - z
            s = np.clip(s - (np.conj(slope) * away).real / np.abs(slope) ** 2, 0, 1)
        return np.asarray(s)

    def reflection(self, s: float, z: complex) -> complex:
        """Return the mirror image of z by the edge, continued analytically from the point at s."""
        ahead = self.complex_parameters(s, np.asarray(z - self.point(s)))
        nearest = ahead[np.argmin(np.abs(ahead))]
        return complex(self.point(s) + self.chord(s, np.conj(nearest)))

    def stretched(self, along_x: float, along_y: float) -> Edge:
        """Return the edge with x and y multiplied."""

        def stretch(z: complex) -> complex:
            return complex(z.real * along_x, z.imag * along_y)

        return replace(
            self,
            start=stretch(self.start),
            step=stretch(self.step),
            major=stretch(self.major),
            minor=stretch(self.minor),
        )

    def winding(self, z: ComplexArray) -> FloatArray:
        """Return the angle through which the edge turns, seen from z."""
        last = self.start + self.step
        with np.errstate(divide="ignore", invalid="ignore"):
            angle = np.angle((last - z) / (self.start - z))
        if not self.sweep:
            return np.asarray(angle)
        # between chord and arc the chord's angle lacks a full turn; in coordinates where the arc is a circle
        system = np.array([[self.major.real, self.minor.real], [self.major.imag, self.minor.imag]])
        from_centre = z - self.centre
        u, v = np.linalg.solve(system, np.stack([from_centre.real.ravel(), from_centre.imag.ravel()]))
        middle = self.angle + self.sweep / 2
        depth = u * math.cos(middle) + v * math.sin(middle)  # towards the middle of the arc
        beyond = depth > math.cos(self.sweep / 2)
        turned = np.sign(self.sweep) * np.sign(np.linalg.det(system))
        enclosed = ((u * u + v * v < 1) & beyond).reshape(z.shape)
        side = np.where(enclosed, -turned, turned)
        angle = np.where(np.abs(angle) > np.pi - 1e-9, side * np.abs(angle), angle)  # on the chord itself
        return np.asarray(angle + np.where(enclosed, 2 * np.pi * turned, 0.0))


def _edges(vertices: Sequence[Point], bulges: Sequence[float] | None) -> tuple[Edge, ...]:
    points = [complex(*vertex) for vertex in vertices]
    turns = [0.0] * len(points) if bulges is None else [float(b) for b in bulges]
    if len(turns) != len(points):
        raise ValueError(f"bulges: {len(points)} are needed, one for each edge, got {len(turns)}")
    if not np.isfinite([*np.real(points), *np.imag(points), *turns]).all():
        raise ValueError("vertices and bulges must be finite")
    edges = []
    for first, second, bulge in zip(points, points[1:] + points[:1], turns, strict=True):
        step = second - first
        if not step:
            raise ValueError(f"vertices: two neighbours are equal, {first.real:g}, {first.imag:g}")
        if abs(bulge) > 3:
            raise ValueError(f"bulges must be within -3 and 3, got {bulge:g}; divide the arc")
        if not bulge:
            edges.append(Edge(first, step))
            continue
        sweep = 4 * math.atan(bulge)
        radius_vector = -step / (np.exp(1j * sweep) - 1)  # from the start to the centre
        radius = abs(radius_vector)
        angle = float(np.angle(-radius_vector))
        edges.append(Edge(first, step, complex(radius), complex(0, radius), angle, sweep))
    return tuple(edges)


class Outline:
    """A region bounded by a closed contour of segments and arcs, optionally with holes.

    vertices: corners of the contour (x, y), in order, either way round. bulges: one for each edge, from its
    vertex to the next: 0 for a segment, tan(angle / 4) for a circular arc of that angle, positive where the
    arc turns left, as in DXF polylines (1: half a circle). holes: outlines inside, without holes of their
    own.

    A *position* on a contour is the arc length from its first vertex in the order of the vertices, in the
    unit of x and y. Contour 0 is the outer one, contour i hole i - 1.

    Raises ValueError naming edges that touch or cross each other, corners sharper than 3 degrees, holes that
    aren't inside, and edges or distances below 1e-4 of the larger extent.
    """

    def __init__(
        self,
        vertices: Sequence[Point],
        bulges: Sequence[float] | None = None,
        holes: Sequence[Outline] = (),
    ) -> None:
        if any(len(hole.contours) > 1 for hole in holes):
            raise ValueError("holes: a hole can't have holes")
        self._set((_edges(vertices, bulges), *(hole.contours[0] for hole in holes)))

    @classmethod
    def circle(cls, radius: float) -> Outline:
        """A disc that touches both axes; positions begin at its right end, counter-clockwise."""
        return cls.ellipse(radius, radius)

    @classmethod
    def ellipse(cls, radius_x: float, radius_y: float) -> Outline:
        """An ellipse that touches both axes; positions begin at its right end, counter-clockwise."""
        if not (radius_x > 0 and radius_y > 0):
            raise ValueError(f"radii must be positive, got {radius_x} and {radius_y}")
        circle = cls([(2.0, 1.0), (0.0, 1.0)], [1.0, 1.0])
        return circle.stretched(radius_x, radius_y)

    def stretched(self, along_x: float, along_y: float) -> Outline:
        """Return the outline with x and y multiplied by positive factors."""
        if not (along_x > 0 and along_y > 0):
            raise ValueError(f"factors must be positive, got {along_x} and {along_y}")
        return self._copy([[e.stretched(along_x, along_y) for e in edges] for edges in self.contours])

    def moved(self, x: float, y: float) -> Outline:
        """Return the outline displaced by (x, y)."""
        return self._copy(
            [[replace(e, start=e.start + complex(x, y)) for e in edges] for edges in self.contours]
        )

    def at_origin(self) -> Outline:
        """Return the outline displaced so that it touches both axes from above and from the right."""
        x, y, _, _ = self.bounds
        return self.moved(-x, -y)

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y."""
        points = [np.array([e.start for e in self.contours[0]])]
        for edge in self.contours[0]:
            if edge.sweep:
                for large, small in (
                    (edge.major.real, edge.minor.real),
                    (edge.major.imag, edge.minor.imag),
                ):
                    extreme = math.atan2(small, large) + np.pi * np.arange(-6, 7)
                    s = (extreme - edge.angle) / edge.sweep
                    points.append(edge.point(s[(s > 0) & (s < 1)]))
        z = np.concatenate(points)
        return float(z.real.min()), float(z.imag.min()), float(z.real.max()), float(z.imag.max())

    def perimeter(self, contour: int = 0) -> float:
        """Return the length of a contour."""
        return math.fsum(edge.length for edge in self.contours[contour])

    def area(self) -> float:
        """Return the area, of holes taken off."""
        areas = [abs(_area(edges)) for edges in self.contours]
        return areas[0] - math.fsum(areas[1:])

    def contains(self, x: npt.ArrayLike, y: npt.ArrayLike) -> BoolArray:
        """Return True for points inside, shape (...); points on the boundary may be either."""
        z = np.asarray(x, np.float64) + 1j * np.asarray(y, np.float64)
        turns = np.zeros(z.shape)
        for edges, sign in zip(self.contours, self.signs, strict=True):
            for edge in edges:
                turns += sign * edge.winding(z)
        return np.asarray(turns > np.pi)

    def boundary_point(self, position: float, contour: int = 0) -> Point:
        """Return (x, y) at a position; raises ValueError if it is off the contour."""
        index, s = self.locate_position(position, contour)
        z = complex(self.contours[contour][index].point(s))
        return z.real, z.imag

    def nearest_position(self, x: float, y: float, contour: int = 0) -> float:
        """Return the position of the contour's point nearest to (x, y)."""
        edges = self.contours[contour]
        z = np.array([complex(x, y)])
        near = [edge.nearest_parameter(z) for edge in edges]
        index = int(np.argmin([abs(e.point(s) - z)[0] for e, s in zip(edges, near, strict=True)]))
        return math.fsum(e.length for e in edges[:index]) + float(edges[index].length_to(near[index])[0])

    def locate_position(self, position: float, contour: int = 0) -> tuple[int, float]:
        """Return edge and parameter at a position; raises ValueError if it is off the contour."""
        if not 0 <= contour < len(self.contours):
            raise ValueError(f"contour {contour}: the outline has contours 0 to {len(self.contours) - 1}")
        edges, perimeter = self.contours[contour], self.perimeter(contour)
        if not -1e-12 * perimeter <= position <= perimeter * (1 + 1e-12):
            raise ValueError(f"position {position:g} is off contour {contour}, of length {perimeter:g}")
        rest = position
        for index, edge in enumerate(edges):
            if rest < edge.length * (1 - 1e-12):
                s = edge.parameter_at(max(rest, 0.0))
                return index, 0.0 if s < 1e-12 else s
            rest -= edge.length
        return 0, 0.0

    def _copy(self, contours: Sequence[Sequence[Edge]]) -> Outline:
        new = self.__class__.__new__(self.__class__)
        new._set(tuple(tuple(edges) for edges in contours))
        return new

    def _set(self, contours: tuple[tuple[Edge, ...], ...]) -> None:
        self.contours = contours
        x0, y0, x1, y1 = self.bounds
        self._size = max(x1 - x0, y1 - y0)
        areas = [_area(edges) for edges in contours]
        self.signs = tuple(
            (1.0 if area > 0 else -1.0) * (1.0 if i == 0 else -1.0) for i, area in enumerate(areas)
        )
        for number, edges in enumerate(contours):
            name = "outline" if number == 0 else f"hole {number - 1}"
            if min(edge.length for edge in edges) < MIN_CLEARANCE * self._size:
                raise ValueError(f"{name}: an edge is shorter than {MIN_CLEARANCE:g} of the outline")
            for i, angle in enumerate(self.corner_angles(number)):
                if not _MIN_CORNER_RAD < angle < 2 * np.pi - _MIN_CORNER_RAD:
                    raise ValueError(
                        f"{name}: the corner at vertex {i} has {math.degrees(angle):.2g} degrees"
                    )
        self._check_clearances()
        for number, edges in enumerate(contours[1:]):
            z = np.concatenate([edge.point(np.linspace(0, 1, 9)) for edge in edges])
            if not self._copy_outer().contains(z.real, z.imag).all():
                raise ValueError(f"hole {number} is not inside the outline")

    def _copy_outer(self) -> Outline:
        if len(self.contours) == 1:
            return self
        return self._copy(self.contours[:1])

    def corner_angles(self, contour: int) -> FloatArray:
        """Return the angle on the region's side at each vertex [rad]."""
        edges, sign = self.contours[contour], self.signs[contour]
        turns = [
            sign * np.angle(edge.derivative(0.0) / before.derivative(1.0))
            for before, edge in zip((edges[-1], *edges[:-1]), edges, strict=True)
        ]
        return np.asarray(np.pi - np.array(turns), np.float64)

    def _check_clearances(self) -> None:
        """Raise ValueError where two edges touch, cross, or come closer than the clearance."""
        named = [
            (f"edge {i}" if number == 0 else f"edge {i} of hole {number - 1}", number, i, edge)
            for number, edges in enumerate(self.contours)
            for i, edge in enumerate(edges)
        ]
        least = MIN_CLEARANCE * self._size
        lines = [edge.point(np.linspace(0, 1, _CHECK_POINTS)) for *_, edge in named]
        for (one, other), (first, second) in zip(
            itertools.combinations(named, 2), itertools.combinations(lines, 2), strict=True
        ):
            count = len(self.contours[one[1]])
            adjacent = one[1] == other[1] and (other[2] - one[2]) % count in (1, count - 1)
            steps = max(one[3].length, other[3].length) / _CHECK_POINTS
            if np.abs(first[:, None] - second[None]).min() > 2 * steps + least:
                continue
            close = _polylines_cross(first, second, adjacent)
            if not adjacent:
                gap = min(_polyline_distance(first, second), _polyline_distance(second, first))
                close = close or gap < least
            if close:
                raise ValueError(f"{one[0]} and {other[0]} cross, or are closer than {least:.2g}")


def _area(edges: Sequence[Edge]) -> float:
    nodes, weights = np.polynomial.legendre.leggauss(_LENGTH_NODES)
    s = (nodes + 1) / 2
    return float(sum((np.conj(e.point(s)) * e.derivative(s)).imag @ weights for e in edges)) / 4


def _polylines_cross(first: ComplexArray, second: ComplexArray, shared: bool) -> bool:
    """Return True if two polylines cross; with `shared`, crossings within a step of shared ends don't
    count.
    """
    a, b = first[:-1, None], first[1:, None]
    c, d = second[None, :-1], second[None, 1:]

    def side(p: ComplexArray, q: ComplexArray, r: ComplexArray) -> FloatArray:
        return np.asarray(((q - p).conjugate() * (r - p)).imag)

    crossing = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    if shared:
        size = np.abs(first - first.mean()).max()
        for end in (first[0], first[-1]):
            if np.abs(second[[0, -1]] - end).min() < 1e-12 * size:
                crossing &= np.minimum(np.abs(a - end), np.abs(b - end)) > 1e-9 * size
    return bool(crossing.any())


def _polyline_distance(points: ComplexArray, line: ComplexArray) -> float:
    """Return the smallest distance of points from a polyline."""
    start, step = line[:-1], np.diff(line)
    along = ((points[:, None] - start) / step).real
    foot = start + np.clip(along, 0, 1) * step
    return float(np.abs(points[:, None] - foot).min())
