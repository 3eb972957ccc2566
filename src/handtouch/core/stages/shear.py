"""Shear pads beneath touched pads: displacement of the skin from currents, and the force vector from both.

Public names: `ShearStage`, `ShearTable`, `SHEAR_NUMBERS`, `SHEAR_CHANNELS`, `REST_SAMPLES`. The equations are
those of `handtouch.field.shear` and `handtouch.field.elastic_layer`, with equal weights of the logarithms of
all currents; derivation: docs/shear.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from handtouch.core.stages.receive import SampleMemory
from handtouch.core.stages.solve import MOUNT_COUNT, VALUE_COUNT, VALUE_SLICES
from handtouch.wire.status import ForceStatus, PadState, PositionStatus

_CHANNELS, _UNKNOWNS, _POINT = 4, 3, 6
SHEAR_CHANNELS = _CHANNELS
"""Electrodes of a shear pad: x0, xa, y0, yb."""
_FILM, _OVERLAP, _LOST, _RADIUS, _INSET, _TRAVEL, _NOISE, _LOAD = 0, 1, 2, 3, 4, 5, 6, 7
_STIFFNESS, _STIFFNESS_STD, _AXIS_STD, _HYSTERESIS, _ZERO_STD, _CENTRE = 8, 10, 11, 12, 13, 14
_LOG_GAIN, _LEAN, _ALONG, _ALPHA, _NUMBERS = 16, 20, 28, 31, 32
SHEAR_NUMBERS = {
    "film_m": slice(_FILM, _FILM + 1),
    "overlap_m": slice(_OVERLAP, _OVERLAP + 1),  # of bars at rest
    "lost_m": slice(_LOST, _LOST + 1),  # by which the gap beside an edge changes this
    "radius_m": slice(_RADIUS, _RADIUS + 1),  # of discs with their edge excess
    "inset_m": slice(_INSET, _INSET + 1),  # of the sides of their sectors
    "travel_m": slice(_TRAVEL, _TRAVEL + 1),
    "noise_counts": slice(_NOISE, _NOISE + 1),
    "load_n": slice(_LOAD, _LOAD + 1),  # normal force that is the film's reference pressure
    "stiffness_n_per_m": slice(_STIFFNESS, _STIFFNESS + 2),
    "stiffness_std": slice(_STIFFNESS_STD, _STIFFNESS_STD + 1),
    "axis_std": slice(_AXIS_STD, _AXIS_STD + 1),
    "hysteresis": slice(_HYSTERESIS, _HYSTERESIS + 1),
    "zero_std_n": slice(_ZERO_STD, _ZERO_STD + 1),
    "centre_m": slice(_CENTRE, _CENTRE + 2),  # of the plate, as arc lengths on the pad
    "log_gain": slice(_LOG_GAIN, _LOG_GAIN + 4),  # of channels: current per count
    "lean_per_m": slice(_LEAN, _LEAN + 8),  # d(pressure over its mean) / d(centre) of channels
    "along": slice(_ALONG, _ALONG + 3),  # the pad's x in the link's frame
    "alpha": slice(_ALPHA, _ALPHA + 1),  # exponent of the film's conductance over pressure
}
"""Layout of the numbers of a `ShearTable`."""
_VALUES, _PAD_M, _FORCE = VALUE_COUNT, VALUE_SLICES["pad_m"].start, VALUE_SLICES["force_n"].start
_FORCE_STD, _COVARIANCE = VALUE_SLICES["force_std_n"].start, VALUE_SLICES["covariance_m2"].start
_NORMAL = VALUE_SLICES["normal"].start
_MOUNT_COUNT, _MOUNT_TURNING = MOUNT_COUNT, 4  # variance of the mount's rotation about each axis [rad^2]
_VECTOR = 12  # force and its covariance
_CLEAR = int(PadState.CLEAR)
_NOT_COMPUTED, _VALID, _LOWER_BOUND, _UNRELIABLE, _INVALID = map(int, ForceStatus)
_POSITION_UNRELIABLE, _POSITION_INVALID = int(PositionStatus.UNRELIABLE), int(PositionStatus.INVALID)
_REST_SAMPLES = 64
REST_SAMPLES = _REST_SAMPLES
"""Untouched samples from which a rest position is measured where there has been no tare."""
_MAX_STEPS, _STEP_TOLERANCE, _MAX_AGM_STEPS, _AGM_TOLERANCE = 30, 1e-10, 20, 1e-15
_MAX_MISFIT = 0.3
"""Largest rms deviation of the logarithms of the currents from those of a displacement; a broken channel has
more"""
_MAX_EXPONENT = 600.0
_SMALLEST_SINE = 1e-6
"""Of the angle between the surface's normal and the pad's x, along which tangential forces are given."""
_PI, _ROOT_HALF, _NAN, _INFINITY = math.pi, math.sqrt(0.5), float("nan"), float("inf")


class ShearTable:
    """Shear pad beneath a pad: its pattern, film and layer.

    column: of its first channel in the slab. unknowns: 2 for a displacement, 3 with a twist. points: (m 6,)
    of the edges of bars, channel, share, direction and position [m], none of a pattern of discs. numbers: as
    in SHEAR_NUMBERS.
    """

    def __init__(
        self, pad: int, column: int, unknowns: int, points: memoryview[float], numbers: memoryview[float]
    ) -> None:
        self.pad, self.column, self.unknowns = pad, column, unknowns
        self.points, self.numbers, self.point_count = points, numbers, len(points) // _POINT


class ShearStage:
    """Shear pads of a model. arrays: flat memory of the arrays of `TickState` by their names.

    position_status, force_status: (n,) of the pads' contacts. mounts: (n MOUNT_COUNT,) as of the
    `ContactSolver`. work: (55,), working memory.
    """

    def __init__(
        self,
        tables: list[ShearTable],
        pads: int,
        arrays: Mapping[str, Any],
        position_status: memoryview[int],
        force_status: memoryview[int],
        mounts: memoryview[float],
        work: memoryview[float],
    ) -> None:
        self.tables, self.pads, self.mounts = tables, pads, mounts
        self.position_status, self.force_status = position_status, force_status
        self.ticks, self.update_interval_ticks = arrays["ticks"], arrays["update_interval_ticks"]
        self.pad_state, self.sample_ns = arrays["pad_state"], arrays["sample_ns"]
        self.touching, self.held, self.unverified = arrays["touching"], arrays["held"], arrays["unverified"]
        self.contact_id, self.values = arrays["contact_id"], arrays["values"]
        self.position_requested = arrays["position_requested"]
        self.force_requested = arrays["force_requested"]
        self.read_ns, self.rest_m = arrays["shear_sample_ns"], arrays["shear_rest_m"]
        self.rest_sum, self.rest_samples = arrays["shear_rest_sum"], arrays["shear_rest_samples"]
        self.peak_n = arrays["shear_peak_n"]
        self.vector, self.status = arrays["force_vector"], arrays["force_vector_status"]
        self.counts, self.logs, self.off = work[0:4], work[4:8], work[8:12]
        self.log_area, self.slope, self.gain = work[12:16], work[16:28], work[28:40]
        self.motion, self.way, self.axes = work[40:43], work[43:46], work[46:55]
        self.misfit = 0.0

    def update_forces(self, memory: SampleMemory) -> None:
        """Compute the force vectors of contacts with a new sample, and rest positions of untouched pads."""
        for number in range(len(self.tables)):
            table = self.tables[number]
            pad = table.pad
            if self.contact_id[pad] == 0:
                discard_vector(self, pad)
            if self.sample_ns[pad] == self.read_ns[pad]:
                continue
            self.read_ns[pad] = self.sample_ns[pad]
            if self.touching[pad]:
                _update_force(self, memory, table)
            elif self.pad_state[pad] == _CLEAR and not (self.held[pad] or self.unverified[pad]):
                _measure_rest(self, memory, table)

    def set_rest(self, number: int, counts: memoryview[float]) -> None:
        """Set the rest position of the shear pad of this number by its counts (4,) at rest: a tare."""
        table = self.tables[number]
        pad = table.pad
        for i in range(_CHANNELS):
            self.counts[i] = counts[i]
        rests = _estimate(self, table, 0.0, 0.0, 0.0)
        for k in range(_UNKNOWNS):
            self.rest_m[_UNKNOWNS * pad + k] = self.motion[k] if rests else _NAN
        self.peak_n[pad] = 0.0
        _forget_samples(self, pad)

    def forget_rest(self, pad: int) -> None:
        """Forget a pad's rest position, because the pad was replaced."""
        for k in range(_UNKNOWNS):
            self.rest_m[_UNKNOWNS * pad + k] = _NAN
        self.peak_n[pad] = 0.0
        _forget_samples(self, pad)


def discard_vector(stage: ShearStage, pad: int) -> None:
    """Discard the force vector of a pad without contact."""
    stage.status[pad] = _NOT_COMPUTED
    for i in range(_VECTOR):
        stage.vector[_VECTOR * pad + i] = _NAN


def _forget_samples(stage: ShearStage, pad: int) -> None:
    stage.rest_samples[pad] = 0
    for i in range(_CHANNELS):
        stage.rest_sum[_CHANNELS * pad + i] = 0.0


def _read_counts(stage: ShearStage, memory: SampleMemory, table: ShearTable) -> bool:
    """Read the counts of a shear pad; return False if one is at the end of its range, or not positive."""
    first, valid = table.pad * memory.channels + table.column, True
    for i in range(_CHANNELS):
        count = memory.counts[first + i]
        if count <= 0 or count <= memory.low_limits[first + i] or count >= memory.high_limits[first + i]:
            valid = False
        stage.counts[i] = count
    return valid


def _measure_rest(stage: ShearStage, memory: SampleMemory, table: ShearTable) -> None:
    """Measure the rest position of an untouched pad that has none, from the mean of its samples."""
    pad = table.pad
    rest = stage.rest_m[_UNKNOWNS * pad]
    if rest == rest or not _read_counts(stage, memory, table):
        return
    for i in range(_CHANNELS):
        stage.rest_sum[_CHANNELS * pad + i] += stage.counts[i]
    stage.rest_samples[pad] += 1
    if stage.rest_samples[pad] < _REST_SAMPLES:
        return
    for i in range(_CHANNELS):
        stage.counts[i] = stage.rest_sum[_CHANNELS * pad + i] / _REST_SAMPLES
    if _estimate(stage, table, 0.0, 0.0, 0.0):
        for k in range(_UNKNOWNS):
            stage.rest_m[_UNKNOWNS * pad + k] = stage.motion[k]
    stage.peak_n[pad] = 0.0
    _forget_samples(stage, pad)


def _update_force(stage: ShearStage, memory: SampleMemory, table: ShearTable) -> None:
    """Compute tangential and whole force of a contact; note the greatest tangential force since the tare."""
    pad, numbers = table.pad, table.numbers
    row = pad * _VALUES
    normal_n = stage.values[row + _FORCE]
    x = stage.values[row + _PAD_M] - numbers[_CENTRE]
    y = stage.values[row + _PAD_M + 1] - numbers[_CENTRE + 1]
    located = -_INFINITY < x + y + normal_n < _INFINITY
    read = _read_counts(stage, memory, table)
    if read:
        read = (
            _estimate(stage, table, max(normal_n, 0.0), x, y)
            if located
            else _estimate(stage, table, 0.0, 0.0, 0.0)
        )
    fx = numbers[_STIFFNESS] * (stage.motion[0] - stage.rest_m[_UNKNOWNS * pad])
    fy = numbers[_STIFFNESS + 1] * (stage.motion[1] - stage.rest_m[_UNKNOWNS * pad + 1])
    known = read and fx + fy == fx + fy
    if known:
        stage.peak_n[pad] = max(stage.peak_n[pad], math.sqrt(fx * fx + fy * fy))
    due = stage.ticks[0] % stage.update_interval_ticks[pad] == 0
    if not due and stage.status[pad] != _NOT_COMPUTED:
        return
    discard_vector(stage, pad)
    if not (stage.position_requested[pad] and stage.force_requested[pad]):
        return
    position, force = stage.position_status[pad], stage.force_status[pad]
    valid = known and located and position != _POSITION_INVALID and force != _INVALID
    if not (valid and _set_axes(stage, table)):
        stage.status[pad] = _INVALID
        return
    stage.status[pad] = _VALID
    if force == _LOWER_BOUND:
        stage.status[pad] = _LOWER_BOUND
    elif force == _UNRELIABLE or position == _POSITION_UNRELIABLE or stage.misfit > _MAX_MISFIT:
        stage.status[pad] = _UNRELIABLE
    _write_vector(stage, table, fx, fy, normal_n)


def _write_vector(stage: ShearStage, table: ShearTable, fx: float, fy: float, normal_n: float) -> None:
    """Write force on the pad and covariance in the link's frame, after `_estimate` and `_set_axes`."""
    pad, numbers, gain = table.pad, table.numbers, stage.gain
    row, first = pad * _VALUES, pad * _VECTOR
    xx = xy = yy = 0.0  # covariance of the displacement: noise of channels
    for i in range(_CHANNELS):
        noise = numbers[_NOISE] / stage.counts[i]
        variance = noise * noise
        xx += gain[i] * gain[i] * variance
        xy += gain[i] * gain[_CHANNELS + i] * variance
        yy += gain[_CHANNELS + i] * gain[_CHANNELS + i] * variance
    # and the centre and size of the normal force
    at = row + _COVARIANCE
    std = stage.values[row + _FORCE_STD]
    zz = std * std
    variance = 0.5 * (stage.values[at] + stage.values[at + 4] + stage.values[at + 8])
    x = stage.values[row + _PAD_M] - numbers[_CENTRE]
    y = stage.values[row + _PAD_M + 1] - numbers[_CENTRE + 1]
    load = max(normal_n, 0.0) / numbers[_LOAD]
    for axis in range(3):
        by_x = by_y = 0.0
        for i in range(_CHANNELS):
            lean = _pressure_ratio(numbers, i, x, y)
            slope = numbers[_ALPHA] / (1.0 + load * lean)
            if axis == 2:
                slope *= lean / numbers[_LOAD]
            else:
                slope *= load * numbers[_LEAN + 2 * i + axis] if lean > 0.0 else 0.0
            by_x += gain[i] * slope
            by_y += gain[_CHANNELS + i] * slope
        if axis == 2:
            variance = zz
        xx += by_x * by_x * variance
        xy += by_x * by_y * variance
        yy += by_y * by_y * variance
    kx, ky = numbers[_STIFFNESS], numbers[_STIFFNESS + 1]
    common = numbers[_STIFFNESS_STD] * numbers[_STIFFNESS_STD]
    axis_variance = numbers[_AXIS_STD] * numbers[_AXIS_STD]
    loop = numbers[_HYSTERESIS] * (stage.peak_n[pad] - 0.5 * math.sqrt(fx * fx + fy * fy))
    even = numbers[_ZERO_STD] * numbers[_ZERO_STD] + loop * loop / 3.0
    xx = kx * kx * xx + (common + axis_variance) * fx * fx + even
    xy = kx * ky * xy + common * fx * fy
    yy = ky * ky * yy + (common + axis_variance) * fy * fy + even
    axes, vector = stage.axes, stage.vector
    for i in range(3):
        vector[first + i] = axes[3 * i] * fx + axes[3 * i + 1] * fy - axes[3 * i + 2] * normal_n
    # a rotation error of s about each axis turns a force F by s^2 (F.F 1 - F F')
    turning = stage.mounts[pad * _MOUNT_COUNT + _MOUNT_TURNING]
    any_way = turning * (fx * fx + fy * fy + normal_n * normal_n)
    for i in range(3):
        a, b, c = axes[3 * i], axes[3 * i + 1], axes[3 * i + 2]
        for j in range(3):
            known = (a * xx + b * xy) * axes[3 * j] + (a * xy + b * yy) * axes[3 * j + 1]
            turned = (any_way if i == j else 0.0) - turning * vector[first + i] * vector[first + j]
            value = known + c * zz * axes[3 * j + 2] + turned
            vector[first + 3 + 3 * i + j] = value if zz < _INFINITY else _NAN


def _set_axes(stage: ShearStage, table: ShearTable) -> bool:
    """Set the axes of the surface at the contact, in the link's frame: x along the pad's, y, and the normal.

    The columns of a matrix, so that it turns forces in the tangent plane to the link's frame. Return False
    where the normal is along the pad's x.
    """
    axes, numbers, at = stage.axes, table.numbers, table.pad * _VALUES + _NORMAL
    nx, ny, nz = stage.values[at], stage.values[at + 1], stage.values[at + 2]
    ax, ay, az = numbers[_ALONG], numbers[_ALONG + 1], numbers[_ALONG + 2]
    part = ax * nx + ay * ny + az * nz
    ax, ay, az = ax - part * nx, ay - part * ny, az - part * nz
    length = math.sqrt(ax * ax + ay * ay + az * az)
    if not length > _SMALLEST_SINE:
        return False
    ax, ay, az = ax / length, ay / length, az / length
    axes[0], axes[3], axes[6] = ax, ay, az
    axes[1], axes[4], axes[7] = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    axes[2], axes[5], axes[8] = nx, ny, nz
    return True


def _pressure_ratio(numbers: memoryview[float], channel: int, x: float, y: float) -> float:
    """Return the pressure at a channel over its mean, of a force at (x, y) from the plate's centre."""
    first = _LEAN + 2 * channel
    return max(1.0 + numbers[first] * x + numbers[first + 1] * y, 0.0)


def _estimate(stage: ShearStage, table: ShearTable, normal_n: float, x: float, y: float) -> bool:
    """Compute motion, its derivatives by the logarithms of the currents, and misfit, by Gauss-Newton steps.

    normal_n, x, y: force on the pad and its centre from the plate's. Return False where no displacement
    within the travel has such currents.
    """
    numbers = table.numbers
    travel, load = numbers[_TRAVEL], normal_n / numbers[_LOAD]
    for i in range(_CHANNELS):
        if not stage.counts[i] > 0.0:
            return False
        tilt = numbers[_ALPHA] * math.log(1.0 + load * _pressure_ratio(numbers, i, x, y))
        stage.logs[i] = math.log(stage.counts[i]) + numbers[_LOG_GAIN + i] - tilt
    for k in range(_UNKNOWNS):
        stage.motion[k] = 0.0
    for _ in range(_MAX_STEPS):
        inside = _evaluate_bars(stage, table) if table.point_count > 0 else _evaluate_discs(stage, table)
        if not inside or not _invert_slopes(stage, table.unknowns):
            return False
        size = 0.0
        for k in range(table.unknowns):
            stage.way[k] = 0.0
            for i in range(_CHANNELS):
                stage.way[k] += stage.gain[_CHANNELS * k + i] * stage.off[i]
            if k < 2:
                size = max(size, abs(stage.way[k]))
        if not size < _INFINITY:
            return False
        damp = 0.5 * travel / size if size > 0.5 * travel else 1.0
        for k in range(table.unknowns):
            stage.motion[k] += damp * stage.way[k]
        if size <= _STEP_TOLERANCE * travel:
            break
    return stage.motion[0] * stage.motion[0] + stage.motion[1] * stage.motion[1] < travel * travel


def _invert_slopes(stage: ShearStage, unknowns: int) -> bool:
    """Compute the gain (unknowns, 4) of the motion over the logarithms of the currents, by least squares.

    Write what these are off, without the common part that is the film's conductance, and the misfit.
    """
    mean = 0.0
    for i in range(_CHANNELS):
        stage.off[i] = stage.logs[i] - stage.log_area[i]
        mean += 0.25 * stage.off[i]
    square = 0.0
    for i in range(_CHANNELS):
        stage.off[i] -= mean
        square += 0.25 * stage.off[i] * stage.off[i]
    stage.misfit = math.sqrt(square) if square < _INFINITY else _INFINITY
    for k in range(unknowns):
        mean = 0.0
        for i in range(_CHANNELS):
            mean += 0.25 * stage.slope[_CHANNELS * k + i]
        for i in range(_CHANNELS):
            stage.slope[_CHANNELS * k + i] -= mean
            stage.gain[_CHANNELS * k + i] = stage.slope[_CHANNELS * k + i]
    # Gauss-Jordan elimination of the normal equations, orthogonalising the rows of the slopes
    for k in range(unknowns):
        length = _dot(stage.gain, k, stage.slope, k)
        if not 0.0 < length < _INFINITY:
            return False
        for i in range(_CHANNELS):
            stage.gain[_CHANNELS * k + i] /= length
        for other in range(unknowns):
            if other != k:
                part = _dot(stage.gain, other, stage.slope, k)
                for i in range(_CHANNELS):
                    stage.gain[_CHANNELS * other + i] -= part * stage.gain[_CHANNELS * k + i]
    return True


def _dot(left: memoryview[float], row: int, right: memoryview[float], other: int) -> float:
    total = 0.0
    for i in range(_CHANNELS):
        total += left[_CHANNELS * row + i] * right[_CHANNELS * other + i]
    return total


def _evaluate_bars(stage: ShearStage, table: ShearTable) -> bool:
    """Compute logarithms of the areas of bars, and their slopes (3, 4), at the present motion."""
    numbers, points, area, slope = table.numbers, table.points, stage.log_area, stage.slope
    for i in range(_CHANNELS):
        area[i] = 0.0
        for k in range(_UNKNOWNS):
            slope[_CHANNELS * k + i] = 0.0
    sine, cosine = math.sin(stage.motion[2]), math.cos(stage.motion[2])
    for point in range(table.point_count):
        first = _POINT * point
        i, share = int(points[first]), points[first + 1]
        wx, wy, px, py = points[first + 2], points[first + 3], points[first + 4], points[first + 5]
        qx, qy = px + wx * numbers[_OVERLAP], py + wy * numbers[_OVERLAP]
        rx, ry = cosine * qx - sine * qy, sine * qx + cosine * qy
        along = wx * (rx + stage.motion[0] - px) + wy * (ry + stage.motion[1] - py)
        s = (along + numbers[_LOST]) / numbers[_FILM]
        if not -_MAX_EXPONENT < _PI * s < _MAX_EXPONENT:
            return False
        wide = math.exp(_PI * s)
        upper = _agm(math.sqrt(wide / (1.0 + wide)))
        rate = share * upper * upper / numbers[_FILM]
        area[i] += share * upper / _agm(math.sqrt(1.0 / (1.0 + wide)))
        slope[i] += rate * wx
        slope[_CHANNELS + i] += rate * wy
        slope[2 * _CHANNELS + i] += rate * (wy * rx - wx * ry)
    for i in range(_CHANNELS):
        if not area[i] > 0.0:
            return False
        for k in range(_UNKNOWNS):
            slope[_CHANNELS * k + i] /= area[i]
        area[i] = math.log(area[i])
    return True


def _agm(low: float) -> float:
    """Return the arithmetic-geometric mean of 1 and a number above 0 that isn't greater."""
    high = 1.0
    for _ in range(_MAX_AGM_STEPS):
        if high - low <= _AGM_TOLERANCE * high:
            break
        mean = 0.5 * (high + low)
        low = math.sqrt(high * low)
        high = mean
    return 0.5 * (high + low)


def _evaluate_discs(stage: ShearStage, table: ShearTable) -> bool:
    """Compute logarithms of the areas of discs over their sectors, and slopes, at the present motion."""
    numbers = table.numbers
    radius, inset = numbers[_RADIUS], numbers[_INSET]
    p = _ROOT_HALF * (stage.motion[0] + stage.motion[1])
    q = _ROOT_HALF * (stage.motion[1] - stage.motion[0])
    for i in range(_CHANNELS):  # x0, xa, y0, yb, along the diagonals
        across = 1.0 if i == 1 or i == 3 else -1.0
        along = 1.0 if i == 0 or i == 3 else -1.0
        low_p, low_q = inset - across * p, inset - along * q
        if not low_p * low_p + low_q * low_q < radius * radius:
            return False
        square = radius * radius
        high_p = math.sqrt(square - low_q * low_q)
        high_q = math.sqrt(square - low_p * low_p)
        wedge = square * (math.atan2(high_q, low_p) - math.atan2(low_q, high_p))
        area = 0.5 * (wedge - low_q * (high_p - low_p) - low_p * (high_q - low_q))
        if not area > 0.0:
            return False
        by_p, by_q = across * (high_q - low_q), along * (high_p - low_p)
        stage.log_area[i] = math.log(area)
        stage.slope[i] = _ROOT_HALF * (by_p - by_q) / area
        stage.slope[_CHANNELS + i] = _ROOT_HALF * (by_p + by_q) / area
    return True
