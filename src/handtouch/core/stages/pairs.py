"""Two contacts on one pad: the most likely pair for the currents, its covariance, and the evidence for it.

Gauss-Newton on both positions with both totals eliminated, from the most likely pairs of a coarse grid;
noise and tolerances are those of `tolerances.whiten_pair`. A pair is accepted where one contact, which may be
elongated, doesn't explain the currents at the false-alarm rate (their squared misfit has at most n - 3
degrees of freedom), the pair is more likely by as much, it explains them, and no other pair far from it does.
"""

from __future__ import annotations

import math

from handtouch.core.memory import number_memory
from handtouch.core.pad_tables import SEARCH_POINTS
from handtouch.core.stages import locate, tables, tolerances

_GRID_STEP, _STARTS, _MAX_STEPS, _MAX_WHITENINGS = 2, 10, 40, 4
_SOLUTION, _MAX_SOLUTIONS = 5, 16  # s, t of both, and their cost
_POWER_STEPS, _ASIDE_CELLS, _FARTHER = 4, 5.0, 3.0  # of a search along the direction of least information
_MAX_STEP_CELLS, _MAX_WHITENING_CELLS = 7.0, 1.0
_MAX_SETTLED_DECREMENT = 1e-3
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-6, 1e6
_MIN_DETERMINANT = 1e-10
_MIN_TOTAL_SIGMA = 3.0
_MAX_STD_SIDES = 0.25  # of a position, in shorter sides
_MAX_OTHER_COST = 6.0  # of another pair, more than the best one's, for which the currents are ambiguous, if
_MIN_OTHER_SIDES = 0.15  # one of its contacts is this far from both, in shorter sides
_INFINITY = math.inf


class PairFit:
    """Working memory of the fit of two contacts, and its result; k numbers the contact, 0 or 1.

    grid: (g n,) whitened fractions at g points, gain: (g g,) reduction of the cost by each pair, of points
    i < j. raw: (3 columns,) what was read last. fractions: (2 n,) as read, then whitened. spread: (2,) ln of
    the spreading radius, and its slopes by cell, (2,) each. slopes: (4 n,) whitened, by s and t of the first
    and of the second, less what the totals absorb. normal, factor: (16,). gradient, step: (4,). mixing:
    (8,) absorbed by each total. place, best, other: (4,) s, t of both. total: (2,). weakest: (4,) direction
    of least information. solutions: (5 count,) pairs found, with their cost; apart: (4,) distance of others.
    """

    def __init__(self, electrodes: int) -> None:
        """Prepare for pads of at most so many electrodes."""
        n = electrodes
        self.grid_points = (SEARCH_POINTS + _GRID_STEP - 1) // _GRID_STEP
        points = self.grid_points * self.grid_points
        self.raw, self.fractions = number_memory(3 * (n + 1)), number_memory(2 * n)
        self.whitened, self.slopes = number_memory(2 * n), number_memory(4 * n)
        self.spreading = number_memory(6)
        self.normal, self.factor, self.covariance = number_memory(16), number_memory(16), number_memory(16)
        self.gradient, self.step, self.mixing = number_memory(4), number_memory(4), number_memory(8)
        self.place, self.best, self.other = number_memory(4), number_memory(4), number_memory(4)
        self.total, self.var_total, self.with_total = number_memory(2), number_memory(2), number_memory(4)
        self.weakest, self.apart = number_memory(4), number_memory(4)
        self.solutions = number_memory(_SOLUTION * _MAX_SOLUTIONS)
        self.grid, self.gain = number_memory(points * n), number_memory(points * points)
        self.cost = self.decrement = self.g11 = self.g12 = self.g22 = 0.0
        self.count = 0
        self.is_settled = self.is_unique = self.found = False


def fit_pair(
    table: locate.ModelTable,
    fit: locate.Fit,
    pair: PairFit,
    moment_std: float,
    limit: float,
) -> None:
    """Fit two contacts to the readings in `fit`, which holds the most likely single one.

    `pair.found`: the pair is accepted. moment_std: of an elongated single contact, see
    `tolerances.whiten_elongated`. limit: of the squared misfit of a single contact, and of the logarithm of
    the likelihood ratio, twice. `fit` is working memory.
    """
    pair.found = False
    locate.locate_elongated(table, fit, moment_std)
    one = fit.cost if fit.total > 0.0 else _INFINITY
    if not one > limit:
        return
    tolerances.whiten_by_gains(fit.whitening, fit.readings)
    tolerances.apply_whitening(fit.whitening, fit.readings, 0, fit.data)
    _search(table, fit, pair)
    if not pair.cost < _INFINITY:
        return
    for _ in range(_MAX_WHITENINGS):
        for k in range(4):
            pair.other[k] = pair.place[k]
        tolerances.whiten_pair(fit.whitening, pair.fractions, pair.total, pair.place)
        for i in range(table.electrodes):
            fit.scaled[i] = fit.readings[i] - fit.whitening.shift[i]
        tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.data)
        _maximise(table, fit, pair)
        if not pair.cost < _INFINITY:
            return
        away = 0.0
        for k in range(4):
            away = max(away, abs(pair.place[k] - pair.other[k]))
        if away <= _MAX_WHITENING_CELLS:
            break
    explained = pair.cost <= limit and one - pair.cost > limit
    if explained and pair.is_settled and _invert_information(table, pair):
        _add_other_solutions(table, pair)
        pair.found = pair.is_unique and _is_determined(table, pair)


def _search(table: locate.ModelTable, fit: locate.Fit, pair: PairFit) -> None:
    """Fit from the most likely pairs of the grid, and beside the best; keep all results."""
    n, side, all_points = table.electrodes, pair.grid_points, table.points
    points = side * side
    for k in range(points):
        at = (k // side) * _GRID_STEP * all_points + (k % side) * _GRID_STEP
        for i in range(n):
            fit.scaled[i] = table.search_fractions[at * n + i] * fit.weight[i]
        tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.fractions)
        for i in range(n):
            pair.grid[k * n + i] = fit.fractions[i]
    _weigh_grid(fit, pair, n, points)
    pair.count = 0
    for _ in range(_STARTS):
        first = second = -1
        highest = 0.0
        for i in range(points):
            for j in range(i + 1, points):
                if pair.gain[i * points + j] > highest:
                    highest = pair.gain[i * points + j]
                    first, second = i, j
        if first < 0:
            break
        for i in range(points):
            for j in range(i + 1, points):
                near = _is_near(i, first, side) and _is_near(j, second, side)
                if near or (_is_near(i, second, side) and _is_near(j, first, side)):
                    pair.gain[i * points + j] = 0.0
        for k in range(2):
            at = first if k == 0 else second
            pair.place[2 * k] = table.search_cells[(at % side) * _GRID_STEP]
            pair.place[2 * k + 1] = table.search_cells[all_points + (at // side) * _GRID_STEP]
        _maximise(table, fit, pair)
        _keep_solution(pair)
    _move_to_best(table, fit, pair)
    if pair.cost < _INFINITY:
        _search_along_weakest(table, fit, pair)
        _move_to_best(table, fit, pair)


def _search_along_weakest(table: locate.ModelTable, fit: locate.Fit, pair: PairFit) -> None:
    """Fit from both sides of the best pair, along the direction in which the currents change least."""
    for v in range(4):
        for w in range(4):
            pair.factor[4 * v + w] = pair.normal[4 * v + w]
        pair.step[v] = 1.0
    if not _factorise(pair):
        return
    for _ in range(_POWER_STEPS):
        _substitute(pair)
        longest = 0.0
        for v in range(4):
            longest = max(longest, abs(pair.step[v]))
        for v in range(4):
            pair.step[v] /= longest
    for v in range(4):
        pair.weakest[v], pair.best[v] = pair.step[v], pair.place[v]
    for k in range(4):
        cells = _ASIDE_CELLS * (1.0 if k < 2 else _FARTHER) * (1.0 if k % 2 == 0 else -1.0)
        for v in range(4):
            pair.place[v] = locate.clamp(table, pair.best[v] + cells * pair.weakest[v])
        _maximise(table, fit, pair)
        _keep_solution(pair)


def _keep_solution(pair: PairFit) -> None:
    """Keep the pair that was reached, if it is a maximum."""
    if not (pair.cost < _INFINITY and pair.is_settled):
        return
    for v in range(4):
        pair.solutions[_SOLUTION * pair.count + v] = pair.place[v] + pair.step[v]
    pair.solutions[_SOLUTION * pair.count + 4] = pair.cost
    pair.count += 1


def _move_to_best(table: locate.ModelTable, fit: locate.Fit, pair: PairFit) -> None:
    """Move to the most likely of the solutions; infinite cost if there is none."""
    best = -1
    for k in range(pair.count):
        cost = pair.solutions[_SOLUTION * k + 4]
        if best < 0 or cost < pair.solutions[_SOLUTION * best + 4]:
            best = k
    pair.cost = _INFINITY
    if best < 0:
        return
    for v in range(4):
        pair.place[v] = locate.clamp(table, pair.solutions[_SOLUTION * best + v])
    _linearise(table, fit, pair)


def _add_other_solutions(table: locate.ModelTable, pair: PairFit) -> None:
    """Widen the covariance by other pairs near it that are about as likely; it isn't unique if one is far."""
    limit = _MIN_OTHER_SIDES * min(table.side_x, table.side_y)
    pair.is_unique = True
    cost = _INFINITY
    for v in range(4):
        pair.apart[v] = 0.0
    for k in range(pair.count):
        cost = min(cost, pair.solutions[_SOLUTION * k + 4])
    for k in range(pair.count):
        if pair.solutions[_SOLUTION * k + 4] - cost > _MAX_OTHER_COST:
            continue
        kept = crossed = 0.0
        for v in range(4):
            nodes = table.nodes_x if v % 2 == 0 else table.nodes_y
            at = locate.coordinate(nodes, table.cells, pair.place[v])
            other = locate.clamp(table, pair.solutions[_SOLUTION * k + v])
            pair.step[v] = locate.coordinate(nodes, table.cells, other) - at
            other = locate.clamp(table, pair.solutions[_SOLUTION * k + (v + 2) % 4])
            pair.gradient[v] = locate.coordinate(nodes, table.cells, other) - at
            kept = max(kept, abs(pair.step[v]))
            crossed = max(crossed, abs(pair.gradient[v]))
        if min(kept, crossed) > limit:
            pair.is_unique = False
            return
        for v in range(4):
            away = pair.step[v] if kept <= crossed else pair.gradient[v]
            pair.apart[v] = max(pair.apart[v], abs(away))
    for v in range(4):
        pair.covariance[5 * v] += pair.apart[v] * pair.apart[v]


def _weigh_grid(fit: locate.Fit, pair: PairFit, n: int, points: int) -> None:
    """Compute the reduction of the cost by each pair of grid points, 0 without two positive totals."""
    for i in range(points):
        along_i = norm_i = 0.0
        for c in range(n):
            along_i += pair.grid[i * n + c] * fit.data[c]
            norm_i += pair.grid[i * n + c] * pair.grid[i * n + c]
        for j in range(i + 1, points):
            along_j = norm_j = mixed = 0.0
            for c in range(n):
                f = pair.grid[j * n + c]
                along_j += f * fit.data[c]
                norm_j += f * f
                mixed += f * pair.grid[i * n + c]
            determinant = norm_i * norm_j - mixed * mixed
            pair.gain[i * points + j] = 0.0
            if determinant > _MIN_DETERMINANT * norm_i * norm_j:
                first = (along_i * norm_j - along_j * mixed) / determinant
                second = (along_j * norm_i - along_i * mixed) / determinant
                if first > 0.0 and second > 0.0:
                    pair.gain[i * points + j] = along_i * first + along_j * second


def _is_near(point: int, other: int, side: int) -> bool:
    """Return True for neighbours on the grid."""
    rows, columns = point // side - other // side, point % side - other % side
    return -1 <= rows <= 1 and -1 <= columns <= 1


def _maximise(table: locate.ModelTable, fit: locate.Fit, pair: PairFit) -> None:
    """Iterate from `place` by damped Gauss-Newton steps; `is_settled` where the maximum was reached."""
    pair.is_settled = False
    _linearise(table, fit, pair)
    if not pair.cost < _INFINITY:
        return
    damping = _FIRST_DAMPING
    for _ in range(_MAX_STEPS):
        _compute_step(table, pair, damping)
        if pair.decrement <= _MAX_SETTLED_DECREMENT and damping <= 1.0:
            pair.is_settled = True
            return
        cost = pair.cost
        for k in range(4):
            pair.other[k] = pair.place[k]
            pair.place[k] = locate.clamp(table, pair.place[k] + pair.step[k])
        _linearise(table, fit, pair)
        if pair.cost <= cost:
            damping = max(0.1 * damping, _MIN_DAMPING)
            continue
        for k in range(4):
            pair.place[k] = pair.other[k]
        _linearise(table, fit, pair)
        damping *= 10.0
        if damping > _MAX_DAMPING:
            return


def _linearise(table: locate.ModelTable, fit: locate.Fit, pair: PairFit) -> None:
    """Evaluate the model at `place`, with the totals eliminated; infinite cost unless both are positive."""
    n, columns = table.electrodes, table.electrodes + 1
    for k in range(2):
        s, t = pair.place[2 * k], pair.place[2 * k + 1]
        tables.read_table(table.values, 0, table.cells, columns, s, t, pair.raw)
        for part in range(3):
            for i in range(n):
                fit.scaled[i] = pair.raw[part * columns + i] * fit.weight[i]
                if part == 0:
                    pair.fractions[k * n + i] = pair.raw[i]
            tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.fractions)
            for i in range(n):
                if part == 0:
                    pair.whitened[k * n + i] = fit.fractions[i]
                else:
                    pair.slopes[(2 * k + part - 1) * n + i] = fit.fractions[i]
            pair.spreading[2 * part + k] = pair.raw[part * columns + n]
    g11 = g12 = g22 = first = second = 0.0
    for i in range(n):
        f, g, data = pair.whitened[i], pair.whitened[n + i], fit.data[i]
        g11 += f * f
        g12 += f * g
        g22 += g * g
        first += f * data
        second += g * data
    determinant = g11 * g22 - g12 * g12
    pair.cost = _INFINITY
    if not determinant > _MIN_DETERMINANT * g11 * g22:
        return
    pair.g11, pair.g12, pair.g22 = g22 / determinant, -g12 / determinant, g11 / determinant
    pair.total[0] = pair.g11 * first + pair.g12 * second
    pair.total[1] = pair.g12 * first + pair.g22 * second
    if not (pair.total[0] > 0.0 and pair.total[1] > 0.0):
        return
    for v in range(4):
        first = second = 0.0
        total = pair.total[v // 2]
        for i in range(n):
            slope = pair.slopes[v * n + i] * total
            pair.slopes[v * n + i] = slope
            first += pair.whitened[i] * slope
            second += pair.whitened[n + i] * slope
        pair.mixing[v] = pair.g11 * first + pair.g12 * second
        pair.mixing[4 + v] = pair.g12 * first + pair.g22 * second
        for i in range(n):
            pair.slopes[v * n + i] -= (
                pair.mixing[v] * pair.whitened[i] + pair.mixing[4 + v] * pair.whitened[n + i]
            )
    cost = 0.0
    for v in range(4):
        pair.gradient[v] = 0.0
    for i in range(n):
        misfit = fit.data[i]
        misfit -= pair.total[0] * pair.whitened[i] + pair.total[1] * pair.whitened[n + i]
        cost += misfit * misfit
        for v in range(4):
            pair.gradient[v] += pair.slopes[v * n + i] * misfit
    pair.cost = cost
    for v in range(4):
        for w in range(v + 1):
            product = 0.0
            for i in range(n):
                product += pair.slopes[v * n + i] * pair.slopes[w * n + i]
            pair.normal[4 * v + w] = pair.normal[4 * w + v] = product


def _compute_step(table: locate.ModelTable, pair: PairFit, damping: float) -> None:
    """Compute the damped step and its squared decrement; coordinates at the table's ends are held."""
    for v in range(4):
        for w in range(4):
            pair.factor[4 * v + w] = pair.normal[4 * v + w]
        pair.factor[5 * v] = pair.normal[5 * v] * (1.0 + damping) + 1e-300
        pair.step[v] = pair.gradient[v]
    for v in range(4):
        at, slope = pair.place[v], pair.gradient[v]
        if (at <= 0.0 and slope < 0.0) or (at >= table.cells and slope > 0.0):
            for w in range(4):
                pair.factor[4 * v + w] = pair.factor[4 * w + v] = 0.0
            pair.factor[5 * v] = 1.0
            pair.step[v] = 0.0
    _solve(pair)
    pair.decrement = longest = 0.0
    for v in range(4):
        pair.decrement += pair.step[v] * pair.gradient[v] if pair.step[v] != 0.0 else 0.0
        longest = max(longest, abs(pair.step[v]))
    if longest > _MAX_STEP_CELLS:
        for v in range(4):
            pair.step[v] *= _MAX_STEP_CELLS / longest


def _factorise(pair: PairFit) -> bool:
    """Replace `factor` by its Cholesky factor, below the diagonal; False where it has none."""
    for v in range(4):
        for w in range(v + 1):
            rest = pair.factor[4 * v + w]
            for k in range(w):
                rest -= pair.factor[4 * v + k] * pair.factor[4 * w + k]
            if v == w:
                if not rest > _MIN_DETERMINANT * pair.factor[5 * v]:
                    return False
                pair.factor[5 * v] = math.sqrt(rest)
            else:
                pair.factor[4 * v + w] = rest / pair.factor[5 * w]
    return True


def _solve(pair: PairFit) -> None:
    """Replace `step` by the solution of `factor` times it; 0 where that is singular."""
    if _factorise(pair):
        _substitute(pair)
        return
    for v in range(4):
        pair.step[v] = 0.0


def _substitute(pair: PairFit) -> None:
    """Replace `step` by the solution of the factorised equations."""
    for v in range(4):
        rest = pair.step[v]
        for k in range(v):
            rest -= pair.factor[4 * v + k] * pair.step[k]
        pair.step[v] = rest / pair.factor[5 * v]
    for v in range(3, -1, -1):
        rest = pair.step[v]
        for k in range(v + 1, 4):
            rest -= pair.factor[4 * k + v] * pair.step[k]
        pair.step[v] = rest / pair.factor[5 * v]


def _invert_information(table: locate.ModelTable, pair: PairFit) -> bool:
    """Compute covariances of the positions, on the pad's rectangle, and of the totals; False if singular."""
    for v in range(4):
        for w in range(4):
            pair.factor[4 * v + w] = pair.normal[4 * v + w]
    if not _factorise(pair):
        return False
    for column in range(4):
        for v in range(4):
            pair.step[v] = 1.0 if v == column else 0.0
        _substitute(pair)
        for v in range(4):
            pair.covariance[4 * v + column] = pair.step[v]
    for k in range(2):
        pair.var_total[k] = pair.g11 if k == 0 else pair.g22
        for v in range(4):
            along = 0.0
            for w in range(4):
                along += pair.covariance[4 * v + w] * pair.mixing[4 * k + w]
            pair.var_total[k] += pair.mixing[4 * k + v] * along
            if v // 2 == k:
                pair.with_total[v] = -along
    for v in range(4):
        pair.gradient[v] = locate.cell_length(
            table.nodes_x if v % 2 == 0 else table.nodes_y, table.cells, pair.place[v]
        )
        pair.with_total[v] *= pair.gradient[v]
    for v in range(4):
        for w in range(4):
            pair.covariance[4 * v + w] *= pair.gradient[v] * pair.gradient[w]
    return True


def _is_determined(table: locate.ModelTable, pair: PairFit) -> bool:
    """Return True if totals and positions are known well enough to be two contacts."""
    limit = _MAX_STD_SIDES * min(table.side_x, table.side_y)
    for v in range(4):
        if not pair.covariance[5 * v] <= limit * limit:
            return False
    for k in range(2):
        if not pair.total[k] * pair.total[k] > _MIN_TOTAL_SIGMA * _MIN_TOTAL_SIGMA * pair.var_total[k]:
            return False
    return True
