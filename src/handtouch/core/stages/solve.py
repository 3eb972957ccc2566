"""Contacts of a tick: locate, estimate the force, place; one row of `values` a pad.

Public names: `ContactSolver`, `VALUE_COUNT`, `VALUE_SLICES`, `MAX_SQUARED_MISFIT`, `PART_COUNT`,
`PART_SLICES`, `PARTS_COUNT`, `MOUNT_COUNT`, `MISFIT_COUNT`.
"""

from __future__ import annotations

import math

import numpy as np

from handtouch.core.memory import row_count, slices_of
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages import force, locate, pairs, tables, tolerances
from handtouch.field import contact_law

VALUE_ROW = np.dtype(
    [
        ("xy", "<f8", 2),  # on the pad's rectangle
        ("pad_m", "<f8", 2),
        ("residual", "<f8"),
        ("position_m", "<f8", 3),
        ("normal", "<f8", 3),
        ("force_n", "<f8"),
        ("force_std_n", "<f8"),
        ("residual_std", "<f8"),  # from channel noise and baseline
        ("covariance_m2", "<f8", 9),  # without that of the mount
        ("mount_covariance_m2", "<f8", 9),
        ("pad_noise_m2", "<f8", 3),  # of pad_m from channel noise: uu, uv, vv
        ("force_status", "<f8"),  # of `stages.force`
        ("cells", "<f8", 2),  # position in the pad's table, where the next tick starts from
        ("squared_misfit", "<f8"),  # of a point, see MAX_SQUARED_MISFIT
        ("is_bound", "<f8"),  # 1 where saturated channels leave the position open
    ]
)
VALUE_SLICES = slices_of(VALUE_ROW)
"""Layout of a row of values."""
_X, _U, _RESIDUAL = VALUE_SLICES["xy"].start, VALUE_SLICES["pad_m"].start, VALUE_SLICES["residual"].start
_POSITION, _NORMAL = VALUE_SLICES["position_m"].start, VALUE_SLICES["normal"].start
_FORCE, _FORCE_STD = VALUE_SLICES["force_n"].start, VALUE_SLICES["force_std_n"].start
_RESIDUAL_STD, _FORCE_STATUS = VALUE_SLICES["residual_std"].start, VALUE_SLICES["force_status"].start
_COVARIANCE, _MOUNT = VALUE_SLICES["covariance_m2"].start, VALUE_SLICES["mount_covariance_m2"].start
_PAD_NOISE, _CELLS = VALUE_SLICES["pad_noise_m2"].start, VALUE_SLICES["cells"].start
_MISFIT, _IS_BOUND = VALUE_SLICES["squared_misfit"].start, VALUE_SLICES["is_bound"].start
_COUNT = row_count(VALUE_ROW)
VALUE_COUNT = _COUNT
PART_ROW = np.dtype(
    [
        ("position_m", "<f8", 3),
        ("normal", "<f8", 3),
        ("covariance_m2", "<f8", 9),
        ("force_n", "<f8"),
        ("force_std_n", "<f8"),
        ("id", "<f8"),  # this and the following stay while there is one contact
        ("place", "<f8", 2),  # on the pad's rectangle
        ("newest_id", "<f8"),  # of the pad, in the first of two
    ]
)
PART_SLICES = slices_of(PART_ROW)
"""Layout of one of two contacts on a pad; a row of parts has two of them, NaN where there is one contact."""
_PART_POSITION, _PART_NORMAL = PART_SLICES["position_m"].start, PART_SLICES["normal"].start
_PART_COVARIANCE, _PART_FORCE = PART_SLICES["covariance_m2"].start, PART_SLICES["force_n"].start
_PART_FORCE_STD, _PART_ID = PART_SLICES["force_std_n"].start, PART_SLICES["id"].start
_PART_PLACE, _PART_NEWEST = PART_SLICES["place"].start, PART_SLICES["newest_id"].start
_PART_COUNT = row_count(PART_ROW)
_PARTS_COUNT = 2 * _PART_COUNT
PART_COUNT, PARTS_COUNT = _PART_COUNT, _PARTS_COUNT
_MOUNT_COUNT = 5
MOUNT_COUNT = _MOUNT_COUNT
"""Values of a pad's mount."""
_NAN = float("nan")
_FITTED, _BOUNDED = float(force.FITTED), float(force.BOUNDED)
_BOUND_SIGMA = contact_law.BOUND_SIGMA
_MAX_SQUARED_MISFIT = MAX_SQUARED_MISFIT
_MAX_EXTENT_SIDES = 0.5
_TWO_PI, _INFINITY = 2.0 * math.pi, math.inf
_MOTION_ALONG, _MOTION_ACROSS = 0.8, 0.3
"""Standard deviations of a position along and across the path, in what a contact moves in a schedule: by
coverage at 30 mm/s in the world `default`, tuning family."""
_PART_MOTION = 2.0  # of one of two contacts that moves, in motions of the single contact that explains both
_PAIRED_CHANNELS = 4  # electrodes x0, xa, y0, yb
_UNKNOWNS = 3  # of a contact: position and total
_MIN_PEAK = 1.2  # largest current of a contact, relative to the reading of a saturated channel
_MISFIT_COUNT = 3
MISFIT_COUNT = _MISFIT_COUNT
"""Values of a pad's misfits."""
_MISFIT_CONTACTS, _MIN_LASTING_MISFIT = 8.0, 2.0
"""Contacts over which the misfit of a pad's contacts is averaged; mean that widens the covariance of later
ones: 5 % of pads as stated have more, by contacts of seven shapes (`default`, tuning family)."""
_UNIFORM_VARIANCE = 1.0 / 12.0  # of a value anywhere in a range, in squares of the range


class ContactSolver:
    """Solves contacts of the pads of a model; arrays are flat, with a row a pad.

    electrodes: number c of channels of the pad that has most.
    currents, weight: (pads c,) currents [A] and 1 / noise [1/A]; a pad reads as many as it has electrodes.
    known: of gains and parts. gain_covariance: (pads c c,) of log gains.
    offset_std: (pads,) of the sum of the currents, from the
    baseline [A]; it counts as noise of the channels, shared among them. force_requested: (pads,), 0 where no
    force is to be estimated. values: (pads VALUE_COUNT,), the result; NaN for a new contact, else the search
    begins at the position in it. pair_limits: (pads,) squared misfit of one contact from which on two are
    tried, infinite where they can't be resolved; moment_stds: (pads,) [m^2], that of an elongated contact,
    see `tolerances.whiten_elongated`; parts: (pads PARTS_COUNT,), the two contacts, NaN if there is one.
    saturated: (pads c,), 1 where a current is a lower bound; peak_currents: (pads,) largest current of an
    electrode by the firmest contact [A]. mounts: (pads MOUNT_COUNT,) origin of each pad on its link [m], and
    the variances of that along each axis [m^2] and about it [rad^2]. crowding: (pads,), 1 where currents
    crowd towards electrodes. ampere_per_count, noise_squared: (pads c,), variances of the channels [counts^2]
    as measured; where the stated noise is larger, that counts. misfits: (3 pads,), running mean of the
    squared misfits of a pad's contacts; of the last contact those of its samples, each times the square of
    its current, summed, and the sum of these squares.
    """

    def __init__(
        self,
        models: list[locate.ModelTable],
        pad_tolerances: list[tolerances.PadTolerances],
        laws: list[force.PadLaw],
        surfaces: list[tables.PadSurface],
        stack: force.StackTable,
        fit: locate.Fit,
        placement: tables.Placement,
        electrodes: int,
        work: memoryview[float],
        currents: memoryview[float],
        weight: memoryview[float],
        known: tolerances.PartKnowledge,
        gain_covariance: memoryview[float],
        offset_std: memoryview[float],
        force_requested: memoryview[int],
        values: memoryview[float],
        pair: pairs.PairFit,
        pair_limits: memoryview[float],
        moment_stds: memoryview[float],
        parts: memoryview[float],
        saturated: memoryview[int],
        peak_currents: memoryview[float],
        mounts: memoryview[float],
        crowding: memoryview[int],
        ampere_per_count: memoryview[float],
        noise_squared: memoryview[float],
        misfits: memoryview[float],
    ) -> None:
        self.misfits = misfits
        self.ampere_per_count, self.noise_squared = ampere_per_count, noise_squared
        self.mounts, self.crowding = mounts, crowding
        self.saturated, self.peak_currents = saturated, peak_currents
        self.were_two = False
        self.pair, self.pair_limits, self.moment_stds, self.parts = pair, pair_limits, moment_stds, parts
        self.models, self.pad_tolerances = models, pad_tolerances
        self.laws, self.surfaces = laws, surfaces
        self.stack, self.fit, self.placement = stack, fit, placement
        self.result = force.ForceResult()
        self.moved_x = self.moved_y = 0.0  # in the course of a schedule
        self.electrodes = electrodes
        self.by_x, self.by_y, self.by_total = (
            work[:electrodes], work[electrodes : 2 * electrodes], work[2 * electrodes : 3 * electrodes],
        )  # fmt: skip
        self.currents, self.weight = currents, weight
        self.known, self.gain_covariance = known, gain_covariance
        self.offset_std, self.force_requested = offset_std, force_requested
        self.values = values

    def solve_contacts(self, pads: memoryview[int]) -> None:
        """Solve the contacts of these pads; a row is NaN where no contact explains the currents."""
        for k in range(len(pads)):
            solve_contact(self, pads[k])


def solve_contact(solver: ContactSolver, pad: int) -> None:
    """Locate a pad's contact, estimate its force, and place it in the link's frame."""
    fit, table, values, parts = solver.fit, solver.models[pad], solver.values, solver.pad_tolerances[pad]
    n, row, first, saturated = table.electrodes, pad * _COUNT, pad * solver.electrodes, 0
    fit.whitening.electrodes = n
    last_x, last_y = values[row + _X], values[row + _X + 1]
    offset2 = solver.offset_std[pad] * solver.offset_std[pad] / n
    for i in range(n):
        weight, scale = solver.weight[first + i], solver.ampere_per_count[first + i]
        excess = solver.noise_squared[first + i] * scale * scale * weight * weight
        if excess > 1.0:
            weight /= math.sqrt(excess)
        weight /= math.sqrt(1.0 + offset2 * weight * weight)
        fit.weight[i] = weight
        fit.readings[i] = solver.currents[first + i] * weight
        if solver.saturated[first + i]:
            saturated += 1
    if saturated:
        _estimate_saturated(solver, pad)
    if values[row + _CELLS] != values[row + _CELLS]:  # a new contact
        _count_misfit(solver, pad)
    locate.locate(
        table,
        fit,
        parts,
        solver.known,
        pad,
        solver.gain_covariance,
        values[row + _CELLS],
        values[row + _CELLS + 1],
    )
    for i in range(_COUNT):
        values[row + i] = _NAN
    values[row + _IS_BOUND] = 1.0 if n - saturated < _UNKNOWNS else 0.0
    solver.were_two = _forget_parts(solver, pad, last_x != last_x)
    if not fit.found:
        return
    values[row + _CELLS], values[row + _CELLS + 1] = fit.s, fit.t
    tables.place_contact(solver.surfaces[pad], solver.placement, fit.x, fit.y)
    _propagate(solver, pad)
    if solver.force_requested[pad]:
        _estimate_force(solver, pad, 1.0)
        if fit.cost > _MAX_SQUARED_MISFIT:
            _span_two_patches(solver, pad)
        if saturated:
            _bound_force(solver, pad)
    if fit.cost > _MAX_SQUARED_MISFIT and n == _PAIRED_CHANNELS and not saturated:
        _add_extent(table, fit, values[row + _RESIDUAL])
    solver.moved_x = solver.moved_y = 0.0
    if parts.states > 1 and last_x == last_x:
        lag = 1.0 * (parts.states - 1)
        solver.moved_x, solver.moved_y = lag * (fit.x - last_x), lag * (fit.y - last_y)
    if solver.crowding[pad] or parts.tilt_std > 0.0:
        _correct_crowding(solver, pad)
    _write_position(solver, pad)
    if fit.cost > _MAX_SQUARED_MISFIT and solver.pair_limits[pad] < _INFINITY and not saturated:
        _resolve_pair(solver, pad)


def _estimate_saturated(solver: ContactSolver, pad: int) -> None:
    """Replace readings of saturated channels by what is known of them.

    They are anywhere between the top of the range and the largest current of the pad's firmest contact. The
    other currents hardly add to that: near an electrode they are in proportion to the total times the
    distance, so that neither is known without this one. The distance is nearly in inverse proportion to it:
    its inverse is taken as equally likely anywhere.
    """
    fit, first = solver.fit, pad * solver.electrodes
    for i in range(fit.whitening.electrodes):
        if not solver.saturated[first + i]:
            continue
        least = solver.currents[first + i]
        greatest = max(solver.peak_currents[pad], _MIN_PEAK * least)
        noise = 1.0 / fit.weight[i]
        current = 2.0 * least * greatest / (least + greatest)
        relative = 2.0 * (greatest - least) / (greatest + least)  # width of the range of the inverse
        variance = _UNIFORM_VARIANCE * relative * relative * current * current
        fit.weight[i] = 1.0 / math.sqrt(noise * noise + variance)
        fit.readings[i] = current * fit.weight[i]


def _bound_force(solver: ContactSolver, pad: int) -> None:
    """Replace the force of a contact with saturated channels by a lower bound: that of their lowest currents,
    less two standard deviations of its logarithm."""
    fit, values, row, first = solver.fit, solver.values, pad * _COUNT, pad * solver.electrodes
    total = variance = 0.0
    for i in range(fit.whitening.electrodes):
        total += solver.currents[first + i]
        variance += 1.0 / (solver.weight[first + i] * solver.weight[first + i])
    fit.total, fit.var_total = total, variance
    fit.cov_x_total = fit.cov_y_total = 0.0
    _estimate_force(solver, pad, 1.0)
    if values[row + _FORCE_STATUS] != _BOUNDED and values[row + _FORCE] > 0.0:
        relative = values[row + _FORCE_STD] / values[row + _FORCE]
        values[row + _FORCE] *= math.exp(-_BOUND_SIGMA * math.sqrt(math.log(1.0 + relative * relative)))
        values[row + _FORCE_STD] = _INFINITY
        values[row + _FORCE_STATUS] = _BOUNDED


def _forget_parts(solver: ContactSolver, pad: int, is_new: bool) -> bool:
    """Write NaN for the two contacts of a pad; return True if there were two in its last sample. Their places
    stay, unless the contact is new."""
    parts, row = solver.parts, pad * _PARTS_COUNT
    were_two = parts[row] == parts[row]
    for k in range(2):
        for i in range(_PART_ID):
            parts[row + k * _PART_COUNT + i] = _NAN
        if is_new:
            parts[row + k * _PART_COUNT + _PART_PLACE] = _NAN
    return were_two and not is_new


def _order_parts(solver: ContactSolver, pad: int) -> int:
    """Return which of two contacts found is the first: each is the one that was nearest to it.

    It keeps that one's id. After samples with one contact it must also be nearer than half of the distance
    between the two; else it is another object's.
    """
    pair, table, parts, row = solver.pair, solver.models[pad], solver.parts, pad * _PARTS_COUNT
    x0 = locate.coordinate(table.nodes_x, table.cells, pair.place[0])
    y0 = locate.coordinate(table.nodes_y, table.cells, pair.place[1])
    x1 = locate.coordinate(table.nodes_x, table.cells, pair.place[2])
    y1 = locate.coordinate(table.nodes_y, table.cells, pair.place[3])
    first, second = row + _PART_PLACE, row + _PART_COUNT + _PART_PLACE
    kept = _squared_distance(parts, first, x0, y0) + _squared_distance(parts, second, x1, y1)
    turned = _squared_distance(parts, first, x1, y1) + _squared_distance(parts, second, x0, y0)
    begin = 1 if turned < kept else 0
    if begin:
        x0, y0, x1, y1 = x1, y1, x0, y0
    near2 = 0.25 * ((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0))
    near2 = _INFINITY if solver.were_two else near2
    _name_part(parts, row, first, x0, y0, near2)
    _name_part(parts, row, second, x1, y1, near2)
    return begin


def _squared_distance(parts: memoryview[float], at: int, x: float, y: float) -> float:
    """Return the squared distance of (x, y) from a place in the parts; NaN if that is none."""
    return (x - parts[at]) * (x - parts[at]) + (y - parts[at + 1]) * (y - parts[at + 1])


def _name_part(parts: memoryview[float], row: int, at: int, x: float, y: float, near2: float) -> None:
    """Write place and id of one of two contacts; another id unless it is near its last place."""
    if not _squared_distance(parts, at, x, y) < near2:
        newest = parts[row + _PART_NEWEST]
        newest = newest + 1.0 if newest == newest else 1.0
        parts[row + _PART_NEWEST] = parts[at + _PART_ID - _PART_PLACE] = newest
    parts[at], parts[at + 1] = x, y


def _resolve_pair(solver: ContactSolver, pad: int) -> None:
    """Write the two contacts of a pad, where the currents support two rather than one."""
    fit, pair, table, parts = solver.fit, solver.pair, solver.models[pad], solver.parts
    scale2 = solver.placement.scale_m * solver.placement.scale_m
    pairs.fit_pair(
        table,
        fit,
        pair,
        solver.pad_tolerances[pad],
        solver.known,
        pad,
        solver.gain_covariance,
        solver.moment_stds[pad] / scale2,
        solver.pair_limits[pad],
    )
    if not pair.found:
        return
    begin = _order_parts(solver, pad)
    for k in range(2):
        row = pad * _PARTS_COUNT + (k ^ begin) * _PART_COUNT
        fit.s, fit.t = pair.place[2 * k], pair.place[2 * k + 1]
        fit.x = locate.coordinate(table.nodes_x, table.cells, fit.s)
        fit.y = locate.coordinate(table.nodes_y, table.cells, fit.t)
        fit.scale_x = locate.cell_length(table.nodes_x, table.cells, fit.s)
        fit.scale_y = locate.cell_length(table.nodes_y, table.cells, fit.t)
        fit.var_x, fit.var_y = pair.covariance[10 * k], pair.covariance[10 * k + 5]
        fit.cov_xy = pair.covariance[10 * k + 1]
        tables.place_contact(solver.surfaces[pad], solver.placement, fit.x, fit.y)
        at = solver.placement
        if solver.force_requested[pad]:
            _estimate_part_force(solver, pad, k, row)
        parts[row + _PART_POSITION], parts[row + _PART_NORMAL] = at.px, at.nx
        parts[row + _PART_POSITION + 1], parts[row + _PART_NORMAL + 1] = at.py, at.ny
        parts[row + _PART_POSITION + 2], parts[row + _PART_NORMAL + 2] = at.pz, at.nz
        _add_motion(solver, _PART_MOTION)
        _add_size(solver, pad)
        _add_overhang(solver, pad)
        _write_row(parts, row + _PART_COVARIANCE, fit, at, at.tx, at.wx)
        _write_row(parts, row + _PART_COVARIANCE + 3, fit, at, at.ty, at.wy)
        _write_row(parts, row + _PART_COVARIANCE + 6, fit, at, at.tz, at.wz)


def _estimate_part_force(solver: ContactSolver, pad: int, k: int, row: int) -> None:
    """Write the force of contact k of a pair into a row of the parts; NaN where it has only a lower bound.

    The other contact's current raises the sheet's potential at this one, by Green's function of a grounded
    boundary, ln(1 + R R' / d^2) / 2 with both spreading radii and the distance, exact in a disc; between bare
    stretches it is more: half of what it changes the force by is added to the standard deviation.
    """
    fit, pair, law, table = solver.fit, solver.pair, solver.laws[pad], solver.models[pad]
    other = 1 - k
    total, n = pair.total[k], fit.whitening.electrodes
    dx = fit.x - locate.coordinate(table.nodes_x, table.cells, pair.place[2 * other])
    dy = fit.y - locate.coordinate(table.nodes_y, table.cells, pair.place[2 * other + 1])
    mutual = math.exp(pair.spreading[k] + pair.spreading[other]) / (dx * dx + dy * dy)
    mutual = 0.5 * math.log(1.0 + mutual) * force.sheet_ohm_per_square(law) / _TWO_PI
    mutual *= pair.total[other] / total
    resistors = force.series_resistance(law, solver.currents, pad * solver.electrodes, n)
    resistors *= 1.0 + pair.total[other] / total
    slope_x, slope_y = pair.spreading[2 + k] / fit.scale_x, pair.spreading[4 + k] / fit.scale_y
    whole = force.whole_factor(law, total) / total
    variance = slope_x * slope_x * fit.var_x + slope_y * slope_y * fit.var_y
    variance += 2.0 * slope_x * slope_y * fit.cov_xy
    with_x, with_y = pair.with_total[2 * k], pair.with_total[2 * k + 1]
    variance += 2.0 * whole * (slope_x * with_x + slope_y * with_y)
    scale_m = solver.placement.scale_m
    force_n = 0.0
    for step in range(2):
        force.estimate_force(
            solver.stack,
            law,
            solver.result,
            total,
            math.sqrt(pair.var_total[k]),
            pair.spreading[k] + math.log(scale_m),
            (slope_x * slope_x + slope_y * slope_y) / (scale_m * scale_m),
            variance,
            resistors + step * mutual,
        )
        if solver.result.status != _FITTED:
            return
        if step == 0:
            force_n = solver.result.force_n
    change = 0.5 * (solver.result.force_n - force_n)
    solver.parts[row + _PART_FORCE] = solver.result.force_n
    std_n = solver.result.std_n
    solver.parts[row + _PART_FORCE_STD] = math.sqrt(std_n * std_n + change * change)


def _propagate(solver: ContactSolver, pad: int) -> None:
    """Compute residual and derivatives by the currents; inflate the covariance for misfit."""
    fit, values, row = solver.fit, solver.values, pad * _COUNT
    n, total, pair, modelled, noise = fit.whitening.electrodes, fit.total, 0.0, 0.0, 0.0
    # derivatives of (x, y, total) by each whitened current, from slopes by cell; then by each current
    per_x, per_y = total / fit.scale_x, total / fit.scale_y
    var_x = fit.var_x if fit.var_x < 1e300 else 0.0
    var_y = fit.var_y if fit.var_y < 1e300 else 0.0
    for i in range(n):
        sx, sy = fit.slope_x[i] * per_x, fit.slope_y[i] * per_y
        fit.data[i] = var_x * sx + fit.cov_xy * sy
        fit.scaled[i] = fit.cov_xy * sx + var_y * sy
    tolerances.transpose_whitening(fit.whitening, fit.data, fit.weight, solver.by_x)
    tolerances.transpose_whitening(fit.whitening, fit.scaled, fit.weight, solver.by_y)
    for i in range(n):
        fit.data[i] = (
            fit.fractions[i] / fit.norm
            - fit.mixing_x * per_x * fit.data[i]
            - fit.mixing_y * per_y * fit.scaled[i]
        )
    tolerances.transpose_whitening(fit.whitening, fit.data, fit.weight, solver.by_total)
    for i in range(2):
        pair += (fit.readings[i] - fit.whitening.shift[i]) / fit.weight[i]
        modelled += fit.raw[i]
    slope_x = (fit.raw[n + 1] + fit.raw[n + 2]) / fit.scale_x
    slope_y = (fit.raw[2 * n + 2] + fit.raw[2 * n + 3]) / fit.scale_y
    residual = pair / total - modelled
    for i in range(n):
        by = (
            -pair / (total * total) * solver.by_total[i] - slope_x * solver.by_x[i] - slope_y * solver.by_y[i]
        )
        if i < 2:
            by += 1.0 / total
        noise += (by / fit.weight[i]) * (by / fit.weight[i])
    if n == _PAIRED_CHANNELS:
        values[row + _RESIDUAL], values[row + _RESIDUAL_STD] = residual, math.sqrt(noise)
    table = solver.models[pad]
    fit.cost *= table.misfit_scale
    values[row + _MISFIT] = fit.cost
    _write_pad_noise(solver, pad)
    _widen_by_misfit(solver, pad)


def _widen_by_misfit(solver: ContactSolver, pad: int) -> None:
    """Widen the covariance by this contact's misfit, or by those of the pad's last contacts, which show that
    its parts aren't as stated. Where two contacts are told apart, misfits are no evidence of that."""
    fit, spread, at = solver.fit, 1.0, _MISFIT_COUNT * pad
    if solver.misfits[at] > _MIN_LASTING_MISFIT:
        spread = solver.misfits[at]
    spread = max(spread, 1.0 + fit.cost - _MAX_SQUARED_MISFIT)
    if spread > 1.0:
        fit.var_x *= spread
        fit.var_y *= spread
        fit.cov_xy *= spread
    if not solver.pair_limits[pad] < _INFINITY:
        solver.misfits[at + 1] += fit.total * fit.total * min(fit.cost, _MAX_SQUARED_MISFIT)
        solver.misfits[at + 2] += fit.total * fit.total


def _count_misfit(solver: ContactSolver, pad: int) -> None:
    """Add the misfit of a pad's contact before to the running mean of its contacts."""
    at, misfits = _MISFIT_COUNT * pad, solver.misfits
    if misfits[at + 2] > 0.0:
        misfits[at] += (misfits[at + 1] / misfits[at + 2] - misfits[at]) / _MISFIT_CONTACTS
        misfits[at + 1] = misfits[at + 2] = 0.0


def _add_extent(table: locate.ModelTable, fit: locate.Fit, residual: float) -> None:
    """Add the extent of the contact that explains its residual.

    A contact whose current spreads along x with a variance v adds v / 2 times the second derivative by x to
    every fraction; one along y subtracts as much, as potentials are harmonic.
    """
    n = table.electrodes
    low, high = max(fit.s - 1.0, 0.0), min(fit.s + 1.0, 1.0 * table.cells)
    tables.read_table(table.values, 0, table.cells, n + 1, high, fit.t, fit.beside)
    slope = fit.beside[n + 1] + fit.beside[n + 2]
    tables.read_table(table.values, 0, table.cells, n + 1, low, fit.t, fit.beside)
    curvature = slope - fit.beside[n + 1] - fit.beside[n + 2]
    curvature /= (high - low) * fit.scale_x * fit.scale_x
    if curvature == 0.0:
        return
    variance = 2.0 * abs(residual / curvature)
    if residual * curvature > 0.0:
        fit.var_x += min(variance, _MAX_EXTENT_SIDES * _MAX_EXTENT_SIDES * table.side_x * table.side_x)
    else:
        fit.var_y += min(variance, _MAX_EXTENT_SIDES * _MAX_EXTENT_SIDES * table.side_y * table.side_y)


def _write_pad_noise(solver: ContactSolver, pad: int) -> None:
    """Write the covariance of the arc lengths from channel noise alone: the larger of stated and measured."""
    n, values, row = solver.fit.whitening.electrodes, solver.values, pad * _COUNT
    first, xx, xy, yy = pad * solver.electrodes, 0.0, 0.0, 0.0
    for i in range(n):
        noise, scale = 1.0 / solver.weight[first + i], solver.ampere_per_count[first + i]
        measured2 = solver.noise_squared[first + i] * scale * scale
        if measured2 > noise * noise:
            noise = math.sqrt(measured2)
        x, y = solver.by_x[i] * noise, solver.by_y[i] * noise
        xx += x * x
        xy += x * y
        yy += y * y
    along, around = solver.placement.along_m, solver.placement.around_m
    values[row + _PAD_NOISE] = xx * along * along
    values[row + _PAD_NOISE + 1] = xy * along * around
    values[row + _PAD_NOISE + 2] = yy * around * around


def _span_two_patches(solver: ContactSolver, pad: int) -> None:
    """Let the force of a contact that is no point span that of two equal patches of the same total current.

    They are the likelier the larger the misfit; as likely as one from twice its limit on.
    """
    values, row, chance = solver.values, pad * _COUNT, 0.5
    chance *= min(solver.fit.cost / _MAX_SQUARED_MISFIT - 1.0, 1.0)
    one, one_std, status = values[row + _FORCE], values[row + _FORCE_STD], values[row + _FORCE_STATUS]
    _estimate_force(solver, pad, 0.5)
    two, two_std = 2.0 * values[row + _FORCE], 2.0 * values[row + _FORCE_STD]
    if status == _FITTED and values[row + _FORCE_STATUS] == _FITTED:
        variance = (1.0 - chance) * one_std * one_std + chance * two_std * two_std
        one_std = math.sqrt(variance + chance * (1.0 - chance) * (two - one) * (two - one))
        one += chance * (two - one)
    elif status == _BOUNDED:
        if values[row + _FORCE_STATUS] == _FITTED:
            two -= _BOUND_SIGMA * two_std
        one += 2.0 * chance * (min(one, max(two, 0.0)) - one)
    values[row + _FORCE], values[row + _FORCE_STD], values[row + _FORCE_STATUS] = one, one_std, status


def _estimate_force(solver: ContactSolver, pad: int, share: float) -> None:
    fit, values, row = solver.fit, solver.values, pad * _COUNT
    n, law = fit.whitening.electrodes, solver.laws[pad]
    log_spreading_m = fit.raw[n] + math.log(solver.placement.scale_m)
    # the stack factor is whole / total - ln R(x, y): its variance beyond that of the total alone
    slope_x, slope_y = fit.raw[2 * n + 1] / fit.scale_x, fit.raw[3 * n + 2] / fit.scale_y
    variance = 0.0
    if fit.var_x < 1e300 and fit.var_y < 1e300:
        whole = force.whole_factor(law, share * fit.total) / fit.total
        variance = slope_x * slope_x * fit.var_x + slope_y * slope_y * fit.var_y
        variance += 2.0 * slope_x * slope_y * fit.cov_xy
        variance += 2.0 * whole * (slope_x * fit.cov_x_total + slope_y * fit.cov_y_total)
    force.estimate_force(
        solver.stack,
        law,
        solver.result,
        share * fit.total,
        share * math.sqrt(fit.var_total),
        log_spreading_m,
        (slope_x * slope_x + slope_y * slope_y) / (solver.placement.scale_m * solver.placement.scale_m),
        variance,
        force.series_resistance(law, solver.currents, pad * solver.electrodes, n) / share,
    )
    values[row + _FORCE], values[row + _FORCE_STD] = solver.result.force_n, solver.result.std_n
    values[row + _FORCE_STATUS] = 1.0 * solver.result.status


def _correct_crowding(solver: ContactSolver, pad: int) -> None:
    """Move the position from the centre of the current to that of the contact; add the covariance of that,
    and of the centre of a pressure that isn't even."""
    fit, table, at = solver.fit, solver.models[pad], solver.placement
    n, law, result, parts = (
        fit.whitening.electrodes,
        solver.laws[pad],
        solver.result,
        solver.pad_tolerances[pad],
    )
    slope_x, slope_y = fit.raw[2 * n + 1] / fit.scale_x, fit.raw[3 * n + 2] / fit.scale_y
    scale2 = at.scale_m * at.scale_m
    gradient2 = (slope_x * slope_x + slope_y * slope_y) / scale2
    force.find_crowding(
        solver.stack,
        law,
        result,
        fit.total,
        fit.raw[n] + math.log(at.scale_m),
        gradient2,
        force.series_resistance(law, solver.currents, pad * solver.electrodes, n),
    )
    spread = parts.tilt_std * parts.tilt_std * result.tilt_m * result.tilt_m
    if solver.crowding[pad]:  # an elongated contact moves more or less, and aside
        moved = parts.moment_std * result.shift
        spread += moved * moved * gradient2
    fit.var_x += spread / (at.along_m * at.along_m)
    fit.var_y += spread / (at.around_m * at.around_m)
    if not solver.crowding[pad]:
        return
    std_x, std_y = result.shift_std / scale2 * slope_x, result.shift_std / scale2 * slope_y
    if fit.var_x < 1e300 and fit.var_y < 1e300:
        fit.var_x += std_x * std_x
        fit.var_y += std_y * std_y
        fit.cov_xy += std_x * std_y
    x = max(0.0, min(table.side_x, fit.x + result.shift / scale2 * slope_x))
    y = max(0.0, min(table.side_y, fit.y + result.shift / scale2 * slope_y))
    if x != fit.x or y != fit.y:
        fit.x, fit.y = x, y
        tables.place_contact(solver.surfaces[pad], at, x, y)


def _write_position(solver: ContactSolver, pad: int) -> None:
    """Write position, normal and covariance; NaN what the currents don't determine."""
    fit, at, values, row = solver.fit, solver.placement, solver.values, pad * _COUNT
    if not fit.var_x < 1e300 or not fit.var_y < 1e300:
        return
    values[row + _X], values[row + _X + 1] = fit.x, fit.y
    values[row + _U], values[row + _U + 1] = at.u_m, at.v_m
    values[row + _POSITION], values[row + _POSITION + 1], values[row + _POSITION + 2] = at.px, at.py, at.pz
    values[row + _NORMAL], values[row + _NORMAL + 1], values[row + _NORMAL + 2] = at.nx, at.ny, at.nz
    _add_motion(solver, 1.0)
    _add_size(solver, pad)
    _add_overhang(solver, pad)
    _write_row(values, row + _COVARIANCE, fit, at, at.tx, at.wx)
    _write_row(values, row + _COVARIANCE + 3, fit, at, at.ty, at.wy)
    _write_row(values, row + _COVARIANCE + 6, fit, at, at.tz, at.wz)
    _write_mount(solver, pad)


def _write_mount(solver: ContactSolver, pad: int) -> None:
    """Write the covariance of the position by the pad's mount on its link.

    A rotation error of s about each axis through the pad's origin moves a point at r by s^2 (r.r 1 - r r').
    """
    at, values, mounts = solver.placement, solver.values, solver.mounts
    first, row = pad * _MOUNT_COUNT, pad * _COUNT + _MOUNT
    x, y, z = at.px - mounts[first], at.py - mounts[first + 1], at.pz - mounts[first + 2]
    turning = mounts[first + 4]
    even = mounts[first + 3] + turning * (x * x + y * y + z * z)
    values[row], values[row + 4] = even - turning * x * x, even - turning * y * y
    values[row + 8] = even - turning * z * z
    values[row + 1] = values[row + 3] = -turning * x * y
    values[row + 2] = values[row + 6] = -turning * x * z
    values[row + 5] = values[row + 7] = -turning * y * z


def _add_motion(solver: ContactSolver, factor: float) -> None:
    """Add the covariance by motion in the course of a schedule of switched electrodes.

    The states are those of different times: the position lags that of the last, depending on what each state
    says, and shifts sideways, as the states contradict each other. What the contact has moved isn't
    known better than by the last two positions.
    """
    fit = solver.fit
    if solver.moved_x == 0.0 and solver.moved_y == 0.0:
        return
    moved_x, moved_y = factor * solver.moved_x, factor * solver.moved_y
    along2, across2 = _MOTION_ALONG * _MOTION_ALONG, _MOTION_ACROSS * _MOTION_ACROSS
    fit.var_x += along2 * moved_x * moved_x + across2 * moved_y * moved_y
    fit.var_y += along2 * moved_y * moved_y + across2 * moved_x * moved_x
    fit.cov_xy += (along2 - across2) * moved_x * moved_y


def _add_size(solver: ContactSolver, pad: int) -> None:
    """Add the covariance of positions by the pad's size, which is in proportion to the distance from the
    middle."""
    fit, table, parts = solver.fit, solver.models[pad], solver.pad_tolerances[pad]
    aside_x = (solver.placement.u_m - parts.middle_u_m) * parts.size_x / solver.placement.along_m
    aside_y = (fit.y - 0.5 * table.side_y) * parts.size_y
    fit.var_x += aside_x * aside_x
    fit.var_y += aside_y * aside_y


def _add_overhang(solver: ContactSolver, pad: int) -> None:
    """Add the covariance of positions of elongated contacts that may hang over an edge."""
    fit, table, parts, at = solver.fit, solver.models[pad], solver.pad_tolerances[pad], solver.placement
    if not parts.is_elongated:
        return
    shift_x = tolerances.overhang(parts, min(fit.x, table.side_x - fit.x) * at.along_m) / at.along_m
    shift_y = tolerances.overhang(parts, min(fit.y, table.side_y - fit.y) * at.around_m) / at.around_m
    fit.var_x += shift_x * shift_x
    fit.var_y += shift_y * shift_y


def _write_row(
    values: memoryview[float], first: int, fit: locate.Fit, at: tables.Placement, t: float, w: float
) -> None:
    """Write a row of the covariance in the link's frame, from components of the tangents."""
    by_t, by_w = fit.var_x * t + fit.cov_xy * w, fit.cov_xy * t + fit.var_y * w
    values[first] = by_t * at.tx + by_w * at.wx
    values[first + 1] = by_t * at.ty + by_w * at.wy
    values[first + 2] = by_t * at.tz + by_w * at.wz
