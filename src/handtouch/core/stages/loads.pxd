cimport cython

cdef class SheetInterval:
    cdef Py_ssize_t number, first, stop, elements, plays
    cdef double dt_s, total, base
    cdef double[::1] lines, transition, widths_n, weights

cdef class SheetLoads:
    cdef readonly long long[::1] rows
    cdef Py_ssize_t columns, play_columns
    cdef double[::1] elements, plays, back_n, growth, relative_std, log_gain_std
    cdef unsigned char[::1] load_is_old
    cdef public list steps

@cython.locals(row=Py_ssize_t, k=Py_ssize_t, step=SheetInterval)
cdef SheetInterval find_step(SheetLoads loads, Py_ssize_t pad)
@cython.locals(row=Py_ssize_t, effective=double)
cdef double find_load(SheetLoads loads, SheetInterval step, Py_ssize_t pad, double reading) noexcept
@cython.locals(first=Py_ssize_t, n=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, greatest=double, load=double)
cdef double invert_creep(SheetLoads loads, SheetInterval step, Py_ssize_t row, double reading) noexcept
cdef double load_before_hysteresis(SheetLoads loads, Py_ssize_t row, double effective) noexcept
@cython.locals(last=Py_ssize_t, i=Py_ssize_t, load=double)
cdef double invert_hysteresis(SheetLoads loads, SheetInterval step, Py_ssize_t row, double before) noexcept
cdef double moved_play(double play, double before, double width_n) noexcept
