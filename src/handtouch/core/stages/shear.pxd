cimport cython
from libc cimport math
from handtouch.core.stages.receive cimport SampleMemory
from handtouch.core.stages.rows cimport ShearRow, ValueRow

cdef Py_ssize_t _CHANNELS, _UNKNOWNS, _POINT, _VECTOR, _CLEAR
cdef Py_ssize_t _MOUNT_COUNT, _MOUNT_TURNING
cdef Py_ssize_t _NOT_COMPUTED, _VALID, _LOWER_BOUND, _UNRELIABLE, _INVALID
cdef Py_ssize_t _POSITION_UNRELIABLE, _POSITION_INVALID, _REST_SAMPLES, _MAX_STEPS, _MAX_AGM_STEPS
cdef double _STEP_TOLERANCE, _AGM_TOLERANCE, _MAX_MISFIT, _MAX_EXPONENT, _SMALLEST_SINE, _PI, _ROOT_HALF, _NAN, _INFINITY

cdef class ShearTable:
    cdef readonly Py_ssize_t pad
    cdef Py_ssize_t column, unknowns, point_count
    cdef double[::1] points
    cdef ShearRow[::1] row

cdef class ShearForces:
    cdef readonly bint any_configured
    cdef object state
    cdef list tables
    cdef dict numbers
    cdef unsigned char[::1] position_status, force_status, pad_state, touching, held, unverified
    cdef unsigned char[::1] position_requested, force_requested, status
    cdef long long[::1] ticks, update_interval_ticks, sample_ns, read_ns, rest_samples
    cdef unsigned int[::1] contact_id
    cdef ValueRow[::1] values
    cdef double[::1] rest_m, rest_sum, peak_n, vector, mounts
    cdef double[::1] counts, logs, off, log_area, slope, gain, motion, way, axes
    cdef double misfit

@cython.locals(number=Py_ssize_t, pad=Py_ssize_t, table=ShearTable)
cdef void _update_pads(ShearForces stage, SampleMemory memory) noexcept
@cython.locals(pad=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, rests=bint)
cdef void _set_rest(ShearForces stage, ShearTable table, double[::1] counts) noexcept
@cython.locals(k=Py_ssize_t)
cdef void _forget_rest(ShearForces stage, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _discard_vector(ShearForces stage, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _forget_samples(ShearForces stage, Py_ssize_t pad) noexcept
@cython.locals(first=Py_ssize_t, i=Py_ssize_t, count='long long', valid=bint)
cdef bint _read_counts(ShearForces stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, rest=double)
cdef void _measure_rest(ShearForces stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, located=bint, read=bint, known=bint,
               due=bint, position=Py_ssize_t, force=Py_ssize_t)
cdef void _update_force(ShearForces stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t,
               axis=Py_ssize_t, gain='double[::1]', axes='double[::1]', vector='double[::1]',
               known=double, turning=double, any_way=double, turned=double,
               xx=double, xy=double, yy=double, by_x=double, by_y=double)
cdef void _write_vector(
    ShearForces stage, ShearTable table, double fx, double fy, double normal_n) noexcept
@cython.locals(pad=Py_ssize_t, axes='double[::1]', part=double, length=double)
cdef bint _set_axes(ShearForces stage, ShearTable table) noexcept
@cython.locals(ratio=double)
cdef double _pressure_ratio(ShearTable table, Py_ssize_t channel, double x, double y) noexcept
@cython.locals(i=Py_ssize_t, k=Py_ssize_t, _=Py_ssize_t, inside=bint, size=double, within=bint)
cdef bint _estimate(ShearForces stage, ShearTable table, double normal_n, double x, double y) noexcept
@cython.locals(i=Py_ssize_t, k=Py_ssize_t, other=Py_ssize_t, mean=double, square=double, length=double)
cdef bint _invert_slopes(ShearForces stage, Py_ssize_t unknowns) noexcept
@cython.locals(i=Py_ssize_t, total=double)
cdef double _dot(double[::1] left, Py_ssize_t row, double[::1] right, Py_ssize_t other) noexcept
@cython.locals(points='double[::1]', area='double[::1]', slope='double[::1]',
               i=Py_ssize_t, k=Py_ssize_t, point=Py_ssize_t, first=Py_ssize_t)
cdef bint _evaluate_bars(ShearForces stage, ShearTable table) noexcept
@cython.locals(_=Py_ssize_t, high=double, mean=double)
cdef double _agm(double low) noexcept
@cython.locals(i=Py_ssize_t)
cdef bint _evaluate_discs(ShearForces stage, ShearTable table) noexcept
