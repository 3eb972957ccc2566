"""Contacts of a tick: locate, estimate the force, place; one row of `values` a pad.

Public name: `ContactSolver`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from handtouch.core.memory import RowArray, view_memory, view_rows
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages import elongation, force, locate, pairs, tables, tolerances, two_sheets
from handtouch.core.stages.rows import MISFIT_COUNT, MISFIT_ROW, MOUNT_ROW, PART_ROW, PARTS_COUNT, VALUE_ROW
from handtouch.field import contact_law
from handtouch.wire.status import ContactRadiusStatus

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch.arrays import BoolArray, FloatArray
    from handtouch.core.pad_model import PadModel

_NAN = float("nan")
_FITTED, _BOUNDED, _WIDE = float(force.FITTED), float(force.BOUNDED), float(force.WIDE)
_, _ESTIMATED, _ASSUMED, _CONTRADICTORY = map(float, ContactRadiusStatus)
_BOUND_SIGMA = contact_law.BOUND_SIGMA
_PART_ASIDE = 0.5
"""Deviation aside of how far one of two contacts' current is from its centre, over that: the other's
potential is that in a disc. Of two ideal presses on a tuning pad of six electrodes it was 0 and 0.4"""
_MAX_SQUARED_MISFIT = MAX_SQUARED_MISFIT
_MAX_EXTENT_SIDES = 0.5
_MIN_TURNED, _MIN_STEEPNESS, _MIN_DETERMINANT = 0.3, 1e-9, 1e-9
_CUT_SPREAD, _CUT_ERROR = 0.68, 0.15
_CUT_MORE, _CURVED_SPREADING = 1.0 - force.CUT_SPREADING, 0.125
_SPREADING_ERROR = 1.25e-3
"""Standard deviation of ln of the spreading radius by the theory. Contacts of 5 N and more that are solved
in `ideal` are found 0.3 % too light (median), and 17 % are outside without it (tuning hands 3 and 4);
4 % with this (hands 3 to 6), 8 % with 0.75e-3, 1.7 % with 1.5e-3. In `default` parts count for far more"""
_CORNER_ERROR, _CORNER_RADII = 0.055, 1.2
_CROWDING_ERROR, _CORNER_CROWDING, _CURVED_CROWDING, _CROWDING_STD = 0.02, 0.15, 0.06, 2.0 / 3.0
"""Standard deviation of the way from the centre of the current to that of the contact, over it; and by
pressures that aren't even, over `contact_tilt_std` (as of Hertz's, a third of it in the resistance)"""
_TWO_PI, _INFINITY = 2.0 * math.pi, math.inf
_MOTION_ALONG, _MOTION_ACROSS = 0.8, 0.3
"""Standard deviations of a position along and across the path, in what a contact moves in a schedule: by
coverage at 30 mm/s in the world `default`, tuning family."""
_PART_MOTION = 2.0  # of one of two contacts that moves, in motions of the single contact that explains both
_PAIRED_CHANNELS = 4  # electrodes x0, xa, y0, yb
_UNKNOWNS = 3  # of a contact: position and total
_MIN_PEAK = 1.2  # largest current of a contact, relative to the reading of a saturated channel
_MISFIT_CONTACTS, _MIN_LASTING_MISFIT = 8.0, 2.0
"""Contacts over which the misfit of a pad's contacts is averaged; mean that widens the covariance of later
ones: 5 % of pads as stated have more, by contacts of seven shapes (`default`, tuning family)."""
_UNIFORM_VARIANCE = 1.0 / 12.0  # of a value anywhere in a range, in squares of the range
_MAX_VARIANCE = 1.0 / 3.0  # of a position anywhere on a side, estimated at its end, in squares of the side


class ContactSolver:
    """Solver of contacts on the pads of a model, which reads and writes these arrays in place.

    currents: (pads, c) [A]; of the channels of the pad with most electrodes, a pad has as many as it has
    electrodes. offset_std_a: (pads,) of the sum of the currents, from the baseline; it counts as noise of the
    channels, shared among them. force_requested: (pads,), False where no force is to be estimated. values:
    (pads, VALUE_COUNT), laid out as VALUE_SLICES, the result; NaN for a new contact, else the search begins
    at the position in it. parts: (pads, PARTS_COUNT), twice PART_SLICES, NaN if there is one contact.
    measured: by name, as far as known, `saturated` (pads, c), True where a current is a lower bound;
    `noise_squared` (pads, c), variances of the channels as measured [counts^2]: where the stated noise is
    larger, that counts; `misfits` (pads, MISFIT_COUNT). both: `TwoSheets` of the pads with two sheets.

    Of the model: pair_limits, (pads,) squared misfit of one contact from which on two are tried, infinite
    where they can't be resolved; moment_stds, (pads,) [m^2] of an elongated contact, see
    `tolerances.whiten_elongated`; peak_currents_a, (pads,) largest current of an electrode by the firmest
    contact; crowding, (pads,) 1 where currents crowd towards electrodes; weight, (pads, c) 1 / noise [1/A].
    """

    def __init__(
        self,
        model: PadModel,
        currents: FloatArray,
        offset_std_a: FloatArray,
        force_requested: BoolArray,
        values: FloatArray,
        parts: FloatArray | None = None,
        measured: Mapping[str, NDArray[Any]] = MappingProxyType({}),
        both: Any = None,
    ) -> None:
        self.models, self.pad_tolerances = model.stage_tables(), model.stage_tolerances()
        self.laws, self.surfaces = model.stage_laws(), model.surfaces
        self.both, self.has_both = both, both is not None
        if parts is None:
            parts = np.full((model.size, PARTS_COUNT), np.nan)
        given = {
            "saturated": np.zeros(currents.shape, dtype=np.bool_),
            "noise_squared": np.zeros(currents.shape),
            "misfits": np.zeros((model.size, MISFIT_COUNT)),
            **measured,
        }
        pair_limits, moment_stds = model.pair_settings()
        self.currents, self.offset_std_a = view_memory(currents), view_memory(offset_std_a)
        self.force_requested = view_memory(force_requested)
        self.values, self.parts = view_rows(values, VALUE_ROW), view_rows(parts, PART_ROW)
        self.saturated = view_memory(given["saturated"])
        self.noise_squared = view_memory(given["noise_squared"])
        self.misfits = view_rows(given["misfits"], MISFIT_ROW)
        self.pair_limits, self.moment_stds = view_memory(pair_limits), view_memory(moment_stds)
        self.peak_currents_a = view_memory(model.peak_currents_a)
        self.mounts = view_rows(model.mounts, MOUNT_ROW)
        self.weight, self.crowding = view_memory(model.weight), view_memory(model.crowding)
        self.ampere_per_count = view_memory(model.ampere_per_count)
        known = tolerances.PartKnowledge(
            axes=model.part_axes,
            ends=model.part_axis_ends,
            offsets=model.part_offsets,
            touch_errors=model.touch_errors,
            gain_covariance=model.gain_covariance,
        )
        self.electrodes = n = currents.shape[1]
        self.stack = force.stack_table()
        self.fit = locate.Fit(n, max(pad.states for pad in self.pad_tolerances), known)
        self.placement, self.pair = tables.Placement(), pairs.PairFit(n)
        self.elongation, self.result = elongation.Elongation(n), force.ForceResult()
        self.part_law = force.empty_law()
        self.by_x, self.by_y = view_memory(np.zeros(n)), view_memory(np.zeros(n))
        self.by_total, self.covariance = view_memory(np.zeros(n)), view_memory(np.zeros(9))
        self.no_value = np.full(1, np.nan, VALUE_ROW).view(np.recarray)
        self.is_by_both = self.contradicts = False  # force and radius of the last contact are by two sheets
        self.were_two = False
        self.pure = self.mixed = 0.0
        # of the contact's centre: cells; ln of the spreading radius on the surface, its derivatives on the
        # rectangle, square of its gradient; by how far the current's is from it, see `crowded_shift`
        self.centre_s = self.centre_t = self.log_spreading_m = self.slope_x = self.slope_y = 0.0
        self.gradient2 = self.shift = self.moved2 = self.scale2 = 0.0
        self.straight_x = self.straight_y = 0.0
        self.moved_x = self.moved_y = 0.0  # in the course of a schedule

    def solve_contacts(self, pads: memoryview[int]) -> None:
        """Solve the contacts of these pads; a row is NaN where no contact explains the currents."""
        for k in range(len(pads)):
            solve_contact(self, pads[k])


def solve_contact(solver: ContactSolver, pad: int) -> None:
    """Locate a pad's contact, estimate its force, and place it in the link's frame."""
    fit, table, parts = solver.fit, solver.models[pad], solver.pad_tolerances[pad]
    n, first, saturated = table.electrodes, pad * solver.electrodes, 0
    tolerances.choose_pad(fit.whitening, parts, pad, n)
    last_x, last_y = solver.values[pad].xy[0], solver.values[pad].xy[1]
    last_radius_m = solver.values[pad].contact_radius_m
    offset2 = solver.offset_std_a[pad] * solver.offset_std_a[pad] / n
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
    if solver.values[pad].cells[0] != solver.values[pad].cells[0]:  # a new contact
        _count_misfit(solver, pad)
    locate.locate(table, fit, solver.values[pad].cells[0], solver.values[pad].cells[1])
    solver.values[pad] = solver.no_value[0]
    solver.values[pad].is_bound = 1.0 if n - saturated < _UNKNOWNS else 0.0
    solver.were_two = _forget_parts(solver, pad, last_x != last_x)
    if not fit.found:
        return
    solver.values[pad].cells[0], solver.values[pad].cells[1] = fit.s, fit.t
    tables.place_contact(solver.surfaces[pad], solver.placement, fit.x, fit.y)
    if n > _UNKNOWNS and not saturated:
        _write_elongation(solver, pad)
    _propagate(solver, pad)
    solver.is_by_both = False
    _find_centre(solver, pad, solver.laws[pad])
    if solver.force_requested[pad]:
        if solver.has_both:
            _estimate_both(solver, pad, last_radius_m, saturated)
        if not solver.is_by_both:
            _estimate_by_first(solver, pad, saturated)
        _limit_force(solver, pad)
    if fit.cost > _MAX_SQUARED_MISFIT and n == _PAIRED_CHANNELS and table.is_potential and not saturated:
        _add_extent(table, fit, solver.values[pad].residual)
    solver.moved_x = solver.moved_y = 0.0
    if parts.states > 1 and last_x == last_x:
        lag = 1.0 * (parts.states - 1)
        solver.moved_x, solver.moved_y = lag * (fit.x - last_x), lag * (fit.y - last_y)
    if solver.crowding[pad] or parts.tilt_std > 0.0:
        _correct_crowding(solver, pad)
    _write_position(solver, pad)
    if fit.cost > _MAX_SQUARED_MISFIT and solver.pair_limits[pad] < _INFINITY and not saturated:
        _resolve_pair(solver, pad)


def _write_elongation(solver: ContactSolver, pad: int) -> None:
    """Write length and direction of the contact just located and placed."""
    fit, found, at = solver.fit, solver.elongation, solver.placement
    elongation.estimate_elongation(found, solver.models[pad], fit, at.along_m * at.around_m)
    solver.values[pad].length_m, solver.values[pad].min_length_m = found.length_m, found.least_m
    solver.values[pad].max_length_m = found.most_m
    along, around = math.cos(found.angle) / at.along_m, math.sin(found.angle) / at.around_m
    solver.values[pad].length_axis[0] = along * at.tx + around * at.wx
    solver.values[pad].length_axis[1] = along * at.ty + around * at.wy
    solver.values[pad].length_axis[2] = along * at.tz + around * at.wz
    solver.values[pad].length_axis_std_rad = found.angle_std


def _estimate_by_first(solver: ContactSolver, pad: int, saturated: int) -> None:
    """Estimate the force by the first sheet alone, for radii as its table states them."""
    fit = solver.fit
    _estimate_force(solver, pad, 1.0)
    if fit.cost > _MAX_SQUARED_MISFIT:
        _span_two_patches(solver, pad)
    if saturated:
        _bound_force(solver, pad)
    law, force_n = solver.laws[pad], solver.values[pad].force_n
    if not force_n > 0.0:
        return
    log_radius = law.parameters[0].log_radius
    if law.parameters[0].growth > 0.0:
        log_radius += math.log(force_n) / 3.0
    radius_m = math.exp(log_radius)
    solver.values[pad].contact_radius_m = radius_m
    solver.values[pad].contact_radius_std_m = radius_m * math.sqrt(law.parameters[0].radius_variance)
    solver.values[pad].contact_radius_status = _ASSUMED
    if solver.has_both and solver.contradicts:
        solver.values[pad].contact_radius_status = _CONTRADICTORY
        if solver.values[pad].force_status == _FITTED:
            solver.values[pad].force_status = _WIDE


def _estimate_both(solver: ContactSolver, pad: int, last_radius_m: float, saturated: int) -> None:
    """Estimate force and radius by both sheets, where the pad has two and the second says something.

    The value of the force is the first sheet's apparent one, as of pads with one sheet.
    """
    fit, both = solver.fit, solver.both
    n, law = fit.whitening.electrodes, solver.laws[pad]
    solver.contradicts = False
    if both.numbers[pad] < 0:
        return
    _find_spreading(solver, pad, 1.0)
    both.spreading, both.pure, both.mixed = solver.log_spreading_m, solver.pure, solver.mixed
    # over an edge, the radius decides how far
    both.gradient2 = 0.0 if solver.result.cut < 0.0 else solver.gradient2
    two_sheets.estimate_both(
        both,
        pad,
        law,
        solver.result,
        0.0 if saturated else fit.total,
        math.sqrt(fit.var_total),
        force.series_resistance(law, solver.currents, pad * solver.electrodes, n),
        last_radius_m,
    )
    solver.contradicts = both.contradicts
    if not both.is_used:
        return
    solver.is_by_both = True
    solver.values[pad].force_n, solver.values[pad].force_std_n = solver.result.force_n, solver.result.std_n
    solver.values[pad].force_status = 1.0 * solver.result.status
    solver.values[pad].contact_radius_m, solver.values[pad].contact_radius_std_m = (
        both.radius_m,
        both.radius_std_m,
    )
    solver.values[pad].contact_radius_status = _ESTIMATED


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
        greatest = max(solver.peak_currents_a[pad], _MIN_PEAK * least)
        noise = 1.0 / fit.weight[i]
        current = 2.0 * least * greatest / (least + greatest)
        relative = 2.0 * (greatest - least) / (greatest + least)  # width of the range of the inverse
        variance = _UNIFORM_VARIANCE * relative * relative * current * current
        fit.weight[i] = 1.0 / math.sqrt(noise * noise + variance)
        fit.readings[i] = current * fit.weight[i]


def _bound_force(solver: ContactSolver, pad: int) -> None:
    """Replace the force of a contact with saturated channels by a lower bound: that of their lowest currents,
    less two standard deviations of its logarithm."""
    fit, first = solver.fit, pad * solver.electrodes
    total = variance = 0.0
    for i in range(fit.whitening.electrodes):
        total += solver.currents[first + i]
        variance += 1.0 / (solver.weight[first + i] * solver.weight[first + i])
    share = locate.channel_sum(solver.models[pad], fit)
    fit.total, fit.var_total = total / share, variance / (share * share)
    fit.cov_x_total = fit.cov_y_total = 0.0
    _find_centre(solver, pad, solver.laws[pad])
    _estimate_force(solver, pad, 1.0)
    if solver.values[pad].force_status != _BOUNDED and solver.values[pad].force_n >= 0.0:
        if solver.values[pad].force_n > 0.0:
            relative = solver.values[pad].force_std_n / solver.values[pad].force_n
            solver.values[pad].force_n *= math.exp(
                -_BOUND_SIGMA * math.sqrt(math.log(1.0 + relative * relative))
            )
        solver.values[pad].force_std_n = _INFINITY
        solver.values[pad].force_status = _BOUNDED


def _limit_force(solver: ContactSolver, pad: int) -> None:
    """Limit a force, of two patches or a lower bound, to the greatest of a contact."""
    force_n, greatest_n = solver.values[pad].force_n, force.max_force_n(solver.laws[pad])
    if force_n > greatest_n:
        solver.values[pad].force_n = greatest_n


def _forget_parts(solver: ContactSolver, pad: int, is_new: bool) -> bool:
    """Write NaN for the two contacts of a pad; return True if there were two in its last sample. Their places
    stay, unless the contact is new."""
    were_two = solver.parts[2 * pad].position_m[0] == solver.parts[2 * pad].position_m[0]
    for row in range(2 * pad, 2 * pad + 2):
        for i in range(3):
            solver.parts[row].position_m[i] = solver.parts[row].normal[i] = _NAN
        for i in range(9):
            solver.parts[row].covariance_m2[i] = _NAN
        solver.parts[row].force_n = solver.parts[row].force_std_n = _NAN
        if is_new:
            solver.parts[row].place[0] = _NAN
    return were_two and not is_new


def _order_parts(solver: ContactSolver, pad: int) -> int:
    """Return which of two contacts found is the first: each is the one that was nearest to it.

    It keeps that one's id. After samples with one contact it must also be nearer than half of the distance
    between the two; else it is another object's.
    """
    pair, table = solver.pair, solver.models[pad]
    x0 = locate.coordinate(table.nodes_x, table.cells, pair.place[0])
    y0 = locate.coordinate(table.nodes_y, table.cells, pair.place[1])
    x1 = locate.coordinate(table.nodes_x, table.cells, pair.place[2])
    y1 = locate.coordinate(table.nodes_y, table.cells, pair.place[3])
    first, second = 2 * pad, 2 * pad + 1
    kept = _squared_distance(solver.parts, first, x0, y0) + _squared_distance(solver.parts, second, x1, y1)
    turned = _squared_distance(solver.parts, first, x1, y1) + _squared_distance(solver.parts, second, x0, y0)
    begin = 1 if turned < kept else 0
    if begin:
        x0, y0, x1, y1 = x1, y1, x0, y0
    near2 = 0.25 * ((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0))
    near2 = _INFINITY if solver.were_two else near2
    if not _squared_distance(solver.parts, first, x0, y0) < near2:
        _name_part(solver.parts, first, first)
    if not _squared_distance(solver.parts, second, x1, y1) < near2:
        _name_part(solver.parts, second, first)
    solver.parts[first].place[0], solver.parts[first].place[1] = x0, y0
    solver.parts[second].place[0], solver.parts[second].place[1] = x1, y1
    return begin


def _squared_distance(parts: RowArray, row: int, x: float, y: float) -> float:
    """Return the squared distance of (x, y) from the place of a part; NaN if that is none."""
    x -= parts[row].place[0]
    y -= parts[row].place[1]
    return x * x + y * y


def _name_part(parts: RowArray, row: int, first: int) -> None:
    """Write another id of one of two contacts, whose pad's newest id is in the first of both."""
    newest = parts[first].newest_id
    newest = newest + 1.0 if newest == newest else 1.0
    parts[first].newest_id = parts[row].id = newest


def _resolve_pair(solver: ContactSolver, pad: int) -> None:
    """Write the two contacts of a pad, where the currents support two rather than one."""
    fit, pair, table = solver.fit, solver.pair, solver.models[pad]
    scale2 = solver.placement.scale_m * solver.placement.scale_m
    pairs.fit_pair(table, fit, pair, solver.moment_stds[pad] / scale2, solver.pair_limits[pad])
    if not pair.found:
        return
    solver.values[pad].length_m = solver.values[pad].min_length_m = solver.values[pad].max_length_m = _NAN
    for i in range(3):
        solver.values[pad].length_axis[i] = _NAN
    solver.values[pad].length_axis_std_rad = _NAN
    begin = _order_parts(solver, pad)
    for k in range(2):
        row = 2 * pad + (k ^ begin)
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
        solver.parts[row].position_m[0], solver.parts[row].normal[0] = at.px, at.nx
        solver.parts[row].position_m[1], solver.parts[row].normal[1] = at.py, at.ny
        solver.parts[row].position_m[2], solver.parts[row].normal[2] = at.pz, at.nz
        if solver.crowding[pad]:
            _add_part_crowding(solver, pad, k)
        _add_motion(solver, _PART_MOTION)
        _add_size(solver, pad)
        _add_overhang(solver, pad)
        _find_covariance(solver)
        for i in range(9):
            solver.parts[row].covariance_m2[i] = solver.covariance[i]


def _add_part_crowding(solver: ContactSolver, pad: int, k: int) -> None:
    """Add to the covariance of contact k of a pair how far the centre of its current is from its own.

    It is turned towards edges, as that of one contact, and away from the other contact, whose potential is
    that of `_estimate_part_force`; neither is corrected.
    """
    fit, pair, table, result = solver.fit, solver.pair, solver.models[pad], solver.result
    other, scale_m = 1 - k, solver.placement.scale_m
    force.find_crowding(
        solver.stack, solver.laws[pad], result, pair.total[k], pair.spreading[k] + math.log(scale_m), 0.0
    )
    dx = fit.x - locate.coordinate(table.nodes_x, table.cells, pair.place[2 * other])
    dy = fit.y - locate.coordinate(table.nodes_y, table.cells, pair.place[2 * other + 1])
    d2 = dx * dx + dy * dy
    mutual = math.exp(pair.spreading[k] + pair.spreading[other]) / d2
    mutual *= pair.total[other] / pair.total[k] / (1.0 + mutual)
    slope_x, slope_y = pair.spreading[2 + k] / fit.scale_x, pair.spreading[4 + k] / fit.scale_y
    shift = 0.5 * result.turning * result.square / (scale_m * scale_m)
    shift_x = shift * (slope_x + mutual * (slope_x - 2.0 * dx / d2))
    shift_y = shift * (slope_y + mutual * (slope_y - 2.0 * dy / d2))
    aside2 = _PART_ASIDE * _PART_ASIDE * (shift_x * shift_x + shift_y * shift_y)
    fit.var_x += shift_x * shift_x + aside2
    fit.var_y += shift_y * shift_y + aside2
    fit.cov_xy += shift_x * shift_y


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
    scale_m, gradient2, force_n = solver.placement.scale_m, 0.0, 0.0
    if solver.crowding[pad]:
        gradient2 = (slope_x * slope_x + slope_y * slope_y) / (scale_m * scale_m)
    solver.result.moved = solver.result.cut = 0.0  # R is that at the centre of the current
    solver.result.spreading, solver.result.gradient2 = pair.spreading[k] + math.log(scale_m), gradient2
    for step in range(2):
        force.estimate_force(
            solver.stack,
            law,
            solver.result,
            total,
            math.sqrt(pair.var_total[k]),
            variance,
            resistors + step * mutual,
        )
        if solver.result.status != _FITTED:
            return
        if step == 0:
            force_n = solver.result.force_n
    change = 0.5 * (solver.result.force_n - force_n)
    solver.parts[row].force_n = solver.result.force_n
    std_n = solver.result.std_n
    solver.parts[row].force_std_n = math.sqrt(std_n * std_n + change * change)


def _propagate(solver: ContactSolver, pad: int) -> None:
    """Compute residual and derivatives by the currents; inflate the covariance for misfit."""
    fit = solver.fit
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
    table = solver.models[pad]
    if n == _PAIRED_CHANNELS and table.is_potential:
        solver.values[pad].residual, solver.values[pad].residual_std = residual, math.sqrt(noise)
    fit.cost *= table.misfit_scale
    solver.values[pad].squared_misfit = fit.cost
    _write_pad_noise(solver, pad)
    _widen_by_misfit(solver, pad)


def _widen_by_misfit(solver: ContactSolver, pad: int) -> None:
    """Widen the covariance by this contact's misfit, or by those of the pad's last contacts, which show that
    its parts aren't as stated. Where two contacts are told apart, misfits are no evidence of that."""
    fit, spread = solver.fit, 1.0
    if solver.misfits[pad].mean_square > _MIN_LASTING_MISFIT:
        spread = solver.misfits[pad].mean_square
    spread = max(spread, 1.0 + fit.cost - _MAX_SQUARED_MISFIT)
    if spread > 1.0:
        fit.var_x *= spread
        fit.var_y *= spread
        fit.cov_xy *= spread
    if not solver.pair_limits[pad] < _INFINITY:
        solver.misfits[pad].weighted_sum += fit.total * fit.total * min(fit.cost, _MAX_SQUARED_MISFIT)
        solver.misfits[pad].weight_sum += fit.total * fit.total


def _count_misfit(solver: ContactSolver, pad: int) -> None:
    """Add the misfit of a pad's contact before to the running mean of its contacts."""
    mean, weight = solver.misfits[pad].mean_square, solver.misfits[pad].weight_sum
    if weight > 0.0:
        mean += (solver.misfits[pad].weighted_sum / weight - mean) / _MISFIT_CONTACTS
        solver.misfits[pad].mean_square = mean
        solver.misfits[pad].weighted_sum = solver.misfits[pad].weight_sum = 0.0


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
    """Write the covariance of the arc lengths from channel noise alone: the larger of stated and measured.

    Of a coordinate that no current determines, as on an edge, it is the whole variance; none is beyond the
    pad.
    """
    fit, table = solver.fit, solver.models[pad]
    n = solver.fit.whitening.electrodes
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
    if not (xx > 0.0 and yy > 0.0):
        xy = 0.0
        xx = xx if xx > 0.0 else fit.var_x
        yy = yy if yy > 0.0 else fit.var_y
    shrink_x = _shrinking(xx, table.side_x)
    shrink_y = _shrinking(yy, table.side_y)
    xx *= shrink_x * shrink_x
    xy *= shrink_x * shrink_y
    yy *= shrink_y * shrink_y
    along, around = solver.placement.along_m, solver.placement.around_m
    solver.values[pad].pad_noise_m2[0] = xx * along * along
    solver.values[pad].pad_noise_m2[1] = xy * along * around
    solver.values[pad].pad_noise_m2[2] = yy * around * around


def _shrinking(variance: float, side: float) -> float:
    """Return the factor by which a deviation shrinks to that of a contact anywhere on a side."""
    limit = _MAX_VARIANCE * side * side
    return math.sqrt(limit / variance) if variance > limit else 1.0


def _limit_to_pad(fit: locate.Fit, table: locate.ModelTable) -> None:
    """Limit the covariance to that of a contact anywhere on the pad."""
    shrink_x, shrink_y = _shrinking(fit.var_x, table.side_x), _shrinking(fit.var_y, table.side_y)
    fit.var_x *= shrink_x * shrink_x
    fit.var_y *= shrink_y * shrink_y
    fit.cov_xy *= shrink_x * shrink_y


def _span_two_patches(solver: ContactSolver, pad: int) -> None:
    """Let the force of a contact that is no point span that of two equal patches of the same total current.

    They are the likelier the larger the misfit; as likely as one from twice its limit on.
    """
    chance = 0.5
    chance *= min(solver.fit.cost / _MAX_SQUARED_MISFIT - 1.0, 1.0)
    one, one_std, status = (
        solver.values[pad].force_n,
        solver.values[pad].force_std_n,
        solver.values[pad].force_status,
    )
    _estimate_force(solver, pad, 0.5)
    two, two_std = 2.0 * solver.values[pad].force_n, 2.0 * solver.values[pad].force_std_n
    if status == _FITTED and solver.values[pad].force_status == _FITTED:
        variance = (1.0 - chance) * one_std * one_std + chance * two_std * two_std
        one_std = math.sqrt(variance + chance * (1.0 - chance) * (two - one) * (two - one))
        one += chance * (two - one)
    elif status == _BOUNDED:
        if solver.values[pad].force_status == _FITTED:
            two -= _BOUND_SIGMA * two_std
        one += 2.0 * chance * (min(one, max(two, 0.0)) - one)
    solver.values[pad].force_n, solver.values[pad].force_std_n, solver.values[pad].force_status = (
        one,
        one_std,
        status,
    )


def _find_centre(solver: ContactSolver, pad: int, law: force.PadLaw) -> None:
    """Find the centre of the contact from that of its current, and what surrounds it; without crowding they
    are one."""
    fit, table, at = solver.fit, solver.models[pad], solver.placement
    n, result, is_crowded = fit.whitening.electrodes, solver.result, solver.crowding[pad] != 0
    log_scale, parts = math.log(at.scale_m), solver.pad_tolerances[pad]
    solver.centre_s, solver.centre_t = fit.s, fit.t
    solver.log_spreading_m = fit.raw[n] + log_scale
    solver.slope_x = fit.raw[2 * n + 1] / fit.scale_x + at.slope_x
    solver.slope_y = fit.raw[3 * n + 2] / fit.scale_y + at.slope_y
    solver.gradient2 = solver.shift = solver.moved2 = 0.0
    if not is_crowded and parts.tilt_std == 0.0:
        return
    resistors = force.series_resistance(law, solver.currents, pad * solver.electrodes, n)
    force.find_crowding(solver.stack, law, result, fit.total, solver.log_spreading_m, resistors)
    if not is_crowded:
        return
    solver.scale2 = at.scale_m * at.scale_m
    gradient2 = (solver.slope_x * solver.slope_x + solver.slope_y * solver.slope_y) / solver.scale2
    shift = force.crowded_shift(result, solver.log_spreading_m, gradient2)
    solver.moved2 = shift * shift * gradient2
    # the gradient is that at the contact's centre: first as if beside a straight edge, inside or over it
    whole = 0.5 * result.turning * result.square
    near = 2.0 * whole / (1.0 + math.sqrt(1.0 + 4.0 * whole * gradient2))
    near = min(near, shift / max(1.0 - shift * gradient2, _MIN_TURNED)) / solver.scale2
    step_x, step_y = near * solver.slope_x, near * solver.slope_y
    solver.centre_s = locate.clamp(table, fit.s + step_x / fit.scale_x)
    solver.centre_t = locate.clamp(table, fit.t + step_y / fit.scale_y)
    locate.read_beside(table, fit, solver.centre_s, solver.centre_t)
    growth = at.slope_x * step_x + at.slope_y * step_y  # of the scale's logarithm
    length_x = locate.cell_length(table.nodes_x, table.cells, solver.centre_s)
    length_y = locate.cell_length(table.nodes_y, table.cells, solver.centre_t)
    solver.log_spreading_m = fit.beside[n] + log_scale + growth
    solver.slope_x = fit.beside[2 * n + 1] / length_x + at.slope_x
    solver.slope_y = fit.beside[3 * n + 2] / length_y + at.slope_y
    solver.scale2 *= math.exp(growth)  # half way
    slope2 = solver.slope_x * solver.slope_x + solver.slope_y * solver.slope_y
    solver.gradient2 = slope2 / solver.scale2
    solver.shift = force.crowded_shift(result, solver.log_spreading_m, solver.gradient2)


def _find_spreading(solver: ContactSolver, pad: int, share: float) -> None:
    """Set what the estimate of the force needs of the position: the variance `pure` of ln of the spreading
    radius, and its covariance `mixed` with the stack factor by the total."""
    fit, law, surface = solver.fit, solver.laws[pad], solver.surfaces[pad]
    # the stack factor is whole / total - ln R(x, y): its variance beyond that of the total alone
    solver.pure, solver.mixed = _SPREADING_ERROR * _SPREADING_ERROR, 0.0
    if solver.gradient2 > 0.0:  # R in the middle of a contact isn't the mean over it on a curved surface
        curved = _CURVED_SPREADING * surface.curvature * solver.result.square
        solver.pure += curved * curved
    if fit.var_x < 1e300 and fit.var_y < 1e300:
        whole = force.whole_factor(law, share * fit.total) / fit.total
        variance = solver.slope_x * solver.slope_x * fit.var_x + solver.slope_y * solver.slope_y * fit.var_y
        solver.pure += variance + 2.0 * solver.slope_x * solver.slope_y * fit.cov_xy
        solver.mixed = whole * (solver.slope_x * fit.cov_x_total + solver.slope_y * fit.cov_y_total)


def _estimate_force(solver: ContactSolver, pad: int, share: float) -> None:
    fit = solver.fit
    n, law = fit.whitening.electrodes, solver.laws[pad]
    _find_spreading(solver, pad, share)
    solver.result.spreading, solver.result.gradient2 = solver.log_spreading_m, solver.gradient2
    if solver.gradient2 > 0.0 and solver.result.cut < 0.0:
        force.set_part(solver.part_law, law, solver.result.cut)
        law = solver.part_law
        solver.result.spreading += _CUT_MORE * solver.result.cut
    force.estimate_force(
        solver.stack,
        law,
        solver.result,
        share * fit.total,
        share * math.sqrt(fit.var_total),
        solver.pure + 2.0 * solver.mixed,
        force.series_resistance(law, solver.currents, pad * solver.electrodes, n) / share,
    )
    solver.values[pad].force_n, solver.values[pad].force_std_n = solver.result.force_n, solver.result.std_n
    solver.values[pad].force_status = 1.0 * solver.result.status


def _correct_crowding(solver: ContactSolver, pad: int) -> None:
    """Move the position from the centre of the current to that of the contact; add the covariance of that,
    and of the centre of a pressure that isn't even."""
    fit, table, at = solver.fit, solver.models[pad], solver.placement
    result, parts = solver.result, solver.pad_tolerances[pad]
    if solver.is_by_both:
        _find_centre(solver, pad, solver.both.near)
    spread = parts.tilt_std * parts.tilt_std * result.tilt_m * result.tilt_m
    # an elongated contact moves more or less, and aside
    spread += parts.moment_std * parts.moment_std * solver.moved2
    fit.var_x += spread / (at.along_m * at.along_m)
    fit.var_y += spread / (at.around_m * at.around_m)
    if not solver.crowding[pad]:
        return
    shift, scale2 = solver.shift, solver.scale2
    # 2 beside a straight edge, 1 in a corner; how far the centre is from the edge, in radii
    spreading_m = math.exp(solver.log_spreading_m)
    steepness = spreading_m * math.sqrt(solver.gradient2)
    inside = spreading_m / math.sqrt(2.0 * max(steepness, _MIN_STEEPNESS) * result.square)
    cornered = max(2.0 - steepness, 0.0)
    uneven, own = _CROWDING_STD * parts.tilt_std, _CROWDING_ERROR
    own += _CORNER_CROWDING * cornered / max(inside * inside, 1.0)
    std = shift * math.sqrt(uneven * uneven + own * own)
    std = math.sqrt(result.shift_std * result.shift_std + std * std) / scale2
    x, y = fit.x + shift / scale2 * solver.slope_x, fit.y + shift / scale2 * solver.slope_y
    if fit.var_x < 1e300 and fit.var_y < 1e300:
        fit.var_x += std * std * solver.slope_x * solver.slope_x
        fit.var_y += std * std * solver.slope_y * solver.slope_y
        fit.cov_xy += std * std * solver.slope_x * solver.slope_y
        curved = _CURVED_CROWDING * shift / scale2
        left_out = _CORNER_ERROR * cornered * max(_CORNER_RADII - inside, 0.0)
        left_out *= left_out * result.square / scale2
        fit.var_x += curved * curved * at.slope_x * at.slope_x + left_out
        fit.var_y += curved * curved * at.slope_y * at.slope_y + left_out
    if inside < 1.0:
        _straighten(solver, inside, scale2)
        x += solver.straight_x
        y += solver.straight_y
        fit.var_x += _CUT_ERROR * _CUT_ERROR * solver.straight_x * solver.straight_x
        fit.var_y += _CUT_ERROR * _CUT_ERROR * solver.straight_y * solver.straight_y
    x, y = max(0.0, min(table.side_x, x)), max(0.0, min(table.side_y, y))
    if x != fit.x or y != fit.y:
        fit.x, fit.y = x, y
        tables.place_contact(solver.surfaces[pad], at, x, y)


def _straighten(solver: ContactSolver, inside: float, scale2: float) -> None:
    """Find how far a position is off by the shape of a contact over the edge: a disc that an edge cuts
    spreads its current farther along it than across.

    inside: how far the centre of the part on the pad is from the edge, in radii; `slope_x` and `slope_y`
    there, whose direction is across.
    """
    fit, n, square = solver.fit, solver.fit.whitening.electrodes, solver.result.square
    # as a variance along the edge: of second and third moments, which a straight edge weighs by its distance
    longer = _CUT_SPREAD * square * inside * (1.0 - inside) * math.sqrt(1.0 - inside) / scale2
    along, across = solver.slope_x * solver.slope_x, solver.slope_y * solver.slope_y
    longer *= 0.5 / (along + across)
    by_xx, by_xy = longer * (along - across), longer * 2.0 * solver.slope_x * solver.slope_y
    tolerances.read_second_derivatives(fit.whitening, solver.centre_s, solver.centre_t)
    for i in range(n):
        change = tolerances.second_derivative(fit.whitening, i, by_xx, by_xy)
        fit.data[i] = fit.weight[i] * change
    tolerances.apply_whitening(fit.whitening, fit.data, 0, fit.scaled)
    gradient_x = gradient_y = solver.straight_x = solver.straight_y = 0.0
    for i in range(n):
        gradient_x += fit.slope_x[i] * fit.scaled[i]
        gradient_y += fit.slope_y[i] * fit.scaled[i]
    determinant = fit.xx * fit.yy - fit.xy * fit.xy
    if determinant > _MIN_DETERMINANT * fit.xx * fit.yy:
        solver.straight_x = fit.scale_x * (fit.yy * gradient_x - fit.xy * gradient_y) / determinant
        solver.straight_y = fit.scale_y * (fit.xx * gradient_y - fit.xy * gradient_x) / determinant


def _write_position(solver: ContactSolver, pad: int) -> None:
    """Write position, normal and covariance; NaN what the currents don't determine."""
    fit, at = solver.fit, solver.placement
    if not fit.var_x < 1e300 or not fit.var_y < 1e300:
        return
    solver.values[pad].xy[0], solver.values[pad].xy[1] = fit.x, fit.y
    solver.values[pad].pad_m[0], solver.values[pad].pad_m[1] = at.u_m, at.v_m
    solver.values[pad].position_m[0], solver.values[pad].position_m[1], solver.values[pad].position_m[2] = (
        at.px,
        at.py,
        at.pz,
    )
    solver.values[pad].normal[0], solver.values[pad].normal[1], solver.values[pad].normal[2] = (
        at.nx,
        at.ny,
        at.nz,
    )
    _add_motion(solver, 1.0)
    _add_size(solver, pad)
    _add_overhang(solver, pad)
    _limit_to_pad(fit, solver.models[pad])
    _find_covariance(solver)
    for i in range(9):
        solver.values[pad].covariance_m2[i] = solver.covariance[i]
    _write_mount(solver, pad)


def _write_mount(solver: ContactSolver, pad: int) -> None:
    """Write the covariance of the position by the pad's mount on its link.

    A rotation error of s about each axis through the pad's origin moves a point at r by s^2 (r.r 1 - r r').
    """
    at, turning = solver.placement, solver.mounts[pad].rotation_variance_rad2
    x, y = at.px - solver.mounts[pad].origin_m[0], at.py - solver.mounts[pad].origin_m[1]
    z = at.pz - solver.mounts[pad].origin_m[2]
    even = solver.mounts[pad].position_variance_m2 + turning * (x * x + y * y + z * z)
    xy, xz, yz = -turning * x * y, -turning * x * z, -turning * y * z
    solver.values[pad].mount_covariance_m2[0] = even - turning * x * x
    solver.values[pad].mount_covariance_m2[4] = even - turning * y * y
    solver.values[pad].mount_covariance_m2[8] = even - turning * z * z
    solver.values[pad].mount_covariance_m2[1] = solver.values[pad].mount_covariance_m2[3] = xy
    solver.values[pad].mount_covariance_m2[2] = solver.values[pad].mount_covariance_m2[6] = xz
    solver.values[pad].mount_covariance_m2[5] = solver.values[pad].mount_covariance_m2[7] = yz


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


def _find_covariance(solver: ContactSolver) -> None:
    """Compute the covariance in the link's frame (3, 3), from that along the tangents."""
    fit, at = solver.fit, solver.placement
    _find_row(solver, 0, fit.var_x * at.tx + fit.cov_xy * at.wx, fit.cov_xy * at.tx + fit.var_y * at.wx)
    _find_row(solver, 3, fit.var_x * at.ty + fit.cov_xy * at.wy, fit.cov_xy * at.ty + fit.var_y * at.wy)
    _find_row(solver, 6, fit.var_x * at.tz + fit.cov_xy * at.wz, fit.cov_xy * at.tz + fit.var_y * at.wz)


def _find_row(solver: ContactSolver, first: int, by_t: float, by_w: float) -> None:
    at = solver.placement
    solver.covariance[first] = by_t * at.tx + by_w * at.wx
    solver.covariance[first + 1] = by_t * at.ty + by_w * at.wy
    solver.covariance[first + 2] = by_t * at.tz + by_w * at.wz
