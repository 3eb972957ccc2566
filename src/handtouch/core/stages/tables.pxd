cimport cython

@cython.locals(i=Py_ssize_t, j=Py_ssize_t, c=Py_ssize_t, node=Py_ssize_t, near=Py_ssize_t, far=Py_ssize_t,
               a=Py_ssize_t, b=Py_ssize_t)
cdef void read_table(double[::1] table, Py_ssize_t first, Py_ssize_t cells, Py_ssize_t columns,
                     double s, double t, double[::1] out) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, c=Py_ssize_t, node=Py_ssize_t, near=Py_ssize_t, far=Py_ssize_t,
               first=Py_ssize_t, a=Py_ssize_t, along=double, along_slope=double, across=double,
               across_slope=double, is_right=bint, is_far=bint, value=double, by_s=double, by_t=double, by_both=double)
cdef void read_values(double[::1] table, Py_ssize_t cells, Py_ssize_t columns, double s, double t,
                      double[::1] out) noexcept
