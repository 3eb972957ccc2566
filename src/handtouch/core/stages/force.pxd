cimport cython
from libc cimport math

cdef Py_ssize_t _LOG_LAYER, _ALPHA, _LOG_RADIUS, _RADIUS_STD, _LOG_SHEET, _DRIVE, _LOG_REFERENCE, _AXES
cdef Py_ssize_t _MIN_FACTORS, _MAX_NODES
cdef double _RADIUS_NODE, _MIN_RADIUS_RATIO, _MIDDLE_WEIGHT, _OUTER_WEIGHT
cdef double _BOUND_SIGMA, _MAX_CURRENT_FRACTION, _MIN_LOG_SPREADING_RATIO, _MIN_CURRENT_A
cdef double _TWO_PI, _LOG_PI, _INFINITY, _NAN, _STEP_SIGMA, _MAX_SIGMA, _MIN_RELATIVE_VARIANCE, _UNLIMITED_SIGMA

cdef Py_ssize_t _VALID, _LOWER_BOUND, _NOT_ESTIMATED

cdef class StackTable:
    cdef double[::1] coefficients
    cdef Py_ssize_t intervals
    cdef double first, width

cdef class PadLaw:
    cdef double[::1] parameters, series
    cdef bint has_series

cdef class ForceResult:
    cdef public double force_n, std_n
    cdef double whole, resistors, log_spreading_m, gradient2, variance, log_radius_m, log_force, slope, std
    cdef double excess, weights, log_mean, mean, square, log_unit
    cdef public Py_ssize_t status

@cython.locals(p='double[::1]')
cdef void estimate_force(
    StackTable stack, PadLaw law, ForceResult result, double total_a, double total_std_a,
    double log_spreading_m, double gradient2, double position_variance, double series_ohm) noexcept
cdef double _lowest_factor(StackTable stack, PadLaw law, ForceResult result, double least) noexcept
@cython.locals(p='double[::1]')
cdef void _integrate(
    StackTable stack, PadLaw law, ForceResult result, double radius_sigma, double share, double least) noexcept
@cython.locals(k=Py_ssize_t, p='double[::1]')
cdef void _evaluate_factor(StackTable stack, PadLaw law, ForceResult result, double factor) noexcept
@cython.locals(p='double[::1]')
cdef double whole_factor(PadLaw law, double total_a) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef double series_resistance(PadLaw law, double[::1] currents, Py_ssize_t first, Py_ssize_t electrodes) noexcept
@cython.locals(k=Py_ssize_t, c='double[::1]')
cdef double _log_x2(StackTable stack, double factor) noexcept
@cython.locals(k=Py_ssize_t, c='double[::1]')
cdef double _log_x2_slope(StackTable stack, double factor) noexcept
cdef Py_ssize_t _interval(StackTable stack, double place) noexcept
