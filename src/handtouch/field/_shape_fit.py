"""Most likely points, lines and pairs of contacts from the currents of many measurements at once.

Currents are sums of totals times columns that depend on positions. Totals, one for each contact and state of
a schedule, are eliminated: they are the best non-negative ones for given positions. Positions are found by
damped Gauss-Newton steps (Levenberg-Marquardt) from the best of several starts.

Lengths are in units of the larger side. Arrays are (n, ...), n measurements; currents (n, states, channels).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from handtouch.field.model import FloatArray, ForwardModel, move_inside

BoolArray = NDArray[np.bool_]
Indices = NDArray[np.intp]
Fractions = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From x, y (n,) to fractions (n, states, channels) and derivatives (n, states, channels, 2)."""

_MAX_STEPS = 60
_SETTLED_GAIN = 1e-6  # of the sum of squares, in variances
_ROUNDING = 1e-14  # of the squared currents
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-9, 1e10
_MAX_STEP, _MAX_MOMENT_STEP = 0.2, 0.04
_MIN_HALF_LENGTH = 1e-3  # at which derivatives by moments are taken for shorter lines
_LINE_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_LINE_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
_POINT_GRID, _PAIR_GRID, _GRID_OFFSET = 25, 11, 0.4681
_START_LENGTHS, _START_ANGLES = (0.2, 0.5), np.pi * np.arange(4) / 4
_BATCH = 256
_MAX_MISFIT = 3.0  # variances per channel; with more, another start is tried
_MAX_CONDITION = 1e7  # of the scaled Jacobian


@dataclass(frozen=True)
class Shape:
    """Parameters of a shape: the contact that each belongs to, the largest step of each, and the columns.

    columns: from fractions and places (n, parameters) to columns (n, states, channels, contacts) and their
    derivatives by the parameters (n, states, channels, parameters).
    """

    owner: Indices
    max_step: FloatArray
    columns: Callable[[Fractions, FloatArray], tuple[FloatArray, FloatArray]]

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return int(self.owner[-1]) + 1


@dataclass
class ShapeSolution:
    """Contacts of one shape: places (n, parameters), totals (n, states, contacts), sums of squared residuals
    in variances (n,).
    """

    shape: Shape
    place: FloatArray
    total: FloatArray
    cost: FloatArray
    converged: BoolArray


def _point_columns(fractions: Fractions, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    values, slopes = fractions(place[:, 0], place[:, 1])
    return values[..., None], slopes


def _pair_columns(fractions: Fractions, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    first, second = (fractions(place[:, k], place[:, k + 1]) for k in (0, 2))
    return np.stack([first[0], second[0]], axis=-1), np.concatenate([first[1], second[1]], axis=-1)


def _line_columns(fractions: Fractions, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A line from -e to e has the second moments e^2 / 3, in complex numbers."""
    count = len(place)
    half = np.sqrt(3 * (place[:, 2] + 1j * place[:, 3]))
    short = np.abs(half) < _MIN_HALF_LENGTH
    used = np.where(short, _MIN_HALF_LENGTH, half)
    nodes = (place[:, 0] + 1j * place[:, 1]) + _LINE_NODES[:, None] * used
    values, slopes = fractions(nodes.real.ravel(), nodes.imag.ravel())
    values = values.reshape(3, count, *values.shape[1:])
    gradient = slopes.reshape(3, count, *slopes.shape[1:])
    if short.any():
        nodes = nodes[:, short] + _LINE_NODES[:, None] * (half - used)[short]
        exact = fractions(nodes.real.ravel(), nodes.imag.ravel())[0]
        values[:, short] = exact.reshape(3, -1, *exact.shape[1:])
    per_moment = (_LINE_NODES[:, None] * 1.5 / used)[..., None, None]
    along = (gradient[..., 0] - 1j * gradient[..., 1]) * per_moment  # d/d(M_xx - M_yy) - i d/d(2 M_xy)
    parts = np.concatenate([gradient, along.real[..., None], -along.imag[..., None]], axis=-1)
    return np.tensordot(_LINE_WEIGHTS, values, 1)[..., None], np.tensordot(_LINE_WEIGHTS, parts, 1)


POINT = Shape(np.array([0, 0]), np.full(2, _MAX_STEP), _point_columns)
LINE = Shape(
    np.array([0, 0, 0, 0]),
    np.array([_MAX_STEP, _MAX_STEP, _MAX_MOMENT_STEP, _MAX_MOMENT_STEP]),
    _line_columns,
)
PAIR = Shape(np.array([0, 0, 1, 1]), np.full(4, _MAX_STEP), _pair_columns)


@dataclass(frozen=True)
class _Linearised:
    """A shape at some places: totals (n, states, contacts), residuals (n, states, channels), derivatives of
    the currents (n, states, channels, parameters) less what totals absorb, and sums of squares (n,).
    """

    total: FloatArray
    misfit: FloatArray
    slopes: FloatArray
    cost: FloatArray

    def assign(self, index: Indices | BoolArray, other: _Linearised, chosen: BoolArray) -> None:
        """Overwrite some by chosen ones of another."""
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(other, field.name)[chosen]


class ShapeFit:
    """Fits to `currents` (channels, n) with standard deviations `sigma` (channels, n)."""

    def __init__(self, model: ForwardModel, currents: FloatArray, sigma: FloatArray, states: int) -> None:
        self.model, self.states, self.channels = model, states, len(currents)
        self.unit = max(model.a, model.b)
        with np.errstate(all="ignore"):
            weight = 1 / np.where(sigma > 0, sigma, np.nan)
            data = np.where(weight == 0, 0.0, currents) * weight
        self._weight, self._data = self._by_state(weight), self._by_state(data)
        self.known: BoolArray = np.asarray(np.isfinite(self._data).all(axis=(1, 2)))
        self._least_gain = np.maximum(_SETTLED_GAIN, _ROUNDING * (self._data**2).sum(axis=(1, 2)))

    @np.errstate(all="ignore")
    def fit_point(self) -> ShapeSolution:
        """Return the most likely point of every measurement."""
        grid, table = self._grid(_POINT_GRID)
        begin = np.full((len(self._data), 2), np.nan)
        for some in _batches(np.flatnonzero(self.known)):
            along = np.einsum("nsc,gsc->nsg", self._data[some] * self._weight[some], table)
            norm = np.einsum("nsc,gsc->nsg", self._weight[some] ** 2, table**2)
            begin[some] = grid[np.argmax((np.maximum(along, 0) ** 2 / norm).sum(axis=1), axis=1)]
        return self._climb(POINT, begin, np.flatnonzero(self.known))

    @np.errstate(all="ignore")
    def fit_line(self, point: ShapeSolution) -> ShapeSolution:
        """Return the most likely line of every measurement, at least as likely as its point."""
        every = np.flatnonzero(self.known)
        best = np.concatenate([point.place, np.zeros((len(point.place), 2))], axis=1)
        least = point.cost[every]
        for moment in (s**2 / 12 * np.exp(2j * q) for s in _START_LENGTHS for q in _START_ANGLES):
            trial = np.concatenate([point.place, np.full((len(best), 2), [moment.real, moment.imag])], axis=1)
            cost = self._linearise(LINE, trial[every], every).cost
            better = cost < least
            best[every[better]], least[better] = trial[every[better]], cost[better]
        return self._climb(LINE, best, every)

    @np.errstate(all="ignore")
    def fit_pair(self, line: ShapeSolution, some: Indices) -> ShapeSolution:
        """Return the most likely pair of measurements `some`, the contact of smaller x first; others NaN."""
        half = np.sqrt(line.place[:, 2] + 1j * line.place[:, 3])
        offset = np.stack([half.real, half.imag], axis=1)
        ends = np.concatenate([line.place[:, :2] - offset, line.place[:, :2] + offset], axis=1)
        begin = self._best_pair_of_grid(some)
        first, second = (self._linearise(PAIR, start[some], some).cost for start in (begin, ends))
        exchanged = some[second < first]
        begin[exchanged], ends[exchanged] = ends[exchanged], begin[exchanged]
        found = self._climb(PAIR, begin, some)
        other = self._climb(PAIR, ends, some[~(found.cost[some] < _MAX_MISFIT * self.channels)])
        better = other.cost < np.where(np.isfinite(found.cost), found.cost, np.inf)
        for name in ("place", "total", "cost", "converged"):
            getattr(found, name)[better] = getattr(other, name)[better]
        swap = found.place[:, 0] > found.place[:, 2]
        found.place[swap] = found.place[swap][:, [2, 3, 0, 1]]
        found.total[swap] = found.total[swap][..., ::-1]
        return found

    @np.errstate(all="ignore")
    def covariance(self, at: ShapeSolution) -> FloatArray:
        """Return the inverse Fisher information (n, k, k) of places, then totals, contact by contact.

        NaN where it is singular, or a total isn't positive.
        """
        contacts, places = at.shape.contacts, at.place.shape[1]
        size = places + contacts * self.states
        found = np.full((len(at.place), size, size), np.nan)
        some = np.flatnonzero((at.total > 0).all(axis=(1, 2)))
        columns, slopes = self._columns(at.shape, at.place[some], some)
        matrix = np.zeros((*columns.shape[:3], size))
        matrix[..., :places] = slopes * at.total[some][:, :, None, at.shape.owner]
        for contact in range(contacts):
            for state in range(self.states):
                matrix[:, state, :, places + contact * self.states + state] = columns[:, state, :, contact]
        matrix = matrix.reshape(len(some), self.channels, size)
        scale = np.sqrt((matrix**2).sum(axis=1))
        good = np.isfinite(scale).all(axis=1) & (scale > 0).all(axis=1)
        good[good] = np.linalg.cond(matrix[good] / scale[good, None]) < _MAX_CONDITION
        scaled, scale = matrix[good] / scale[good, None], scale[good]
        inverse = np.linalg.inv(scaled.swapaxes(1, 2) @ scaled)
        found[some[good]] = inverse / scale[:, :, None] / scale[:, None, :]
        return found

    def _by_state(self, values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(values.T).reshape(-1, self.states, len(values) // self.states)

    def _fractions(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        f, jacobian = self.model.fractions_with_jacobian(x * self.unit, y * self.unit)
        slopes = np.moveaxis(jacobian, 2, 0) * self.unit
        return self._by_state(f), slopes.reshape(-1, self.states, len(f) // self.states, 2)

    def _columns(self, shape: Shape, place: FloatArray, index: Indices) -> tuple[FloatArray, FloatArray]:
        columns, slopes = shape.columns(self._fractions, place)
        weight = self._weight[index][..., None]
        return columns * weight, slopes * weight

    def _linearise(self, shape: Shape, place: FloatArray, index: Indices) -> _Linearised:
        """Evaluate a shape at places (n, parameters) of measurements `index`; infinite cost off the pad."""
        columns, slopes = self._columns(shape, place, index)
        data = self._data[index]
        total, absorb = _best_totals(columns, data)
        misfit = data - np.einsum("nsck,nsk->nsc", columns, total)
        slopes = slopes * total[:, :, None, shape.owner]
        slopes = slopes - columns @ (absorb @ slopes)
        cost = (misfit**2).sum(axis=(1, 2))
        return _Linearised(total, misfit, slopes, np.where(np.isfinite(cost), cost, np.inf))

    def _climb(self, shape: Shape, begin: FloatArray, some: Indices) -> ShapeSolution:
        """Return the maxima next to `begin` (all, parameters) of measurements `some`, others NaN."""
        place = self._move_inside(shape, begin[some])
        best = self._linearise(shape, place, some)
        converged = np.zeros(len(some), np.bool_)
        damping = np.full(len(some), _FIRST_DAMPING)
        active = np.flatnonzero(np.isfinite(best.cost))
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            slopes = best.slopes[active].reshape(active.size, self.channels, place.shape[1])
            normal = slopes.swapaxes(1, 2) @ slopes
            gradient = np.einsum(
                "ncp,nc->np", slopes, best.misfit[active].reshape(active.size, self.channels)
            )
            diagonal = np.einsum("npp->np", normal)
            diagonal += damping[active, None] * (diagonal + 1e-12 * diagonal.max(axis=1)[:, None] + 1e-300)
            step = np.linalg.solve(normal, gradient[..., None])[..., 0]
            step /= np.maximum(1.0, (np.abs(step) / shape.max_step).max(axis=1))[:, None]
            gain = (gradient * step).sum(axis=1)
            trial = self._move_inside(shape, place[active] + step)
            new = self._linearise(shape, trial, some[active])
            accept = new.cost <= best.cost[active]
            little = np.where(accept, best.cost[active] - new.cost, gain) < self._least_gain[some[active]]
            place[active[accept]] = trial[accept]
            best.assign(active[accept], new, accept)
            damping[active] = np.clip(
                np.where(accept, damping[active] / 8, damping[active] * 6), _MIN_DAMPING, _MAX_DAMPING
            )
            done = (little & (damping[active] < 1)) | (gain < self._least_gain[some[active]])
            converged[active[done]] = True
            active = active[~done & (damping[active] < _MAX_DAMPING)]
        return self._spread(shape, some, place, best, converged)

    def _spread(
        self, shape: Shape, some: Indices, place: FloatArray, best: _Linearised, converged: BoolArray
    ) -> ShapeSolution:
        """Return the solution of all measurements, NaN for others than `some`."""
        count = len(self._data)

        def spread(values: FloatArray) -> FloatArray:
            full = np.full((count, *values.shape[1:]), np.nan)
            full[some] = values
            return full

        done = np.zeros(count, np.bool_)
        done[some] = converged & (best.total > 0).all(axis=(1, 2))
        return ShapeSolution(shape, spread(place), spread(best.total), spread(best.cost), done)

    def _move_inside(self, shape: Shape, place: FloatArray) -> FloatArray:
        """Return places with points, centres of lines, and both contacts of pairs on the pad."""
        place = np.array(place)
        for k in range(0, 2 * shape.contacts, 2):
            x, y = move_inside(self.model, place[:, k] * self.unit, place[:, k + 1] * self.unit)
            place[:, k], place[:, k + 1] = x / self.unit, y / self.unit
        return place

    def _grid(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return points of the pad (g, 2) and their fractions (g, states, channels)."""
        side = (np.arange(count) + _GRID_OFFSET) / count
        x, y = (c.ravel() for c in np.meshgrid(side * self.model.a, side * self.model.b))
        f = self.model.fractions(x, y)
        on_pad = np.isfinite(f).all(axis=0)
        return np.stack([x, y], axis=1)[on_pad] / self.unit, self._by_state(f[:, on_pad])

    def _best_pair_of_grid(self, some: Indices) -> FloatArray:
        """Return the most likely pairs of grid points (all, 4) for measurements `some`."""
        grid, table = self._grid(_PAIR_GRID)
        i, j = np.triu_indices(len(grid), 1)
        begin = np.full((len(self._data), 4), np.nan)
        for part in _batches(some):
            weight = self._weight[part]
            along = np.einsum("nsc,gsc->nsg", self._data[part] * weight, table)
            same = (weight == weight[:1]).all()  # then the matrix is that of all
            gram = np.einsum(
                "nsc,gsc,hsc->nsgh", (weight[:1] if same else weight) ** 2, table, table, optimize=True
            )
            norm = np.einsum("nsgg->nsg", gram)
            ai, aj, ii, jj, ij = along[..., i], along[..., j], norm[..., i], norm[..., j], gram[..., i, j]
            first, second = ai * jj - aj * ij, aj * ii - ai * ij
            both = (ai * first + aj * second) / (ii * jj - ij * ij)
            one = np.maximum(np.maximum(ai, 0) ** 2 / ii, np.maximum(aj, 0) ** 2 / jj)
            likelihood = np.where((first > 0) & (second > 0), both, one).sum(axis=1)
            chosen = np.argmax(likelihood, axis=1)
            begin[part] = np.concatenate([grid[i[chosen]], grid[j[chosen]]], axis=1)
        return begin


def _best_totals(columns: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the best non-negative totals (n, states, contacts) of one or two columns, and the matrices
    (n, states, contacts, channels) from changes of the currents to those of the totals.
    """
    along = np.einsum("nsck,nsc->nsk", columns, data)
    norm = (columns**2).sum(axis=2)
    alone = np.maximum(along / norm, 0.0)
    if columns.shape[3] == 1:
        return alone, np.where(alone > 0, 1 / norm, 0.0)[..., None] * columns.swapaxes(2, 3)
    mixed = (columns[..., 0] * columns[..., 1]).sum(axis=2)
    determinant = norm[..., 0] * norm[..., 1] - mixed**2
    inverse = np.stack([norm[..., 1], -mixed, -mixed, norm[..., 0]], axis=-1) / determinant[..., None]
    inverse = inverse.reshape(*mixed.shape, 2, 2)
    both = np.einsum("nskl,nsl->nsk", inverse, along)
    positive = (both > 0).all(axis=-1) & (determinant > 1e-12 * norm[..., 0] * norm[..., 1])
    better = (alone**2 * norm).argmax(axis=-1)[..., None] == np.arange(2)
    single = np.where(better, alone, 0.0)
    single_inverse = np.where(single > 0, 1 / norm, 0.0)[..., None] * np.eye(2)
    total = np.where(positive[..., None], both, single)
    return total, np.where(positive[..., None, None], inverse, single_inverse) @ columns.swapaxes(2, 3)


def _batches(index: Indices) -> list[Indices]:
    return np.array_split(index, max(1, -(-index.size // _BATCH)))
