cimport cython
from libc cimport math
from handtouch.core.stages cimport tables

cdef Py_ssize_t _WAVES

cdef class PadTolerances:
    cdef float[::1] values
    cdef double[::1] end_vectors, series_vectors, series_by_sheet
    cdef Py_ssize_t cells
    cdef double cell_ratio, aspect_std, wave_std, tilt_std, moment_std, middle_u_m, size_x, size_y
    cdef double[::1] elongations, overhangs
    cdef double overhang_step_m
    cdef readonly Py_ssize_t states
    cdef Py_ssize_t[::1] state_of
    cdef double state_std, state_std_per_a
    cdef bint has_series, is_elongated, is_shape_exact

cdef class PartKnowledge:
    cdef double[::1] axes, offsets, touch_errors, gain_covariance
    cdef Py_ssize_t[::1] ends
    cdef Py_ssize_t size, rows, parts

cdef class Whitening:
    cdef PadTolerances pad
    cdef PartKnowledge known
    cdef double[::1] weight, matrix, shift, modelled, fields, changes, vectors, vector
    cdef Py_ssize_t number, electrodes, channels

cpdef Py_ssize_t part_count(Py_ssize_t electrodes) noexcept

cdef void choose_pad(Whitening whitening, PadTolerances pad, Py_ssize_t number, Py_ssize_t electrodes) noexcept
@cython.locals(
    n=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, channels=Py_ssize_t, first=Py_ssize_t, matrix='double[::1]')
cdef void whiten_by_gains(Whitening whitening, double[::1] readings) noexcept
cdef void whiten(Whitening whitening, double[::1] fractions, double total, double s, double t) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t)
cdef void whiten_elongated(
    Whitening whitening, double[::1] fractions, double total, double s, double t, double moment_std,
    double error_std) noexcept
cdef void whiten_pair(
    Whitening whitening, double[::1] fractions, double[::1] total, double[::1] place) noexcept
cdef void _complete(Whitening whitening) noexcept
@cython.locals(ratio=double, columns=Py_ssize_t, pad=PadTolerances)
cdef void read_second_derivatives(Whitening whitening, double s, double t) noexcept
@cython.locals(first=Py_ssize_t, second=double)
cdef double second_derivative(Whitening whitening, Py_ssize_t i, double by_xx, double by_xy) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef void _begin(Whitening whitening) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _clear(double[::1] values, Py_ssize_t count) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, pad=PadTolerances, matrix='double[::1]', weight='double[::1]')
cdef void _add_contact(
    Whitening whitening, double[::1] fractions, Py_ssize_t first, double total, double s, double t) noexcept
@cython.locals(
    n=Py_ssize_t, i=Py_ssize_t, state=Py_ssize_t, pad=PadTolerances, vector='double[::1]',
    weight='double[::1]', by_state=double, std=double)
cdef void _add_states(
    Whitening whitening, double[::1] fractions, Py_ssize_t first, double total) noexcept
@cython.locals(
    n=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, k=Py_ssize_t, parts=Py_ssize_t, size=Py_ssize_t, varied=Py_ssize_t,
    row=Py_ssize_t, count=Py_ssize_t, begin=Py_ssize_t, end=Py_ssize_t, number=Py_ssize_t, pad=PadTolerances,
    known=PartKnowledge, vectors='double[::1]', changes='double[::1]', axes='double[::1]', offsets='double[::1]')
cdef void _add_parts(Whitening whitening) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef void apply_whitening(
    Whitening whitening, double[::1] values, Py_ssize_t first, double[::1] out) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef void transpose_whitening(
    Whitening whitening, double[::1] values, double[::1] weight, double[::1] out) noexcept
@cython.locals(
    n=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, resistor=Py_ssize_t, columns=Py_ssize_t, ends=Py_ssize_t,
    field=Py_ssize_t, pad=PadTolerances, changes='double[::1]', fields='double[::1]', weight='double[::1]')
cdef void _add_changes(
    Whitening whitening, double[::1] fractions, Py_ssize_t first, double total, double s, double t) noexcept
@cython.locals(cell=Py_ssize_t, beyond=double, std=double)
cdef double elongation_std(PadTolerances pad, double s) noexcept
cdef Py_ssize_t field_count(PadTolerances pad, Py_ssize_t n) noexcept
@cython.locals(
    n=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, first=Py_ssize_t, vector='double[::1]', fields='double[::1]')
cdef void _add_second_derivatives(Whitening whitening, double total, double std) noexcept
@cython.locals(k=Py_ssize_t, shift=double)
cdef double overhang(PadTolerances pad, double distance_m) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef void _add_square(double[::1] matrix, double[::1] vector, Py_ssize_t n) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, k=Py_ssize_t)
cdef void _add_squares(double[::1] matrix, double[::1] vectors, Py_ssize_t count, Py_ssize_t n) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, k=Py_ssize_t)
cdef void _invert_root(double[::1] matrix, Py_ssize_t n) noexcept
