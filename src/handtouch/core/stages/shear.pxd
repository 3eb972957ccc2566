cimport cython
from libc cimport math
from handtouch.core.stages.receive cimport SampleMemory

cdef Py_ssize_t _CHANNELS, _UNKNOWNS, _POINT, _FILM, _OVERLAP, _LOST, _RADIUS, _INSET, _TRAVEL, _NOISE, _LOAD
cdef Py_ssize_t _STIFFNESS, _STIFFNESS_STD, _AXIS_STD, _HYSTERESIS, _ZERO_STD, _CENTRE, _LOG_GAIN, _LEAN
cdef Py_ssize_t _ALONG, _ALPHA, _NUMBERS, _NORMAL, _VALUES, _PAD_M, _FORCE, _FORCE_STD, _COVARIANCE, _VECTOR, _CLEAR
cdef Py_ssize_t _MOUNT_COUNT, _MOUNT_TURNING
cdef Py_ssize_t _NOT_COMPUTED, _VALID, _LOWER_BOUND, _UNRELIABLE, _INVALID
cdef Py_ssize_t _POSITION_UNRELIABLE, _POSITION_INVALID, _REST_SAMPLES, _MAX_STEPS, _MAX_AGM_STEPS
cdef double _STEP_TOLERANCE, _AGM_TOLERANCE, _MAX_MISFIT, _MAX_EXPONENT, _PI, _ROOT_HALF, _NAN, _INFINITY

cdef class ShearTable:
    cdef readonly Py_ssize_t pad
    cdef Py_ssize_t column, unknowns, point_count
    cdef double[::1] points, numbers

cdef class ShearStage:
    cdef list tables
    cdef Py_ssize_t pads
    cdef unsigned char[::1] position_status, force_status, pad_state, touching, held, unverified
    cdef unsigned char[::1] position_requested, force_requested, status
    cdef long long[::1] ticks, update_interval_ticks, sample_ns, read_ns, rest_samples
    cdef unsigned int[::1] contact_id
    cdef double[::1] values, rest_m, rest_sum, peak_n, vector, mounts
    cdef double[::1] counts, logs, off, log_area, slope, gain, motion, way, axes
    cdef double misfit
    @cython.locals(number=Py_ssize_t, pad=Py_ssize_t, table=ShearTable)
    cpdef update_forces(self, SampleMemory memory)
    @cython.locals(pad=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, table=ShearTable, rests=bint)
    cpdef set_rest(self, Py_ssize_t number, double[::1] counts)
    @cython.locals(k=Py_ssize_t)
    cpdef forget_rest(self, Py_ssize_t pad)

@cython.locals(i=Py_ssize_t)
cpdef void discard_vector(ShearStage stage, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _forget_samples(ShearStage stage, Py_ssize_t pad) noexcept
@cython.locals(first=Py_ssize_t, i=Py_ssize_t, count='long long', valid=bint)
cdef bint _read_counts(ShearStage stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, rest=double)
cdef void _measure_rest(ShearStage stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, row=Py_ssize_t, numbers='double[::1]', located=bint, read=bint, known=bint,
               due=bint, position=Py_ssize_t, force=Py_ssize_t)
cdef void _update_force(ShearStage stage, SampleMemory memory, ShearTable table) noexcept
@cython.locals(pad=Py_ssize_t, row=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, at=Py_ssize_t,
               axis=Py_ssize_t, numbers='double[::1]', gain='double[::1]', axes='double[::1]', vector='double[::1]',
               known=double, turning=double, any_way=double, turned=double,
               xx=double, xy=double, yy=double, by_x=double, by_y=double)
cdef void _write_vector(
    ShearStage stage, ShearTable table, double fx, double fy, double normal_n) noexcept
@cython.locals(at=Py_ssize_t, axes='double[::1]', numbers='double[::1]', part=double, length=double)
cdef bint _set_axes(ShearStage stage, ShearTable table) noexcept
@cython.locals(first=Py_ssize_t)
cdef double _pressure_ratio(double[::1] numbers, Py_ssize_t channel, double x, double y) noexcept
@cython.locals(numbers='double[::1]', i=Py_ssize_t, k=Py_ssize_t, _=Py_ssize_t, inside=bint, size=double)
cdef bint _estimate(ShearStage stage, ShearTable table, double normal_n, double x, double y) noexcept
@cython.locals(i=Py_ssize_t, k=Py_ssize_t, other=Py_ssize_t, mean=double, square=double, length=double)
cdef bint _invert_slopes(ShearStage stage, Py_ssize_t unknowns) noexcept
@cython.locals(i=Py_ssize_t, total=double)
cdef double _dot(double[::1] left, Py_ssize_t row, double[::1] right, Py_ssize_t other) noexcept
@cython.locals(numbers='double[::1]', points='double[::1]', area='double[::1]', slope='double[::1]',
               i=Py_ssize_t, k=Py_ssize_t, point=Py_ssize_t, first=Py_ssize_t)
cdef bint _evaluate_bars(ShearStage stage, ShearTable table) noexcept
@cython.locals(_=Py_ssize_t, high=double, mean=double)
cdef double _agm(double low) noexcept
@cython.locals(numbers='double[::1]', i=Py_ssize_t)
cdef bint _evaluate_discs(ShearStage stage, ShearTable table) noexcept
