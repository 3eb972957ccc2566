cimport cython

cdef Py_ssize_t _VALUES, _FORCE, _FORCE_STD, _FORCE_STATUS, _INVALID
cdef double _LOWER_BOUND, _NAN, _INFINITY
cdef long long _MAX_PAUSE_NS

cdef class SheetInterval:
    cdef Py_ssize_t number, first, stop, elements, plays
    cdef readonly double dt_s
    cdef double total, base
    cdef double[::1] lines, transition, widths_n, weights

cdef class SheetStage:
    cdef long long[::1] pads, last_touch_ns, updated_ns
    cdef Py_ssize_t sheets, columns, play_columns, rows
    cdef long long period_ns
    cdef double update_period_s
    cdef unsigned char[::1] touching, load_is_old, reliability, new_contact
    cdef double[::1] gain, results, values, apparent_n, elements, plays, back_n, flow_s, impulse_ns
    cdef double[::1] back_waited_s, force_n, std_n, relative_std, waited_s
    cdef readonly Py_ssize_t pressed
    cdef readonly bint due
    @cython.locals(elapsed_ns='long long', periods='long long')
    cpdef long long elapsed_periods(self, long long sync_ns)
    @cython.locals(old=bint, row=Py_ssize_t, waited_s=double)
    cpdef bint compensate_sheets(self, SheetInterval step)
    @cython.locals(row=Py_ssize_t, pad=Py_ssize_t)
    cpdef find_pressed(self, double dt_s)
    @cython.locals(row=Py_ssize_t, pad=Py_ssize_t, first=Py_ssize_t, force=double, saturated=bint)
    cpdef store_forces(self)

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
