"""Tables of forward models: quintic splines in coordinates that stretch towards the edges.

A coordinate x of a side a is counted in cells s: x / a = 1 / (1 + exp(-w)), w = (s - cells / 2) * width.
Cells shrink in proportion to the distance from an edge, and the fractions vary on that same scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from handtouch.field._spline import spline_operator
from handtouch.field.model import FloatArray, ForwardModel

TERMS = 6  # coefficients of a quintic
COLUMNS = 5  # four fractions and ln of the spreading radius
RATIO_CELLS = 128  # of the table that gives a start
RATIO_SPAN = 16.0  # it covers |ln(T0 / T1)| up to this
MARGIN = 0.03  # of a side: from here inwards the error is promised


@dataclass(frozen=True)
class Grid:
    """Cells of a side and their width; the outermost nodes are about exp(-cells * width / 2) of it inside."""

    cells: int
    width: float

    def place(self, s: FloatArray) -> FloatArray:
        """Fraction of the side at s cells."""
        return np.asarray(1 / (1 + np.exp((self.cells / 2 - s) * self.width)))

    def coordinate(self, fraction: FloatArray) -> FloatArray:
        """Inverse of `place`; infinite at the ends of the side."""
        return np.asarray(self.cells / 2 + np.log(fraction / (1 - fraction)) / self.width)

    def points(self, model: ForwardModel, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points of the pad at cells s along either side, shape (y, x) each."""
        side = self.place(s)
        x, y = np.meshgrid(model.a * side, model.b * side)
        return x, y


# Wide gaps put singular points of the boundary where cells are wide, so they want finer ones.
GRIDS = (Grid(64, 0.2), Grid(88, 0.15), Grid(128, 0.1))


def tabulate(values: FloatArray, out: FloatArray, workspace: FloatArray | None = None) -> FloatArray:
    """Polynomials (cells^2, TERMS, m TERMS) into `out` through node values (cells + 1, cells + 1, m).

    By cell (y, x), power of y, power of x and column. workspace: as large as `out`, returned for the next
    table; one big product and one transposition, for the tables are as large as what the start may cost.
    """
    cells, columns = len(values) - 1, values.shape[2]
    operator = spline_operator(cells, TERMS - 1)
    along_y = np.tensordot(operator, values, axes=(2, 0)).transpose(0, 1, 3, 2)  # cell, power, column, x
    workspace = np.empty(out.size) if workspace is None else workspace
    both = workspace.reshape(-1, cells * TERMS)
    np.matmul(along_y.reshape(-1, cells + 1), operator.reshape(-1, cells + 1).T, out=both)
    of = both.reshape(cells, TERMS, columns, cells, TERMS)
    out.reshape(cells, cells, TERMS, TERMS, columns)[:] = of.transpose(0, 3, 1, 4, 2)
    return workspace


def log_ratios(currents: FloatArray) -> FloatArray:
    """ln(T0 / T1) of both pairs of sides, T = tan(pi f / 2) (see `_separable`): (4, ...) to (2, ...)."""
    logs = np.log(np.tan(math.pi / 2 / currents.sum(axis=0) * currents))
    return np.asarray(logs[::2] - logs[1::2])


def start_table(model: ForwardModel, grid: Grid) -> FloatArray:
    """Cells against ln(T0 / T1), falling, along the two middle lines of the pad: (2, RATIO_CELLS + 1).

    On an ideal pad this is exact off the middle lines as well; with gaps it is a close start.
    """
    s = np.linspace(0, grid.cells, 8 * grid.cells + 1)
    side = grid.place(s)
    middle = np.full_like(s, 0.5)
    along_x = log_ratios(model.fractions(model.a * side, model.b * middle))[0]
    along_y = log_ratios(model.fractions(model.a * middle, model.b * side))[1]
    wanted = np.linspace(-RATIO_SPAN, RATIO_SPAN, RATIO_CELLS + 1)
    return np.stack([np.interp(wanted, np.maximum.accumulate(-line), s) for line in (along_x, along_y)])


@dataclass(frozen=True)
class PadTable:
    """One model on a grid, as far as is needed to judge it; `tabulate` makes the polynomials of `values`.

    values: (cells + 1, cells + 1, COLUMNS) at the nodes (y, x): the fraction of each channel and ln of the
    spreading radius. error: the largest of a fraction, measured between the nodes, from `MARGIN` inwards;
    edge_error: the largest anywhere.
    """

    values: FloatArray
    starts: FloatArray
    error: float
    edge_error: float

    @classmethod
    def of(cls, model: ForwardModel, grid: Grid) -> PadTable:
        """Evaluate `model` and measure what tabulating costs."""
        x, y = grid.points(model, np.arange(grid.cells + 1.0))
        values = np.stack([*model.fractions(x, y), np.log(_spreading_radius(model, x, y))], axis=-1)
        between = np.arange(0.5, grid.cells)
        middle = np.tensordot(spline_operator(grid.cells, TERMS - 1), 0.5 ** np.arange(TERMS), axes=(1, 0))
        found = middle @ np.moveaxis(values[..., :4], -1, 0) @ middle.T
        error = np.abs(found - model.fractions(*grid.points(model, between))).max(axis=0)
        inside = np.abs(grid.place(between) - 0.5) <= 0.5 - MARGIN
        return cls(
            values, start_table(model, grid), float(error[np.ix_(inside, inside)].max()), float(error.max())
        )


def _spreading_radius(model: ForwardModel, x: FloatArray, y: FloatArray) -> FloatArray:
    """The radius in the sheet resistance ln(radius / A) / (2 pi): the conformal radius, enlarged by gaps."""
    radius = getattr(model, "spreading_radius", None) or model.conformal_radius  # type: ignore[attr-defined]
    return np.asarray(radius(x, y), dtype=np.float64)
