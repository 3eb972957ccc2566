"""Force and radius of a contact on two sheets of different alpha, by both total currents.

A contact of one force and radius passes a current through each sheet. At a given radius either current gives
a force, by the contact law and the sheet's history (`loads`); the radius is likely where both agree. The
histories are by the stated radius: another one changes them, and what they make of a current, alike. All
forces are equally likely before, by their logarithm; the radius is log-normal, as the first sheet's table
states it. The integral over ln radius takes both logarithms of force as normal at each radius, with the
covariance of what they share: the distance from the edge, and a pressure that isn't even. Force and radius
follow as in `force`: the harmonic mean of the force, the mean of the radius, and the roots of the mean
squares from them.

The layer's conductance goes as the mean of pressure^alpha over the contact: an uneven pressure, of variance
v, adds alpha (alpha - 1) v / 2 to its logarithm, nothing at alpha = 1.

Public names: `TwoSheets`, `read_totals`, `estimate_both`, `store_both`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from handtouch.core.memory import RowArray, view_memory
from handtouch.core.stages import force, loads
from handtouch.core.stages.receive import SampleMemory
from handtouch.field import contact_law

SHEET_ROW = np.dtype(
    [
        ("left", "<f8"),  # stack factor and spreading that the current leaves
        ("variance", "<f8"),  # of its logarithm, by noise and position
        ("resistors", "<f8"),  # stack factor of the series resistors
        ("log_force", "<f8"),  # apparent, at one radius
        ("log_load", "<f8"),  # the same with the sheet's history
        ("load_variance", "<f8"),
        ("by_radius", "<f8"),  # derivative of ln force by ln radius
        ("by_stack", "<f8"),  # and by ln of the spreading radius
        ("half_width", "<f8"),  # deviation by the edge, in ln force
        ("by_layer", "<f8"),  # by an uneven pressure, where the layer dominates, in ln force
        ("by_sheet", "<f8"),  # and where the sheet does
        ("excess", "<f8"),  # deviations by which the current exceeds what the radius passes, 0 or less
        ("by_excess", "<f8"),  # its derivative by ln radius
        ("by_history", "<f8"),  # ln of load over apparent force, at any radius
    ]
)
"""One of the two sheets under a contact"""
RADIUS_ROW = np.dtype(
    [
        ("log_radius", "<f8"),
        ("covariance", "<f8"),  # of both logarithms of load
        ("squared_excess", "<f8"),
        ("log_load", "<f8", 2),  # of each sheet, as the following
        ("load_variance", "<f8", 2),
        ("by_radius", "<f8", 2),
    ]
)
"""Both sheets at one radius"""
_ROWS = 8
_BETWEEN = _ROWS
"""Rows of a table of radii; after them one between two of these"""
_FITTED, _WIDE = force.FITTED, force.WIDE
_BOUND_SIGMA, _MAX_CURRENT_FRACTION = contact_law.BOUND_SIGMA, contact_law.MAX_CURRENT_FRACTION
_MIN_LEFT, _THIRD, _NAN, _INFINITY = 1e-12, 1.0 / 3.0, float("nan"), math.inf
_MAX_STEPS, _MAX_STEP, _CONVERGED_SIGMA = 12, 0.7, 0.3
_MIN_CLEAR_FACTOR = 0.8
"""Stack factor of the smallest radius above which no other is as likely: the force by a sheet of alpha 1.5
falls with the radius below 1.1"""
_MIN_CURVATURE = 1.5
"""Of the logarithm of the radius's probability, over that before the currents: below it, these say little"""
_MAX_AMBIGUOUS_SIGMA = 2.5
"""Deviations up to which small radii may explain both currents, too: 0.6 % of radii are smaller"""
_WIDE_NODES = 24
"""Nodes over all radii that the table states, where several may explain both currents"""
_NODE_SIGMA = 3.3  # of the quadrature over ln radius
_MAX_NEAR_STD = 0.4
"""Deviation of ln radius up to which five nodes suffice, as for forces that are nearly log-normal"""
_MAX_SQUARED_CONTRADICTION = 16.0
"""Squared misfit of both currents, in variances: four standard deviations, from where on the two sheets
contradict each other"""
_MEAN_UNEVEN = 0.3
"""Mean of what an uneven pressure adds to the logarithm of a layer's conductance, in deviations of it: even,
Hertz's, tilted, annular and two-spot pressures, weighted alike, beside even discs of the same area"""
_MAX_SPREAD = 4.0  # mean times mean inverse of a force from which on it is WIDE, see `force`
_MIN_VARIANCE, _MIN_RADIUS_VARIANCE = 1e-12, 1e-8
_MAX_LOG_FORCE = 60.0
_MAX_EQUAL_SAMPLES = 200
MAX_EQUAL_SAMPLES = _MAX_EQUAL_SAMPLES
"""Touched samples of equal counts from which on a channel is stuck: with noise of 0.3 counts, rounded, nine
in ten are equal, so many in a row once in 1e9"""


class TwoSheets:
    """Second sheets of n pads, m of which have one.

    state, second_state: memory of a tick's state and of that of the second sheets, by name. sheets: memory by
    name: numbers (n,) of a pad's second sheet, -1 without; pads (m,), columns (m,) of the slab,
    expected_counts, ampere_per_count, noise_counts (m,). laws: of the second sheets. first, second: histories
    of both.

    Written: totals (m,) [A] and usable (m,) of the second sheets' channels. By `estimate_both` force_n and
    std_n (m,), NaN where the second sheet isn't used, and the apparent force of the second, in its state; of
    the last contact `is_used`, `contradicts`, `radius_m` and `radius_std_m`, and `near`, the first sheet's
    law at that radius."""

    def __init__(
        self,
        state: Mapping[str, Any],
        second_state: Mapping[str, Any],
        sheets: Mapping[str, Any],
        laws: list[force.PadLaw],
        first: loads.SheetLoads,
        second: loads.SheetLoads,
    ) -> None:
        self.numbers, self.pads, self.columns = sheets["numbers"], sheets["pads"], sheets["columns"]
        self.expected_counts, self.ampere_per_count = sheets["expected_counts"], sheets["ampere_per_count"]
        self.noise_counts, self.laws, self.count = sheets["noise_counts"], laws, len(self.pads)
        self.usable, self.totals = (
            view_memory(np.zeros(self.count, np.uint8)),
            view_memory(np.zeros(self.count)),
        )
        self.first, self.second = first, second
        self.touching, self.rising = state["touching"], state["contradicting_samples"]
        self.last_counts, self.equal_samples = state["second_count"], state["equal_samples"]
        self.gain = state["log_gain"]
        self.force_n, self.std_n = state["joint_force_n"], state["joint_std_n"]
        self.new_contact, self.relative_std = state["new_contact"], state["relative_std"]
        self.known, self.offset_std = second_state["known"], second_state["offset_std"]
        self.block_sum, self.block_squares = second_state["block_sum"], second_state["block_squares"]
        self.block_count = second_state["block_count"]
        self.second_touching = second_state["touching"]
        self.second_force_n = second_state["uncompensated_force_n"]
        self.second_std_n = second_state["uncompensated_std_n"]
        self.sheets = np.zeros(2, SHEET_ROW).view(np.recarray)
        self.rows = np.zeros(_ROWS + 1, RADIUS_ROW).view(np.recarray)
        self.stack, self.result = force.stack_table(), force.ForceResult()
        self.near, self.second_near = force.empty_law(), force.empty_law()
        self.pad = self.number = 0
        self.is_used = self.contradicts = False
        self.radius_m = self.radius_std_m = _NAN
        self.spreading = self.gradient2 = self.pure = self.mixed = self.shared = self.uneven = 0.0
        self.squared = self.score = self.curvature = 0.0
        self.off = self.by_radius = self.variance = self.aside = self.by_aside = 0.0
        self.log_load = self.load_variance = self.log_weight = self.growth = 0.0
        self.middle = self.width2 = self.cell = 0.0
        self.centre = self.log_load_unit = self.level = self.least = self.weights = self.inverse = 0.0
        self.mean = self.square = self.radius = self.radius2 = self.log_first = self.log_second = 0.0


def read_totals(both: TwoSheets, memory: SampleMemory) -> None:
    """Compute the currents of the second sheets, and collect untouched samples for their baselines."""
    for k in range(both.count):
        pad = both.pads[k]
        i = pad * memory.channels + both.columns[k]
        count, touching = memory.counts[i], both.touching[pad] != 0
        excess = count - both.expected_counts[k]
        both.totals[k] = excess * both.ampere_per_count[k]
        both.second_touching[k] = touching
        if memory.fresh[pad]:
            if not (touching and count == both.last_counts[k]):
                both.equal_samples[k] = 0
            else:
                both.equal_samples[k] += 1
            both.last_counts[k] = count
            if not touching and both.rising[pad] == 0:
                both.block_sum[k] += excess
                both.block_squares[k] += excess * excess
                both.block_count[k] += 1.0
        in_range = memory.low_limits[i] < count < memory.high_limits[i]
        stuck = both.equal_samples[k] >= _MAX_EQUAL_SAMPLES
        both.usable[k] = 1 if in_range and not stuck and both.known[k] != 0 else 0


def estimate_both(
    both: TwoSheets,
    pad: int,
    law: force.PadLaw,
    result: force.ForceResult,
    total_a: float,
    total_std_a: float,
    series_ohm: float,
    start_m: float,
) -> None:
    """Estimate force and radius by both sheets; `is_used` is False where the second says nothing.

    Set before: `spreading`, ln of the spreading radius; `gradient2`, square of its gradient; `pure`, `mixed`,
    variance of the former by the position, and its covariance with the first sheet's stack factor by the
    total. total_a, total_std_a, series_ohm: of the first sheet's current. start_m: radius to begin the search
    at, NaN for the middle of those expected. The result has the first sheet's apparent force at the radius
    that its table states."""
    k = both.numbers[pad]
    both.pad, both.number, both.result = pad, k, result
    both.is_used = both.contradicts = False
    both.force_n[k] = both.std_n[k] = both.second_force_n[k] = _NAN
    both.second_std_n[k] = 0.0
    scale = both.ampere_per_count[k]
    noise_a = scale * math.sqrt(
        both.noise_counts[k] * both.noise_counts[k] + both.offset_std[k] * both.offset_std[k]
    )
    second_a = both.totals[k]
    if not both.usable[k] or not second_a > _BOUND_SIGMA * noise_a:
        return
    if not total_a > _BOUND_SIGMA * total_std_a:
        return
    both.shared = both.pure + both.mixed
    _set_sheet(both, 0, law, both.near, total_a, total_std_a, series_ohm, both.pure + 2.0 * both.mixed)
    _set_sheet(both, 1, both.laws[k], both.second_near, second_a, noise_a, 0.0, both.pure)
    both.uneven = law.parameters[0].uneven
    both.growth = _THIRD if law.parameters[0].growth > 0.0 else 0.0
    both.middle = law.parameters[0].log_radius
    both.width2 = max(law.parameters[0].radius_variance, _MIN_RADIUS_VARIANCE)
    _set_histories(both)
    log_radius = math.log(start_m) if start_m > 0.0 else both.middle
    both.cell = 0.0
    log_radius = _find_radius(both, log_radius)
    width, middle = math.sqrt(both.width2), both.middle + both.growth * both.log_load
    if _is_ambiguous(both, middle - _MAX_AMBIGUOUS_SIGMA * width):
        reach = _NODE_SIGMA * width
        _integrate_all(both, middle - reach, 2.0 * reach)
        if not both.is_used or both.radius_std_m > both.cell * both.radius_m:
            return
        both.cell = 0.0  # one radius explains both
        log_radius = _find_radius(both, math.log(both.radius_m))
    both.contradicts = both.squared > _MAX_SQUARED_CONTRADICTION
    both.is_used = False
    if not both.contradicts:
        _integrate_near(both, log_radius)


def _is_ambiguous(both: TwoSheets, log_radius: float) -> bool:
    """Return True if several radii may explain both currents: a sheet is near its limit at a small radius,
    where the force by it falls with the radius, while it rises with larger ones; or the currents say
    little."""
    ratio = max(both.spreading - log_radius, 0.0)
    left: float = min(both.sheets[0].left, both.sheets[1].left)
    return left - ratio < _MIN_CLEAR_FACTOR or both.curvature * both.width2 < _MIN_CURVATURE


def _set_sheet(
    both: TwoSheets,
    number: int,
    law: force.PadLaw,
    near: force.PadLaw,
    total_a: float,
    total_std_a: float,
    series_ohm: float,
    position_variance: float,
) -> None:
    """Set what is the same at all radii; `near` becomes the law at one radius, whatever the force."""
    whole = force.whole_factor(law, total_a)
    noise = whole * total_std_a / total_a
    resistors = whole / law.parameters[0].drive_v * total_a * series_ohm
    left = max(whole - resistors, _MIN_LEFT)
    both.sheets[number].left, both.sheets[number].resistors = left, resistors
    both.sheets[number].variance = max(noise * noise + position_variance, 0.0) / (left * left)
    near.parameters[0] = law.parameters[0]
    power = 1.0 / (1.0 - 0.5 * law.parameters[0].by_radius)  # 1 / alpha
    before = law.parameters[0].power - 2.0 * law.parameters[0].growth
    near.parameters[0].log_reference += law.parameters[0].log_x2 * (power - before)
    near.parameters[0].power = power
    near.parameters[0].growth = near.parameters[0].radius_variance = near.parameters[0].uneven = 0.0


def _set_histories(both: TwoSheets) -> None:
    """Set what the sheets' histories make of their apparent forces, which they have by the radius that the
    first sheet's table states, as on pads with one sheet.

    Creep is linear: if the contact has another radius, apparent force, history and load differ by the same
    factor."""
    both.sheets[0].by_history = both.sheets[1].by_history = 0.0
    _evaluate_both(both, both.middle, 1)
    if both.growth > 0.0:
        first = both.sheets[0].log_force
        by_force = both.growth / (1.0 - both.growth * both.sheets[0].by_radius)
        _evaluate_both(both, both.middle + by_force * first, 1)
    both.log_first, both.log_second = both.sheets[0].log_force, both.sheets[1].log_force
    both.sheets[0].by_history = _by_history(both.first, both.pad, both.log_first)
    both.sheets[1].by_history = _by_history(both.second, both.number, both.log_second)


def _by_history(history: loads.SheetLoads, index: int, log_force: float) -> float:
    """Return ln of the load over the apparent force, whose logarithm is given; index: of the sheet."""
    step = loads.find_step(history, index)
    if step is None:
        return 0.0
    load = loads.find_load(history, step, index, math.exp(log_force))
    return math.log(load) - log_force if load > 0.0 else 0.0


def _evaluate_sheet(
    both: TwoSheets, number: int, index: int, near: force.PadLaw, history: loads.SheetLoads, log_radius: float
) -> None:
    """Compute the force by one sheet's current at a radius; index: of the sheet in its history."""
    result = both.result
    force.move_law(near, log_radius)
    result.left, result.variance = both.sheets[number].left, both.sheets[number].variance
    result.spreading, result.gradient2 = both.spreading, both.gradient2
    force.set_radius(result, log_radius)
    least = (1.0 / _MAX_CURRENT_FRACTION - 1.0) * (result.high + both.sheets[number].resistors)
    factor = result.left - 0.5 * (result.high + result.low)
    is_limited = factor < least
    log_x2 = force.find_log_x2(both.stack, max(factor, least))
    force.evaluate(both.stack, near, result, log_x2)
    std = result.step * near.parameters[0].power
    by_stack = std / result.std
    log_force = log_x2 - near.parameters[0].log_x2
    both.sheets[number].excess = both.sheets[number].by_excess = 0.0
    if not is_limited:
        log_force -= result.sigma * result.step
    elif result.sigma < 0.0:
        both.sheets[number].excess, both.sheets[number].by_excess = (
            result.sigma,
            -result.by_radius / result.std,
        )
    uneven = 2.0 * both.uneven * result.factor * by_stack
    layer = uneven * (1.0 / near.parameters[0].power - 1.0) * (1.0 - result.share)
    sheet = uneven * result.share
    log_force = log_force * near.parameters[0].power - _MEAN_UNEVEN * layer
    log_force = max(-_MAX_LOG_FORCE, min(_MAX_LOG_FORCE, log_force))
    variance = std * std + layer * layer + sheet * sheet
    both.sheets[number].log_force = log_force
    both.sheets[number].log_load = log_force + both.sheets[number].by_history
    # either includes the error of the contact law
    gain, relative = history.log_gain_std[index], history.relative_std[index]
    variance = max(variance, gain * gain)
    if relative > gain:
        variance += relative * relative - gain * gain
    both.sheets[number].load_variance = variance
    by_radius = result.by_radius + 2.0 * force.bent(result.bend, result.share)
    both.sheets[number].by_radius = by_stack * by_radius + 2.0 - 2.0 * near.parameters[0].power
    both.sheets[number].by_stack, both.sheets[number].half_width = by_stack, by_stack * result.half_width
    both.sheets[number].by_layer, both.sheets[number].by_sheet = layer, sheet


def _evaluate_both(both: TwoSheets, log_radius: float, number: int) -> None:
    """Compute the loads by both sheets at a radius, and write them to a row of the table."""
    _evaluate_sheet(both, 0, both.pad, both.near, both.first, log_radius)
    _evaluate_sheet(both, 1, both.number, both.second_near, both.second, log_radius)
    covariance = both.sheets[0].by_stack * both.sheets[1].by_stack * both.shared
    covariance += both.sheets[0].half_width * both.sheets[1].half_width
    covariance += both.sheets[0].by_layer * both.sheets[1].by_layer
    covariance += both.sheets[0].by_sheet * both.sheets[1].by_sheet
    excess2 = both.sheets[0].excess * both.sheets[0].excess
    excess2 += both.sheets[1].excess * both.sheets[1].excess
    both.rows[number].log_radius, both.rows[number].covariance = log_radius, covariance
    both.rows[number].squared_excess = excess2
    for i in range(2):
        both.rows[number].log_load[i] = both.sheets[i].log_load
        both.rows[number].load_variance[i] = both.sheets[i].load_variance
        both.rows[number].by_radius[i] = both.sheets[i].by_radius


def _weigh(both: TwoSheets, log_radius: float, row: int) -> None:
    """Compute the load by both sheets at a radius, of a row, and how likely that is: its logarithm."""
    one, two = both.rows[row].load_variance[0], both.rows[row].load_variance[1]
    first, second = both.rows[row].log_load[0], both.rows[row].log_load[1]
    covariance, second_slope = both.rows[row].covariance, both.rows[row].by_radius[1]
    variance = max(one + two - 2.0 * covariance, _MIN_VARIANCE)
    weight = (two - covariance) / variance
    off, by_radius = first - second, both.rows[row].by_radius[0] - second_slope
    both.log_load = second + weight * off
    both.load_variance = max((one * two - covariance * covariance) / variance, _MIN_VARIANCE)
    variance += by_radius * by_radius * both.cell * both.cell / 12.0
    aside = log_radius - both.middle - both.growth * both.log_load
    both.off, both.by_radius, both.variance, both.aside = off, by_radius, variance, aside
    both.by_aside = 1.0 - both.growth * (second_slope + weight * by_radius)
    both.squared = off * off / variance + aside * aside / both.width2 + both.rows[row].squared_excess
    both.log_weight = -0.5 * (both.squared + math.log(variance))


def _weigh_between(both: TwoSheets, log_radius: float, low: int) -> None:
    """The same between a row and the next: loads by cubics of values and slopes, the rest linear."""
    high = low + 1
    width = both.rows[high].log_radius - both.rows[low].log_radius
    t = (log_radius - both.rows[low].log_radius) / width
    before, after = both.rows[low].covariance, both.rows[high].covariance
    both.rows[_BETWEEN].covariance = before + t * (after - before)
    before, after = both.rows[low].squared_excess, both.rows[high].squared_excess
    both.rows[_BETWEEN].squared_excess = before + t * (after - before)
    for i in range(2):
        before, after = both.rows[low].load_variance[i], both.rows[high].load_variance[i]
        both.rows[_BETWEEN].load_variance[i] = before + t * (after - before)
        slope, next_slope = both.rows[low].by_radius[i], both.rows[high].by_radius[i]
        both.rows[_BETWEEN].by_radius[i] = slope + t * (next_slope - slope)
        before, rise = both.rows[low].log_load[i], both.rows[high].log_load[i] - both.rows[low].log_load[i]
        left, right = slope * width - rise, rise - next_slope * width
        both.rows[_BETWEEN].log_load[i] = before + t * rise
        both.rows[_BETWEEN].log_load[i] += t * (1.0 - t) * ((1.0 - t) * left + t * right)
    _weigh(both, log_radius, _BETWEEN)


def _find_radius(both: TwoSheets, log_radius: float) -> float:
    """Return ln of the likeliest radius by Newton steps; both sheets are in the middle row near it."""
    for _ in range(_MAX_STEPS):
        _evaluate_both(both, log_radius, 1)
        _weigh(both, log_radius, 1)
        both.score = both.off * both.by_radius / both.variance + both.aside * both.by_aside / both.width2
        both.curvature = both.by_radius * both.by_radius / both.variance
        both.curvature += both.by_aside * both.by_aside / both.width2
        for sheet in range(2):
            by_excess = both.sheets[sheet].by_excess
            both.score += both.sheets[sheet].excess * by_excess
            both.curvature += by_excess * by_excess
        step = -both.score / both.curvature
        if step * step * both.curvature < _CONVERGED_SIGMA * _CONVERGED_SIGMA:
            break
        log_radius += max(-_MAX_STEP, min(_MAX_STEP, step))
    found: float = both.rows[1].log_radius
    return found


def _integrate_near(both: TwoSheets, log_radius: float) -> None:
    """Integrate over ln radius about the likeliest one, between three rows."""
    std = 1.0 / math.sqrt(both.curvature)
    half, middle = _NODE_SIGMA * std, log_radius - both.score / both.curvature
    if not middle - half < log_radius < middle + half:
        return
    _evaluate_both(both, middle - half, 0)
    _evaluate_both(both, middle + half, 2)
    begin, end = 0, both.stack.any_count
    if std < _MAX_NEAR_STD:
        begin, end = end, end + both.stack.near_count
    _clear_sums(both, middle)
    for i in range(begin, end):
        at = middle - half + 2.0 * half * both.stack.nodes[2 * i]
        _weigh_between(both, at, 0 if at < log_radius else 1)
        _add_node(both, at, both.stack.nodes[2 * i + 1])
    _finish(both)


def _integrate_all(both: TwoSheets, low: float, width: float) -> None:
    """Integrate over all radii that the table states: those of several solutions are among them. Each node
    stands for its part of the range."""
    step, number = width / (_ROWS - 1), 0
    for i in range(_ROWS):
        _evaluate_both(both, low + i * step, i)
    both.cell = width / _WIDE_NODES
    _clear_sums(both, low + 0.5 * width)
    for i in range(_WIDE_NODES):
        at = low + (i + 0.5) * both.cell
        while number < _ROWS - 2 and at > both.rows[number + 1].log_radius:
            number += 1
        _weigh_between(both, at, number)
        _add_node(both, at, 1.0)
    both.contradicts = both.least > _MAX_SQUARED_CONTRADICTION
    if not both.contradicts:
        _finish(both)


def _clear_sums(both: TwoSheets, middle: float) -> None:
    both.centre, both.log_load_unit = middle, both.log_load
    both.level, both.least = both.log_weight, _INFINITY
    both.weights = both.inverse = both.mean = both.square = both.radius = both.radius2 = 0.0


def _add_node(both: TwoSheets, log_radius: float, weight: float) -> None:
    """Add a node of the integral over ln radius, as weighed."""
    both.least = min(both.least, both.squared)
    weight *= math.exp(both.log_weight - both.level)
    ratio, size = math.exp(both.log_load - both.log_load_unit), math.exp(log_radius - both.centre)
    spread = math.exp(0.5 * both.load_variance)
    both.weights += weight
    both.inverse += weight * spread / ratio
    both.mean += weight * spread * ratio
    both.square += weight * spread * spread * spread * spread * ratio * ratio
    both.radius += weight * size
    both.radius2 += weight * size * size


def _finish(both: TwoSheets) -> None:
    """Set force and radius by the sums over all nodes, and the first sheet's law at that radius."""
    weights, result, k = both.weights, both.result, both.number
    if not weights > 0.0:
        return
    both.is_used = True
    load, unit = weights / both.inverse, math.exp(both.log_load_unit)
    variance = (both.square - 2.0 * load * both.mean) / weights + load * load
    both.force_n[k], both.std_n[k] = unit * load, unit * math.sqrt(max(variance, 0.0))
    both.second_force_n[k] = math.exp(both.log_second)
    result.force_n, result.std_n = math.exp(both.log_first), 0.0
    result.status = _FITTED if both.mean * both.inverse < _MAX_SPREAD * weights * weights else _WIDE
    radius = both.radius / weights
    relative2 = max(both.radius2 / weights - radius * radius, 0.0) / (radius * radius)
    both.radius_m = radius * math.exp(both.centre)
    both.radius_std_m = both.radius_m * math.sqrt(relative2)
    force.move_law(both.near, both.centre + math.log(radius))
    both.near.parameters[0].radius_variance = math.log(1.0 + relative2)


def store_both(both: TwoSheets, values: RowArray) -> None:
    """Replace the forces of touched pads in their VALUE_ROWs by those of both sheets."""
    for k in range(both.count):
        pad = both.pads[k]
        if not both.touching[pad] or not both.force_n[k] > 0.0:
            continue
        gain = math.exp(both.gain[pad])
        force_n, std_n = gain * both.force_n[k], gain * both.std_n[k]
        if both.new_contact[pad] and both.relative_std[pad] > 0.0:
            std_n = max(std_n, force_n * both.relative_std[pad])
        values[pad].force_n, values[pad].force_std_n = force_n, std_n
