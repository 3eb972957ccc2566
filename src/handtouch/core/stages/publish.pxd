cimport cython
from handtouch.core.stages.rows cimport ColumnRow, FieldRow, FrameRow, PartRow, ValueRow

cdef Py_ssize_t _VALUES, _FRAME_VALID, _END, _HEADER_BYTES, _NUMBER_BYTES
cdef Py_ssize_t _NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID
cdef Py_ssize_t _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID, _EVIDENCE_MISSING
cdef Py_ssize_t _INTEGER, _SECONDS, _NAME, _TRUTH, _NUMBERS, _SUM, _WHOLE, _TEXT, _PARTS
cdef Py_ssize_t _ALWAYS, _LOCATED, _STD, _FRAMES, _PALM, _BASE, _MODELLED, _VECTOR, _PART_PALM, _PART_BASE
cdef Py_ssize_t _SEQ, _T, _EVENT, _ID, _BEGIN, _POSITION_STATUS, _FORCE_STATUS, _REASON, _RETAINED, _GROUP
cdef Py_ssize_t _PALM_STATUS, _BASE_STATUS, _FRESH, _VECTOR_STATUS, _DURATION, _AGE, _RADIUS_STATUS
cdef long long _MAX_SILENT_PERIODS
cdef Py_ssize_t _MISFIT_COUNT
cdef double _SECONDS_PER_NS, _MAX_SQUARED_MISFIT, _MAX_LASTING_MISFIT, _BOUNDED_ESTIMATE, _WIDE_ESTIMATE, _NAN
cdef double _MAX_NUMBER, _MIN_NUMBER, _MAX_RADIUS_STATUS

cdef class ContactColumns:
    cdef Py_ssize_t pads, count
    cdef unsigned char[::1] position_unreliable, position_status, force_status, radius_status, solved
    cdef unsigned char[::1] position_requested, force_requested, known, reliability
    cdef unsigned int[::1] contact_id
    cdef ColumnRow[::1] columns
    cdef ValueRow[::1] contacts
    cdef float[::1] published, published_current_a
    cdef double[::1] values, total_current_a, uncompensated_force_n, uncompensated_std_n, peak_force_n, misfits
    @cython.locals(k=Py_ssize_t, pad=Py_ssize_t)
    cpdef store_solved(self, Py_ssize_t[::1] pads)
    @cython.locals(pad=Py_ssize_t, i=Py_ssize_t)
    cpdef publish(self)

@cython.locals(before=Py_ssize_t, index=Py_ssize_t)
cdef Py_ssize_t _published_index(ContactColumns columns, Py_ssize_t pad, Py_ssize_t i) noexcept
cdef bint _is_finite(double value) noexcept
@cython.locals(i=Py_ssize_t, located=bint)
cdef bint _is_located(ValueRow[::1] contacts, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, known=bint)
cdef bint _has_mount(ValueRow[::1] contacts, Py_ssize_t pad) noexcept
@cython.locals(first=Py_ssize_t, i=Py_ssize_t, value=double, std=double, misfit=double, estimate=double, has_mount=bint,
               no_point=bint, is_odd=bint, is_bounded=bint, position=Py_ssize_t, force=Py_ssize_t, radius=double)
cdef void _publish_contact(ContactColumns columns, Py_ssize_t pad) noexcept

cdef class ContactEncoder:
    cdef object model, pack, buffer
    cdef list topics, calibrations, own_texts
    cdef unsigned char[::1] position_status, force_status, radius_status, has_sheet_model, texts, pad_texts
    cdef unsigned char[::1] message, synchronous, palm_requested, base_requested, palm_status, base_status
    cdef unsigned char[::1] vector_status, conditions
    cdef unsigned int[::1] contact_id, group_id
    cdef long long[::1] text_ends, pad_text_ends, contact_seq, sample_ns, begin_ns, silent_ns
    cdef long long[::1] max_sample_period_ns, integers
    cdef double[::1] state, summed
    cdef unsigned long long[::1] state_bits, summed_bits
    cdef FieldRow[::1] fields
    cdef ValueRow[::1] contacts
    cdef PartRow[::1] parts
    cdef FrameRow[:] parts_palm, parts_base
    cdef Py_ssize_t written, written_fields, field_count, row_count, pad_text_count
    @cython.locals(sample_ns='long long', begin_ns='long long', t_ns='long long', row=Py_ssize_t)
    cpdef Py_ssize_t encode_contact(
        self, Py_ssize_t pad, Py_ssize_t event, long long sync_ns, long long now_ns, Py_ssize_t end_reason,
        bint retained)

@cython.locals(max_silent_ns='long long')
cdef bint _is_fresh(ContactEncoder encoder, Py_ssize_t pad) noexcept
@cython.locals(in_frames=bint, force=Py_ssize_t)
cdef void _read_statuses(ContactEncoder encoder, Py_ssize_t pad) noexcept
@cython.locals(i=Py_ssize_t, finite=bint)
cdef bint _are_known(ContactEncoder encoder, Py_ssize_t first, Py_ssize_t count) noexcept
@cython.locals(kind=Py_ssize_t, value='long long', name=Py_ssize_t)
cdef void _write_field(ContactEncoder encoder, Py_ssize_t row, Py_ssize_t pad, Py_ssize_t number) noexcept
@cython.locals(absent=Py_ssize_t, count=Py_ssize_t, first=Py_ssize_t, size=Py_ssize_t, i=Py_ssize_t,
               is_met=bint, is_known=bint, is_sum=bint, message='unsigned char[::1]', end=Py_ssize_t)
cdef void _write_numbers(ContactEncoder encoder, Py_ssize_t row, Py_ssize_t pad, Py_ssize_t number) noexcept
@cython.locals(i=Py_ssize_t, has_mount=bint, finite=bint)
cdef bint _sum_covariance(ContactEncoder encoder, Py_ssize_t first, Py_ssize_t pad) noexcept
@cython.locals(fields=Py_ssize_t, number=Py_ssize_t, header=Py_ssize_t, row=Py_ssize_t,
               in_palm=bint, in_base=bint, palm=double, base=double)
cdef void _write_parts(ContactEncoder encoder, Py_ssize_t pad) noexcept
cdef void _write_text(ContactEncoder encoder, Py_ssize_t begin, Py_ssize_t end) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _copy(
    unsigned char[::1] message, Py_ssize_t at, unsigned char[::1] texts, Py_ssize_t begin, Py_ssize_t end) noexcept
cdef void _write_key(ContactEncoder encoder, Py_ssize_t row) noexcept
@cython.locals(begin=Py_ssize_t, end=Py_ssize_t)
cdef void _write_pad_text(ContactEncoder encoder, Py_ssize_t row) noexcept
cdef void _write_byte(ContactEncoder encoder, Py_ssize_t byte) noexcept
@cython.locals(size=Py_ssize_t, kind=Py_ssize_t, k=Py_ssize_t)
cdef void _write_integer(ContactEncoder encoder, long long value) noexcept
cdef void _write_bits(unsigned char[::1] message, Py_ssize_t at, unsigned long long bits) noexcept
