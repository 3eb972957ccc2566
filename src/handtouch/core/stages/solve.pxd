cimport cython
from libc cimport math
from handtouch.core.stages cimport elongation, force, locate, pairs, tables, tolerances, two_sheets
from handtouch.core.stages.rows cimport MisfitRow, MountRow, PartRow, ValueRow

cdef Py_ssize_t _UNKNOWNS
cdef double _PART_ASIDE, _WIDE, _ESTIMATED, _ASSUMED, _CONTRADICTORY
cdef double _MIN_PEAK, _UNIFORM_VARIANCE, _MAX_VARIANCE, _MISFIT_CONTACTS, _MIN_LASTING_MISFIT
cdef double _TWO_PI, _INFINITY
cdef double _PART_MOTION, _MOTION_ALONG, _MOTION_ACROSS
cdef double _CROWDING_ERROR, _CROWDING_STD, _MIN_TURNED, _CUT_ERROR, _CUT_SPREAD, _CUT_MORE, _CURVED_SPREADING, _SPREADING_ERROR
cdef double _MIN_DETERMINANT
cdef double _MIN_STEEPNESS, _CORNER_ERROR, _CORNER_CROWDING, _CORNER_RADII, _CURVED_CROWDING
cdef double _NAN, _FITTED, _BOUNDED, _BOUND_SIGMA, _MAX_SQUARED_MISFIT, _MAX_EXTENT_SIDES
cdef Py_ssize_t _PAIRED_CHANNELS

cdef class ContactSolver:
    cdef list models, pad_tolerances, laws, surfaces
    cdef force.StackTable stack
    cdef locate.Fit fit
    cdef tables.Placement placement
    cdef readonly pairs.PairFit pair
    cdef double[::1] pair_limits, moment_stds
    cdef ValueRow[::1] values, no_value
    cdef PartRow[::1] parts
    cdef MountRow[::1] mounts
    cdef MisfitRow[::1] misfits
    cdef force.ForceResult result
    cdef force.PadLaw part_law
    cdef elongation.Elongation elongation
    cdef Py_ssize_t electrodes
    cdef double[::1] by_x, by_y, by_total
    cdef double moved_x, moved_y
    cdef two_sheets.TwoSheets both
    cdef bint has_both, is_by_both, contradicts
    cdef double centre_s, centre_t, log_spreading_m, gradient2, shift, moved2, scale2, slope_x, slope_y
    cdef double pure, mixed, straight_x, straight_y
    cdef bint were_two
    cdef double[::1] currents, weight, offset_std_a, covariance
    cdef unsigned char[::1] force_requested, saturated, crowding
    cdef double[::1] peak_currents_a, ampere_per_count, noise_squared
    @cython.locals(k=Py_ssize_t)
    cpdef solve_contacts(self, Py_ssize_t[::1] pads)

@cython.locals(n=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, fit=locate.Fit,
               table=locate.ModelTable, parts=tolerances.PadTolerances, last_x=double,
               last_y=double, lag=double, weight=double, scale=double, excess=double,
               offset2=double, saturated=Py_ssize_t, last_radius_m=double)
cdef void solve_contact(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, found=elongation.Elongation, at=tables.Placement,
               along=double, around=double)
cdef void _write_elongation(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, first=Py_ssize_t, fit=locate.Fit, least=double, greatest=double, noise=double,
               current=double, relative=double,
               variance=double)
cdef void _estimate_saturated(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, first=Py_ssize_t, fit=locate.Fit, total=double, variance=double, relative=double)
cdef void _bound_force(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(force_n=double, greatest_n=double)
cdef void _limit_force(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(limit=double)
cdef double _shrinking(double variance, double side) noexcept
@cython.locals(shrink_x=double, shrink_y=double)
cdef void _limit_to_pad(locate.Fit fit, locate.ModelTable table) noexcept
@cython.locals(row=Py_ssize_t, i=Py_ssize_t, were_two=bint)
cdef bint _forget_parts(ContactSolver solver, Py_ssize_t pad, bint is_new) noexcept
@cython.locals(first=Py_ssize_t, second=Py_ssize_t, begin=Py_ssize_t, pair=pairs.PairFit,
               table=locate.ModelTable, x0=double, y0=double, x1=double, y1=double,
               kept=double, turned=double, near2=double)
cdef Py_ssize_t _order_parts(ContactSolver solver, Py_ssize_t pad) noexcept
cdef double _squared_distance(PartRow[::1] parts, Py_ssize_t row, double x, double y) noexcept
@cython.locals(newest=double)
cdef void _name_part(PartRow[::1] parts, Py_ssize_t row, Py_ssize_t first) noexcept
@cython.locals(row=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, begin=Py_ssize_t, fit=locate.Fit, pair=pairs.PairFit,
               table=locate.ModelTable, at=tables.Placement)
cdef void _resolve_pair(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(other=Py_ssize_t, fit=locate.Fit, pair=pairs.PairFit, table=locate.ModelTable,
               result=force.ForceResult, scale_m=double, dx=double, dy=double, d2=double, mutual=double, slope_x=double,
               slope_y=double, shift=double, shift_x=double, shift_y=double, aside2=double)
cdef void _add_part_crowding(ContactSolver solver, Py_ssize_t pad, Py_ssize_t k) noexcept
@cython.locals(other=Py_ssize_t, n=Py_ssize_t, step=Py_ssize_t, fit=locate.Fit,
               pair=pairs.PairFit, law=force.PadLaw, table=locate.ModelTable, gradient2=double)
cdef void _estimate_part_force(ContactSolver solver, Py_ssize_t pad, Py_ssize_t k, Py_ssize_t row) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, fit=locate.Fit, table=locate.ModelTable)
cdef void _propagate(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, spread=double)
cdef void _widen_by_misfit(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(mean=double, weight=double)
cdef void _count_misfit(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(n=Py_ssize_t, first=Py_ssize_t, i=Py_ssize_t, noise=double,
               scale=double, measured2=double, fit=locate.Fit, table=locate.ModelTable)
cdef void _write_pad_noise(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, law=force.PadLaw, force_n=double,
               log_radius=double, radius_m=double)
cdef void _estimate_by_first(ContactSolver solver, Py_ssize_t pad, Py_ssize_t saturated) noexcept
@cython.locals(fit=locate.Fit, both=two_sheets.TwoSheets, n=Py_ssize_t,
               law=force.PadLaw)
cdef void _estimate_both(
    ContactSolver solver, Py_ssize_t pad, double last_radius_m, Py_ssize_t saturated) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, at=tables.Placement, n=Py_ssize_t,
               result=force.ForceResult, parts=tolerances.PadTolerances, is_crowded=bint, log_scale=double, resistors=double, gradient2=double,
               shift=double, near=double)
cdef void _find_centre(ContactSolver solver, Py_ssize_t pad, force.PadLaw law) noexcept
@cython.locals(fit=locate.Fit, law=force.PadLaw, surface=tables.PadSurface, whole=double, variance=double,
               curved=double)
cdef void _find_spreading(ContactSolver solver, Py_ssize_t pad, double share) noexcept
@cython.locals(n=Py_ssize_t, fit=locate.Fit, law=force.PadLaw)
cdef void _estimate_force(ContactSolver solver, Py_ssize_t pad, double share) noexcept
@cython.locals(chance=double)
cdef void _span_two_patches(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, at=tables.Placement, result=force.ForceResult,
               parts=tolerances.PadTolerances, spread=double, std=double, shift=double, x=double, y=double,
               own=double, cornered=double, uneven=double, left_out=double, curved=double)
cdef void _correct_crowding(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, n=Py_ssize_t, i=Py_ssize_t, change=double)
cdef void _straighten(ContactSolver solver, double inside, double scale2) noexcept
@cython.locals(i=Py_ssize_t, fit=locate.Fit, at=tables.Placement)
cdef void _write_position(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(at=tables.Placement, x=double, y=double, z=double, turning=double, even=double, xy=double,
               xz=double, yz=double)
cdef void _write_mount(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, moved_x=double, moved_y=double, along2=double, across2=double)
cdef void _add_motion(ContactSolver solver, double factor) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, parts=tolerances.PadTolerances)
cdef void _add_size(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, table=locate.ModelTable, parts=tolerances.PadTolerances, at=tables.Placement)
cdef void _add_overhang(ContactSolver solver, Py_ssize_t pad) noexcept
@cython.locals(fit=locate.Fit, at=tables.Placement)
cdef void _find_covariance(ContactSolver solver) noexcept
@cython.locals(at=tables.Placement)
cdef void _find_row(ContactSolver solver, Py_ssize_t first, double by_t, double by_w) noexcept
@cython.locals(n=Py_ssize_t)
cdef void _add_extent(locate.ModelTable table, locate.Fit fit, double residual) noexcept
