cimport cython
from handtouch.core.stages cimport kinematics

cdef Py_ssize_t _COUNT, _ROW, _AGE, _VALUES, _POSITION, _NORMAL, _COVARIANCE, _VECTOR, _FRAME_VECTORS
cdef Py_ssize_t _NOT_COMPUTED, _VALID, _STALE, _INVALID
cdef Py_ssize_t _PART_COUNT, _PARTS_COUNT, _PART_FRAMES, _PART_POSITION, _PART_NORMAL, _PART_COVARIANCE
cdef double _NAN, _INFINITY
cdef long long _NEVER_NS

cdef class HandFrames:
    cdef kinematics.LinkPoses tree
    cdef Py_ssize_t first, stop
    cdef unsigned char[::1] masks
    cdef double[::1] stds, mounts
    cdef double mount_variance, mount_rotation_variance, stale_s

cdef class FrameStage:
    cdef Py_ssize_t pads
    cdef double[::1] values, frame_values, rotation, joint_variance_m2, pose, covariance, vector, frame_vector
    cdef double[::1] parts, part_frames
    cdef float[::1] published
    cdef long long[::1] sample_ns
    cdef unsigned char[::1] palm_requested, base_requested, palm_status, base_status, pending
    @cython.locals(k=Py_ssize_t, pad=Py_ssize_t)
    cpdef begin_contacts(self, const Py_ssize_t[::1] began, const Py_ssize_t[::1] updated)
    @cython.locals(k=Py_ssize_t)
    cpdef discard(self, const Py_ssize_t[::1] pads)
    @cython.locals(pad=Py_ssize_t)
    cpdef publish(self)
    @cython.locals(pad=Py_ssize_t, earliest='long long')
    cpdef long long next_sample_ns(self, HandFrames hand)
    @cython.locals(pad=Py_ssize_t, joint=Py_ssize_t)
    cpdef transform_contacts(
        self, HandFrames hand, long long sample_ns, const double[::1] positions, const double[::1] ages_s,
        const double[::1] stds)

cdef void _begin_contact(FrameStage stage, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, first=Py_ssize_t, in_palm=double, in_base=double)
cdef void _discard(FrameStage stage, Py_ssize_t pad) noexcept
@cython.locals(row=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, first=Py_ssize_t, width=Py_ssize_t,
               status=Py_ssize_t, value=double)
cdef void _publish_pad(FrameStage stage, Py_ssize_t pad) noexcept
cdef void _transform_contact(
    FrameStage stage, HandFrames hand, Py_ssize_t pad, const double[::1] ages_s) noexcept
@cython.locals(link=Py_ssize_t, joints=Py_ssize_t, joint=Py_ssize_t, mask=Py_ssize_t, on_pad=Py_ssize_t,
               row=Py_ssize_t, at=Py_ssize_t, status=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t,
               pose='double[::1]', values='double[::1]')
cdef double _transform(
    FrameStage stage, HandFrames hand, Py_ssize_t pad, bint in_base, const double[::1] ages_s) noexcept
@cython.locals(link=Py_ssize_t, k=Py_ssize_t, i=Py_ssize_t, at=Py_ssize_t)
cdef void _transform_parts(FrameStage stage, HandFrames hand, Py_ssize_t pad, bint in_base) noexcept
@cython.locals(i=Py_ssize_t, pose='double[::1]')
cdef void _write_in_frame(
    FrameStage stage, HandFrames hand, Py_ssize_t link, double[::1] values, Py_ssize_t position,
    Py_ssize_t normal, Py_ssize_t covariance, double[::1] written, Py_ssize_t row) noexcept
@cython.locals(at=Py_ssize_t, mount=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, pose='double[::1]')
cdef void _add_link_covariance(
    FrameStage stage, HandFrames hand, Py_ssize_t link, double[::1] values, Py_ssize_t position,
    Py_ssize_t first) noexcept
