"""Tables of forward models: quintic splines in coordinates that stretch towards the edges.

A coordinate x of a side a is counted in cells s: x / a = 1 / (1 + exp(-w)), w = (s - cells / 2) * width.
Cells shrink in proportion to the distance from an edge, and the fractions vary on that same scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from handtouch.field.model import FloatArray, ForwardModel, spreading_radius
from handtouch.field.spline import spline_operator

POLYNOMIAL_TERMS = 6  # coefficients of a quintic
TABLE_COLUMNS = 5  # four fractions and ln of the spreading radius
RATIO_TABLE_CELLS = 128  # of the start table
RATIO_TABLE_SPAN = 16.0  # it covers |ln(T0 / T1)| up to this
_MIN_FRACTION = float(np.finfo(np.float64).eps)  # smaller ones are rounding, also negative, on long pads
EDGE_MARGIN = 0.03  # of a side: from here inwards the error is promised


@dataclass(frozen=True)
class Grid:
    """Cells of a side and their width; the outermost nodes are about exp(-cells * width / 2) of it inside."""

    cells: int
    width: float

    def fraction(self, s: FloatArray) -> FloatArray:
        """Return the fraction of the side at s cells."""
        return np.asarray(1 / (1 + np.exp((self.cells / 2 - s) * self.width)))

    def coordinate(self, fraction: FloatArray) -> FloatArray:
        """Return the inverse of `fraction`; infinite at the ends of the side."""
        return np.asarray(self.cells / 2 + np.log(fraction / (1 - fraction)) / self.width)

    def points(self, model: ForwardModel, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points of the pad at cells s along either side, shape (y, x) each."""
        side = self.fraction(s)
        x, y = np.meshgrid(model.a * side, model.b * side)
        return x, y


# Wide gaps put singular points of the boundary where cells are wide, so they need finer ones.
GRIDS = (Grid(64, 0.2), Grid(88, 0.15), Grid(128, 0.1))


def tabulate(values: FloatArray, out: FloatArray, workspace: FloatArray | None = None) -> FloatArray:
    """Write polynomials (cells^2, TERMS, m TERMS) into `out` from node values (cells + 1, cells + 1, m).

    By cell (y, x), power of y, power of x and column. workspace: as large as `out`, returned for reuse; one
    large product and one transposition, because building the tables dominates the start-up time.
    """
    cells, columns = len(values) - 1, values.shape[2]
    operator = spline_operator(cells, POLYNOMIAL_TERMS - 1)
    along_y = np.tensordot(operator, values, axes=(2, 0)).transpose(0, 1, 3, 2)  # cell, power, column, x
    workspace = np.empty(out.size) if workspace is None else workspace
    both = workspace.reshape(-1, cells * POLYNOMIAL_TERMS)
    np.matmul(along_y.reshape(-1, cells + 1), operator.reshape(-1, cells + 1).T, out=both)
    of = both.reshape(cells, POLYNOMIAL_TERMS, columns, cells, POLYNOMIAL_TERMS)
    out.reshape(cells, cells, POLYNOMIAL_TERMS, POLYNOMIAL_TERMS, columns)[:] = of.transpose(0, 3, 1, 4, 2)
    return workspace


def log_ratios(currents: FloatArray) -> FloatArray:
    """Return ln(T0 / T1) of both pairs of sides, T = tan(pi f / 2) (see `_separable`): (4, ...) to (2,
    ...).
    """
    logs = np.log(np.tan(math.pi / 2 / currents.sum(axis=0) * currents))
    return np.asarray(logs[::2] - logs[1::2])


def start_table(model: ForwardModel, grid: Grid) -> FloatArray:
    """Return cells over ln(T0 / T1), decreasing, along the two centre lines of the pad: (2, RATIO_CELLS +
    1).

    On an ideal pad this is exact off the centre lines as well; with gaps it is a close start.
    """
    s = np.linspace(0, grid.cells, 8 * grid.cells + 1)
    side = grid.fraction(s)
    middle = np.full_like(s, 0.5)
    along_x, along_y = (
        log_ratios(np.maximum(model.fractions(model.a * x, model.b * y), _MIN_FRACTION))[axis]
        for axis, (x, y) in enumerate(((side, middle), (middle, side)))
    )
    targets = np.linspace(-RATIO_TABLE_SPAN, RATIO_TABLE_SPAN, RATIO_TABLE_CELLS + 1)
    return np.stack([np.interp(targets, np.maximum.accumulate(-line), s) for line in (along_x, along_y)])


@dataclass(frozen=True)
class PadTable:
    """One model on a grid, as needed to assess the error; `tabulate` builds the polynomials of `values`.

    values: (cells + 1, cells + 1, COLUMNS) at the nodes (y, x): the fraction of each channel and ln of the
    spreading radius. max_error: the largest of a fraction, measured between the nodes, from `EDGE_MARGIN`
    inwards; max_edge_error: the largest anywhere.
    """

    values: FloatArray
    starts: FloatArray
    max_error: float
    max_edge_error: float

    @classmethod
    def from_model(cls, model: ForwardModel, grid: Grid) -> PadTable:
        """Evaluate `model` on the grid and measure the error of interpolation."""
        x, y = grid.points(model, np.arange(grid.cells + 1.0))
        values = np.stack([*model.fractions(x, y), np.log(spreading_radius(model, x, y))], axis=-1)
        between = np.arange(0.5, grid.cells)
        middle = np.tensordot(
            spline_operator(grid.cells, POLYNOMIAL_TERMS - 1), 0.5 ** np.arange(POLYNOMIAL_TERMS), axes=(1, 0)
        )
        found = middle @ np.moveaxis(values[..., :4], -1, 0) @ middle.T
        error = np.abs(found - model.fractions(*grid.points(model, between))).max(axis=0)
        inside = np.abs(grid.fraction(between) - 0.5) <= 0.5 - EDGE_MARGIN
        return cls(
            values, start_table(model, grid), float(error[np.ix_(inside, inside)].max()), float(error.max())
        )
