cimport cython
from libc cimport math

cdef Py_ssize_t _LOG_LAYER, _ALPHA, _LOG_RADIUS, _RADIUS_STD, _LOG_SHEET, _DRIVE, _LOG_REFERENCE, _AXES
cdef double _MIN_ALPHA, _BOUND_SIGMA, _MAX_CURRENT_FRACTION, _MIN_LOG_SPREADING_RATIO, _MIN_CURRENT_A
cdef double _TWO_PI, _LOG_PI, _INFINITY, _NAN, _NEAR_NODE, _FAR_NODE, _NEAR_WEIGHT, _FAR_WEIGHT

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
    cdef public Py_ssize_t status

@cython.locals(k=Py_ssize_t, p='double[::1]')
cdef void estimate_force(
    StackTable stack, PadLaw law, ForceResult result, double total_a, double total_std_a,
    double log_spreading_m, double position_variance, double series_ohm) noexcept
@cython.locals(p='double[::1]')
cdef double whole_factor(PadLaw law, double total_a) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef double series_resistance(PadLaw law, double[::1] currents, Py_ssize_t first, Py_ssize_t electrodes) noexcept
@cython.locals(p='double[::1]')
cdef double _squared_change(
    StackTable stack, PadLaw law, double force, double log_ratio, double log_spreading_m, double whole,
    double resistors) noexcept
@cython.locals(p='double[::1]')
cdef double _squared_change_along(
    StackTable stack, PadLaw law, double force, Py_ssize_t axis, double sigma, double spread, double whole,
    double resistors) noexcept
cdef double _force_at(
    StackTable stack, double log_layer, double alpha, double log_radius_m, double log_sheet,
    double factor) noexcept
@cython.locals(k=Py_ssize_t, c='double[::1]')
cdef double _log_x2(StackTable stack, double factor) noexcept
@cython.locals(k=Py_ssize_t, c='double[::1]')
cdef double _log_x2_slope(StackTable stack, double factor) noexcept
cdef Py_ssize_t _interval(StackTable stack, double place) noexcept
