cimport cython

cdef Py_ssize_t _VALUES, _FORCE, _FORCE_STD, _FORCE_STATUS, _INVALID
cdef double _BOUNDED, _NAN, _INFINITY
cdef long long _MAX_PAUSE_NS

cdef class SheetInterval:
    cdef Py_ssize_t number, first, stop, elements, plays
    cdef double dt_s, total, base
    cdef double[::1] lines, transition, widths_n, weights

cdef class SheetStage:
    cdef long long[::1] pads, last_touch_ns, updated_ns
    cdef Py_ssize_t sheets, columns, play_columns, rows
    cdef long long period_ns
    cdef double update_period_s
    cdef unsigned char[::1] touching, load_is_old, reliability, new_contact
    cdef double[::1] gain, results, values, apparent_n, growth, elements, plays, back_n, flow_s, impulse_ns
    cdef double[::1] back_waited_s, force_n, std_n, relative_std, waited_s
    cdef object update, update_began, make_steps
    cdef list steps
    cdef long long periods
    cdef bint due, began, back_due
    @cython.locals(periods='long long', k=Py_ssize_t)
    cpdef compensate_forces(self, long long sync_ns)
    @cython.locals(uncertainties=bint)
    cpdef complete_update(self)
    @cython.locals(row=Py_ssize_t, pad=Py_ssize_t, first=Py_ssize_t, force=double, saturated=bint)
    cpdef store_forces(self)

@cython.locals(elapsed_ns='long long', periods='long long')
cdef long long _elapsed_periods(SheetStage stage, long long sync_ns) noexcept
@cython.locals(old=bint, row=Py_ssize_t, waited_s=double)
cdef bint _compensate_sheets(SheetStage stage, SheetInterval step) noexcept
@cython.locals(row=Py_ssize_t, pad=Py_ssize_t, pressed=bint)
cdef void _find_pressed(SheetStage stage, double dt_s) noexcept
@cython.locals(pad=Py_ssize_t, first=Py_ssize_t, last=Py_ssize_t, i=Py_ssize_t, apparent=double, finite=bint,
               effective=double, before=double, load=double)
cdef void _compensate_sheet(SheetStage stage, SheetInterval step, Py_ssize_t row, bint old) noexcept
@cython.locals(n=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, greatest=double, load=double)
cdef double _invert_creep(SheetStage stage, SheetInterval step, Py_ssize_t first, double reading) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, at=Py_ssize_t, moved=double)
cdef void _advance_creep(
    SheetStage stage, SheetInterval step, Py_ssize_t first, double load, bint old) noexcept
@cython.locals(i=Py_ssize_t, load=double, play=double)
cdef double _invert_hysteresis(SheetStage stage, SheetInterval step, Py_ssize_t last, double before) noexcept
cdef void _write_result(
    SheetStage stage, Py_ssize_t row, double load, double before, double effective, double reading) noexcept
