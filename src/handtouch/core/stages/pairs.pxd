cimport cython
from libc cimport math
from handtouch.core.stages cimport locate, tables, tolerances

cdef Py_ssize_t _GRID_STEP, _STARTS, _MAX_STEPS, _MAX_WHITENINGS
cdef double _MAX_STEP_CELLS, _MAX_WHITENING_CELLS, _MAX_SETTLED_DECREMENT
cdef double _FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING, _MIN_DETERMINANT, _MIN_TOTAL_SIGMA, _MAX_STD_SIDES
cdef Py_ssize_t _SOLUTION, _MAX_SOLUTIONS, _POWER_STEPS
cdef double _ASIDE_CELLS, _FARTHER
cdef double _MAX_OTHER_COST, _MIN_OTHER_SIDES, _INFINITY

cdef class PairFit:
    cdef double[::1] raw, fractions, whitened, slopes, spreading, normal, factor, covariance, gradient, step
    cdef double[::1] mixing, place, best, other, total, var_total, with_total, grid, gain, weakest, apart, solutions
    cdef Py_ssize_t grid_points, count
    cdef public double cost
    cdef double decrement, g11, g12, g22
    cdef public bint is_settled, is_unique
    cdef public bint found

@cython.locals(_=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, explained=bint)
cdef void fit_pair(
    locate.ModelTable table, locate.Fit fit, PairFit pair, double moment_std, double limit) noexcept
@cython.locals(
    n=Py_ssize_t, side=Py_ssize_t, all_points=Py_ssize_t, points=Py_ssize_t, k=Py_ssize_t, at=Py_ssize_t,
    i=Py_ssize_t, j=Py_ssize_t, _=Py_ssize_t, first=Py_ssize_t, second=Py_ssize_t, near=bint)
cdef void _search(locate.ModelTable table, locate.Fit fit, PairFit pair) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, c=Py_ssize_t)
cdef void _weigh_grid(locate.Fit fit, PairFit pair, Py_ssize_t n, Py_ssize_t points) noexcept
@cython.locals(rows=Py_ssize_t, columns=Py_ssize_t)
cdef bint _is_near(Py_ssize_t point, Py_ssize_t other, Py_ssize_t side) noexcept
@cython.locals(v=Py_ssize_t, w=Py_ssize_t, k=Py_ssize_t, _=Py_ssize_t)
cdef void _search_along_weakest(locate.ModelTable table, locate.Fit fit, PairFit pair) noexcept
@cython.locals(v=Py_ssize_t)
cdef void _keep_solution(PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, k=Py_ssize_t, best=Py_ssize_t)
cdef void _move_to_best(locate.ModelTable table, locate.Fit fit, PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, k=Py_ssize_t, nodes='double[::1]')
cdef void _add_other_solutions(locate.ModelTable table, PairFit pair) noexcept
@cython.locals(k=Py_ssize_t, _=Py_ssize_t)
cdef void _maximise(locate.ModelTable table, locate.Fit fit, PairFit pair) noexcept
@cython.locals(
    n=Py_ssize_t, columns=Py_ssize_t, k=Py_ssize_t, part=Py_ssize_t, i=Py_ssize_t, v=Py_ssize_t, w=Py_ssize_t)
cdef void _linearise(locate.ModelTable table, locate.Fit fit, PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, w=Py_ssize_t)
cdef void _compute_step(locate.ModelTable table, PairFit pair, double damping) noexcept
@cython.locals(v=Py_ssize_t, w=Py_ssize_t, k=Py_ssize_t)
cdef bint _factorise(PairFit pair) noexcept
@cython.locals(v=Py_ssize_t)
cdef void _solve(PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, k=Py_ssize_t)
cdef void _substitute(PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, w=Py_ssize_t, k=Py_ssize_t, column=Py_ssize_t)
cdef bint _invert_information(locate.ModelTable table, PairFit pair) noexcept
@cython.locals(v=Py_ssize_t, k=Py_ssize_t)
cdef bint _is_determined(locate.ModelTable table, PairFit pair) noexcept
