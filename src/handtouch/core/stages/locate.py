"""Location: the most likely point contact for the currents of one pad, and its covariance.

Gauss-Newton on the position with the total current eliminated (variable projection), steps halved until the
likelihood rises. Positions are in cells of the pad's table, which shrink towards edges and electrode ends as
the distances do over which currents vary. The likelihood is that of noise and of the tolerances of the
pad's parts, whose covariance is computed at the position found before. Without tolerances: the same
likelihood, limits and covariance as `handtouch.field.estimate`, which is the reference.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from handtouch.core.memory import view_memory
from handtouch.core.pad_tables import SEARCH_POINTS
from handtouch.core.stages import tables, tolerances
from handtouch.field.estimate import CORNER_RADIUS_FACTOR, MAX_STD_SIDES

if TYPE_CHECKING:
    from handtouch.core.pad_tables import ForwardTable

_MAX_STEPS = 30
_MAX_STEP_CELLS = 7.0
_MAX_SETTLED_DECREMENT = 1e-3  # squared Newton decrement, in variances: the last step leaves far less
_FIRST_DAMPING, _MIN_DAMPING = 1e-2, 1e-3
_BISECTIONS = 50
_MAX_TRACKED_COST = 25.0  # sum of squares beyond which, and
_MAX_TRACKED_VARIANCE = 2.5e-3  # variance of a coordinate, in sides, beyond which other starts are tried
_MAX_WHITENING_CELLS = 1.0  # distance from the position for which tolerances were whitened, and
_MAX_WHITENINGS, _ELONGATED_WHITENINGS = 3, 2
_FOURTH_MOMENTS = 5.0  # of a line: L^4 / 1920 d^4 f, fractions of about 1 / 6 that vary as sin(pi x / side)
_MAX_START_COST = 40.0  # cost beyond twice the best start's at which another one is still tried
_MAX_STD_SIDES, _CORNER_RADIUS_FACTOR = MAX_STD_SIDES, CORNER_RADIUS_FACTOR
_MIN_CHANNEL_SUM = 1e-6  # of a map where nothing responds
_MAX_CORNER_RADIUS = 0.25  # in shorter sides
_CORNER_STEPS = 6
_MAX_CORNER_CELLS = 24.0  # from both edges, within which likelihoods may have two maxima
_UNIFORM_VARIANCE = 1.0 / 12.0  # of a position anywhere on a side, in squares of the side
_MAX_EDGE_CELLS = 0.5  # of a position on an edge
_EDGE_BISECTIONS = 12
_MIN_CORNER_ANGLE_RAD = 0.02
_MIN_INFORMATION = 1e-300
_MIN_LONG_ASPECT = 2.0  # of a pad on which positions far apart can have the same currents, but for noise
_PROFILE_POINTS, _PROFILE_STEPS, _MAX_PROFILE_STEP = 20, 4, 3.0  # positions, steps across and cells of a step
_MAX_INSIDE = 9.0  # squared deviations: within, the covariance represents the probability
_INFINITY, _HALF_PI, _TWO_PI = math.inf, 0.5 * math.pi, 2.0 * math.pi


class ModelTable:
    """Table of one pad's forward model, as `read_table` needs it.

    values: columns are the fractions of the n electrodes and ln of the spreading radius. nodes_x, nodes_y:
    (2 (cells + 1),) coordinate of each node, and its derivative by cell. search_fractions: (points^2, n) on a
    square grid, x fastest; search_cells: (2 points,) its coordinates along x, then y, in cells. misfit_scale:
    from the squared misfit of n currents, n - 3 degrees of freedom, to one that is as likely of one.
    is_potential: the fractions are potentials of one sheet, harmonic, and vanish with the distance from a
    corner.
    """

    def __init__(self, table: ForwardTable, states: int, is_potential: bool = True) -> None:
        """Take a pad's table; `states`: of a schedule, 1 without one."""
        self.is_potential = is_potential
        self.values = view_memory(table.nodes)
        self.cells, self.electrodes, self.points = len(table.nodes) - 1, table.electrodes, SEARCH_POINTS
        self.nodes_x, self.nodes_y = view_memory(table.nodes_x), view_memory(table.nodes_y)
        self.side_x, self.side_y = table.nodes_x[self.cells, 0], table.nodes_y[self.cells, 0]
        self.search_fractions = view_memory(table.search_fractions)
        self.search_cells = view_memory(table.search_cells)
        self.misfit_scale = table.misfit_scale(states)


class Fit:
    """Working memory of the fit of one contact, and its result.

    `weight` (n,): 1 / noise. `readings` (n,): currents over noise. `data`, `fractions`, `slope_x`, `slope_y`
    (n,): currents and what the model gives for them per total, all whitened; slopes by cell, less the part
    that the total absorbs. `raw` (3 columns,): what was read from the table; `beside`: the same elsewhere.
    `scaled` (n,): working memory.
    `gain` (points,): reduction of the cost by a contact at each search point.
    """

    def __init__(self, channels: int, states: int, known: tolerances.PartKnowledge) -> None:
        """Prepare for pads of at most so many electrodes, and states of a schedule."""
        n, columns = channels, channels + 1
        self.readings, self.data = view_memory(np.zeros(n)), view_memory(np.zeros(n))
        self.weight, self.scaled = view_memory(np.zeros(n)), view_memory(np.zeros(n))
        self.fractions = view_memory(np.zeros(n))
        self.slope_x, self.slope_y = view_memory(np.zeros(n)), view_memory(np.zeros(n))
        self.raw, self.beside = view_memory(np.zeros(3 * columns)), view_memory(np.zeros(3 * columns))
        self.gain = view_memory(np.zeros(SEARCH_POINTS**2))
        self.whitening = tolerances.Whitening(channels, states, known, self.weight)
        self.s = self.t = 0.0  # position, in cells
        self.read_s = self.read_t = _INFINITY  # the same of what was read from the table
        self.whitened_s = self.whitened_t = 0.0  # and for which tolerances were whitened
        self.sum = 0.0  # of the currents
        self.total = self.cost = 0.0
        self.norm = self.mixing_x = self.mixing_y = 0.0  # of fractions; slopes' part that the total absorbs
        self.gradient_x = self.gradient_y = 0.0
        self.xx = self.xy = self.yy = 0.0
        self.step_s = self.step_t = self.decrement = 0.0
        # the result: position in sides of the pad and lengths of a cell there; covariance of (x, y, total)
        self.x = self.y = self.scale_x = self.scale_y = 0.0
        self.var_x = self.var_y = self.cov_xy = 0.0
        self.cov_x_total = self.cov_y_total = self.var_total = 0.0
        self.found = False


def locate(table: ModelTable, fit: Fit, s: float, t: float) -> None:
    """Find the most likely contact for the readings in `fit`; (s, t): last position in cells, NaN if new.

    Noise and tolerances are those of `fit.whitening`, for whose pad the table is. `fit.found` is False where
    no contact explains the currents better than none.
    """
    fit.sum = 0.0
    fit.read_s = fit.read_t = _INFINITY
    for i in range(table.electrodes):
        fit.sum += fit.readings[i] / fit.weight[i]
    tracked, settled = s == s and t == t, False
    if tracked:
        fit.s, fit.t = s, t
        _whiten(table, fit)
        settled = _maximise(table, fit, True)
    if settled:
        _refine(table, fit)
        variance = max(fit.var_x / (table.side_x * table.side_x), fit.var_y / (table.side_y * table.side_y))
        settled = fit.cost <= _MAX_TRACKED_COST and variance <= _MAX_TRACKED_VARIANCE
    if not settled:
        tolerances.whiten_by_gains(fit.whitening, fit.readings)
        tolerances.apply_whitening(fit.whitening, fit.readings, 0, fit.data)
        fit.whitened_s = fit.whitened_t = _INFINITY
        if not tracked:
            fit.s = fit.t = 0.5 * table.cells
        _search(table, fit, tracked)
        _refine(table, fit)
    fit.found = fit.total > 0.0
    if fit.found:
        _add_other_positions(table, fit)
        if table.is_potential:
            _move_out_of_corner(table, fit)
        _widen_at_edge(table, fit, True)
        _widen_at_edge(table, fit, False)
        _bound_by_pad(table, fit)


def locate_elongated(table: ModelTable, fit: Fit, moment_std: float) -> None:
    """Find again, from (s, t) and all over the pad, a contact that may be elongated.

    The result is `s`, `t`, `total` and `cost` alone. moment_std: see `whiten_elongated`.
    """
    relative = moment_std / min(table.side_x * table.side_x, table.side_y * table.side_y)
    error_std = _FOURTH_MOMENTS * relative * relative
    for _ in range(_ELONGATED_WHITENINGS):
        fit.read_s = fit.read_t = _INFINITY
        _read_model(table, fit)
        total = max(fit.sum, 0.0) / channel_sum(table, fit)
        tolerances.whiten_elongated(fit.whitening, fit.raw, total, fit.s, fit.t, moment_std, error_std)
        for i in range(table.electrodes):
            fit.scaled[i] = fit.readings[i] - fit.whitening.shift[i]
        tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.data)
        _search(table, fit, True)


def _whiten(table: ModelTable, fit: Fit) -> None:
    """Whiten for noise and tolerances at (s, t)."""
    n = table.electrodes
    _read_model(table, fit)
    total = max(fit.sum, 0.0) / channel_sum(table, fit)
    tolerances.whiten(fit.whitening, fit.raw, total, fit.s, fit.t)
    for i in range(n):
        fit.scaled[i] = fit.readings[i] - fit.whitening.shift[i]
    tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.data)
    fit.whitened_s, fit.whitened_t = fit.s, fit.t


def _refine(table: ModelTable, fit: Fit) -> None:
    """Maximise again while the position is far from that of the tolerances; compute the covariance."""
    for _ in range(_MAX_WHITENINGS):
        away = max(abs(fit.s - fit.whitened_s), abs(fit.t - fit.whitened_t))
        if away <= _MAX_WHITENING_CELLS or not fit.total > 0.0:
            break
        _whiten(table, fit)
        _maximise(table, fit, False)
    _compute_covariance(table, fit)


def _read_model(table: ModelTable, fit: Fit) -> None:
    """Read the table at (s, t), unless that was done."""
    if fit.s != fit.read_s or fit.t != fit.read_t:
        tables.read_table(table.values, 0, table.cells, table.electrodes + 1, fit.s, fit.t, fit.raw)
        fit.read_s, fit.read_t = fit.s, fit.t


def read_beside(table: ModelTable, fit: Fit, s: float, t: float) -> None:
    """Read the table at (s, t) into `beside`."""
    tables.read_table(table.values, 0, table.cells, table.electrodes + 1, s, t, fit.beside)


def channel_sum(table: ModelTable, fit: Fit) -> float:
    """Return the sum of the fractions that were read from the table; that of a sheet is 1."""
    if table.is_potential:
        return 1.0
    share = 0.0
    for i in range(table.electrodes):
        share += fit.raw[i]
    return max(share, _MIN_CHANNEL_SUM)


def clamp(table: ModelTable, s: float) -> float:
    """Return a coordinate inside the table, in cells."""
    return max(0.0, min(1.0 * table.cells, s))


def coordinate(nodes: memoryview[float], cells: int, s: float) -> float:
    """Return the coordinate on the pad at s cells, a cubic between the nodes."""
    i = int(s)
    if i > cells - 1:
        i = cells - 1
    p = s - i
    near, far, near_slope, far_slope = nodes[2 * i], nodes[2 * i + 2], nodes[2 * i + 1], nodes[2 * i + 3]
    rise = p * p * (3.0 - 2.0 * p)
    return near + rise * (far - near) + p * (1.0 - p) * ((1.0 - p) * near_slope - p * far_slope)


def cell_length(nodes: memoryview[float], cells: int, s: float) -> float:
    """Return the derivative of `coordinate`."""
    i = int(s)
    if i > cells - 1:
        i = cells - 1
    p = s - i
    near_slope, far_slope = nodes[2 * i + 1], nodes[2 * i + 3]
    rise = 6.0 * p * (1.0 - p) * (nodes[2 * i + 2] - nodes[2 * i])
    return rise + (1.0 - p) * (1.0 - 3.0 * p) * near_slope + p * (3.0 * p - 2.0) * far_slope


def _cell_at(nodes: memoryview[float], cells: int, x: float) -> float:
    """Return the cells of a coordinate on the pad, the inverse of `coordinate`."""
    low, high = 0.0, 1.0 * cells
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if coordinate(nodes, cells, middle) < x:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _linearise(table: ModelTable, fit: Fit) -> None:
    """Evaluate the model at (s, t), with the total eliminated."""
    n = table.electrodes
    _read_model(table, fit)
    _whiten_column(table, fit, 0, fit.fractions)
    _whiten_column(table, fit, n + 1, fit.slope_x)
    _whiten_column(table, fit, 2 * n + 2, fit.slope_y)
    norm = along = mixing_x = mixing_y = 0.0
    for i in range(n):
        f, fx, fy = fit.fractions[i], fit.slope_x[i], fit.slope_y[i]
        norm += f * f
        along += f * fit.data[i]
        mixing_x += f * fx
        mixing_y += f * fy
    total = along / norm
    mixing_x /= norm
    mixing_y /= norm
    cost = xx = xy = yy = gradient_x = gradient_y = 0.0
    for i in range(n):
        f = fit.fractions[i]
        sx, sy = fit.slope_x[i] - mixing_x * f, fit.slope_y[i] - mixing_y * f
        fit.slope_x[i], fit.slope_y[i] = sx, sy
        misfit = fit.data[i] - total * f
        cost += misfit * misfit
        xx += sx * sx
        xy += sx * sy
        yy += sy * sy
        gradient_x += sx * misfit
        gradient_y += sy * misfit
    fit.total, fit.cost, fit.norm = total, cost, norm
    fit.mixing_x, fit.mixing_y = mixing_x, mixing_y
    fit.xx, fit.xy, fit.yy = xx, xy, yy
    fit.gradient_x, fit.gradient_y = gradient_x, gradient_y


def _whiten_column(table: ModelTable, fit: Fit, first: int, out: memoryview[float]) -> None:
    """Whiten what was read from the table, from index `first` on, into `out`."""
    for i in range(table.electrodes):
        fit.scaled[i] = fit.raw[first + i] * fit.weight[i]
    tolerances.apply_whitening(fit.whitening, fit.scaled, 0, out)


def _compute_step(table: ModelTable, fit: Fit, damping: float) -> None:
    """Compute the step and its squared decrement; a coordinate at the table's end is held.

    damping: 0 for Gauss-Newton's step; more makes it shorter and turns it downhill (Levenberg-Marquardt).
    """
    xx, xy, yy = fit.xx * (1.0 + damping), fit.xy, fit.yy * (1.0 + damping)
    gradient_x, gradient_y = fit.gradient_x, fit.gradient_y
    if (fit.s <= 0.0 and gradient_x < 0.0) or (fit.s >= table.cells and gradient_x > 0.0):
        gradient_x = xy = 0.0
    if (fit.t <= 0.0 and gradient_y < 0.0) or (fit.t >= table.cells and gradient_y > 0.0):
        gradient_y = xy = 0.0
    along_x = along_y = 0.0
    determinant = xx * yy - xy * xy
    if determinant > 1e-14 * xx * yy:
        along_x = (yy * gradient_x - xy * gradient_y) / determinant
        along_y = (xx * gradient_y - xy * gradient_x) / determinant
    elif xx >= yy and xx > 0.0:
        along_x = gradient_x / xx
    elif yy > 0.0:
        along_y = gradient_y / yy
    fit.decrement = along_x * gradient_x + along_y * gradient_y
    if fit.total != 0.0:
        along_x /= fit.total
        along_y /= fit.total
    longest = max(abs(along_x), abs(along_y))
    scale = _MAX_STEP_CELLS / longest if longest > _MAX_STEP_CELLS else 1.0
    fit.step_s, fit.step_t = scale * along_x, scale * along_y


def _maximise(table: ModelTable, fit: Fit, tracked: bool) -> bool:
    """Iterate from (s, t); return True where the maximum was reached.

    tracked: give up where the first step is too long for the contact to have been followed.
    """
    _linearise(table, fit)
    _compute_step(table, fit, 0.0)
    longest = 0.999 * _MAX_STEP_CELLS
    if tracked and (fit.total <= 0.0 or abs(fit.step_s) > longest or abs(fit.step_t) > longest):
        return False
    damping = 0.0
    for _ in range(_MAX_STEPS):
        s, t, cost, total = fit.s, fit.t, fit.cost, fit.total
        if total > 0.0 and fit.decrement <= _MAX_SETTLED_DECREMENT:
            fit.s, fit.t = clamp(table, s + fit.step_s), clamp(table, t + fit.step_t)
            fit.step_s, fit.step_t = fit.s - s, fit.t - t
            return True
        if damping > 0.0:
            _compute_step(table, fit, damping)
        fit.s, fit.t = clamp(table, s + fit.step_s), clamp(table, t + fit.step_t)
        _linearise(table, fit)
        if total <= 0.0 or (fit.total > 0.0 and fit.cost <= cost):
            damping *= 0.1
            if damping < _MIN_DAMPING:
                damping = 0.0
        else:
            fit.s, fit.t = s, t
            _linearise(table, fit)
            damping = max(_FIRST_DAMPING, 10.0 * damping)
        _compute_step(table, fit, 0.0)
    fit.step_s = fit.step_t = fit.decrement = 0.0
    return False


def _search(table: ModelTable, fit: Fit, located: bool) -> None:
    """Fit from the most likely points of the search grid; keep the most likely result.

    located: the present position is a result too. Weak contacts on long pads have two maxima.
    """
    n, points = table.electrodes, table.points
    power = 0.0
    for i in range(n):
        power += fit.data[i] * fit.data[i]
    for k in range(points * points):
        for i in range(n):
            fit.scaled[i] = table.search_fractions[k * n + i] * fit.weight[i]
        tolerances.apply_whitening(fit.whitening, fit.scaled, 0, fit.fractions)
        along = norm = 0.0
        for i in range(n):
            f = fit.fractions[i]
            along += f * fit.data[i]
            norm += f * f
        fit.gain[k] = along * along / norm if along > 0.0 else 0.0
    best_s, best_t, best_cost = fit.s, fit.t, _INFINITY
    if located:
        _linearise(table, fit)
        if fit.total > 0.0:
            best_cost = fit.cost
    first, second = _highest_peak(fit, points, -1), -1
    if first >= 0:
        second = _highest_peak(fit, points, first)
    for peak in range(2):
        k = second if peak else first
        if k < 0 or (peak and power - fit.gain[k] > 2.0 * (power - fit.gain[first]) + _MAX_START_COST):
            continue
        fit.s, fit.t = table.search_cells[k % points], table.search_cells[points + k // points]
        _maximise(table, fit, False)
        if fit.total > 0.0 and fit.cost < best_cost:
            best_s, best_t, best_cost = fit.s, fit.t, fit.cost
    fit.s, fit.t = _nearer_corner(table, best_s), _nearer_corner(table, best_t)
    if fit.s != best_s and fit.t != best_t and best_cost > _MAX_SETTLED_DECREMENT:
        _maximise(table, fit, False)
        if fit.total > 0.0 and fit.cost < best_cost:
            best_s, best_t = fit.s, fit.t
    fit.s, fit.t = best_s, best_t
    _linearise(table, fit)
    fit.step_s = fit.step_t = fit.decrement = 0.0


def _nearer_corner(table: ModelTable, s: float) -> float:
    """Return a coordinate half as far from the nearer edge, in cells, unless it is far from both.

    There may be two maxima between the bare ends of electrodes; the search points are farther inside."""
    if s < _MAX_CORNER_CELLS:
        return 0.5 * s
    return 0.5 * (s + table.cells) if table.cells - s < _MAX_CORNER_CELLS else s


def _add_other_positions(table: ModelTable, fit: Fit) -> None:
    """Add the probability of positions along a long pad that are more than three deviations away.

    In its middle the currents of the far electrodes vanish: weak contacts have a plateau of probability
    there, or a second maximum beyond it. The currents of the near ones determine the other coordinate.
    """
    along_x = table.side_x > table.side_y
    longer, shorter = max(table.side_x, table.side_y), min(table.side_x, table.side_y)
    variance = fit.var_x if along_x else fit.var_y
    uncertain = _MAX_TRACKED_VARIANCE * shorter * shorter < variance < 1e300
    if longer < _MIN_LONG_ASPECT * shorter or not uncertain:
        return
    s, t, cost, total = fit.s, fit.t, fit.cost, fit.total
    outside = moment = 0.0
    for k in range(_PROFILE_POINTS):
        at = longer * (k + 0.5) / _PROFILE_POINTS
        away = at - (fit.x if along_x else fit.y)
        if away * away <= _MAX_INSIDE * variance:
            continue
        fit.s, fit.t = s, t
        if along_x:
            fit.s = _cell_at(table.nodes_x, table.cells, at)
        else:
            fit.t = _cell_at(table.nodes_y, table.cells, at)
        _linearise(table, fit)
        for _ in range(_PROFILE_STEPS):
            if along_x and fit.total > 0.0 and fit.yy > 0.0:
                step = fit.gradient_y / (fit.yy * fit.total)
                fit.t = clamp(table, fit.t + max(-_MAX_PROFILE_STEP, min(_MAX_PROFILE_STEP, step)))
            elif fit.total > 0.0 and fit.xx > 0.0:
                step = fit.gradient_x / (fit.xx * fit.total)
                fit.s = clamp(table, fit.s + max(-_MAX_PROFILE_STEP, min(_MAX_PROFILE_STEP, step)))
            _linearise(table, fit)
        if fit.total > 0.0:
            weight = math.exp(-0.5 * max(fit.cost - cost, 0.0)) * longer / _PROFILE_POINTS
            outside += weight
            moment += weight * away * away
    fit.s, fit.t = s, t
    _linearise(table, fit)
    fit.cost, fit.total = cost, total
    fit.step_s = fit.step_t = fit.decrement = 0.0
    added = moment / (outside + math.sqrt(_TWO_PI * variance))
    if along_x:
        fit.var_x += added
    else:
        fit.var_y += added


def _highest_peak(fit: Fit, points: int, excluded: int) -> int:
    """Return the local maximum of the gain other than `excluded`, -1 if there is none."""
    best, highest = -1, 0.0
    for k in range(points * points):
        gain = fit.gain[k]
        if gain <= highest or k == excluded:
            continue
        row, column = k // points, k % points
        is_peak = True
        for j in range(-1, 2):
            for i in range(-1, 2):
                if 0 <= row + j < points and 0 <= column + i < points and (i != 0 or j != 0):
                    is_peak = is_peak and gain > fit.gain[(row + j) * points + column + i]
        if is_peak:
            best, highest = k, gain
    return best


def _compute_covariance(table: ModelTable, fit: Fit) -> None:
    """Apply the last step; compute position and inverse Fisher information of (x, y, total)."""
    ds, dt, n = fit.step_s, fit.step_t, table.electrodes
    if ds != 0.0 or dt != 0.0:  # what was read moves along its tangent
        for i in range(n + 1):
            fit.raw[i] += ds * fit.raw[n + 1 + i] + dt * fit.raw[2 * n + 2 + i]
        fit.total *= 1.0 - fit.mixing_x * ds - fit.mixing_y * dt
        fit.cost = max(0.0, fit.cost - fit.decrement)
        fit.read_s = fit.read_t = _INFINITY
        fit.step_s = fit.step_t = fit.decrement = 0.0
    _compute_position(table, fit)
    _invert_information(table, fit)


def _compute_position(table: ModelTable, fit: Fit) -> None:
    fit.x, fit.y = (
        coordinate(table.nodes_x, table.cells, fit.s),
        coordinate(table.nodes_y, table.cells, fit.t),
    )
    fit.scale_x = cell_length(table.nodes_x, table.cells, fit.s)
    fit.scale_y = cell_length(table.nodes_y, table.cells, fit.t)


def _invert_information(table: ModelTable, fit: Fit) -> None:
    total2 = fit.total * fit.total
    xx, xy, yy = fit.xx, fit.xy, fit.yy
    by_y = xy / yy if yy > 0.0 else 0.0
    by_x = xy / xx if xx > 0.0 else 0.0
    # each variance from the part that the other coordinate can't explain: no difference of products
    free_x = free_y = 0.0
    for i in range(table.electrodes):
        rest_x = fit.slope_x[i] - by_y * fit.slope_y[i]
        rest_y = fit.slope_y[i] - by_x * fit.slope_x[i]
        free_x += rest_x * rest_x
        free_y += rest_y * rest_y
    var_x = 1.0 / (free_x * total2) if free_x * total2 > _MIN_INFORMATION else _INFINITY
    var_y = 1.0 / (free_y * total2) if free_y * total2 > _MIN_INFORMATION else _INFINITY
    limit_x, limit_y = _MAX_STD_SIDES * table.side_x, _MAX_STD_SIDES * table.side_y
    known_x = var_x * fit.scale_x * fit.scale_x <= limit_x * limit_x
    known_y = var_y * fit.scale_y * fit.scale_y <= limit_y * limit_y
    cov_xy = 0.0
    if known_x and known_y:
        cov_xy = -by_x * var_y
    elif known_x and xx > 0.0:
        var_x = 1.0 / (xx * total2)
    elif known_y and yy > 0.0:
        var_y = 1.0 / (yy * total2)
    cov_x_total = cov_y_total = 0.0
    fit.var_total = 1.0 / fit.norm
    fit.var_x = fit.var_y = _INFINITY
    if known_x:
        cov_x_total -= fit.total * fit.mixing_x * var_x
        cov_y_total -= fit.total * fit.mixing_x * cov_xy
        fit.var_x = var_x * fit.scale_x * fit.scale_x
    if known_y:
        cov_y_total -= fit.total * fit.mixing_y * var_y
        cov_x_total -= fit.total * fit.mixing_y * cov_xy
        fit.var_y = var_y * fit.scale_y * fit.scale_y
    if known_x:
        fit.var_total -= fit.total * fit.mixing_x * cov_x_total
    if known_y:
        fit.var_total -= fit.total * fit.mixing_y * cov_y_total
    fit.cov_xy = cov_xy * fit.scale_x * fit.scale_y
    fit.cov_x_total, fit.cov_y_total = cov_x_total * fit.scale_x, cov_y_total * fit.scale_y


def _move_out_of_corner(table: ModelTable, fit: Fit) -> None:
    """Move a position out of a corner to where the currents carry information.

    Near a corner the two far currents vanish with the square of the distance from it, so that all distances
    up to the root of the relative noise are equally likely, and only the direction is known.
    """
    far_x, far_y = fit.x > 0.5 * table.side_x, fit.y > 0.5 * table.side_y
    near_x = table.side_x - fit.x if far_x else fit.x
    near_y = table.side_y - fit.y if far_y else fit.y
    shortest = min(table.side_x, table.side_y)
    distance2 = near_x * near_x + near_y * near_y
    if distance2 >= _MAX_CORNER_RADIUS * _MAX_CORNER_RADIUS * shortest * shortest:
        return
    weight2 = 0.0
    for i in range(table.electrodes):
        weight2 += fit.weight[i] * fit.weight[i]
    noise = math.sqrt(table.electrodes / weight2)
    relative = min(_CORNER_RADIUS_FACTOR * math.sqrt(noise / fit.total), _MAX_CORNER_RADIUS)
    radius = relative * shortest
    if distance2 >= radius * radius:
        return
    angle = math.atan2(near_y, near_x)
    highest = _HALF_PI - _MIN_CORNER_ANGLE_RAD
    for _ in range(_CORNER_STEPS):
        angle = max(_MIN_CORNER_ANGLE_RAD, min(highest, angle))
        _linearise_on_arc(table, fit, far_x, far_y, radius, angle)
        # derivatives of the whitened currents by the angle; slopes are by cell
        by_x = -radius * math.sin(angle) / fit.scale_x
        by_y = radius * math.cos(angle) / fit.scale_y
        if far_x:
            by_x = -by_x
        if far_y:
            by_y = -by_y
        along = norm = 0.0
        for i in range(table.electrodes):
            tangent = fit.total * (fit.slope_x[i] * by_x + fit.slope_y[i] * by_y)
            along += tangent * (fit.data[i] - fit.total * fit.fractions[i])
            norm += tangent * tangent
        if norm > 0.0:
            angle += max(-0.3, min(0.3, along / norm))
    angle = max(_MIN_CORNER_ANGLE_RAD, min(highest, angle))
    _linearise_on_arc(table, fit, far_x, far_y, radius, angle)
    fit.found = fit.total > 0.0
    _invert_information(table, fit)


def _linearise_on_arc(
    table: ModelTable, fit: Fit, far_x: bool, far_y: bool, radius: float, angle: float
) -> None:
    x, y = radius * math.cos(angle), radius * math.sin(angle)
    fit.s = _cell_at(table.nodes_x, table.cells, table.side_x - x if far_x else x)
    fit.t = _cell_at(table.nodes_y, table.cells, table.side_y - y if far_y else y)
    _linearise(table, fit)
    fit.step_s = fit.step_t = fit.decrement = 0.0
    _compute_position(table, fit)


def _widen_at_edge(table: ModelTable, fit: Fit, along_x: bool) -> None:
    """Widen the variance across an edge that the position is on, to the distance from it that is likely.

    Currents may not change across an edge, as on the bare length next to a corner, where the information is
    0; how far inside the contact is follows from the likelihood itself.
    """
    s, t, cost, cells = fit.s, fit.t, fit.cost, 1.0 * table.cells
    at = s if along_x else t
    if at > _MAX_EDGE_CELLS and at < cells - _MAX_EDGE_CELLS:
        return
    nodes = table.nodes_x if along_x else table.nodes_y
    sign = 1.0 if at < 0.5 * cells else -1.0
    likely, unlikely = 0.0, cells
    for _ in range(_EDGE_BISECTIONS):
        inward = 0.5 * (likely + unlikely)
        if along_x:
            fit.s = clamp(table, s + sign * inward)
        else:
            fit.t = clamp(table, t + sign * inward)
        _linearise(table, fit)
        if fit.total > 0.0 and fit.cost <= cost + 1.0:
            likely = inward
        else:
            unlikely = inward
    if likely == 0.0:
        likely = unlikely  # nearer than the bisection resolves
    fit.s, fit.t = s, t
    _linearise(table, fit)
    fit.step_s = fit.step_t = fit.decrement = 0.0
    distance = coordinate(nodes, table.cells, clamp(table, at + sign * likely))
    distance -= coordinate(nodes, table.cells, at)
    variance = distance * distance
    if along_x and (fit.var_x > 1e300 or variance > fit.var_x):
        fit.var_x, fit.cov_xy, fit.cov_x_total = variance, 0.0, 0.0
    elif not along_x and (fit.var_y > 1e300 or variance > fit.var_y):
        fit.var_y, fit.cov_xy, fit.cov_y_total = variance, 0.0, 0.0


def _bound_by_pad(table: ModelTable, fit: Fit) -> None:
    """Bound the covariance by that of a contact anywhere on the pad, unless both coordinates are unknown."""
    if not (fit.var_x < 1e300 or fit.var_y < 1e300):
        return
    bound_x = _UNIFORM_VARIANCE * table.side_x * table.side_x
    bound_y = _UNIFORM_VARIANCE * table.side_y * table.side_y
    shrink_x = 1.0 / math.sqrt(1.0 + fit.var_x / bound_x)
    shrink_y = 1.0 / math.sqrt(1.0 + fit.var_y / bound_y)
    fit.var_x = fit.var_x * shrink_x * shrink_x if fit.var_x < 1e300 else bound_x
    fit.var_y = fit.var_y * shrink_y * shrink_y if fit.var_y < 1e300 else bound_y
    fit.cov_xy *= shrink_x * shrink_y
    fit.cov_x_total *= shrink_x
    fit.cov_y_total *= shrink_y
