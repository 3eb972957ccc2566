cimport cython
from libc cimport math
from handtouch.core.stages cimport loads
from handtouch.core.stages.loads cimport SheetInterval, SheetLoads
from handtouch.core.stages.rows cimport SheetLoadRow, ValueRow

cdef double _BOUNDED, _BOUND_SIGMA, _NAN, _INFINITY
cdef long long _MAX_PAUSE_NS

cdef class SheetStage:
    cdef SheetLoads history
    cdef long long[::1] pads, last_touch_ns, updated_ns
    cdef Py_ssize_t sheets
    cdef long long period_ns, periods
    cdef double update_period_s
    cdef unsigned char[::1] touching, new_contact
    cdef double[::1] max_force_n, gain, apparent_n, law_std_n, flow_s, impulse_ns
    cdef double[::1] back_waited_s, force_n, std_n, relative_std, waited_s
    cdef ValueRow[:] values
    cdef SheetLoadRow[:] results
    cdef object owner
    cdef bint due, began, back_due
    cpdef find_intervals(self, long long sync_ns)
    @cython.locals(periods='long long', k=Py_ssize_t, steps=list)
    cpdef compensate_forces(self, long long sync_ns)
    @cython.locals(uncertainties=bint)
    cpdef complete_update(self)
    @cython.locals(row=Py_ssize_t, pad=Py_ssize_t, force=double, relative=double, law=double, bounded=bint)
    cpdef store_forces(self)

cdef _find_steps(SheetStage stage, long long periods)
@cython.locals(elapsed_ns='long long')
cdef long long _periods_to(SheetStage stage, long long sync_ns) noexcept
@cython.locals(elapsed_ns='long long', periods='long long')
cdef long long _elapsed_periods(SheetStage stage, long long sync_ns) noexcept
@cython.locals(row=Py_ssize_t, waited_s=double)
cdef bint _compensate_sheets(SheetStage stage, SheetInterval step) noexcept
@cython.locals(row=Py_ssize_t, pad=Py_ssize_t, pressed=bint)
cdef void _find_pressed(SheetStage stage, double dt_s) noexcept
@cython.locals(history=SheetLoads, pad=Py_ssize_t, first=Py_ssize_t, last=Py_ssize_t, i=Py_ssize_t, apparent=double,
               finite=bint, effective=double, before=double, load=double)
cdef void _compensate_sheet(SheetStage stage, SheetInterval step, Py_ssize_t row) noexcept
@cython.locals(n=Py_ssize_t, i=Py_ssize_t, at=Py_ssize_t, moved=double, old=bint)
cdef void _advance_creep(SheetLoads history, SheetInterval step, Py_ssize_t first, double load) noexcept
cdef void _write_result(
    SheetStage stage, Py_ssize_t row, double load, double before, double effective, double reading) noexcept
