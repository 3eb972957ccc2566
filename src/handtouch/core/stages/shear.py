"""Shear pads beneath touched pads: displacement of the skin from currents, and the force vector from both.

Public names: `ShearForces`, `ShearTable`, `SHEAR_ROW`, `REST_SAMPLES`. The equations are
those of `handtouch.field.shear` and `handtouch.field.elastic_layer`, with equal weights of the logarithms of
all currents; derivation: docs/shear.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from handtouch.core.memory import RowArray, view_memory, view_rows
from handtouch.core.stages.receive import SampleMemory
from handtouch.core.stages.rows import MOUNT_COUNT, SHEAR_CHANNELS, VALUE_ROW
from handtouch.wire.status import ForceStatus, PadState, PositionStatus

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from handtouch.arrays import FloatArray
    from handtouch.core.slab import Slab
    from handtouch.core.state import TickState


_CHANNELS, _UNKNOWNS, _POINT = SHEAR_CHANNELS, 3, 6
SHEAR_ROW = np.dtype(
    [
        ("film_m", "<f8"),
        ("overlap_m", "<f8"),  # of bars at rest
        ("lost_m", "<f8"),  # by which the gap beside an edge changes this
        ("radius_m", "<f8"),  # of discs with their edge excess
        ("inset_m", "<f8"),  # of the sides of their sectors
        ("travel_m", "<f8"),
        ("noise_counts", "<f8"),
        ("load_n", "<f8"),  # normal force that is the film's reference pressure
        ("stiffness_n_per_m", "<f8", 2),
        ("stiffness_std", "<f8"),
        ("axis_std", "<f8"),
        ("hysteresis", "<f8"),
        ("zero_std_n", "<f8"),
        ("centre_m", "<f8", 2),  # of the plate, as arc lengths on the pad
        ("log_gain", "<f8", 4),  # of channels: current per count
        ("lean_per_m", "<f8", 8),  # d(pressure over its mean) / d(centre) of channels
        ("along", "<f8", 3),  # the pad's x in the link's frame
        ("alpha", "<f8"),  # exponent of the film's conductance over pressure
    ]
)
"""A shear pad"""
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
    of the edges of bars, channel, share, direction and position [m], none of a pattern of discs. row: (1,) as
    SHEAR_ROW.
    """

    def __init__(self, pad: int, column: int, unknowns: int, points: FloatArray, row: RowArray) -> None:
        self.pad, self.column, self.unknowns = pad, column, unknowns
        self.points, self.row, self.point_count = view_memory(points), row, len(points)


class ShearForces:
    """Force vectors of n pads, in a tick's state: those of contacts above shear pads, 0 to n of them.

    position_status, force_status: (n,) of the contacts, read in place. mounts: (n, MOUNT_COUNT), as
    `PadModel.mounts`. `any_configured`: there is a shear pad.
    """

    def __init__(
        self,
        tables: Sequence[ShearTable],
        state: TickState,
        position_status: NDArray[np.uint8],
        force_status: NDArray[np.uint8],
        mounts: FloatArray,
    ) -> None:
        self.state, self.tables, self.any_configured = state, list(tables), bool(tables)
        self.numbers = {table.pad: number for number, table in enumerate(self.tables)}
        self.mounts = view_memory(mounts)
        self.position_status, self.force_status = view_memory(position_status), view_memory(force_status)
        arrays = state.memory
        self.ticks, self.update_interval_ticks = arrays["ticks"], arrays["update_interval_ticks"]
        self.pad_state, self.sample_ns = arrays["pad_state"], arrays["sample_ns"]
        self.touching, self.held, self.unverified = arrays["touching"], arrays["held"], arrays["unverified"]
        self.contact_id, self.values = arrays["contact_id"], view_rows(state.values, VALUE_ROW)
        self.position_requested = arrays["position_requested"]
        self.force_requested = arrays["force_requested"]
        self.read_ns, self.rest_m = arrays["shear_sample_ns"], arrays["shear_rest_m"]
        self.rest_sum, self.rest_samples = arrays["shear_rest_sum"], arrays["shear_rest_samples"]
        self.peak_n = arrays["shear_peak_n"]
        self.vector, self.status = arrays["force_vector"], arrays["force_vector_status"]
        self.counts, self.logs, self.off, self.log_area = (view_memory(np.zeros(4)) for _ in range(4))
        self.slope, self.gain = view_memory(np.zeros(12)), view_memory(np.zeros(12))
        self.motion, self.way, self.axes = (view_memory(np.zeros(count)) for count in (3, 3, 9))
        self.misfit = 0.0

    def has_shear(self, pad: int) -> bool:
        """Return True if there is a shear pad beneath a pad."""
        return pad in self.numbers

    def rest_known(self, pad: int) -> bool:
        """Return True if the rest position of the shear pad beneath a pad is known."""
        return bool(np.isfinite(self.state.shear_rest_m[pad]).all())

    def update_forces(self, slab: Slab) -> None:
        """Compute the force vectors of contacts with a new sample, and rest positions of untouched pads, once
        position and force of a tick's contacts are known."""
        _update_pads(self, slab.memory)

    def set_rest(self, pad: int, counts: ArrayLike) -> None:
        """Set the rest position of the shear pad beneath a pad by its counts (4,) at rest: a tare."""
        _set_rest(self, self.tables[self.numbers[pad]], view_memory(np.array(counts, np.float64)))

    def forget_rest(self, pads: Sequence[int]) -> None:
        """Forget the rest positions of pads that were replaced; untouched samples give new ones."""
        for pad in pads:
            _forget_rest(self, pad)

    def discard(self, pads: NDArray[np.intp]) -> None:
        """Discard the force vectors of pads whose contact ended, or whose model changed."""
        held = self.state
        held.force_vector[pads], held.force_vector_status[pads] = np.nan, 0

    def hand_columns(self, rows: slice) -> dict[str, bytes]:
        """Return columns of a hand frame; empty for a hand without shear pads."""
        if not any(rows.start <= pad < rows.stop for pad in self.numbers):
            return {}
        held = self.state
        values = held.force_vector[rows].astype("<f4")
        columns = {
            "force_vector_status": held.force_vector_status[rows].tobytes(),
            "force_vector_n": values[:, :3].tobytes(),
            "force_vector_covariance_n2": values[:, 3:].tobytes(),
        }
        in_frames = held.frame_force_vector[rows].astype("<f4").reshape(-1, 2, 3)
        for number, (frame, requested) in enumerate(
            (("palm", held.palm_requested), ("base", held.base_requested))
        ):
            if np.count_nonzero(requested[rows]):
                columns[f"{frame}_force_vector_n"] = in_frames[:, number].tobytes()
        return columns


def _update_pads(stage: ShearForces, memory: SampleMemory) -> None:
    for number in range(len(stage.tables)):
        table = stage.tables[number]
        pad = table.pad
        if stage.contact_id[pad] == 0:
            _discard_vector(stage, pad)
        if stage.sample_ns[pad] == stage.read_ns[pad]:
            continue
        stage.read_ns[pad] = stage.sample_ns[pad]
        if stage.touching[pad]:
            _update_force(stage, memory, table)
        elif stage.pad_state[pad] == _CLEAR and not (stage.held[pad] or stage.unverified[pad]):
            _measure_rest(stage, memory, table)


def _set_rest(stage: ShearForces, table: ShearTable, counts: memoryview[float]) -> None:
    pad = table.pad
    for i in range(_CHANNELS):
        stage.counts[i] = counts[i]
    rests = _estimate(stage, table, 0.0, 0.0, 0.0)
    for k in range(_UNKNOWNS):
        stage.rest_m[_UNKNOWNS * pad + k] = stage.motion[k] if rests else _NAN
    stage.peak_n[pad] = 0.0
    _forget_samples(stage, pad)


def _forget_rest(stage: ShearForces, pad: int) -> None:
    for k in range(_UNKNOWNS):
        stage.rest_m[_UNKNOWNS * pad + k] = _NAN
    stage.peak_n[pad] = 0.0
    _forget_samples(stage, pad)


def _discard_vector(stage: ShearForces, pad: int) -> None:
    """Discard the force vector of a pad without contact."""
    stage.status[pad] = _NOT_COMPUTED
    for i in range(_VECTOR):
        stage.vector[_VECTOR * pad + i] = _NAN


def _forget_samples(stage: ShearForces, pad: int) -> None:
    stage.rest_samples[pad] = 0
    for i in range(_CHANNELS):
        stage.rest_sum[_CHANNELS * pad + i] = 0.0


def _read_counts(stage: ShearForces, memory: SampleMemory, table: ShearTable) -> bool:
    """Read the counts of a shear pad; return False if one is at the end of its range, or not positive."""
    first, valid = table.pad * memory.channels + table.column, True
    for i in range(_CHANNELS):
        count = memory.counts[first + i]
        if count <= 0 or count <= memory.low_limits[first + i] or count >= memory.high_limits[first + i]:
            valid = False
        stage.counts[i] = count
    return valid


def _measure_rest(stage: ShearForces, memory: SampleMemory, table: ShearTable) -> None:
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


def _update_force(stage: ShearForces, memory: SampleMemory, table: ShearTable) -> None:
    """Compute tangential and whole force of a contact; note the greatest tangential force since the tare."""
    pad = table.pad
    normal_n = stage.values[pad].force_n
    x = stage.values[pad].pad_m[0] - table.row[0].centre_m[0]
    y = stage.values[pad].pad_m[1] - table.row[0].centre_m[1]
    located = -_INFINITY < x + y + normal_n < _INFINITY
    read = _read_counts(stage, memory, table)
    if read:
        read = (
            _estimate(stage, table, max(normal_n, 0.0), x, y)
            if located
            else _estimate(stage, table, 0.0, 0.0, 0.0)
        )
    fx = table.row[0].stiffness_n_per_m[0] * (stage.motion[0] - stage.rest_m[_UNKNOWNS * pad])
    fy = table.row[0].stiffness_n_per_m[1] * (stage.motion[1] - stage.rest_m[_UNKNOWNS * pad + 1])
    known = read and fx + fy == fx + fy
    if known:
        stage.peak_n[pad] = max(stage.peak_n[pad], math.sqrt(fx * fx + fy * fy))
    due = stage.ticks[0] % stage.update_interval_ticks[pad] == 0
    if not due and stage.status[pad] != _NOT_COMPUTED:
        return
    _discard_vector(stage, pad)
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


def _write_vector(stage: ShearForces, table: ShearTable, fx: float, fy: float, normal_n: float) -> None:
    """Write force on the pad and covariance in the link's frame, after `_estimate` and `_set_axes`."""
    pad, gain = table.pad, stage.gain
    first = pad * _VECTOR
    xx = xy = yy = 0.0  # covariance of the displacement: noise of channels
    for i in range(_CHANNELS):
        noise = table.row[0].noise_counts / stage.counts[i]
        variance = noise * noise
        xx += gain[i] * gain[i] * variance
        xy += gain[i] * gain[_CHANNELS + i] * variance
        yy += gain[_CHANNELS + i] * gain[_CHANNELS + i] * variance
    # and the centre and size of the normal force
    std = stage.values[pad].force_std_n
    zz = std * std
    variance = stage.values[pad].covariance_m2[0] + stage.values[pad].covariance_m2[4]
    variance = 0.5 * (variance + stage.values[pad].covariance_m2[8])
    x = stage.values[pad].pad_m[0] - table.row[0].centre_m[0]
    y = stage.values[pad].pad_m[1] - table.row[0].centre_m[1]
    load = max(normal_n, 0.0) / table.row[0].load_n
    for axis in range(3):
        by_x = by_y = 0.0
        for i in range(_CHANNELS):
            lean = _pressure_ratio(table, i, x, y)
            slope = table.row[0].alpha / (1.0 + load * lean)
            if axis == 2:
                slope *= lean / table.row[0].load_n
            else:
                slope *= load * table.row[0].lean_per_m[2 * i + axis] if lean > 0.0 else 0.0
            by_x += gain[i] * slope
            by_y += gain[_CHANNELS + i] * slope
        if axis == 2:
            variance = zz
        xx += by_x * by_x * variance
        xy += by_x * by_y * variance
        yy += by_y * by_y * variance
    kx, ky = table.row[0].stiffness_n_per_m[0], table.row[0].stiffness_n_per_m[1]
    common = table.row[0].stiffness_std * table.row[0].stiffness_std
    axis_variance = table.row[0].axis_std * table.row[0].axis_std
    loop = table.row[0].hysteresis * (stage.peak_n[pad] - 0.5 * math.sqrt(fx * fx + fy * fy))
    even = table.row[0].zero_std_n * table.row[0].zero_std_n + loop * loop / 3.0
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


def _set_axes(stage: ShearForces, table: ShearTable) -> bool:
    """Set the axes of the surface at the contact, in the link's frame: x along the pad's, y, and the normal.

    The columns of a matrix, so that it turns forces in the tangent plane to the link's frame. Return False
    where the normal is along the pad's x.
    """
    axes, pad = stage.axes, table.pad
    nx, ny = stage.values[pad].normal[0], stage.values[pad].normal[1]
    nz = stage.values[pad].normal[2]
    ax, ay, az = table.row[0].along[0], table.row[0].along[1], table.row[0].along[2]
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


def _pressure_ratio(table: ShearTable, channel: int, x: float, y: float) -> float:
    """Return the pressure at a channel over its mean, of a force at (x, y) from the plate's centre."""
    ratio: float = 1.0 + table.row[0].lean_per_m[2 * channel] * x
    ratio += table.row[0].lean_per_m[2 * channel + 1] * y
    return max(ratio, 0.0)


def _estimate(stage: ShearForces, table: ShearTable, normal_n: float, x: float, y: float) -> bool:
    """Compute motion, its derivatives by the logarithms of the currents, and misfit, by Gauss-Newton steps.

    normal_n, x, y: force on the pad and its centre from the plate's. Return False where no displacement
    within the travel has such currents.
    """
    travel, load = table.row[0].travel_m, normal_n / table.row[0].load_n
    for i in range(_CHANNELS):
        if not stage.counts[i] > 0.0:
            return False
        tilt = table.row[0].alpha * math.log(1.0 + load * _pressure_ratio(table, i, x, y))
        stage.logs[i] = math.log(stage.counts[i]) + table.row[0].log_gain[i] - tilt
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
    within: bool = stage.motion[0] * stage.motion[0] + stage.motion[1] * stage.motion[1] < travel * travel
    return within


def _invert_slopes(stage: ShearForces, unknowns: int) -> bool:
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


def _evaluate_bars(stage: ShearForces, table: ShearTable) -> bool:
    """Compute logarithms of the areas of bars, and their slopes (3, 4), at the present motion."""
    points, area, slope = table.points, stage.log_area, stage.slope
    for i in range(_CHANNELS):
        area[i] = 0.0
        for k in range(_UNKNOWNS):
            slope[_CHANNELS * k + i] = 0.0
    sine, cosine = math.sin(stage.motion[2]), math.cos(stage.motion[2])
    for point in range(table.point_count):
        first = _POINT * point
        i, share = int(points[first]), points[first + 1]
        wx, wy, px, py = points[first + 2], points[first + 3], points[first + 4], points[first + 5]
        qx, qy = px + wx * table.row[0].overlap_m, py + wy * table.row[0].overlap_m
        rx, ry = cosine * qx - sine * qy, sine * qx + cosine * qy
        along = wx * (rx + stage.motion[0] - px) + wy * (ry + stage.motion[1] - py)
        s = (along + table.row[0].lost_m) / table.row[0].film_m
        if not -_MAX_EXPONENT < _PI * s < _MAX_EXPONENT:
            return False
        wide = math.exp(_PI * s)
        upper = _agm(math.sqrt(wide / (1.0 + wide)))
        rate = share * upper * upper / table.row[0].film_m
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


def _evaluate_discs(stage: ShearForces, table: ShearTable) -> bool:
    """Compute logarithms of the areas of discs over their sectors, and slopes, at the present motion."""
    radius, inset = table.row[0].radius_m, table.row[0].inset_m
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
