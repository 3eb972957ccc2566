cimport cython
from handtouch.core.stages cimport kinematics
from handtouch.core.stages.rows cimport FrameRow, PartRow, PoseRow, ValueRow

cdef Py_ssize_t _BASE, _AGE, _ROW, _PARTS, _VECTOR, _VECTORS, _NOT_COMPUTED, _VALID, _STALE, _INVALID
cdef double _NAN, _INFINITY
cdef long long _NEVER_NS

cdef class HandFrames:
    cdef object name, errors
    cdef kinematics.LinkPoses tree
    cdef Py_ssize_t first, stop
    cdef unsigned char[::1] masks
    cdef double[::1] stds, mounts
    cdef double mount_variance, mount_rotation_variance, stale_s

cdef class ContactTransforms:
    cdef public object joints_at
    cdef readonly list used_joints
    cdef readonly bint any_requested
    cdef object held, requested, groups, published_values
    cdef list hands
    cdef Py_ssize_t pads
    cdef PoseRow[::1] pose
    cdef FrameRow[::1] on_link
    cdef ValueRow[::1] contacts
    cdef PartRow[::1] parts
    cdef FrameRow[:] palm, base, parts_palm, parts_base
    cdef double[::1] values, part_values, rotation, vector, frame_vector, joint_variance_m2, covariance
    cdef float[::1] published
    cdef long long[::1] sample_ns
    cdef unsigned char[::1] palm_requested, base_requested, palm_status, base_status, pending
    @cython.locals(pad=Py_ssize_t)
    cpdef refresh(self)
    @cython.locals(pad=Py_ssize_t, hand=HandFrames, sample_ns='long long')
    cpdef transform_updated(self, result)
    @cython.locals(k=Py_ssize_t)
    cpdef begin_contacts(self, const Py_ssize_t[::1] pads)
    @cython.locals(k=Py_ssize_t)
    cpdef discard(self, const Py_ssize_t[::1] pads)
    @cython.locals(pad=Py_ssize_t, earliest='long long')
    cpdef long long next_sample_ns(self, HandFrames hand)
    @cython.locals(pad=Py_ssize_t, joint=Py_ssize_t)
    cpdef transform_contacts(
        self, HandFrames hand, long long sample_ns, const double[::1] positions, const double[::1] ages_s,
        const double[::1] stds)

cdef void _begin_contact(ContactTransforms frames, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, in_palm=double, in_base=double)
cdef void _discard(ContactTransforms frames, Py_ssize_t pad) noexcept
@cython.locals(row=Py_ssize_t, i=Py_ssize_t, in_palm=bint, in_base=bint)
cdef void _publish_pad(ContactTransforms frames, Py_ssize_t pad) noexcept
cdef void _transform_contact(
    ContactTransforms frames, HandFrames hand, Py_ssize_t pad, const double[::1] ages_s) noexcept
@cython.locals(link=Py_ssize_t, joint=Py_ssize_t, mask=Py_ssize_t, status=Py_ssize_t, i=Py_ssize_t,
               vector=Py_ssize_t, turned_vector=Py_ssize_t, part=Py_ssize_t)
cdef double _transform(
    ContactTransforms frames, HandFrames hand, Py_ssize_t pad, bint in_base, const double[::1] ages_s) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _transform_part(
    ContactTransforms frames, HandFrames hand, Py_ssize_t link, Py_ssize_t part, bint in_base) noexcept
@cython.locals(element=double)
cdef double _turning(ContactTransforms frames, Py_ssize_t i, Py_ssize_t j) noexcept
@cython.locals(i=Py_ssize_t, x=double, y=double, z=double)
cdef void _set_joint_covariance(
    ContactTransforms frames, HandFrames hand, Py_ssize_t link, bint in_base) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _write_in_frame(
    ContactTransforms frames, HandFrames hand, Py_ssize_t link, FrameRow[:] written, Py_ssize_t row) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef void _add_link_covariance(ContactTransforms frames, HandFrames hand, Py_ssize_t link) noexcept
@cython.locals(turned=double)
cdef double _turned_column(
    ContactTransforms frames, Py_ssize_t j, double a, double b, double c) noexcept
