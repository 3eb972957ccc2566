cimport cython

cdef Py_ssize_t _VALUES, _FIRST, _COUNT, _POSITION, _FORCE, _FORCE_STD, _ESTIMATE, _MISFIT, _IS_BOUND
cdef Py_ssize_t _NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID
cdef Py_ssize_t _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID, _EVIDENCE_MISSING
cdef Py_ssize_t _PALM_VALUES, _PAD_M, _NORMAL, _COVARIANCE, _RESIDUAL, _RESIDUAL_STD, _BASE, _AGE, _END
cdef Py_ssize_t _EVENTS, _POSITION_STATUSES, _FORCE_STATUSES, _FRAME_STATUSES, _REASONS, _REQUIRED
cdef Py_ssize_t _HEADER_BYTES, _PAD_TEXTS, _FRAME_VALID, _VECTOR, _FRAME_VECTORS, _PART_FRAMES, _KEY_PALM, _KEY_BASE
cdef Py_ssize_t _PART_COUNT, _PARTS_COUNT, _PART_COVARIANCE, _PART_FORCE, _KEY_POSITION, _KEY_NORMAL
cdef Py_ssize_t _KEY_COVARIANCE, _KEY_FORCE, _KEY_FORCE_STD, _KEY_PARTS, _KEY_MOUNT, _MOUNT, _COVARIANCE
cdef long long _MAX_SILENT_PERIODS
cdef double _SECONDS_PER_NS
cdef double _MAX_SQUARED_MISFIT, _BOUNDED_ESTIMATE, _WIDE_ESTIMATE, _NAN, _INFINITY

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
cdef bint _are_finite(double[::1] values, Py_ssize_t first, Py_ssize_t count) noexcept
@cython.locals(values='double[::1]', first=Py_ssize_t, i=Py_ssize_t, value=double, located=bint, has_mount=bint,
               no_point=bint, position=Py_ssize_t, force=Py_ssize_t)
cdef void _publish_contact(ContactColumns columns, Py_ssize_t pad) noexcept

cdef class ContactEncoder:
    cdef unsigned char[::1] position_status, force_status, has_sheet_model, texts, pad_texts, number_bytes
    cdef unsigned char[::1] message, synchronous, palm_requested, base_requested, palm_status, base_status
    cdef unsigned int[::1] contact_id, group_id
    cdef long long[::1] text_ends, pad_text_ends, contact_seq, sample_ns, begin_ns, silent_ns
    cdef long long[::1] max_sample_period_ns
    cdef double[::1] number, values, palm_values, peak_force_n, total_current_a, uncompensated_force_n
    cdef unsigned char[::1] vector_status
    cdef double[::1] vector, frame_vector, parts, part_frames, summed
    cdef Py_ssize_t written, field, fields
    @cython.locals(sample_ns='long long', begin_ns='long long', t_ns='long long', first=Py_ssize_t,
                   status=Py_ssize_t, located=bint, has_std=bint, max_silent_ns='long long')
    cpdef Py_ssize_t encode_contact(
        self, Py_ssize_t pad, Py_ssize_t event, long long sync_ns, long long now_ns, Py_ssize_t end_reason,
        bint retained)

@cython.locals(i=Py_ssize_t, known=bint)
cdef void _sum_covariance(
    ContactEncoder encoder, double[::1] values, Py_ssize_t first, Py_ssize_t mount) noexcept
@cython.locals(first=Py_ssize_t)
cdef void _write_frames(ContactEncoder encoder, Py_ssize_t pad) noexcept
cdef void _write_frame(ContactEncoder encoder, Py_ssize_t status, Py_ssize_t first) noexcept
@cython.locals(k=Py_ssize_t, at=Py_ssize_t, first=Py_ssize_t, in_palm=bint, in_base=bint, has_palm=bint,
               has_base=bint)
cdef void _write_parts(ContactEncoder encoder, Py_ssize_t pad) noexcept
cdef void _write_frame_values(ContactEncoder encoder, Py_ssize_t at) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _write_text(ContactEncoder encoder, Py_ssize_t begin, Py_ssize_t end) noexcept
cdef void _write_key(ContactEncoder encoder) noexcept
cdef void _write_name(ContactEncoder encoder, Py_ssize_t name) noexcept
@cython.locals(row=Py_ssize_t, i=Py_ssize_t)
cdef void _write_pad_text(ContactEncoder encoder, Py_ssize_t pad, Py_ssize_t number) noexcept
cdef void _write_byte(ContactEncoder encoder, Py_ssize_t byte) noexcept
cdef void _write_truth(ContactEncoder encoder, bint truth) noexcept
@cython.locals(size=Py_ssize_t, kind=Py_ssize_t, k=Py_ssize_t)
cdef void _write_integer(ContactEncoder encoder, long long value) noexcept
cdef void _write_optional_number(ContactEncoder encoder, double value) noexcept
cdef void _write_number(ContactEncoder encoder, double value) noexcept
cdef void _write_optional_array(
    ContactEncoder encoder, double[::1] values, Py_ssize_t first, Py_ssize_t count) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _write_array(
    ContactEncoder encoder, double[::1] values, Py_ssize_t first, Py_ssize_t count, bint valid) noexcept
@cython.locals(k=Py_ssize_t)
cdef void _write_double(ContactEncoder encoder, double value) noexcept
