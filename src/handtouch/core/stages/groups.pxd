cimport cython
from handtouch.core.stages.rows cimport FrameRow

cdef double _SPLIT_DISTANCE2_RATIO, _MIN_NORMAL_COSINE, _INFINITY

cdef class ContactGroups:
    cdef object held
    cdef Py_ssize_t pads
    cdef double[::1] within2
    cdef FrameRow[:] palm
    cdef Py_ssize_t[::1] hands
    cdef unsigned int[::1] contact_id, group_id, grouped_contact_id
    cdef unsigned char[::1] palm_requested, base_requested, joined

@cython.locals(pad=Py_ssize_t, other=Py_ssize_t, contacts=Py_ssize_t, contact='unsigned int', changed=bint)
cdef bint _update_pairs(ContactGroups groups) noexcept
@cython.locals(other=Py_ssize_t, i=Py_ssize_t, changed=bint, before=Py_ssize_t, near=Py_ssize_t,
               limit2=double)
cdef bint _update_pairs_of(ContactGroups groups, Py_ssize_t pad) noexcept
