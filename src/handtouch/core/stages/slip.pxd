cimport cython
from libc cimport math
from handtouch.core.stages.rows cimport GripRow, SlipRow, ValueRow

cdef Py_ssize_t _ONSETS, _RECENT, _OLDER_STRIDE, _BLOCKS
cdef Py_ssize_t _LEVEL, _TREMOR, _SPEED, _COUPLING, _SCORE, _INFORMATION, _START, _START_NOISE
cdef Py_ssize_t _LEVEL_LEVEL, _LEVEL_TREMOR, _LEVEL_SPEED, _LEVEL_COUPLING, _TREMOR_TREMOR, _TREMOR_SPEED
cdef Py_ssize_t _TREMOR_COUPLING, _SPEED_SPEED, _SPEED_COUPLING, _COUPLING_COUPLING
cdef Py_ssize_t _STICKING, _INCIPIENT, _SLIDING, _LIFT_OFF
cdef double _NO_SLIP, _INFINITY, _MIN_VARIANCE_M2, _FIRM_CURRENT_FACTOR, _START_VELOCITY_VARIANCE
cdef double _ACCELERATION_DENSITY, _FORCE_RATE_TIME_S, _LIFT_OFF_HORIZON_S, _SLIP_RATE_HZ, _UNLOADING_FACTOR
cdef double _ODDS_DECAY_S, _MIN_REST_S, _MAX_REST_SPEED, _START_LEVEL_VARIANCE, _PRESS_NOISE_GAIN
cdef double _MIN_LEARNING_S, _DECREASE_FACTOR, _MIN_LOG_CREEP, _MAX_LOG_CREEP, _MAX_SQUARED_INNOVATION
cdef double _MIN_ONSET_LOG_ODDS, _NOISE_SIGMA, _SLOW, _MEDIUM, _FAST

cdef class SlipDetector:
    cdef readonly object state, contact_id, sample_ns, requested
    cdef readonly bint any_requested
    cdef readonly double samples_per_false_alarm
    cdef GripRow[::1] grip
    cdef SlipRow[::1] rows
    cdef ValueRow[::1] values
    cdef double[::1] work, total_a
    cdef unsigned int[::1] known, ids
    cdef Py_ssize_t[::1] counted, times
    cdef double x, y, noise_x, noise_y, press, dt_s
    cdef double f11, f12, f21, f22, q11, q12, q22, innovation, variance, gain0, gain1, gain2, gain3, alarm_ratio

@cython.locals(usable=bint, known=bint)
cdef void process_sample(SlipDetector slips, Py_ssize_t pad) noexcept
cdef void _read_sample(SlipDetector slips, Py_ssize_t pad) noexcept
@cython.locals(k=Py_ssize_t)
cdef void _begin_contact(SlipDetector slips, Py_ssize_t pad, double force) noexcept
@cython.locals(axis=Py_ssize_t, k=Py_ssize_t, block=Py_ssize_t)
cdef void _start_test(SlipDetector slips, Py_ssize_t pad, bint kept) noexcept
@cython.locals(axis=Py_ssize_t)
cdef void _track_motion(SlipDetector slips, Py_ssize_t pad, double force) noexcept
@cython.locals(axis=Py_ssize_t)
cdef void _test_slip(SlipDetector slips, Py_ssize_t pad) noexcept
cdef void _keep_last(SlipDetector slips, Py_ssize_t pad) noexcept
cdef void _set_transition(SlipDetector slips) noexcept
cdef void _filter_axis(SlipDetector slips, Py_ssize_t pad, Py_ssize_t axis) noexcept
@cython.locals(k=Py_ssize_t, axis=Py_ssize_t, block=Py_ssize_t)
cdef void _advance_onsets(SlipDetector slips, Py_ssize_t pad) noexcept
@cython.locals(k=Py_ssize_t, axis=Py_ssize_t, block=Py_ssize_t)
cdef void _shift_onsets(SlipDetector slips, Py_ssize_t pad, Py_ssize_t first, Py_ssize_t stop) noexcept
@cython.locals(k=Py_ssize_t)
cdef void _advance_ramps(SlipDetector slips, Py_ssize_t pad, Py_ssize_t axis) noexcept
@cython.locals(work='double[::1]', parts=Py_ssize_t, k=Py_ssize_t)
cdef void _learn_creep(SlipDetector slips, Py_ssize_t pad, Py_ssize_t axis) noexcept
@cython.locals(work='double[::1]', k=Py_ssize_t, best=Py_ssize_t, axis=Py_ssize_t, slow=Py_ssize_t,
               medium=Py_ssize_t, fast=Py_ssize_t)
cdef void _sum_ratios(SlipDetector slips, Py_ssize_t pad) noexcept
@cython.locals(limit=double, noise=double, x=double, y=double, far=bint)
cdef bint _is_far(SlipDetector slips, Py_ssize_t pad, Py_ssize_t k, Py_ssize_t j) noexcept
@cython.locals(since_s=double, j=Py_ssize_t)
cdef bint _has_left(SlipDetector slips, Py_ssize_t pad, Py_ssize_t k) noexcept
cdef double _log_ratio(double[::1] work, Py_ssize_t k, double speed_variance) noexcept
@cython.locals(axis=Py_ssize_t, k=Py_ssize_t)
cdef void _start_slip(SlipDetector slips, Py_ssize_t pad) noexcept
cdef void _detect_rest(SlipDetector slips, Py_ssize_t pad) noexcept
@cython.locals(label=Py_ssize_t)
cdef void _classify(SlipDetector slips, Py_ssize_t pad) noexcept
