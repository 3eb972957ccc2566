"""Tolerances of parts: covariance that they add to the currents of a contact, and its whitening.

Every tolerance changes the fractions along one vector: a gain by its own fraction; the end of an electrode
by a constant vector times a field on the pad (Hadamard: of the potentials, only the strength of their
singularity at that end differs); a series resistor by a constant vector times its fraction; the ratio of the
pad's sides and each wave of its sheet's resistance by a vector of fields.

Public names: `PadTolerances`, `PartKnowledge`, `Whitening`, `part_count`, `shape_error`, `overhangs`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from handtouch.config.channels import channel_states
from handtouch.core.memory import view_memory
from handtouch.core.pad_tables import CELLS_PER_TOLERANCE_CELL, ForwardTable
from handtouch.core.stages import tables
from handtouch.field.network import ElectrodeNetwork
from handtouch.hand.pads import (
    elongation_stds,
    log_aspect_std,
    pad_surface,
    relative_size_stds,
    series_ohm_stds,
    shape_stds,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch import config
    from handtouch.arrays import FloatArray
    from handtouch.field.model import ChannelModel


_WAVES = 5  # of the sheet resistance
_M_PER_MM = 1e-3
_OVERHANG_STEP = 1.0 / 16.0  # of a contact radius
_STATE_STD = 0.08
"""Standard deviation of the logarithm of a contact's current in one state of a schedule, by its force."""
_STATE_GRID = (np.arange(12) + 0.5) / 12
_MARGIN = 0.1  # of the sides, of typical contacts
_MIN_SERIES_STD = 1e-6  # relative; that of the sheet resistance is in multiples of it
_OVERHANGS, _DIRECTIONS, _SEGMENT_POINTS = 33, 8, 24


class PadTolerances:
    """Tolerances of one pad of n electrodes, gains aside, as standard deviations.

    values: `tolerance_nodes` of the pad's `ForwardTable`, over the pad in `cells` cells, each as many of the
    forward model's as 1 / `cell_ratio`. end_vectors: (2 n n,) changes of fractions by one standard deviation
    of each end, per its field. aspect_std, wave_std: of the logarithm of the ratio of the sides, and of a
    wave. series_vectors: (n n,) changes by one standard deviation of each resistor, per its electrode's
    fraction; series_by_sheet: (n,) standard deviations of each resistor to which one of the sheet resistance
    is equal. tilt_std: rise of a contact's pressure to its rim, over its mean, along any direction;
    moment_std: relative difference of its second moment along any direction from that of a round one.
    middle_u_m: arc length from the electrode x0 to the pad's middle; size_x, size_y: relative standard
    deviations of its sides. elongations: (cells + 1,) along x, standard deviation of what an elongated
    contact multiplies derivatives by x x and x y with. overhangs: (k,) root mean square shift [m] of
    positions from an edge that an elongated contact hangs over, at multiples of `overhang_step_m` from it.
    states: of a schedule, 1 without one; state_of: (n,) state in which each electrode is measured; state_std,
    state_std_per_a: of the logarithm of a contact's current in each, by its force, and per ampere by the
    electrodes that it sees. is_shape_exact: none but gains have a tolerance.
    """

    def __init__(
        self,
        pad: config.Pad,
        node: config.Node,
        sheet: config.Sheet,
        network: ChannelModel,
        table: ForwardTable,
    ) -> None:
        """Take the tolerances that a deployment states; `network` and `table` are the pad's."""
        surface = pad_surface(pad)
        self.values = view_memory(table.tolerance_nodes)
        self.cells, self.cell_ratio = len(table.tolerance_nodes) - 1, 1 / CELLS_PER_TOLERANCE_CELL
        end_stds, self.wave_std = shape_stds(pad, sheet, network)
        end_vectors = np.ascontiguousarray(end_stds[:, None] * table.end_vectors)
        self.end_vectors = view_memory(end_vectors)
        self.aspect_std = log_aspect_std(pad, sheet)
        series_ohm = np.array(pad.series_ohm)
        series_stds = np.maximum(series_ohm_stds(pad, node), _MIN_SERIES_STD * series_ohm)
        series_vectors = np.ascontiguousarray(series_stds[:, None] * table.series_vectors)
        self.series_vectors, self.has_series = view_memory(series_vectors), bool(series_vectors.any())
        self.series_by_sheet = view_memory(
            sheet.ohm_per_square_std * series_ohm / np.where(series_stds > 0, series_stds, 1.0)
        )
        self.middle_u_m = surface.extent_m[0] / 2
        self.size_x, self.size_y = relative_size_stds(pad, sheet)
        elongations = elongation_stds(sheet, surface, network, table.nodes_x[::CELLS_PER_TOLERANCE_CELL, 0])
        self.elongations, self.is_elongated = view_memory(elongations), bool(elongations.any())
        radius_m = math.hypot(sheet.contact_radius_mm, sheet.contact_radius_std_mm) * _M_PER_MM
        self.overhangs = view_memory(radius_m * overhangs(sheet.contact_elongation_std))
        self.overhang_step_m = radius_m * _OVERHANG_STEP
        self.tilt_std, self.moment_std = sheet.contact_tilt_std, math.sinh(sheet.contact_elongation_std)
        self.states = pad.state_count
        self.state_of = view_memory(
            np.array(channel_states(pad) or [0] * len(pad.electrode_names), dtype=np.intp)
        )
        self.state_std = _STATE_STD if pad.switch_states else 0.0
        self.state_std_per_a = _state_ohm_std(network) / node.drive_v
        self.is_shape_exact = not (
            end_vectors.any() or self.aspect_std or self.wave_std or self.has_series or self.is_elongated
        )


class PartKnowledge:
    """Knowledge of the log gains of all pads, and of their parts in standard deviations as stated.

    A pad has n log gains, then p = `part_count(n)` parts. axes: (pads size,), of each pad the (n + p)^2
    numbers of an upper triangle, row by row, whose product with its transpose is their covariance. ends:
    (pads rows,) number of columns of each row up to the last that isn't 0. offsets: (pads parts,) most likely
    values of the parts. `size`, `rows` and `parts` are those of the pad with most electrodes. touch_errors:
    (pads,) standard deviation of the fractions of a touch, another one each time. gain_covariance:
    (pads c c,) of the log gains alone, c channels a pad.
    """

    def __init__(
        self,
        axes: FloatArray,
        ends: NDArray[np.intp],
        offsets: FloatArray,
        touch_errors: FloatArray,
        gain_covariance: FloatArray,
    ) -> None:
        self.axes, self.ends = view_memory(axes), view_memory(ends)
        self.offsets, self.touch_errors = view_memory(offsets), view_memory(touch_errors)
        self.gain_covariance = view_memory(gain_covariance)
        self.size, self.rows, self.parts = axes.shape[1], ends.shape[1], offsets.shape[1]


class Whitening:
    """Whitening of currents over noise: `matrix` (n n,) is lower triangular; its product with currents that
    noise and tolerances vary is uncorrelated, of variance 1. `shift` (n,): what the offsets of the parts add
    to the currents over noise. `modelled` (n,): currents of the contacts over noise. `fields` (8 n
    and 2 n for each state,), `changes` (p n,), `vectors` (n (n + p),), `vector` (n,): working memory.
    `electrodes` is n of the present pad, of which are `pad` and `number`, `channels` that of the pad with
    most; `states` that with most. known: of all pads. weight: (n,) 1 / noise of the present pad.
    """

    def __init__(self, channels: int, states: int, known: PartKnowledge, weight: memoryview[float]) -> None:
        self.known, self.weight, self.number = known, weight, 0
        self.pad: Any = None
        n, parts = channels, part_count(channels)
        self.electrodes = self.channels = n
        self.matrix, self.shift = view_memory(np.zeros(n * n)), view_memory(np.zeros(n))
        self.modelled, self.vector = view_memory(np.zeros(n)), view_memory(np.zeros(n))
        self.fields = view_memory(np.zeros((8 + 2 * states) * n))
        self.changes = view_memory(np.zeros(parts * n))
        self.vectors = view_memory(np.zeros(n * (n + parts)))


def _state_ohm_std(network: ChannelModel) -> float:
    """Return the root mean square, over the pad, of what a contact's resistance to ground differs by between
    the states of its schedule [ohm]; 0 without one."""
    if not (isinstance(network, ElectrodeNetwork) and network.states):
        return 0.0
    x, y = np.meshgrid(network.a * _STATE_GRID, network.b * _STATE_GRID)
    return math.sqrt(network.state_resistance(x, y).var(axis=0).mean())


@cache
def overhangs(elongation_std: float) -> FloatArray:
    """Return the root mean square shift (k,) of positions found at multiples of 1 / 16 radius from an edge.

    In contact radii. elongation_std: of the logarithm of length over width. The current of an elliptical
    patch is that of the segment between its foci with the density (1 - t^2)^(1/2); what hangs over an edge
    enters at the edge. So the centre of the current, which is the position found, is farther inside than the
    patch's, which is equally likely anywhere on the pad, in any direction.
    """
    deviations = np.linspace(-3.5, 3.5, 36)
    ratio = np.exp(elongation_std * np.abs(deviations))
    directions = (np.arange(_DIRECTIONS) + 0.5) * np.pi / 2 / _DIRECTIONS
    reach = np.outer(np.sqrt(ratio - 1 / ratio), np.cos(directions)).ravel()
    angles = np.pi * np.arange(1, _SEGMENT_POINTS + 1) / (_SEGMENT_POINTS + 1)
    points, share = np.cos(angles)[:, None], np.sin(angles) ** 2 / (np.sin(angles) ** 2).sum()
    found_at = _OVERHANG_STEP * np.arange(_OVERHANGS)
    centre = np.linspace(0.0, found_at.max(), 8 * _OVERHANGS)
    square, weight = np.zeros((2, _OVERHANGS))
    for length, likely in zip(reach, np.repeat(np.exp(-0.5 * deviations**2), _DIRECTIONS), strict=True):
        found = share @ np.maximum(centre + length * points, 0.0)
        shift = np.interp(found_at, found, found - centre, left=0.0)
        # no patch of this length is found nearer than one on the edge
        density = np.interp(found_at, found, np.gradient(centre, found), left=0.0)
        square += likely * density * shift**2
        weight += likely * density
    return np.asarray(np.sqrt(square / np.maximum(weight, 1e-300)))


def shape_error(pad: config.Pad, sheet: config.Sheet, network: ChannelModel, table: ForwardTable) -> float:
    """Return a typical standard deviation of a fraction by contacts that are elongated as stated."""
    x, y = (nodes[::CELLS_PER_TOLERANCE_CELL, 0] for nodes in (table.nodes_x, table.nodes_y))
    second = table.tolerance_nodes[:, :, 0, -2 * table.electrodes :].astype(np.float64)
    square = (
        (second**2).sum(axis=2) / table.electrodes * elongation_stds(sheet, pad_surface(pad), network, x) ** 2
    )
    inside = [(at > _MARGIN * at.max()) & (at < (1 - _MARGIN) * at.max()) for at in (y, x)]
    return float(np.sqrt(np.median(square[np.ix_(*inside)])))


def part_count(electrodes: int) -> int:
    """Return the number of parts: ends of electrodes, ratio of the sides, waves, resistors and sheet."""
    return 3 * electrodes + 2 + _WAVES


def choose_pad(whitening: Whitening, pad: PadTolerances, number: int, electrodes: int) -> None:
    """Let what follows be of pad `number`."""
    whitening.pad, whitening.number, whitening.electrodes = pad, number, electrodes


def whiten_by_gains(whitening: Whitening, readings: memoryview[float]) -> None:
    """Set the whitening for a contact at an unknown position: that by gains alone, each by itself.

    readings: (n,) currents over noise.
    """
    n, matrix, channels = whitening.electrodes, whitening.matrix, whitening.channels
    first = whitening.number * channels
    for i in range(n):
        whitening.shift[i] = 0.0
        for j in range(n):
            matrix[i * n + j] = 0.0
        variance = whitening.known.gain_covariance[(first + i) * channels + i] * readings[i] * readings[i]
        matrix[i * n + i] = 1.0 / math.sqrt(1.0 + variance)


def whiten(whitening: Whitening, fractions: memoryview[float], total: float, s: float, t: float) -> None:
    """Set whitening and shift for a contact at (s, t), in cells of the forward model, with a total current.

    fractions: (n,) there.
    """
    _begin(whitening)
    _add_contact(whitening, fractions, 0, total, s, t)
    _complete(whitening)


def whiten_elongated(
    whitening: Whitening,
    fractions: memoryview[float],
    total: float,
    s: float,
    t: float,
    moment_std: float,
    error_std: float,
) -> None:
    """Set them for a contact that may be elongated: half the difference of its current's variances along
    any two axes at right angles has the deviation `moment_std`, in squares of the rectangle's unit.

    What fourth moments add is taken as `error_std` of each fraction.
    """
    n = whitening.electrodes
    _begin(whitening)
    for i in range(n):
        error = error_std * total * whitening.weight[i]
        whitening.matrix[i * n + i] += error * error
    _add_contact(whitening, fractions, 0, total, s, t)
    _add_parts(whitening)
    read_second_derivatives(whitening, s, t)
    _add_second_derivatives(whitening, total, moment_std)
    _invert_root(whitening.matrix, n)


def whiten_pair(
    whitening: Whitening, fractions: memoryview[float], total: memoryview[float], place: memoryview[float]
) -> None:
    """Set them for two contacts on one pad.

    fractions: (2 n,) of the first, then of the second; total: (2,); place: (4,), s and t of each.
    """
    _begin(whitening)
    _add_contact(whitening, fractions, 0, total[0], place[0], place[1])
    _add_contact(whitening, fractions, whitening.electrodes, total[1], place[2], place[3])
    _complete(whitening)


def _complete(whitening: Whitening) -> None:
    """Add what the contacts share, and invert."""
    _add_parts(whitening)
    _invert_root(whitening.matrix, whitening.electrodes)


def read_second_derivatives(whitening: Whitening, s: float, t: float) -> None:
    """Read the pad's fields at (s, t), in cells of the forward model, for `second_derivative`."""
    pad = whitening.pad
    ratio, columns = pad.cell_ratio, field_count(pad, whitening.electrodes)
    tables.read_values(pad.values, pad.cells, columns, s * ratio, t * ratio, whitening.fields)


def second_derivative(whitening: Whitening, i: int, by_xx: float, by_xy: float) -> float:
    """Return these multiples of the second derivatives of fraction i by x x and by x y, summed."""
    first = (2 * whitening.pad.states + 1 + _WAVES) * whitening.electrodes
    second: float = by_xx * whitening.fields[first + i]
    second += by_xy * whitening.fields[first + whitening.electrodes + i]
    return second


def _begin(whitening: Whitening) -> None:
    """Set the covariance to that of noise, and what contacts add up to 0."""
    n = whitening.electrodes
    for i in range(n):
        whitening.shift[i] = whitening.modelled[i] = 0.0
        for j in range(n):
            whitening.matrix[i * n + j] = 0.0
        whitening.matrix[i * n + i] = 1.0
    _clear(whitening.changes, part_count(n) * n)


def _clear(values: memoryview[float], count: int) -> None:
    """Set the first values to 0."""
    for i in range(count):
        values[i] = 0.0


def _add_contact(
    whitening: Whitening, fractions: memoryview[float], first: int, total: float, s: float, t: float
) -> None:
    """Add what is a contact's own: errors of its touch and shape, and its share of the changes by parts."""
    n, matrix, pad, weight = whitening.electrodes, whitening.matrix, whitening.pad, whitening.weight
    for i in range(n):
        error = whitening.known.touch_errors[whitening.number] * total * weight[i]
        matrix[i * n + i] += error * error
        whitening.modelled[i] += total * fractions[first + i] * weight[i]
    if pad.states > 1:
        _add_states(whitening, fractions, first, total)
    if not pad.is_shape_exact:
        _add_changes(whitening, fractions, first, total, s, t)
    if pad.is_elongated:
        # current that spreads with variances v + d along one direction and v - d at right angles to it adds d
        # times the second derivative along it, as potentials are harmonic; the direction is unknown
        _add_second_derivatives(whitening, total, elongation_std(pad, s))


def _add_states(whitening: Whitening, fractions: memoryview[float], first: int, total: float) -> None:
    """Add the covariance by currents of a contact that differ from state to state of a schedule."""
    n, vector, pad, weight = whitening.electrodes, whitening.vector, whitening.pad, whitening.weight
    by_state = pad.state_std_per_a * total
    std = math.sqrt(pad.state_std * pad.state_std + by_state * by_state)
    for state in range(pad.states):
        for i in range(n):
            vector[i] = 0.0
            if pad.state_of[i] == state:
                vector[i] = std * total * fractions[first + i] * weight[i]
        _add_square(whitening.matrix, vector, n)


def _add_parts(whitening: Whitening) -> None:
    """Add the covariance by gains and parts, which all contacts share; set the shift."""
    n, vectors, changes = whitening.electrodes, whitening.vectors, whitening.changes
    pad, known, number = whitening.pad, whitening.known, whitening.number
    parts = part_count(n)
    size, axes, offsets, varied = n + parts, known.axes, known.offsets, 0
    if not pad.is_shape_exact:
        varied = parts if pad.has_series else parts - n - 1
    count = n + varied
    for k in range(count):
        row = number * known.size + k * size
        begin, end = max(k - n, 0), min(known.ends[number * known.rows + k] - n, varied)
        if k >= n and end == begin + 1:  # a part of which nothing was learned
            for i in range(n):
                vectors[i * count + k] = axes[row + k] * changes[begin * n + i]
            continue
        for i in range(n):
            change = axes[row + i] * whitening.modelled[i] if i >= k else 0.0
            for j in range(begin, end):
                change += axes[row + n + j] * changes[j * n + i]
            vectors[i * count + k] = change
    _add_squares(whitening.matrix, vectors, count, n)
    for j in range(varied):
        step = offsets[number * known.parts + j]
        if step != 0.0:
            for i in range(n):
                whitening.shift[i] += step * changes[j * n + i]


def apply_whitening(
    whitening: Whitening, values: memoryview[float], first: int, out: memoryview[float]
) -> None:
    """Write the whitened values (n,), from index `first` on, to `out`."""
    n = whitening.electrodes
    for i in range(n):
        row = 0.0
        for j in range(i + 1):
            row += whitening.matrix[i * n + j] * values[first + j]
        out[i] = row


def transpose_whitening(
    whitening: Whitening, values: memoryview[float], weight: memoryview[float], out: memoryview[float]
) -> None:
    """Write the product of `values` (n,) with the whitening, times `weight` (n,), to `out`: the derivative by
    each current of a function of whitened currents whose derivatives are `values`."""
    n = whitening.electrodes
    for i in range(n):
        row = 0.0
        for j in range(i, n):
            row += whitening.matrix[j * n + i] * values[j]
        out[i] = row * weight[i]


def _add_changes(
    whitening: Whitening, fractions: memoryview[float], first: int, total: float, s: float, t: float
) -> None:
    """Add the changes of the currents over noise by one standard deviation of each part."""
    n, changes, fields = whitening.electrodes, whitening.changes, whitening.fields
    pad, weight = whitening.pad, whitening.weight
    ends, ratio = 2 * pad.states * n, pad.cell_ratio
    tables.read_values(pad.values, pad.cells, field_count(pad, n), s * ratio, t * ratio, fields)
    for i in range(n):
        scale = total * weight[i]
        field = 2 * n * pad.state_of[i]
        for k in range(2 * n):
            changes[k * n + i] += pad.end_vectors[k * n + i] * fields[field + k] * scale
        changes[2 * n * n + i] += pad.aspect_std * fields[ends + i] * scale
        for k in range(_WAVES):
            changes[(2 * n + 1 + k) * n + i] += pad.wave_std * fields[ends + (1 + k) * n + i] * scale
        if pad.has_series:
            resistor = (2 * n + 1 + _WAVES) * n + i
            together = 0.0
            for k in range(n):
                change = pad.series_vectors[k * n + i] * fractions[first + k]
                changes[resistor + k * n] += change * scale
                together += pad.series_by_sheet[k] * change
            # a larger sheet resistance is a smaller one of every resistor
            changes[resistor + n * n] -= together * scale


def elongation_std(pad: PadTolerances, s: float) -> float:
    """Return the deviation of half the difference of a contact's variances along two axes at right angles, in
    squares of the rectangle's unit, at s cells of the forward model; 0 if contacts are round."""
    if not pad.is_elongated:
        return 0.0
    s *= pad.cell_ratio
    cell = int(s)
    if cell > pad.cells - 1:
        cell = pad.cells - 1
    beyond = s - cell
    std: float = (1.0 - beyond) * pad.elongations[cell] + beyond * pad.elongations[cell + 1]
    return std


def field_count(pad: PadTolerances, n: int) -> int:
    """Return the number of fields of a pad of n electrodes: by ends, aspect and waves, second derivatives."""
    return (2 * pad.states + 3 + _WAVES) * n


def _add_second_derivatives(whitening: Whitening, total: float, std: float) -> None:
    """Add the covariance by second derivatives, which are in `fields`, with amplitudes of deviation `std`."""
    n, vector, fields = whitening.electrodes, whitening.vector, whitening.fields
    first = (2 * whitening.pad.states + 1 + _WAVES) * n
    for k in range(2):
        for i in range(n):
            vector[i] = std * fields[first + k * n + i] * total * whitening.weight[i]
        _add_square(whitening.matrix, vector, n)


def overhang(pad: PadTolerances, distance_m: float) -> float:
    """Return the root mean square shift [m] of a position by the part of a contact beyond an edge."""
    place = max(distance_m, 0.0) / pad.overhang_step_m
    k = int(place)
    if k > len(pad.overhangs) - 2:
        return 0.0
    shift: float = pad.overhangs[k] + (place - k) * (pad.overhangs[k + 1] - pad.overhangs[k])
    return shift


def _add_square(matrix: memoryview[float], vector: memoryview[float], n: int) -> None:
    """Add the square of a vector (n,) to the lower triangle of a matrix (n n,)."""
    for i in range(n):
        factor = vector[i]
        for j in range(i + 1):
            matrix[i * n + j] += factor * vector[j]


def _add_squares(matrix: memoryview[float], vectors: memoryview[float], count: int, n: int) -> None:
    """Add the squares of vectors, (n count,) with a column each, to the lower triangle of a matrix (n n,)."""
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i * n + j]
            for k in range(count):
                value += vectors[i * count + k] * vectors[j * count + k]
            matrix[i * n + j] = value


def _invert_root(matrix: memoryview[float], n: int) -> None:
    """Replace the lower triangle of a matrix not below the identity by the inverse of its Cholesky factor."""
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i * n + j]
            for k in range(j):
                rest -= matrix[i * n + k] * matrix[j * n + k]
            if i == j:
                matrix[i * n + i] = math.sqrt(max(rest, 1e-6))
            else:
                matrix[i * n + j] = rest / matrix[j * n + j]
    for i in range(n):
        matrix[i * n + i] = 1.0 / matrix[i * n + i]
        for j in range(i):
            row = 0.0
            for k in range(j, i):
                row -= matrix[i * n + k] * matrix[k * n + j]
            matrix[i * n + j] = row * matrix[i * n + i]
