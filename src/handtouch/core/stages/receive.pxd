cimport cython

cdef long long _STAMP_KIND, _LOW_HALF
cdef Py_ssize_t _HEADER, _FRAME, _CONTROL, _ROUTE, _FIELD, _PACKET, _PATTERN, _DATA_BYTES
cdef Py_ssize_t _CONTROL_SIZE, _MESSAGE_SIZE, _STAMP_BYTES, _FRAME_BYTES, _IDENTIFIERS, _WORDS_OF_SLOT

cdef class SampleMemory:
    cdef long long[::1] words, arrival_ns, repeat_counts, contrary_counts
    cdef long long[::1] counts, fields, low_limits, high_limits
    cdef unsigned char[::1] fresh, single, contrary
    cdef readonly Py_ssize_t channels, new_fresh, stored_bytes

cdef class FrameBatch:
    cdef long long[::1] headers, frames, control
    cdef public long long offset_ns, earliest_ns, latest_ns

cdef class PacketMemory:
    cdef long long[::1] words, masks, patterns
    cdef unsigned char[::1] octets
    cdef Py_ssize_t empty_size, id_at, data_at

@cython.locals(i=Py_ssize_t, k=Py_ssize_t, size=Py_ssize_t, begin=Py_ssize_t, masked='long long',
               can_id='long long', data='long long', scale='long long', octet='long long')
cpdef Py_ssize_t unpack_packets(PacketMemory packets, FrameBatch batch, Py_ssize_t first, Py_ssize_t count)
@cython.locals(i=Py_ssize_t, head='long long', can_id='long long', slot='long long', size='long long',
               message_size='long long', length='long long')
cpdef Py_ssize_t store_samples(
    SampleMemory memory, FrameBatch batch, long long[::1] routes, Py_ssize_t first, Py_ssize_t count)
@cython.locals(header=Py_ssize_t, control=Py_ssize_t, arrival_ns='long long')
cpdef long long frame_arrival_ns(FrameBatch batch, Py_ssize_t i)
@cython.locals(slot=Py_ssize_t, count=Py_ssize_t)
cpdef Py_ssize_t begin_cycle(SampleMemory memory, long long sync_ns)
@cython.locals(i=Py_ssize_t, field=Py_ssize_t, count='long long')
cpdef unpack_counts(SampleMemory memory)
