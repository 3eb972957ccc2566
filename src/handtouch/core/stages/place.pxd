cimport cython
from libc cimport math
from handtouch.core.stages cimport tables

cdef Py_ssize_t _COLUMNS

cdef class PadSurface:
    cdef double[::1] values, ends
    cdef Py_ssize_t first, cells, patch_floats, patches
    cdef double side_x

cdef class Placement:
    cdef double[::1] raw
    cdef double u_m, v_m, px, py, pz, nx, ny, nz, tx, ty, tz, wx, wy, wz, along_m, around_m, scale_m

@cython.locals(cells=Py_ssize_t, patch=Py_ssize_t, raw='double[::1]')
cdef void place_contact(PadSurface surface, Placement placement, double x, double y) noexcept
