cimport cython
from libc cimport math
from handtouch.core.stages.rows cimport JointRow, PoseRow

cdef Py_ssize_t _TURNS, _SLIDES

cdef class LinkPoses:
    cdef JointRow[::1] tree
    cdef PoseRow[::1] poses
    cdef Py_ssize_t[::1] frames
    cdef double[::1] signs, velocities
    cdef readonly Py_ssize_t joints
    cdef Py_ssize_t tree_joints, links
    @cython.locals(k=Py_ssize_t, mover=Py_ssize_t, moved=double)
    cpdef set_joint_positions(self, const double[::1] positions)
    @cython.locals(at=Py_ssize_t, seen_from=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, a=double, b=double,
                   c=double, x=double, y=double, z=double)
    cpdef write_pose(self, Py_ssize_t link, bint in_base, PoseRow[::1] out)
    @cython.locals(velocities='double[::1]', at=Py_ssize_t, seen_from=Py_ssize_t, row=Py_ssize_t,
                   i=Py_ssize_t, j=Py_ssize_t, k=Py_ssize_t, x=double, y=double, z=double, turned=double)
    cpdef add_joint_covariance(
        self, Py_ssize_t link, bint in_base, double px, double py, double pz, double[::1] stds,
        double[::1] out)

@cython.locals(turned=double)
cdef double _turned(
    LinkPoses tree, Py_ssize_t frame, Py_ssize_t i, double x, double y, double z) noexcept
@cython.locals(kind=Py_ssize_t, parent=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, sine=double, versine=double,
               half=double, a=double, b=double, c=double, x=double, y=double, z=double, origin=double)
cdef void _place_child(LinkPoses tree, Py_ssize_t k, double moved) noexcept
@cython.locals(element=double)
cdef double _column(LinkPoses tree, Py_ssize_t k, Py_ssize_t i, double sine, double versine) noexcept
@cython.locals(first=Py_ssize_t, a=double, b=double, c=double, ax=double, ay=double, az=double)
cdef void _add_velocity(
    LinkPoses tree, Py_ssize_t k, double rate, double x, double y, double z) noexcept
