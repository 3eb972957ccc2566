cimport cython

cdef Py_ssize_t _VALUES, _FIRST, _COUNT, _POSITION, _FORCE, _FORCE_STD, _ESTIMATE, _MISFIT
cdef Py_ssize_t _NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID
cdef Py_ssize_t _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID, _EVIDENCE_MISSING
cdef double _MAX_SQUARED_MISFIT, _LOWER_BOUND_ESTIMATE, _NAN, _INFINITY

cdef class ContactColumns:
    cdef Py_ssize_t pads
    cdef unsigned char[::1] position_unreliable, position_status, force_status, solved
    cdef unsigned char[::1] position_requested, force_requested, known, reliability
    cdef unsigned int[::1] contact_id
    cdef long long[::1] value_columns
    cdef float[::1] published, published_current_a
    cdef double[::1] values, total_current_a, uncompensated_force_n, uncompensated_std_n, peak_force_n
    @cython.locals(k=Py_ssize_t, pad=Py_ssize_t)
    cpdef store_solved(self, Py_ssize_t[::1] pads)
    @cython.locals(pad=Py_ssize_t, i=Py_ssize_t)
    cpdef publish(self)

@cython.locals(before=Py_ssize_t, width=Py_ssize_t)
cdef Py_ssize_t _published_index(ContactColumns columns, Py_ssize_t pad, Py_ssize_t i) noexcept
@cython.locals(i=Py_ssize_t, finite=bint)
cdef bint _is_finite(double[::1] values, Py_ssize_t first, Py_ssize_t count) noexcept
@cython.locals(values='double[::1]', first=Py_ssize_t, i=Py_ssize_t, value=double, located=bint,
               no_point=bint, position=Py_ssize_t, force=Py_ssize_t)
cdef void _publish_contact(ContactColumns columns, Py_ssize_t pad) noexcept
