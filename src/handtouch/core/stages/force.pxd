cimport cython
from libc cimport math
from handtouch.core.stages.rows cimport LawRow

cdef double _BOUND_SIGMA, _MAX_CURRENT_FRACTION, _MIN_LOG_SPREADING_RATIO, _MIN_CURRENT_A, _MIN_LEFT
cdef double _TWO_PI, _INFINITY, _NAN, _MAX_SIGMA, _MIN_RELATIVE_VARIANCE, _MAX_SPREAD, _UNLIMITED_SIGMA
cdef double _MAX_LOG_FORCE, _MIN_LOG_X2, _SMALL_CONTACT_REST
cdef double _MAX_NEAR_HALF, _MIN_NEAR_ROOM, _MAX_NEAR_SHIFT, _MAX_NEAR_CHANGE, _INTERVAL_SIGMA
cdef double _CONVERGED_SIGMA, _MIN_CROWDED_FACTOR, _TILT_REST, _CUT_TURNING, _BEND_ERROR, _CORNER_BEND_ERROR, _CUT_BEND_ERROR
cdef double _CUT_AREA, _CUT_MORE_AREA, _CUT_SPREADING, _CUT_ERROR, _CORNER_ERROR, _CUT_REST
cdef Py_ssize_t _CROWDING_STEPS
cdef Py_ssize_t _FITTED, _BOUNDED, _NOT_ESTIMATED, _WIDE, _MAX_STEPS

cdef class StackTable:
    cdef double[::1] inverse, values, nodes
    cdef Py_ssize_t inverse_intervals, intervals, any_count, near_count
    cdef double inverse_first, inverse_width, first, per_width

cdef class PadLaw:
    cdef LawRow[::1] parameters
    cdef double[::1] series
    cdef bint has_series

cdef class ForceResult:
    cdef public double force_n, std_n
    cdef double left, high, low, bend, by_radius, variance, sigma, std, step, density
    cdef double spreading, gradient2, by_stack, cut_std, total, factor, share, half_width
    cdef public double turning, turning_by_factor, around, square, log_radius, shift_std, tilt_m
    cdef public double moved, cut, cut_by_radius, cut_error, bend_error
    cdef public Py_ssize_t status

@cython.locals(is_limited=bint)
cdef void estimate_force(
    StackTable stack, PadLaw law, ForceResult result, double total_a, double total_std_a,
    double position_variance, double series_ohm) noexcept
cdef void set_radius(ForceResult result, double log_radius) noexcept
cdef double _find_end(StackTable stack, PadLaw law, ForceResult result, double resistors) noexcept
@cython.locals(_=Py_ssize_t)
cdef double _find_likely(
    StackTable stack, PadLaw law, ForceResult result, double left, double least, double top) noexcept
@cython.locals(k=Py_ssize_t, begin=Py_ssize_t, end=Py_ssize_t, is_far=bint, is_narrow=bint, cut=double, last=double, reach=double)
cdef void _integrate(StackTable stack, PadLaw law, ForceResult result, double log_x2, double top) noexcept
@cython.locals(k=Py_ssize_t, cut2=double)
cdef void evaluate(StackTable stack, PadLaw law, ForceResult result, double log_x2) noexcept
@cython.locals(_=Py_ssize_t)
cdef void find_crowding(
    StackTable stack, PadLaw law, ForceResult result, double total_a, double log_spreading_m,
    double series_ohm) noexcept
@cython.locals(ratio=double, turning=double, square=double, inside=double, limit=double, by_factor=double,
               outside=double, root=double, cornered=double)
cdef double crowded_shift(ForceResult result, double log_spreading_m, double gradient2) noexcept
@cython.locals(bend=double)
cdef double bent(double limit, double share) noexcept
@cython.locals(moved=double, by_radius=double, by_pressure=double)
cdef void move_law(PadLaw law, double log_radius) noexcept
@cython.locals(factor=double, slope=double)
cdef void set_part(PadLaw part, PadLaw law, double cut) noexcept
cdef double sheet_ohm_per_square(PadLaw law) noexcept
@cython.locals(room=double)
cdef double max_force_n(PadLaw law) noexcept
cdef double whole_factor(PadLaw law, double total_a) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef double series_resistance(PadLaw law, double[::1] currents, Py_ssize_t first, Py_ssize_t electrodes) noexcept
@cython.locals(k=Py_ssize_t, square=double, level=double)
cdef double find_log_x2(StackTable stack, double factor) noexcept
