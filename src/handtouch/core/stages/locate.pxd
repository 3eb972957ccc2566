cimport cython
from libc cimport math
from handtouch.core.stages cimport tables, tolerances

cdef Py_ssize_t _MAX_STEPS, _CORNER_STEPS, _BISECTIONS, _EDGE_BISECTIONS
cdef double _MAX_STEP_CELLS, _MAX_CORNER_CELLS, _MAX_SETTLED_DECREMENT, _FIRST_DAMPING, _MIN_DAMPING, _MAX_TRACKED_COST, _MAX_TRACKED_VARIANCE
cdef Py_ssize_t _MAX_WHITENINGS, _ELONGATED_WHITENINGS
cdef double _MAX_WHITENING_CELLS, _FOURTH_MOMENTS
cdef double _MAX_START_COST, _MAX_STD_SIDES, _CORNER_RADIUS_FACTOR, _MIN_CHANNEL_SUM, _MAX_CORNER_RADIUS, _MIN_CORNER_ANGLE_RAD
cdef double _MAX_EDGE_CELLS, _UNIFORM_VARIANCE, _MIN_INFORMATION, _INFINITY, _HALF_PI
cdef double _MIN_LONG_ASPECT, _MAX_PROFILE_STEP, _MAX_INSIDE, _TWO_PI
cdef Py_ssize_t _PROFILE_POINTS, _PROFILE_STEPS

cdef class ModelTable:
    cdef double[::1] values, nodes_x, nodes_y, search_fractions, search_cells
    cdef Py_ssize_t cells, electrodes, points
    cdef double side_x, side_y, misfit_scale
    cdef bint is_potential

cdef class Fit:
    cdef double[::1] readings, data, weight, fractions, slope_x, slope_y, raw, beside, scaled, gain
    cdef tolerances.Whitening whitening
    cdef double read_s, read_t
    cdef public double whitened_s, whitened_t, sum
    cdef public double s, t, total, cost, norm, mixing_x, mixing_y, gradient_x, gradient_y, xx, xy, yy
    cdef public double step_s, step_t, decrement, x, y, scale_x, scale_y
    cdef public double var_x, var_y, cov_xy, cov_x_total, cov_y_total, var_total
    cdef public bint found

@cython.locals(i=Py_ssize_t, tracked=bint, settled=bint, variance=double)
cdef void locate(ModelTable table, Fit fit, double s, double t) noexcept
@cython.locals(_=Py_ssize_t, i=Py_ssize_t)
cdef void locate_elongated(ModelTable table, Fit fit, double moment_std) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t)
cdef void _whiten(ModelTable table, Fit fit) noexcept
@cython.locals(_=Py_ssize_t)
cdef void _refine(ModelTable table, Fit fit) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _whiten_column(ModelTable table, Fit fit, Py_ssize_t first, double[::1] out) noexcept
cdef void _read_model(ModelTable table, Fit fit) noexcept
cdef void read_beside(ModelTable table, Fit fit, double s, double t) noexcept
@cython.locals(i=Py_ssize_t, share=double)
cdef double channel_sum(ModelTable table, Fit fit) noexcept
cdef double clamp(ModelTable table, double s) noexcept
@cython.locals(i=Py_ssize_t)
cdef double coordinate(double[::1] nodes, Py_ssize_t cells, double s) noexcept
@cython.locals(i=Py_ssize_t)
cdef double cell_length(double[::1] nodes, Py_ssize_t cells, double s) noexcept
@cython.locals(_=Py_ssize_t)
cdef double _cell_at(double[::1] nodes, Py_ssize_t cells, double x) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t)
cdef void _linearise(ModelTable table, Fit fit) noexcept
cdef void _compute_step(ModelTable table, Fit fit, double damping) noexcept
@cython.locals(_=Py_ssize_t)
cdef bint _maximise(ModelTable table, Fit fit, bint tracked) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, points=Py_ssize_t, first=Py_ssize_t, second=Py_ssize_t,
               peak=Py_ssize_t)
cdef void _search(ModelTable table, Fit fit, bint located) noexcept
@cython.locals(k=Py_ssize_t, _=Py_ssize_t, along_x=bint, uncertain=bint)
cdef void _add_other_positions(ModelTable table, Fit fit) noexcept
@cython.locals(k=Py_ssize_t, row=Py_ssize_t, column=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, best=Py_ssize_t,
               is_peak=bint)
cdef double _nearer_corner(ModelTable table, double s) noexcept
cdef Py_ssize_t _highest_peak(Fit fit, Py_ssize_t points, Py_ssize_t excluded) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t)
cdef void _compute_covariance(ModelTable table, Fit fit) noexcept
cdef void _compute_position(ModelTable table, Fit fit) noexcept
@cython.locals(i=Py_ssize_t, known_x=bint, known_y=bint)
cdef void _invert_information(ModelTable table, Fit fit) noexcept
@cython.locals(i=Py_ssize_t, _=Py_ssize_t, far_x=bint, far_y=bint)
cdef void _move_out_of_corner(ModelTable table, Fit fit) noexcept
cdef void _linearise_on_arc(ModelTable table, Fit fit, bint far_x, bint far_y, double radius, double angle) noexcept
@cython.locals(_=Py_ssize_t, nodes='double[::1]')
cdef void _widen_at_edge(ModelTable table, Fit fit, bint along_x) noexcept
cdef void _bound_by_pad(ModelTable table, Fit fit) noexcept
