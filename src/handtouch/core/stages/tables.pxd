cimport cython
from libc cimport math

cdef Py_ssize_t _COLUMNS

@cython.locals(i=Py_ssize_t, j=Py_ssize_t, c=Py_ssize_t, node=Py_ssize_t, near=Py_ssize_t, far=Py_ssize_t,
               a=Py_ssize_t, b=Py_ssize_t)
cdef void read_table(double[::1] table, Py_ssize_t first, Py_ssize_t cells, Py_ssize_t columns,
                     double s, double t, double[::1] out) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, c=Py_ssize_t, near=Py_ssize_t, a=Py_ssize_t)
cdef void read_values(float[::1] table, Py_ssize_t cells, Py_ssize_t columns, double s, double t,
                      double[::1] out) noexcept

cdef class PadSurface:
    cdef readonly object nodes
    cdef double[::1] values, ends
    cdef Py_ssize_t cells, patch_floats, patches
    cdef double side_x, curvature

cdef class Placement:
    cdef double[::1] raw
    cdef double u_m, v_m, px, py, pz, nx, ny, nz, tx, ty, tz, wx, wy, wz, along_m, around_m, scale_m, slope_x, slope_y

@cython.locals(cells=Py_ssize_t, patch=Py_ssize_t, raw='double[::1]')
cdef void place_contact(PadSurface surface, Placement placement, double x, double y) noexcept
