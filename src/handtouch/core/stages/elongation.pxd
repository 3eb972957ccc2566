cimport cython
from libc cimport math
from handtouch.core.stages cimport locate, tolerances

cdef double _SIGMAS, _MIN_CHI_SQUARED, _LINE, _MAX_STD_SIDES, _RELATIVE_STD, _NAN, _INFINITY, _PI, _AXIS_STD_RAD

cdef class Elongation:
    cdef double[::1] along, across
    cdef double aa, ab, bb, a, b
    cdef readonly double length_m, least_m, most_m, angle, angle_std

@cython.locals(determinant=double, half=double, middle=double, radius=double, turn=double, cosine=double,
               sine=double, prior=double, side=double, most=double, variance=double, first=double,
               other_variance=double, second=double, scale=double)
cdef void estimate_elongation(
    Elongation found, locate.ModelTable table, locate.Fit fit, double metres2) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, whitening=tolerances.Whitening)
cdef void _read_derivatives(Elongation found, locate.ModelTable table, locate.Fit fit) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _project(Elongation found, locate.Fit fit, Py_ssize_t n, double determinant) noexcept
cdef double _variance(double information, double prior) noexcept
@cython.locals(size2=double, size=double, chi2=double, error2=double, along2=double, across2=double)
cdef void _state_two(
    Elongation found, double first, double second, double variance, double other, double turn) noexcept
@cython.locals(error=double, std=double)
cdef void _state_one(Elongation found, double first, double variance, double turn) noexcept
cdef void _state_length(Elongation found, double size, double std) noexcept
