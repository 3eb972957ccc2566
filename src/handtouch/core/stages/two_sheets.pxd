cimport cython
from libc cimport math
from handtouch.core.stages cimport force, loads
from handtouch.core.stages.receive cimport SampleMemory
from handtouch.core.stages.rows cimport RadiusRow, SheetRow, ValueRow

cdef Py_ssize_t _ROWS, _BETWEEN
cdef Py_ssize_t _FITTED, _WIDE, _MAX_STEPS, _WIDE_NODES
cdef long long _MAX_EQUAL_SAMPLES
cdef double _BOUND_SIGMA, _MAX_CURRENT_FRACTION, _MIN_LEFT, _THIRD, _NAN, _INFINITY, _MAX_STEP, _CONVERGED_SIGMA
cdef double _NODE_SIGMA, _MAX_NEAR_STD, _MAX_SQUARED_CONTRADICTION, _MAX_SPREAD, _MIN_VARIANCE
cdef double _MIN_RADIUS_VARIANCE, _MAX_LOG_FORCE, _MEAN_UNEVEN, _MIN_CLEAR_FACTOR, _MAX_AMBIGUOUS_SIGMA, _MIN_CURVATURE

cdef class TwoSheets:
    cdef long long[::1] numbers, pads, columns, rising, last_counts, equal_samples
    cdef list laws
    cdef Py_ssize_t count, pad, number
    cdef double[::1] expected_counts, ampere_per_count, noise_counts, totals, gain, force_n, std_n, relative_std
    cdef double[::1] offset_std, block_sum, block_squares, block_count, second_force_n, second_std_n
    cdef SheetRow[::1] sheets
    cdef RadiusRow[::1] rows
    cdef unsigned char[::1] usable, touching, new_contact, known, second_touching
    cdef loads.SheetLoads first, second
    cdef force.StackTable stack
    cdef force.ForceResult result
    cdef force.PadLaw near, second_near
    cdef bint is_used, contradicts
    cdef double radius_m, radius_std_m, spreading, gradient2, pure, mixed, shared, uneven, squared, score, curvature
    cdef double log_load, load_variance, log_weight, growth, middle, width2, cell
    cdef double off, by_radius, variance, aside, by_aside
    cdef double centre, log_load_unit, level, least, weights, inverse, mean, square, radius, radius2
    cdef double log_first, log_second

@cython.locals(k=Py_ssize_t, pad=Py_ssize_t, i=Py_ssize_t, count='long long', touching=bint, excess=double,
               in_range=bint, stuck=bint)
cpdef read_totals(TwoSheets both, SampleMemory memory)
@cython.locals(k=Py_ssize_t, scale=double, noise_a=double, second_a=double, log_radius=double, reach=double,
               width=double, middle=double)
cdef void estimate_both(
    TwoSheets both, Py_ssize_t pad, force.PadLaw law, force.ForceResult result,
    double total_a, double total_std_a, double series_ohm, double start_m) noexcept
@cython.locals(whole=double, noise=double, resistors=double, left=double,
               power=double, before=double)
cdef void _set_sheet(
    TwoSheets both, Py_ssize_t number, force.PadLaw law, force.PadLaw near, double total_a, double total_std_a,
    double series_ohm, double position_variance) noexcept
@cython.locals(first=double, by_force=double)
cdef void _set_histories(TwoSheets both) noexcept
@cython.locals(step=loads.SheetInterval, load=double)
cdef double _by_history(loads.SheetLoads history, Py_ssize_t index, double log_force) noexcept
@cython.locals(least=double, factor=double,
               is_limited=bint, log_x2=double, std=double, by_stack=double, log_force=double, uneven=double,
               layer=double, sheet=double, variance=double, gain=double,
               relative=double, by_radius=double, result=force.ForceResult)
cdef void _evaluate_sheet(
    TwoSheets both, Py_ssize_t number, Py_ssize_t index, force.PadLaw near, loads.SheetLoads history,
    double log_radius) noexcept
@cython.locals(covariance=double, excess2=double, i=Py_ssize_t)
cdef void _evaluate_both(TwoSheets both, double log_radius, Py_ssize_t number) noexcept
@cython.locals(one=double, two=double, covariance=double, variance=double, weight=double, first=double,
               second=double, second_slope=double, off=double, by_radius=double, aside=double)
cdef void _weigh(TwoSheets both, double log_radius, Py_ssize_t row) noexcept
@cython.locals(high=Py_ssize_t, width=double, t=double, before=double, after=double, slope=double,
               next_slope=double, rise=double, left=double, right=double, i=Py_ssize_t)
cdef void _weigh_between(TwoSheets both, double log_radius, Py_ssize_t low) noexcept
@cython.locals(_=Py_ssize_t, step=double, by_excess=double, sheet=Py_ssize_t, found=double)
cdef double _find_radius(TwoSheets both, double log_radius) noexcept
@cython.locals(std=double, half=double, middle=double, begin=Py_ssize_t, end=Py_ssize_t, i=Py_ssize_t, at=double)
cdef void _integrate_near(TwoSheets both, double log_radius) noexcept
@cython.locals(step=double, number=Py_ssize_t, i=Py_ssize_t, at=double)
cdef void _integrate_all(TwoSheets both, double low, double width) noexcept
cdef void _clear_sums(TwoSheets both, double middle) noexcept
@cython.locals(ratio=double, size=double, spread=double)
cdef void _add_node(TwoSheets both, double log_radius, double weight) noexcept
@cython.locals(weights=double, load=double, unit=double, variance=double, radius=double, relative2=double,
               result=force.ForceResult, k=Py_ssize_t)
cdef void _finish(TwoSheets both) noexcept
@cython.locals(ratio=double, left=double)
cdef bint _is_ambiguous(TwoSheets both, double log_radius) noexcept
@cython.locals(k=Py_ssize_t, pad=Py_ssize_t, force_n=double, std_n=double)
cpdef store_both(TwoSheets both, ValueRow[:] values)
