cimport cython
from libc cimport math

cdef Py_ssize_t _PERIOD, _LOG_THRESHOLD, _STRIDE, _CREEP_START, _LEVEL_DRIFT, _TREMOR_START, _TREMOR_MIN
cdef Py_ssize_t _TREMOR_MAX, _TREMOR_RATE, _TREMOR_TIME, _CREEP_TIME, _COUPLING, _COUPLING_DRIFT
cdef Py_ssize_t _CHATTER, _CHATTER_SPEED, _CHATTER_TIME, _SWAY, _START, _START_NOISE, _LAST, _LAST_NOISE
cdef Py_ssize_t _ONSETS, _RECENT, _OLDER_STRIDE, _RAMP, _SCORE, _INFORMATION
cdef Py_ssize_t _LABEL, _LOG_ODDS, _SLIPPING, _SLIPS, _SAMPLES, _AGE
cdef Py_ssize_t _POSITION, _VELOCITY, _VAR_PP, _VAR_PV, _VAR_VV
cdef Py_ssize_t _FORCE, _RATE, _RATE_STD, _FIRM_CURRENT, _PEAK_CURRENT
cdef Py_ssize_t _SLIP_START, _REST, _LOG_RATIO, _ONSET_AGE, _SLIP_VELOCITY
cdef Py_ssize_t _FIRST_PRESS, _LAST_PRESS, _BEFORE_PRESS, _PRESS_NOISE, _TESTED, _UNTIL_ONSET, _ONSET_NUMBER
cdef Py_ssize_t _LEARNING, _TREMOR, _GRIP_TREMOR, _LEVEL, _COVARIANCE, _AGES, _RAMPS, _CREEP, _GRIP_CREEP
cdef Py_ssize_t _COUNT, _VALUES, _PAD_M, _COVARIANCE_M2, _PAD_NOISE, _FORCE_N
cdef Py_ssize_t _STICKING, _INCIPIENT, _SLIDING, _LIFT_OFF
cdef double _NO_SLIP, _INFINITY, _MIN_VARIANCE_M2, _FIRM_CURRENT_FACTOR, _START_VELOCITY_VARIANCE
cdef double _ACCELERATION_DENSITY, _FORCE_RATE_TIME_S, _LIFT_OFF_HORIZON_S, _SLIP_RATE_HZ, _UNLOADING_FACTOR
cdef double _ODDS_DECAY_S, _MIN_REST_S, _MAX_REST_SPEED, _START_LEVEL_VARIANCE, _PRESS_NOISE_GAIN
cdef double _MIN_LEARNING_S, _DECREASE_FACTOR, _MIN_LOG_CREEP, _MAX_LOG_CREEP, _MAX_SQUARED_INNOVATION
cdef double _MIN_ONSET_LOG_ODDS, _NOISE_SIGMA, _SLOW, _MEDIUM, _FAST

cdef class SlipStage:
    cdef double[::1] parameters, work, state, values, total_a
    cdef unsigned int[::1] contact_id, ids
    cdef Py_ssize_t[::1] sample_ns, times
    cdef double x, y, noise_x, noise_y, press, dt_s
    cdef double f11, f12, f21, f22, q11, q12, q22, innovation, variance, gain0, gain1, gain2, gain3, alarm_ratio
    @cython.locals(k=Py_ssize_t)
    cpdef detect_slips(self, Py_ssize_t[::1] pads)

@cython.locals(row=Py_ssize_t, values=Py_ssize_t, state='double[::1]', usable=bint, known=bint)
cdef void process_sample(SlipStage stage, Py_ssize_t pad) noexcept
@cython.locals(v='double[::1]', first=Py_ssize_t, c=Py_ssize_t)
cdef void _read_sample(SlipStage stage, Py_ssize_t pad) noexcept
@cython.locals(s='double[::1]', k=Py_ssize_t)
cdef void _begin_contact(SlipStage stage, Py_ssize_t row, double force) noexcept
@cython.locals(s='double[::1]', p='double[::1]', axis=Py_ssize_t, k=Py_ssize_t, level=Py_ssize_t,
               c=Py_ssize_t, creep=Py_ssize_t)
cdef void _start_test(SlipStage stage, Py_ssize_t row, bint kept) noexcept
@cython.locals(s='double[::1]', axis=Py_ssize_t)
cdef void _track_motion(SlipStage stage, Py_ssize_t row, double force) noexcept
@cython.locals(s='double[::1]', axis=Py_ssize_t)
cdef void _test_slip(SlipStage stage, Py_ssize_t row) noexcept
@cython.locals(s='double[::1]')
cdef void _keep_last(SlipStage stage, Py_ssize_t row) noexcept
cdef void _set_transition(SlipStage stage) noexcept
@cython.locals(s='double[::1]', p='double[::1]', first=Py_ssize_t, c=Py_ssize_t)
cdef void _filter_axis(SlipStage stage, Py_ssize_t row, Py_ssize_t axis) noexcept
@cython.locals(s='double[::1]', ages=Py_ssize_t, k=Py_ssize_t, axis=Py_ssize_t)
cdef void _advance_onsets(SlipStage stage, Py_ssize_t row) noexcept
@cython.locals(s='double[::1]', slots=Py_ssize_t, k=Py_ssize_t, block=Py_ssize_t)
cdef void _shift_onsets(SlipStage stage, Py_ssize_t row, Py_ssize_t first, Py_ssize_t stop) noexcept
@cython.locals(s='double[::1]', ages=Py_ssize_t, k=Py_ssize_t, r=Py_ssize_t)
cdef void _advance_ramps(SlipStage stage, Py_ssize_t row, Py_ssize_t ramps) noexcept
@cython.locals(s='double[::1]', p='double[::1]', work='double[::1]', ramps=Py_ssize_t, creeps=Py_ssize_t,
               parts=Py_ssize_t, k=Py_ssize_t)
cdef void _learn_creep(SlipStage stage, Py_ssize_t row, Py_ssize_t axis) noexcept
@cython.locals(s='double[::1]', work='double[::1]', k=Py_ssize_t, best=Py_ssize_t, axis=Py_ssize_t,
               ramps=Py_ssize_t, slow=Py_ssize_t, medium=Py_ssize_t, fast=Py_ssize_t)
cdef void _sum_ratios(SlipStage stage, Py_ssize_t row) noexcept
@cython.locals(s='double[::1]', p='double[::1]', limit=double, noise=double, x=double, y=double)
cdef bint _is_far(SlipStage stage, Py_ssize_t row, Py_ssize_t k, Py_ssize_t j) noexcept
@cython.locals(ages=Py_ssize_t, since_s=double, j=Py_ssize_t)
cdef bint _has_left(SlipStage stage, Py_ssize_t row, Py_ssize_t k) noexcept
cdef double _log_ratio(double[::1] work, Py_ssize_t k, double speed_variance) noexcept
@cython.locals(s='double[::1]', axis=Py_ssize_t, k=Py_ssize_t)
cdef void _start_slip(SlipStage stage, Py_ssize_t row) noexcept
@cython.locals(s='double[::1]')
cdef void _detect_rest(SlipStage stage, Py_ssize_t row) noexcept
@cython.locals(s='double[::1]', label=Py_ssize_t)
cdef void _classify(SlipStage stage, Py_ssize_t row) noexcept
