cimport cython
from handtouch.core.stages.receive cimport SampleMemory
from handtouch.core.stages.rows cimport TouchRow

cdef Py_ssize_t _VALUES, _CLEAR, _TOUCHED, _STALE, _FAULTED, _STARTING, _MAX_SILENT
cdef double _MAX_NEGATIVE_SIGMA, _MAX_NEGATIVE_FRACTION, _MAX_NEGATIVE_AMPLITUDES, _MAX_ZERO_FRACTION, _NAN

cdef class ContactDetector:
    cdef Py_ssize_t pads, channels
    cdef Py_ssize_t began, ended, updated, silent, solved, framed
    cdef list lists
    cdef readonly object currents_a, saturated_channels, offset_std_a
    cdef long long[::1] began_pads, ended_pads, updated_pads, silent_pads, solved_pads, framed_pads
    cdef TouchRow[:] touch
    cdef double[::1] expected_counts, currents, ampere_per_count, noise_counts
    cdef double[::1] begin_threshold_a, end_threshold_a, mean_ampere_per_count, offset_std, sum_std_a
    cdef long long[::1] sample_delay_ns
    cdef long long[::1] ticks, sample_ns, arrival_ns, sample_counts, missed_sample_counts, silent_ns
    cdef long long[::1] max_sample_period_ns
    cdef unsigned char[::1] pad_state, synchronous, touching, is_solved, position_requested, held
    cdef double[::1] total_current_a, peak_force_n, values
    cdef unsigned int[::1] contact_id
    cdef long long[::1] next_contact_id, begin_ns, first_sample_ns, contradicting_samples
    cdef long long[::1] update_interval_ticks, ticks_per_hand_frame
    cdef double[::1] block_sum, block_squares, block_count, excess
    cdef double[::1] span_sum, span_squares, span_count, span_low, span_crossings, span_level
    cdef double[::1] disturbance, threshold_factor
    cdef unsigned char[::1] saturated, known, span_above
    cdef bint sampled, implausible, trusted, stale, zeroing, railed

@cython.locals(pad=Py_ssize_t)
cdef void _detect_contacts(
    ContactDetector stage, SampleMemory memory, const unsigned char[::1] node_state, long long sync_ns,
    long long previous_sync_ns, long long half_period_ns, long long until_ns) noexcept
@cython.locals(arrival_ns='long long', here=bint, in_time=bint, watched=bint)
cdef void _take_sample(
    ContactDetector stage, SampleMemory memory, Py_ssize_t pad, bint operational, long long sync_ns,
    long long previous_sync_ns, long long until_ns) noexcept
@cython.locals(railed=bint, at_top=bint, near_zero=bint, touching=bint, began=bint, total=double, magnitude=double,
               others=double, excess=double, c=Py_ssize_t, i=Py_ssize_t, k=Py_ssize_t, count='long long')
cdef void _check_sample(ContactDetector stage, SampleMemory memory, Py_ssize_t pad) noexcept
@cython.locals(sources=bint, drains=bint, excess=double, limit=double, c=Py_ssize_t)
cdef bint _sources(ContactDetector stage, Py_ssize_t pad, double total, double magnitude) noexcept
@cython.locals(period_ns='long long')
cdef void _check_silence(
    ContactDetector stage, Py_ssize_t pad, long long cycle_ns, long long half_period_ns) noexcept
@cython.locals(level=double, touching=bint, above=bint, debounce_ns=double, elapsed_ns='long long')
cdef void _detect_contact(ContactDetector stage, Py_ssize_t pad, long long half_period_ns) noexcept
@cython.locals(factor=double, begin_a=double, end_a=double)
cdef bint _is_above(ContactDetector stage, Py_ssize_t pad, double level, bint touching) noexcept
@cython.locals(i=Py_ssize_t)
cdef void _begin_contact(ContactDetector stage, Py_ssize_t pad) noexcept
cdef void _end_contact(ContactDetector stage, Py_ssize_t pad) noexcept
@cython.locals(due=bint, framed=bint)
cdef void _select(ContactDetector stage, Py_ssize_t pad, bint continued, bint above) noexcept
@cython.locals(free=bint, above=bint, c=Py_ssize_t, i=Py_ssize_t, excess=double, total=double)
cdef void _count_sample(ContactDetector stage, Py_ssize_t pad) noexcept
