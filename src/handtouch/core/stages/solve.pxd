cimport cython
from libc cimport math
from handtouch.core.stages cimport force, locate, pairs, tables, tolerances

cdef Py_ssize_t _X, _U, _RESIDUAL, _POSITION, _NORMAL, _FORCE, _FORCE_STD, _RESIDUAL_STD
cdef Py_ssize_t _COVARIANCE, _MOUNT, _PAD_NOISE, _FORCE_STATUS, _CELLS, _MISFIT, _IS_BOUND, _COUNT, _UNKNOWNS
cdef Py_ssize_t _MOUNT_COUNT, _MISFIT_COUNT
cdef double _MIN_PEAK, _UNIFORM_VARIANCE, _MISFIT_CONTACTS, _MIN_LASTING_MISFIT
cdef Py_ssize_t _PART_POSITION, _PART_NORMAL, _PART_COVARIANCE, _PART_FORCE, _PART_FORCE_STD, _PART_ID, _PART_PLACE, _PART_NEWEST
cdef Py_ssize_t _PART_COUNT, _PARTS_COUNT
cdef double _TWO_PI, _INFINITY
cdef double _PART_MOTION, _MOTION_ALONG, _MOTION_ACROSS
cdef double _NAN, _FITTED, _BOUNDED, _BOUND_SIGMA, _MAX_SQUARED_MISFIT, _MAX_EXTENT_SIDES
cdef Py_ssize_t _PAIRED_CHANNELS

cdef class ContactSolver:
    cdef list models, pad_tolerances, laws, surfaces
    cdef force.StackTable stack
    cdef locate.Fit fit
    cdef tolerances.PartKnowledge known
    cdef tables.Placement placement
    cdef readonly pairs.PairFit pair
    cdef double[::1] pair_limits, moment_stds, parts
    cdef force.ForceResult result
    cdef Py_ssize_t electrodes
    cdef double[::1] by_x, by_y, by_total
    cdef double moved_x, moved_y
    cdef bint were_two
    cdef double[::1] currents, weight, gain_covariance, offset_std, values
    cdef unsigned char[::1] force_requested, saturated, crowding
    cdef double[::1] peak_currents, mounts, ampere_per_count, noise_squared, misfits
    @cython.locals(k=Py_ssize_t)
    cpdef solve_contacts(self, Py_ssize_t[::1] pads)

@cython.locals(n=Py_ssize_t, row=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, fit=locate.Fit,
               table=locate.ModelTable, values='double[::1]', parts=tolerances.PadTolerances, last_x=double,
               last_y=double, lag=double, weight=double, scale=double, excess=double,
               offset2=double, saturated=Py_ssize_t)
cdef void solve_contact(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, first=Py_ssize_t, fit=locate.Fit, least=double, greatest=double, noise=double,
               current=double, relative=double,
               variance=double)
cdef void _estimate_saturated(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, first=Py_ssize_t, fit=locate.Fit, values='double[::1]', row=Py_ssize_t,
               total=double, variance=double, relative=double)
cdef void _bound_force(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(row=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, parts='double[::1]', were_two=bint)
cdef bint _forget_parts(ContactSolver solver, Py_ssize_t pad, bint is_new) noexcept
@cython.locals(row=Py_ssize_t, first=Py_ssize_t, second=Py_ssize_t, begin=Py_ssize_t, pair=pairs.PairFit,
               table=locate.ModelTable, parts='double[::1]', x0=double, y0=double, x1=double, y1=double,
               kept=double, turned=double, near2=double)
cdef Py_ssize_t _order_parts(ContactSolver solver, Py_ssize_t pad) noexcept
cdef double _squared_distance(double[::1] parts, Py_ssize_t at, double x, double y) noexcept
@cython.locals(newest=double)
cdef void _name_part(
    double[::1] parts, Py_ssize_t row, Py_ssize_t at, double x, double y, double near2) noexcept
@cython.locals(k=Py_ssize_t, row=Py_ssize_t, begin=Py_ssize_t, fit=locate.Fit, pair=pairs.PairFit,
               table=locate.ModelTable, at=tables.Placement, parts='double[::1]')
cdef void _resolve_pair(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(other=Py_ssize_t, n=Py_ssize_t, step=Py_ssize_t, fit=locate.Fit,
               pair=pairs.PairFit, law=force.PadLaw, table=locate.ModelTable)
cdef void _estimate_part_force(ContactSolver solver, Py_ssize_t pad, Py_ssize_t k, Py_ssize_t row) noexcept
@cython.locals(n=Py_ssize_t, row=Py_ssize_t, i=Py_ssize_t, fit=locate.Fit, table=locate.ModelTable,
               values='double[::1]')
cdef void _propagate(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, spread=double, at=Py_ssize_t)
cdef void _widen_by_misfit(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(at=Py_ssize_t, misfits='double[::1]')
cdef void _count_misfit(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(n=Py_ssize_t, row=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, values='double[::1]', noise=double,
               scale=double, measured2=double)
cdef void _write_pad_noise(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(n=Py_ssize_t, row=Py_ssize_t, fit=locate.Fit, values='double[::1]', law=force.PadLaw)
cdef void _estimate_force(ContactSolver solver, Py_ssize_t pad, double share) noexcept
@cython.locals(row=Py_ssize_t, values='double[::1]', chance=double)
cdef void _span_two_patches(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, at=tables.Placement, n=Py_ssize_t, law=force.PadLaw,
               result=force.ForceResult, parts=tolerances.PadTolerances, spread=double,
               moved=double, gradient2=double)
cdef void _correct_crowding(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(row=Py_ssize_t, fit=locate.Fit, at=tables.Placement, values='double[::1]')
cdef void _write_position(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(at=tables.Placement, values='double[::1]', mounts='double[::1]', first=Py_ssize_t,
               row=Py_ssize_t, x=double, y=double, z=double, turning=double, even=double)
cdef void _write_mount(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, moved_x=double, moved_y=double, along2=double, across2=double)
cdef void _add_motion(ContactSolver solver, double factor) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, parts=tolerances.PadTolerances)
cdef void _add_size(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, parts=tolerances.PadTolerances, at=tables.Placement)
cdef void _add_overhang(ContactSolver solver, Py_ssize_t pad) noexcept
cdef void _write_row(
    double[::1] values, Py_ssize_t first, locate.Fit fit, tables.Placement at, double t, double w) noexcept
@cython.locals(n=Py_ssize_t)
cdef void _add_extent(locate.ModelTable table, locate.Fit fit, double residual) noexcept
