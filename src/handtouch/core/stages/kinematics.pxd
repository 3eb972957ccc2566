cimport cython
from libc cimport math

cdef Py_ssize_t _POSE, _MOTION, _AXIS, _TURNS, _SLIDES

cdef class JointTree:
    cdef Py_ssize_t[::1] parents, kinds, movers, frames
    cdef double[::1] motions, factors, offsets, signs, poses, velocities
    cdef Py_ssize_t tree_joints, links, joints
    @cython.locals(k=Py_ssize_t, mover=Py_ssize_t)
    cpdef set_joint_positions(self, const double[::1] positions)
    @cython.locals(poses='double[::1]', at=Py_ssize_t, seen_from=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
    cpdef write_pose(self, Py_ssize_t link, bint in_base, double[::1] out)
    @cython.locals(poses='double[::1]', velocities='double[::1]', at=Py_ssize_t, seen_from=Py_ssize_t,
                   row=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, k=Py_ssize_t)
    cpdef add_joint_covariance(
        self, Py_ssize_t link, bint in_base, double[::1] point, Py_ssize_t first,
        double[::1] stds, double[::1] out)

@cython.locals(poses='double[::1]', motions='double[::1]', kind=Py_ssize_t, parent=Py_ssize_t,
               child=Py_ssize_t, of=Py_ssize_t, row=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef void _place_child(JointTree tree, Py_ssize_t k, double moved) noexcept
@cython.locals(poses='double[::1]', velocities='double[::1]', row=Py_ssize_t, axis=Py_ssize_t,
               first=Py_ssize_t)
cdef void _add_velocity(JointTree tree, Py_ssize_t k, double rate, double x, double y, double z) noexcept
