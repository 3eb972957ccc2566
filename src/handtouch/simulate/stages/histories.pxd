cimport cython
from libc cimport math

cdef class HistoryStage:
    cdef double preload_n_per_k, gain_per_k, instant, threshold_n, recovery_s, fatigue_s, wipe_fraction
    cdef double exponent, linear, play_weight
    cdef bint has_loops
    cdef double[::1] plays_n, weights, times_s, shares, back_times_s
    cdef Py_ssize_t plays, elements, speeds, depth
    cdef double[::1] turning_n, back_n, creep_n, peak_n, flow_s
    cdef Py_ssize_t[::1] turns
    @cython.locals(k=Py_ssize_t)
    cpdef advance(self, Py_ssize_t[::1] sheets, double[::1] dt_s, double[::1] load_n, unsigned char[::1] excited,
                  double[::1] warmer_k, double[::1] apparent_n)

@cython.locals(load=double, effective=double, crept=double, first=Py_ssize_t, i=Py_ssize_t, part=double,
               apparent=double)
cdef double _advance(HistoryStage stage, Py_ssize_t sheet, double dt_s, double load_n, bint excited,
                     double warmer_k) noexcept
@cython.locals(first=Py_ssize_t, i=Py_ssize_t, back=double, flows=bint, pressed=bint, speed=double, change=double,
               left=double)
cdef double _adapt(HistoryStage stage, Py_ssize_t sheet, double dt_s, double load_n, bint excited) noexcept
@cython.locals(i=Py_ssize_t, total=double)
cdef double _sum_back(HistoryStage stage, Py_ssize_t first) noexcept
@cython.locals(first=Py_ssize_t, points='double[::1]', last=Py_ssize_t, swing=double, is_continued=bint,
               is_wiped_out=bint, at=Py_ssize_t, total=double)
cdef double _apply_loops(HistoryStage stage, Py_ssize_t sheet, double load_n) noexcept
@cython.locals(i=Py_ssize_t, swing=double, beyond=double, reading=double)
cdef double _swing(HistoryStage stage, double high_n, double low_n) noexcept
