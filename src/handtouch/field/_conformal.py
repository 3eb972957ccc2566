"""Conformal map of a rectangle to an outline with four marked points.

Public name: `ConformalRectangle`.

With the marked points as its corners, x / a is the potential between two opposite sides, the others bare, and
y / b that between the others; b / a is a conductance. Both potentials are solved by boundary integrals. The
map from the rectangle to the outline is a rational function fitted to them on the boundary by the AAA
algorithm (Nakatsukasa, Sete, Trefethen, SIAM J. Sci. Comput. 40, 2018), whose poles cluster at the corners.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field.outline import ComplexArray, Outline
from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork

_TOLERANCE = 1e-7  # error of the fit over the outline's larger extent
_MAX_ERROR = 1e-5
_MAX_DEGREE = 100
_NETWORK_TOLERANCE = 1e-6
_EDGE_DISTANCE = 1e-9  # distance of points from the edges, and of fitted points, over the longer side
_START_POINTS = 33
_NEWTON_STEPS = 40
_MAX_NEWTON_STEP = 0.1  # step over the shorter side


class ConformalRectangle:
    """Map of a rectangle [0, a] x [0, b] to an outline without holes, whose area it has.

    corners: positions on the outline, see `Outline`, that the corners (0, 0), (a, 0), (a, b) and (0, b) are
    mapped to, counter-clockwise. Accurate to 1e-6 of the larger extent, 1e-7 for smooth outlines.

    Raises ValueError for corners in another order, and for an outline whose map isn't found to 1e-5: arms too
    slender, or a corner too sharp.
    """

    def __init__(self, outline: Outline, corners: Sequence[float]) -> None:
        if len(outline.contours) > 1:
            raise ValueError("outline: one with holes has no conformal rectangle")
        x0, y0, x1, y1 = outline.bounds
        self._origin, self._size = complex(x0, y0), max(x1 - x0, y1 - y0)
        self._corners = [float(corner) for corner in corners]
        perimeter = outline.perimeter()
        steps = np.diff([*self._corners, self._corners[0]]) % perimeter
        if len(self._corners) != 4 or outline.signs[0] < 0 or abs(steps.sum() / perimeter - 1) > 1e-6:
            raise ValueError("corners: four are needed, counter-clockwise along the outline")
        solved = outline.at_origin().stretched(1 / self._size, 1 / self._size)
        scaled = [corner / self._size for corner in self._corners]
        y0_side, xa_side, yb_side, x0_side = (
            BoundaryElectrode(*pair) for pair in zip(scaled, [*scaled[1:], scaled[0]], strict=True)
        )
        across = OutlineNetwork(solved, (x0_side, xa_side), 1.0, tolerance=_NETWORK_TOLERANCE)
        along = OutlineNetwork(solved, (y0_side, yb_side), 1.0, tolerance=_NETWORK_TOLERANCE)
        ratio = math.sqrt(float(across.conductance[0, 0] / along.conductance[0, 0]))  # b / a
        area = solved.area()
        self._a, self._b = math.sqrt(area / ratio), math.sqrt(area * ratio)
        self._fit(*self._boundary_pairs(across, along, scaled))
        side = (np.arange(_START_POINTS) + 0.5) / _START_POINTS
        x, y = np.meshgrid(self._a * side, self._b * side)
        self._starts: ComplexArray = np.concatenate([(x + 1j * y).ravel(), self._support])
        self._start_images = self._evaluate(self._starts)[0]

    @property
    def a(self) -> float:
        """Side along x, in the unit of the outline."""
        return self._a * self._size

    @property
    def b(self) -> float:
        """Side along y."""
        return self._b * self._size

    def to_outline(self, x: FloatArray, y: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the points of the outline (...), as complex numbers, and the map's complex derivatives.

        Continued across the edges by a fraction of the rectangle.
        """
        w: ComplexArray = np.asarray((x + 1j * y) / self._size, np.complex128)
        image, slope = self._evaluate(w.ravel())
        return (self._origin + self._size * image).reshape(w.shape), slope.reshape(w.shape)

    def from_outline(self, z: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y (...) of points of the outline, by Newton's method; NaN for points off it."""
        target = (z.ravel() - self._origin) / self._size
        w = np.full(target.shape, complex(np.nan, np.nan))
        limit = _MAX_NEWTON_STEP * min(self._a, self._b)
        for part in np.array_split(np.flatnonzero(np.isfinite(target)), max(1, target.size // 512)):
            nearest = np.abs(self._start_images[:, None] - target[part]).argmin(axis=0)
            at = self._starts[nearest]
            for _ in range(_NEWTON_STEPS):
                image, slope = self._evaluate(at)
                step = (target[part] - image) / slope
                at = at + step * np.minimum(1.0, limit / np.maximum(np.abs(step), 1e-300))
                at = np.clip(at.real, 0.0, self._a) + 1j * np.clip(at.imag, 0.0, self._b)
            close = np.abs(self._evaluate(at)[0] - target[part]) < 1e2 * _MAX_ERROR
            w[part[close]] = at[close]
        return self._size * w.real.reshape(z.shape), self._size * w.imag.reshape(z.shape)

    def _boundary_pairs(
        self, across: OutlineNetwork, along: OutlineNetwork, corners: Sequence[float]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return points of the rectangle's edges and their images, from the bare sides of each solution."""
        a, b, perimeter = self._a, self._b, across.outline.perimeter()
        rectangle, images = [], []
        for network, sides in ((across, (0, 2)), (along, (1, 3))):
            position, points, fractions = network.boundary_fractions()
            for side in sides:
                length = (corners[(side + 1) % 4] - corners[side]) % perimeter
                on_side = (position - corners[side]) % perimeter < length
                part = np.clip(fractions[1, on_side], 0.0, 1.0)
                edge = (a * part, a + 1j * b * part, a * part + 1j * b, 1j * b * part)[side]
                rectangle.append(edge)
                images.append(points[0, on_side] + 1j * points[1, on_side])
        w, z = np.concatenate(rectangle), np.concatenate(images)
        order = np.lexsort((w.imag, w.real))
        w, z = w[order], z[order]
        apart = np.append(True, np.abs(np.diff(w)) > _EDGE_DISTANCE * max(a, b))
        return w[apart], z[apart]

    def _fit(self, w: ComplexArray, z: ComplexArray) -> None:
        """Fit a rational function in barycentric form, by a support point more at a time."""
        rest, support = np.ones(len(w), np.bool_), []
        cauchy = np.empty((len(w), 0), np.complex128)
        fitted = np.full(len(w), z.mean())
        for _ in range(_MAX_DEGREE):
            worst = int(np.argmax(np.where(rest, np.abs(z - fitted), -1.0)))
            support.append(worst)
            rest[worst] = False
            with np.errstate(divide="ignore", invalid="ignore"):
                cauchy = np.concatenate([cauchy, 1 / (w[:, None] - w[worst])], axis=1)
            loewner = (z[rest, None] - z[support]) * cauchy[rest]
            weights = np.linalg.svd(loewner, full_matrices=False)[2][-1].conj()
            fitted = z.copy()
            fitted[rest] = (cauchy[rest] @ (weights * z[support])) / (cauchy[rest] @ weights)
            error = float(np.abs(z - fitted).max())
            if error < _TOLERANCE:
                break
        if error > _MAX_ERROR:
            raise ValueError(f"outline: its conformal map is found to {error:.1e} only; widen its arms")
        self._support, self._values, self._weights = w[support], z[support], weights

    def _evaluate(self, w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the rational function at w (n,), and its derivative."""
        least = _EDGE_DISTANCE * max(self._a, self._b)
        distance = w[:, None] - self._support
        distance = np.where(np.abs(distance) < least, least * (0.6 + 0.8j), distance)
        terms = self._weights / distance
        total = terms.sum(axis=1)
        image = (terms @ self._values) / total
        slope = (terms * (image[:, None] - self._values) / distance).sum(axis=1) / total
        return image, slope
