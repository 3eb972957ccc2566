"""Maximum-likelihood contacts on all the pads of a hand, of any forward models, in one pass.

Public names: `LocatorBank`, `TableTangent`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.field._bank_table import (
    GRIDS,
    POLYNOMIAL_TERMS,
    RATIO_TABLE_CELLS,
    RATIO_TABLE_SPAN,
    TABLE_COLUMNS,
    PadTable,
    log_ratios,
    tabulate,
)
from handtouch.field.estimate import (
    CORNER_RADIUS_FACTOR,
    MAX_STD_SIDES,
    PointEstimate,
    estimate_covariance,
    most_likely_direction,
)
from handtouch.field.model import FloatArray, ForwardModel, channel_noise

IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_MAX_STEPS = 10
_MAX_SEARCH_STEPS = 20
_SEARCH_GRID = np.stack(np.meshgrid(*[(np.arange(9) + 0.5) / 9] * 2), axis=-1).reshape(-1, 2)  # sides
_MAX_SETTLED_DECREMENT = 1e-2  # squared Newton decrement, in variances: the last step leaves far less
_MAX_STEP = 1.0  # in w, where positions are 1 / (1 + exp(-w)) of a side
_WITH_SLOPES = np.hstack(
    [np.eye(POLYNOMIAL_TERMS), np.diag(np.arange(1.0, POLYNOMIAL_TERMS), 1)]
)  # powers and their derivatives


class LocatorBank:
    """Tables of one forward model for each pad, evaluated for many contacts at once.

    models: one for each pad, with channels x0, xa, y0, yb; pads that share a model object share its table.
    tolerance: of a tabulated fraction; finer tables, of 6 to 24 MB a model, are tried until all meet it.
    sides: (pads, 2), a and b of each. table_error: (pads,), the largest error of a tabulated fraction, as
    measured between the nodes, at 3 % of a side and farther from the edges. edge_error: the same up to the
    edges.

    Contacts are kept 0.15 % of a side inside the edges, where the tables end. Raises ValueError for a model
    with other channels, and in every method for an `index` that isn't the number of a pad.
    """

    def __init__(self, models: Sequence[ForwardModel], tolerance: float = 1e-6) -> None:
        distinct = list({id(model): model for model in models}.values())
        for model in distinct:
            channels = len(model.fractions(model.a / 2, model.b / 2))
            if channels != 4:
                raise ValueError(f"a bank takes models with four channels, one has {channels}")
        for grid in GRIDS:
            tables = [PadTable.from_model(model, grid) for model in distinct]
            if all(table.max_error < tolerance for table in tables):
                break
        order = {id(model): i for i, model in enumerate(distinct)}
        self._model = np.array([order[id(model)] for model in models], dtype=np.intp)
        self._grid = grid
        self._max_coordinate = np.nextafter(float(grid.cells), 0)
        self._table = np.empty(
            (len(tables) * grid.cells**2, POLYNOMIAL_TERMS, TABLE_COLUMNS * POLYNOMIAL_TERMS)
        )
        workspace = None
        for table, part in zip(tables, self._table.reshape(len(tables), -1), strict=True):
            workspace = tabulate(table.values, part, workspace)
        self._start_tables = np.stack([table.starts for table in tables]).reshape(-1)
        self._search_fractions = np.stack([m.fractions(*(_SEARCH_GRID * (m.a, m.b)).T).T for m in distinct])
        self.sides = np.array([(model.a, model.b) for model in distinct])[self._model]
        self._shortest_side2 = self.sides.min(axis=1) ** 2
        self.table_error = np.array([table.max_error for table in tables])[self._model]
        self.edge_error = np.array([table.max_edge_error for table in tables])[self._model]

    def fractions(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the measured fractions (4, n) of points (n,) on the pads `index` (n,)."""
        index = self._checked_index(index)
        with np.errstate(all="ignore"):
            s = self._coordinates(index, np.stack([x, y], axis=-1))
            return np.ascontiguousarray(self._read_tables(self._first_row(index), s)[:, 0, :4].T)

    def conformal_radius(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the radius R (n,) that gives a contact of radius A the resistance sheet / 2 pi ln(R / A).

        The conformal radius of an ideal pad, in the unit of its sides, and the spreading radius of one with
        gaps.
        """
        index = self._checked_index(index)
        with np.errstate(all="ignore"):
            s = self._coordinates(index, np.stack([x, y], axis=-1))
            return np.exp(self._read_tables(self._first_row(index), s)[:, 0, 4])

    def tangent(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> TableTangent:
        """Return values and slopes of all tabulated quantities, at points (n,) of the pads `index` (n,)."""
        index = self._checked_index(index)
        with np.errstate(all="ignore"):
            s = self._coordinates(index, np.stack([x, y], axis=-1))
            rows = self._read_tables(self._first_row(index), s)
            side = self._grid.fraction(s)
            point = self.sides.take(index, axis=0) * side
            slopes = rows[:, 1:3] / self._grid.width
            return TableTangent(
                point, point * (1 - side), rows[:, 0, :4], slopes[:, :, :4], rows[:, 0, 4], slopes[:, :, 4]
            )

    def estimate(
        self, index: ArrayLike, currents: ArrayLike, noise: ArrayLike, start: ArrayLike | None = None
    ) -> PointEstimate:
        """Return the most likely contacts, arrays (n,), for currents (4, n) of the pads `index` (n,).

        noise: standard deviations, same unit, one a channel or broadcastable; an infinite one leaves its
            channel out. start: (2, n), the last (x, y) of contacts being followed, NaN for new ones.

        The same likelihood, clamps and covariance as `handtouch.field.estimate`. Never raises for any
        reading: what is NaN, has noise that is not positive, or has no positive total is NaN in its own
        element, and `converged` says which iterations were cut off.
        """
        index = self._checked_index(index)
        data = np.asarray(currents, dtype=np.float64)
        with np.errstate(all="ignore"):
            weight = np.empty_like(data)
            np.divide(1.0, channel_noise(noise, data.shape), out=weight)
            if not weight.all():
                data = np.where(weight == 0, 0.0, data)  # readings of excluded channels
            s = self._start(index, data, weight, start)
            sides = self.sides.take(index, axis=0)
            readings = _BankReadings(index, self._first_row(index), sides, data.T, weight.T)
            found = self._iterate(readings, s)
            if not np.logical_and.reduce(found.converged):
                left = np.flatnonzero(
                    ~found.converged & np.isfinite(readings.data * readings.weight).all(axis=1)
                )
                if left.size:
                    found.assign(left, self._search(readings.select(left)))
            return found

    # Details ----------------------------------------------------------------------------------------------

    def _checked_index(self, index: ArrayLike) -> IndexArray:
        """Return pad numbers as an array. Raises ValueError for what is no number of a pad."""
        found = np.asarray(index)
        if found.size and (
            found.dtype.kind not in "iu" or found.min() < 0 or found.max() >= len(self._model)
        ):
            raise ValueError(f"index of pads: whole numbers from 0 to {len(self._model) - 1}, not {index!r}")
        return np.asarray(found, np.intp)

    def _first_row(self, index: IndexArray) -> IndexArray:
        return np.asarray(self._model.take(index) * self._grid.cells**2)

    def _coordinates(self, index: IndexArray, point: FloatArray) -> FloatArray:
        """Return cells (n, 2) of points (n, 2), clamped to the tables."""
        s = self._grid.coordinate(point / self.sides.take(index, axis=0))
        return np.asarray(np.minimum(np.maximum(s, 0.0), self._max_coordinate))

    def _start(
        self, index: IndexArray, data: FloatArray, weight: FloatArray, start: ArrayLike | None
    ) -> FloatArray:
        """Return the start in cells (n, 2): the given point, or an estimate from the ratios of opposite
        currents.
        """
        if start is not None:
            s = self._coordinates(index, np.asarray(start, dtype=np.float64).T)
            fresh = np.isnan(s).any(axis=1)
            if not fresh.any():
                return s
            s[fresh] = self._start(index[fresh], data[:, fresh], weight[:, fresh], None)
            return s
        ratios = log_ratios(np.maximum(data, 0.3 / weight))
        ratios = np.where(np.isnan(ratios), 0.0, ratios)  # a channel is excluded: start at the centre
        position = (RATIO_TABLE_SPAN - ratios) * (RATIO_TABLE_CELLS / (2 * RATIO_TABLE_SPAN))
        position = np.minimum(np.maximum(position, 0.0), RATIO_TABLE_CELLS - 1e-9).T
        cell = position.astype(np.intp)
        position -= cell
        cell += (2 * self._model.take(index))[:, None] * (RATIO_TABLE_CELLS + 1)
        cell[:, 1] += RATIO_TABLE_CELLS + 1
        low = self._start_tables.take(cell, mode="clip")
        return np.asarray(low + position * (self._start_tables.take(cell + 1, mode="clip") - low))

    def _basis(self, first_row: IndexArray, s: FloatArray) -> tuple[FloatArray, IndexArray]:
        """Return powers within the cell and their slopes, (n, x or y, value or slope, TERMS), and table
        rows.
        """
        cell = s.astype(np.intp)
        powers = np.empty((len(s), 2, POLYNOMIAL_TERMS))
        powers[:, :, 0] = 1.0
        powers[:, :, 1:] = (s - cell)[:, :, None]
        np.multiply.accumulate(powers, axis=2, out=powers)
        basis = np.matmul(powers.reshape(-1, POLYNOMIAL_TERMS), _WITH_SLOPES).reshape(
            -1, 2, 2, POLYNOMIAL_TERMS
        )
        return basis, first_row + cell[:, 1] * self._grid.cells + cell[:, 0]

    def _read_tables(self, first_row: IndexArray, s: FloatArray) -> FloatArray:
        """Return columns, their slopes along x, along y and their cross slope by cell: (n, 4, COLUMNS)."""
        basis, row = self._basis(first_row, s)
        table = self._table.take(row, axis=0, mode="clip")
        by_y = np.matmul(basis[:, 1], table).reshape(-1, 2, POLYNOMIAL_TERMS, TABLE_COLUMNS)
        rows: FloatArray = np.matmul(basis[:, 0, None], by_y).reshape(-1, 4, TABLE_COLUMNS)
        return rows

    def _linearise(self, readings: _BankReadings, s: FloatArray) -> _NormalEquations:
        """Return the whitened normal equations at s cells."""
        rows = self._read_tables(readings.first_row, s)[:, :, :4]
        rows[:, 3] = readings.data
        rows *= readings.weight[:, None]
        gram = np.matmul(rows, rows.swapaxes(1, 2))
        mixing = gram[:, 1:3, :1] / gram[:, :1, :1]
        return _NormalEquations(rows, gram, mixing, gram[:, 1:3] - mixing * gram[:, :1])

    def _iterate(self, readings: _BankReadings, s: FloatArray) -> PointEstimate:
        """Run Gauss-Newton on the cell coordinates with the total eliminated, all contacts in parallel."""
        longest = _MAX_STEP / self._grid.width
        for _ in range(_MAX_STEPS):
            at = self._linearise(readings, s)
            step, decrement = at.gauss_newton_step(s, self._max_coordinate)
            np.minimum(np.maximum(step, -longest, out=step), longest, out=step)
            step += s
            np.minimum(np.maximum(step, 0.0, out=step), self._max_coordinate, out=step)
            s, step = step, step - s
            unsettled = decrement > _MAX_SETTLED_DECREMENT
            if not np.logical_or.reduce(unsettled):
                break
        return self._result(readings, s, step, at, decrement, ~unsettled)

    def _search(self, readings: _BankReadings) -> PointEstimate:
        """Search from the most likely point of a grid, halving steps until the likelihood rises.

        For contacts barely above their noise: Gauss-Newton alone leads some of them off the pad.
        """
        weighted, squared = (
            readings.data * readings.weight * readings.weight,
            readings.weight * readings.weight,
        )
        fractions = self._search_fractions.take(self._model.take(readings.pad), axis=0)
        along = np.matmul(fractions, weighted[:, :, None])[:, :, 0]
        norm = np.matmul(fractions * fractions, squared[:, :, None])[:, :, 0]
        best = np.argmax(np.square(np.maximum(along, 0.0)) / norm, axis=1)
        s = self._grid.coordinate(_SEARCH_GRID[best])
        at = self._linearise(readings, s)
        damping, settled = np.ones(len(s)), np.zeros(len(s), dtype=np.bool_)
        longest = _MAX_STEP / self._grid.width
        for _ in range(_MAX_SEARCH_STEPS):
            step, decrement = at.gauss_newton_step(s, self._max_coordinate)
            step = np.minimum(np.maximum(step, -longest), longest) * damping[:, None]
            trial = np.minimum(np.maximum(s + step, 0.0), self._max_coordinate)
            new = self._linearise(readings, trial)
            better = (new.cost() <= at.cost()) & (new.total() > 0) | ~(at.total() > 0)
            still = settled | ~better
            settled |= better & (decrement <= _MAX_SETTLED_DECREMENT)
            s = np.where(still[:, None], s, trial)
            at = at.select_where(still, new)
            damping = np.where(better, np.minimum(1.0, 4 * damping), damping / 4)
            if settled.all():
                break
        return self._result(readings, s, np.zeros_like(s), at, np.zeros(len(s)), settled)

    def _result(
        self,
        readings: _BankReadings,
        s: FloatArray,
        step: FloatArray,
        at: _NormalEquations,
        decrement: FloatArray,
        settled: BoolArray,
    ) -> PointEstimate:
        """Return the estimate at s, one last step away from where the model was evaluated."""
        total = at.total()
        step_x, step_y = step.T
        chi_squared = at.gram[:, 3, 3] - total * at.gram[:, 0, 3] - decrement
        np.maximum(chi_squared, 0.0, out=chi_squared)
        pair = at.rows[:, :3, 0] / readings.weight[:, :1] + at.rows[:, :3, 1] / readings.weight[:, 1:2]
        total *= 1 - at.mixing[:, 0, 0] * step_x - at.mixing[:, 1, 0] * step_y
        residual = (readings.data[:, 0] + readings.data[:, 1]) / total
        residual -= pair[:, 0] + pair[:, 1] * step_x + pair[:, 2] * step_y
        fraction = self._grid.fraction(s)
        point = readings.sides * fraction
        covariance = at.covariance(total, (self._grid.width * (1 - fraction)) * point)
        found = total > 0
        if not np.logical_and.reduce(found):
            point[~found] = covariance[~found] = np.nan
        estimate = PointEstimate(
            point[:, 0], point[:, 1], total, residual, chi_squared, covariance, settled & found
        )
        self._move_out_of_corners(readings, point, estimate)
        _mark_unobservable(point, readings.sides, covariance)
        return estimate

    def _move_out_of_corners(self, readings: _BankReadings, point: FloatArray, found: PointEstimate) -> None:
        """Move points out of corners, in place, to where the currents carry information, as in `estimate`."""
        nearest = np.minimum(point, readings.sides - point)
        distance = nearest[:, 0] ** 2 + nearest[:, 1] ** 2
        shortest = self._shortest_side2.take(readings.pad)
        if not np.logical_or.reduce(distance < 0.0625 * shortest):
            return
        noise = 2 / np.sqrt((readings.weight * readings.weight).sum(axis=1))
        radius = shortest * np.minimum(
            CORNER_RADIUS_FACTOR * CORNER_RADIUS_FACTOR * noise / found.total, 0.0625
        )
        which = np.flatnonzero(distance < radius)
        if not which.size:
            return
        readings = readings.select(which)
        far = 2 * point[which] > readings.sides
        corner, inward = (
            np.where(far, readings.sides, 0.0).T,
            np.where(far, -1.0, 1.0).T * np.sqrt(radius[which]),
        )

        def linearised(place: FloatArray) -> tuple[FloatArray, FloatArray]:
            at, scale = self._linearise_at(readings, place.T)
            slopes = at.slopes() * (at.total()[:, None] / scale)[:, :, None]
            return at.residuals().T, np.moveaxis(slopes, 0, -1)

        angle = most_likely_direction(
            linearised, corner, inward, np.arctan2(nearest[which, 1], nearest[which, 0])
        )
        point[which] = (corner + inward * np.stack([np.cos(angle), np.sin(angle)])).T
        at, scale = self._linearise_at(readings, point[which])
        total = at.total()
        found.total[which], found.chi_squared[which] = total, at.cost()
        found.residual[which] = (at.residuals()[:, :2] / readings.weight[:, :2]).sum(axis=1) / total
        found.covariance[which] = at.covariance(total, scale)
        found.converged[which] = total > 0

    def _linearise_at(
        self, readings: _BankReadings, point: FloatArray
    ) -> tuple[_NormalEquations, FloatArray]:
        """Return the normal equations at points (n, 2), and lengths of a cell there, (n, 2)."""
        s = self._coordinates(readings.pad, point)
        fraction = self._grid.fraction(s)
        return self._linearise(readings, s), readings.sides * fraction * (1 - fraction) * self._grid.width


class TableTangent(NamedTuple):
    """Tables of n pads linearised at a point of each, with slopes along x and y per `reach`.

    point (n, 2): x and y, kept inside the tables. reach (n, 2): the length over which all quantities vary, a
    quarter of a side in the middle, the distance near an edge. fractions (n, 4), slopes (n, 2, 4). log_radius
    (n,), radius_slopes (n, 2): of `conformal_radius`.
    """

    point: FloatArray
    reach: FloatArray

    fractions: FloatArray
    slopes: FloatArray
    log_radius: FloatArray
    radius_slopes: FloatArray


class _BankReadings(NamedTuple):
    """Measured currents (n, 4) and weights, with their pads (n,), the tables' first rows (n,), sides (n,
    2).
    """

    pad: IndexArray
    first_row: IndexArray
    sides: FloatArray
    data: FloatArray
    weight: FloatArray

    def select(self, which: IndexArray) -> _BankReadings:
        """Return those of the contacts `which`."""
        return _BankReadings(
            self.pad[which], self.first_row[which], self.sides[which], self.data[which], self.weight[which]
        )


class _NormalEquations(NamedTuple):
    """Least squares at one point of each contact, in cells.

    rows: whitened fractions, their slopes along x and y, and the data, (n, 4, 4). gram: their products.
    mixing: the part of the slopes that the total absorbs, per total, (n, 2, 1). reduced: products of the rest
    of the slopes with the fractions (zero), the slopes and the data, (n, 2, 4).
    """

    rows: FloatArray
    gram: FloatArray
    mixing: FloatArray
    reduced: FloatArray

    def select_where(self, keep: BoolArray, other: _NormalEquations) -> _NormalEquations:
        """Return these where `keep` (n,), else the others."""
        return _NormalEquations(
            *(np.where(keep[:, None, None], mine, its) for mine, its in zip(self, other, strict=True))
        )

    def slopes(self) -> FloatArray:
        """Return the slopes of the fractions by cell, less the part that the total absorbs, (n, 2, 4)."""
        return self.rows[:, 1:3] - self.mixing * self.rows[:, :1]

    def residuals(self) -> FloatArray:
        """Return the residuals of the data with the best total, (n, 4)."""
        return self.rows[:, 3] - self.total()[:, None] * self.rows[:, 0]

    def cost(self) -> FloatArray:
        """Return the sum of squared residuals at this point with the best total, (n,)."""
        return np.asarray(self.gram[:, 3, 3] - self.total() * self.gram[:, 0, 3])

    def total(self) -> FloatArray:
        """Return the best total at this point, (n,)."""
        return np.asarray(self.gram[:, 0, 3] / self.gram[:, 0, 0])

    def gauss_newton_step(self, s: FloatArray, top: float) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton step (n, 2) and squared decrement; coordinates at a table's end are
        fixed.
        """
        reduced = self.reduced
        if np.fmin.reduce(s, axis=None, initial=top) <= 0 or np.fmax.reduce(s, axis=None, initial=0) >= top:
            reduced = _hold_at_table_ends(reduced, s, top)
        xx, xy, yy = reduced[:, 0, 1], reduced[:, 0, 2], reduced[:, 1, 2]
        gradient = reduced[:, :, 3]
        gradient_x, gradient_y = gradient[:, 0], gradient[:, 1]
        step = np.empty(s.shape)
        np.subtract(yy * gradient_x, xy * gradient_y, out=step[:, 0])
        np.subtract(xx * gradient_y, xy * gradient_x, out=step[:, 1])
        step /= (xx * yy - xy * xy)[:, None]
        decrement = step[:, 0] * gradient_x + step[:, 1] * gradient_y
        step /= self.total()[:, None]
        return step, decrement

    def covariance(self, total: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the inverse Fisher information of (x, y, total), (n, 3, 3); scale: lengths of a cell, (n,
        2).
        """
        by_cell = estimate_covariance(
            np.moveaxis(self.slopes() * total[:, None, None], 0, -1),
            self.mixing[:, :, 0].T * total,
            self.rows[:, 0].T,
            np.zeros(len(total)),
        )
        units = np.concatenate([scale, np.ones((len(scale), 1))], axis=1)
        return np.where(by_cell == 0, 0.0, by_cell * units[:, :, None] * units[:, None])


def _hold_at_table_ends(reduced: FloatArray, s: FloatArray, top: float) -> FloatArray:
    """Return the normal equations without the coordinates that would leave the table."""
    gradient = reduced[:, :, 3]
    held = ((s <= 0) & (gradient < 0)) | ((s >= top) & (gradient > 0))
    reduced = np.where(held[:, :, None], 0.0, reduced)
    reduced[:, :, 1:3][held[:, None, :].repeat(2, axis=1)] = 0.0
    reduced[:, 0, 1] += held[:, 0]
    reduced[:, 1, 2] += held[:, 1]
    return reduced


def _mark_unobservable(point: FloatArray, sides: FloatArray, covariance: FloatArray) -> None:
    """Set coordinates that the currents don't determine to NaN, with infinite variance; in place."""
    variance = covariance.reshape(-1, 9)[:, :5:4]
    limit = MAX_STD_SIDES * sides
    held = (variance >= 0) & (variance <= limit * limit)
    if np.logical_and.reduce(held, axis=None):
        return
    lost = ~held
    point[lost] = np.nan
    for axis in range(2):
        covariance[lost[:, axis], axis] = 0.0
        covariance[lost[:, axis], :, axis] = 0.0
        covariance[lost[:, axis], axis, axis] = np.inf
