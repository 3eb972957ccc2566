"""Electrodes of a pad as stretches of its boundary, in metres along the surface.

Public names: `FabricationLimits`, `BoundaryLengths`, `ElectrodeLayout`.

Positions are lengths along the boundary, counter-clockwise from the corner of sides x0 and y0. Electrodes
are in the order in which they follow each other: y0, xa, yb, x0 for one on each side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.field import ElectrodeNetwork, Surface
from handtouch.field.outline_surface import OutlineSurface

RING_OF_SIDES = ("y0", "xa", "yb", "x0")
"""Sides in the order of the boundary; the higher end of yb and x0 comes first."""
_STEPS = 400  # steps of each side, between which lengths are interpolated
_E24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91, 100)
_MIN_RESISTOR_OHM = 5.0  # a smaller one is left out


@dataclass(frozen=True)
class FabricationLimits:
    """Limits of manufacture.

    min_gap_mm: least bare length at an end of an electrode before its side's corner or, of electrodes
    anywhere, half of that between two. min_electrode_mm: least length of an electrode. max_series_ohm:
    largest resistor; 0: none are used. step_mm: lengths are multiples of it.
    """

    min_gap_mm: float = 0.3
    min_electrode_mm: float = 3.0
    max_series_ohm: float = 1000.0
    step_mm: float = 0.05

    def standard_resistor(self, ohm: float) -> float:
        """Return the nearest resistor of the E24 series up to the largest; 0 for one that is left out."""
        if ohm < _MIN_RESISTOR_OHM:
            return 0.0
        known = np.outer(10.0 ** np.arange(-1, 5), _E24).ravel()
        known = known[known <= self.max_series_ohm]
        return float(known[np.argmin(np.abs(np.log(known / ohm)))]) if known.size else 0.0


class BoundaryLengths:
    """Lengths along a surface's boundary, and the positions on its rectangle's perimeter there."""

    def __init__(self, surface: Surface) -> None:
        self.a, self.b = surface.a, surface.b
        sides = (self.a, self.b, self.a, self.b)
        self._knots = np.append(0.0, np.cumsum(sides))
        if isinstance(surface, OutlineSurface):
            at, length = _outline_lengths(surface, self._knots)
        else:
            at, length = _integrated_lengths(surface, self._knots)
        self._at, self._length = at, length
        self.corners_m: FloatArray = self._length[::_STEPS]
        """Positions of the four corners and, last, the whole length (5,)."""

    @property
    def perimeter_m(self) -> float:
        """Length of the boundary."""
        return float(self.corners_m[-1])

    def on_rectangle(self, position_m: FloatArray) -> FloatArray:
        """Return positions on the rectangle's perimeter, of any shape."""
        turns, rest = np.divmod(position_m, self.perimeter_m)
        return np.asarray(turns * self._knots[-1] + np.interp(rest, self._length, self._at))


@dataclass(frozen=True)
class ElectrodeLayout:
    """Electrodes on the boundary of a surface, with their series resistors.

    stretches_m: begin and end of each (n, 2), begin < end. series_ohm: (n,).
    """

    stretches_m: FloatArray
    series_ohm: FloatArray

    @classmethod
    def from_pad(cls, pad: config.Pad, boundary: BoundaryLengths) -> ElectrodeLayout:
        """Return the electrodes of a pad's table."""
        gaps_m = dict(zip(("x0", "xa", "y0", "yb"), 1e-3 * np.array(pad.gaps_mm), strict=True))
        ohm = dict(zip(("x0", "xa", "y0", "yb"), pad.series_ohm, strict=True))
        corners = boundary.corners_m
        stretches = []
        for side, start, stop in zip(RING_OF_SIDES, corners[:-1], corners[1:], strict=True):
            first, last = gaps_m[side] if side in ("y0", "xa") else gaps_m[side][::-1]
            stretches.append((start + first, stop - last))
        return cls(np.array(stretches), np.array([ohm[side] for side in RING_OF_SIDES]))

    @property
    def count(self) -> int:
        """Number of electrodes."""
        return len(self.stretches_m)

    @cached_property
    def lengths_m(self) -> FloatArray:
        """Lengths of the electrodes (n,)."""
        return np.asarray(np.diff(self.stretches_m, axis=1)[:, 0])

    def gaps_m(self, boundary: BoundaryLengths) -> FloatArray:
        """Return the bare length after each electrode (n,)."""
        following = np.append(self.stretches_m[1:, 0], self.stretches_m[0, 0] + boundary.perimeter_m)
        return np.asarray(following - self.stretches_m[:, 1])

    def network(self, boundary: BoundaryLengths, sheet_ohm_per_square: float) -> ElectrodeNetwork:
        """Return its forward model on the surface's rectangle."""
        spans = boundary.on_rectangle(self.stretches_m)
        return ElectrodeNetwork.from_arcs(
            boundary.a, boundary.b, spans, sheet_ohm_per_square, tuple(self.series_ohm.tolist())
        )

    def is_on_sides(self, boundary: BoundaryLengths) -> bool:
        """Return True if there are four electrodes, one on each side, in the order of the sides."""
        corners = boundary.corners_m
        slack = 1e-9 * boundary.perimeter_m
        return self.count == 4 and bool(
            (self.stretches_m[:, 0] >= corners[:-1] - slack).all()
            and (self.stretches_m[:, 1] <= corners[1:] + slack).all()
        )


def _integrated_lengths(surface: Surface, knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions on the perimeter and the lengths of the surface there, by the trapezium rule."""
    s = np.linspace(0, 1, _STEPS + 1)
    zero, one = np.zeros_like(s), np.ones_like(s)
    lines = ((s, zero, 0), (one, s, 1), (1 - s, one, 0), (zero, 1 - s, 1))
    at, length = [np.zeros(1)], [np.zeros(1)]
    for (x, y, axis), start, stop in zip(lines, knots[:-1], knots[1:], strict=True):
        scale = surface.scales(x * surface.a, y * surface.b)[axis] * (stop - start)
        steps = (scale[1:] + scale[:-1]) / (2 * _STEPS)
        at.append(start + s[1:] * (stop - start))
        length.append(length[-1][-1] + np.cumsum(steps))
    return np.concatenate(at), np.concatenate(length)


def _outline_lengths(surface: OutlineSurface, knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions on the perimeter at evenly spaced lengths of the drawing's sides."""
    whole = surface.outline.perimeter()
    at, length = [np.zeros(1)], [np.zeros(1)]
    steps = np.linspace(0, 1, _STEPS + 1)[1:]
    for side in range(4):
        begin = surface.corners_m[side]
        own = (surface.corners_m[(side + 1) % 4] - begin) % whole
        points = [surface.outline.boundary_point((begin + own * step) % whole) for step in steps]
        lower_x, lower_y = surface.outline.bounds[:2]
        u, v = np.array(points).T - np.array([[lower_x], [lower_y]])
        x, y = surface.to_rectangle(u, v)
        along = (x, y, surface.a - x, surface.b - y)[side]
        along[-1] = knots[side + 1] - knots[side]
        at.append(knots[side] + np.maximum.accumulate(np.clip(along, 0, along[-1])))
        length.append(length[-1][-1] + own * steps)
    return np.concatenate(at), np.concatenate(length)
