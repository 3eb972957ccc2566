cimport cython
from libc cimport math

cdef double _4_PI, _MAX_OWN

cdef class NodeTables:
    cdef double[::1] table, breaks, values, slopes, work
    cdef Py_ssize_t points, rows, elements, size
    @cython.locals(count=Py_ssize_t, sloped=bint, k=Py_ssize_t, first=Py_ssize_t, row=Py_ssize_t, at=Py_ssize_t)
    cpdef read(self, const Py_ssize_t[::1] sheets, const double[::1] s, const double[::1] t, double[::1] found,
               double[::1] slopes)

@cython.locals(inside=double, element=Py_ssize_t, half=double, x=double)
cdef Py_ssize_t _weigh(NodeTables tables, double place, Py_ssize_t at, bint sloped) noexcept
@cython.locals(size=Py_ssize_t, work='double[::1]', i=Py_ssize_t, p=Py_ssize_t)
cdef void _sum_powers(NodeTables tables, double[::1] factors, double x, double power, Py_ssize_t at) noexcept
@cython.locals(total=double, line=double, at=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef double _sum(NodeTables tables, Py_ssize_t first, Py_ssize_t along, Py_ssize_t across) noexcept

cdef class NodeSystems:
    cdef Py_ssize_t nodes
    cdef double[::1] area_m2, pressure, green, system, nearest2
    @cython.locals(green='double[::1]', nearest2='double[::1]', nodes=Py_ssize_t, patch=Py_ssize_t, first=Py_ssize_t,
                   i=Py_ssize_t, j=Py_ssize_t, at=Py_ssize_t, radius=double, x=double, y=double, dx=double, dy=double,
                   square=double, ratio=double)
    cpdef fill_green(self, double[::1] place_m, double[::1] own_m, double[::1] radius_m)
    @cython.locals(count=Py_ssize_t, nodes=Py_ssize_t, k=Py_ssize_t, first=Py_ssize_t, at=Py_ssize_t, i=Py_ssize_t,
                   j=Py_ssize_t, row=Py_ssize_t, log_force=double, log_ratio=double, specific=double)
    cpdef solve(self, const Py_ssize_t[::1] patches, double[::1] force_n, double[::1] sheet_ohm, double[::1] layer,
                double[::1] current)

@cython.locals(top=Py_ssize_t, under=Py_ssize_t, row=Py_ssize_t, p=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, ratio=double,
               second=double, total=double)
cdef void _solve_symmetric(double[::1] system, Py_ssize_t n, double[::1] right, Py_ssize_t first) noexcept
