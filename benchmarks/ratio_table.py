"""Location on an ideal pad by tables of two ratios, as a peer of `Rectangle.locate` in benchmarks.

Each coordinate of a `Rectangle` depends on one number, the ratio T0 / T1 of its pair of sides, where
T = tan(pi f / 2). In terms of u = (sqrt T0 - sqrt T1) / (sqrt T0 + sqrt T1), from -1 at one side to 1 at the
other, it is a smooth function up to the sides, and a short cubic table holds it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from handtouch.field._ratio_inverse import RatioInverse
from handtouch.field._separable import SideRatio
from handtouch.field.model import FloatArray
from handtouch.field.rectangle import Rectangle

_MAX_ERROR = 1e-8  # of a side
_FEWEST_CELLS, _MOST_CELLS = 256, 16384


class RatioTable:
    """Location from currents by table, for a pad of at most 4:1.

    pad: the rectangle. error: (2,), the largest error of x and y over the whole pad, measured between the
    nodes; below 1e-8 of the side. Raises ValueError for a longer pad.
    """

    LONGEST_ASPECT = 4.0  # beyond, the coordinate along the pad is too steep in u

    def __init__(self, pad: Rectangle) -> None:
        aspect = max(pad.a / pad.b, pad.b / pad.a)
        if aspect > self.LONGEST_ASPECT:
            raise ValueError(
                f"aspect {aspect:.3g}: a ratio table is for pads of at most {self.LONGEST_ASPECT:g}:1"
            )
        cells = _FEWEST_CELLS
        self._tabulate(pad, cells)
        while (self.error > _MAX_ERROR * np.array([pad.a, pad.b])).any() and cells < _MOST_CELLS:
            cells *= 2
            self._tabulate(pad, cells)

    def _tabulate(self, pad: Rectangle, cells: int) -> None:
        from scipy.interpolate import CubicSpline  # costs a daemon's start a fifth of a second

        nodes = np.linspace(-1, 1, cells + 1)
        splines = [CubicSpline(nodes, place) for place in _places(pad, nodes)]
        between = nodes[:-1] + 1 / cells
        found = np.stack([spline(between) for spline in splines])
        self.error: FloatArray = np.abs(found - _places(pad, between)).max(axis=1)
        widths = (2 / cells) ** np.arange(4.0)
        coefficients = np.concatenate([spline.c[::-1] for spline in splines], axis=1)
        self._rows = np.ascontiguousarray((coefficients * widths[:, None]).T)
        self._cells = cells

    def locate(self, currents: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x and y, shape (...), from currents (4, ...), any unit; NaN for one that is negative."""
        currents = np.asarray(currents, dtype=np.float64)
        with np.errstate(all="ignore"):
            scale = (math.pi / 2) / np.add.reduce(currents, axis=0)
            roots = np.sqrt(np.tan(currents * scale))
            low, high = roots[::2], roots[1::2]
            position = (low - high) / (low + high)
            position += 1
            position *= self._cells / 2
            cell = position.astype(np.intp)
            np.minimum(cell, self._cells - 1, out=cell)
            position -= cell
            cell[1] += self._cells
            c0, c1, c2, c3 = np.moveaxis(self._rows.take(cell, axis=0, mode="clip"), -1, 0)
            place = c3 * position
            for c in (c2, c1):
                place += c
                place *= position
            place += c0
        return place[0], place[1]


def _places(pad: Rectangle, u: FloatArray) -> FloatArray:
    """Exact x and y at u, shape (2, n)."""
    inverse = RatioInverse((SideRatio(pad.a, pad.b), SideRatio(pad.b, pad.a)))
    with np.errstate(all="ignore"):
        ratio = ((1 + np.abs(u)) / (1 - np.abs(u))) ** 2
        near = inverse(np.stack([ratio, ratio]))
    return np.where(u < 0, np.array([[pad.a], [pad.b]]) - near, near)
