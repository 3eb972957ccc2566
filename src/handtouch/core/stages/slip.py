"""Slip and lift-off: a sequential test on the position of every contact, with a bounded rate of false alarms.

While a contact sticks, its centroid is modelled, along each axis of the pad, as a slowly drifting level, plus
a part proportional to the contact pressure (the fingertip rolls and flattens; measured by the total current,
which unlike the force doesn't jump or saturate at the end of its range), plus a smooth tremor of some hertz
(Matern 3/2), plus channel noise: a Kalman filter whose innovations are white. Sliding adds a ramp from its
onset on. The response of the innovations to ramps that began at several past times is propagated (A. Willsky,
H. Jones 1976), which gives the likelihood ratio of each onset; the speed is integrated out over scales from 1
to 100 mm/s. The sum over onsets is the Shiryaev-Roberts statistic R: under the model, R less the number of
samples is a martingale of mean 0, so the mean number of samples to a false alarm is at least the threshold on
R.

Real hands deviate from this model: soft contacts creep and roll at about half a millimetre a second, and
tremor that fits the model from sample to sample may not over a tenth of a second. So every ramp is tested
against one of random speed, whose variance is learnt for every onset age from what ramps of that age met
while the contact stuck, starting at a prior: gradient ascent on the likelihood.

Chatter moves a contact as fast as a slow slip, and returns. Only onsets count since which the contact moved
farther than chatter does, or farther than at its speed. For alarms and odds, it must also be as far from all
its positions in the period of chatter before that onset; ln R itself, evidence beside that of joints, counts
the others too.

Public names: `SlipStage`, `SLIP_SLICES`, `SLIP_COUNT`, `SLIP_PARAMETERS`, `MOTION_CLASSES`.
"""

from __future__ import annotations

import math

from handtouch.core.stages.solve import VALUE_COUNT, VALUE_SLICES

SLIP_PARAMETERS = (
    "period_s", "log_threshold", "onset_stride", "log_creep_variance", "level_drift_variance",
    "log_tremor_variance", "min_log_tremor_variance", "max_log_tremor_variance", "tremor_rate",
    "tremor_time_constant_s", "creep_time_constant_s", "coupling_variance", "coupling_drift_variance",
    "chatter_m", "chatter_speed", "chatter_time_s", "sway_m",
)  # fmt: skip
"""Names of the parameters, in order; `handtouch.core.slip.GripModel` explains them."""
_PERIOD, _LOG_THRESHOLD, _STRIDE, _CREEP_START, _LEVEL_DRIFT, _TREMOR_START, _TREMOR_MIN = 0, 1, 2, 3, 4, 5, 6
_TREMOR_MAX, _TREMOR_RATE, _TREMOR_TIME, _CREEP_TIME, _COUPLING, _COUPLING_DRIFT = 7, 8, 9, 10, 11, 12
_CHATTER, _CHATTER_SPEED, _CHATTER_TIME, _SWAY = 13, 14, 15, 16

_ONSETS, _RECENT, _OLDER_STRIDE = (
    33,
    12,
    4,
)  # onset hypotheses; the latest of them; every fourth of older ones
_RAMP = 8 * _ONSETS  # of an axis: four states, and these
_SCORE, _INFORMATION, _START, _START_NOISE = 4 * _ONSETS, 5 * _ONSETS, 6 * _ONSETS, 7 * _ONSETS

# a pad's row of the state
_LABEL, _LOG_ODDS, _SLIPPING, _SLIPS, _SAMPLES, _AGE = 0, 1, 2, 3, 4, 5
_POSITION, _VELOCITY, _VAR_PP, _VAR_PV, _VAR_VV = 6, 8, 10, 12, 14
_FORCE, _RATE, _RATE_STD, _FIRM_CURRENT, _PEAK_CURRENT = 16, 17, 18, 19, 20
_SLIP_START, _REST, _LOG_RATIO, _ONSET_AGE, _SLIP_VELOCITY = 21, 23, 24, 25, 26
_FIRST_PRESS, _LAST_PRESS, _BEFORE_PRESS, _PRESS_NOISE, _TESTED, _UNTIL_ONSET, _ONSET_NUMBER, _LEARNING = (
    28, 29, 30, 31, 32, 33, 34, 35,
)  # fmt: skip
_TREMOR, _GRIP_TREMOR, _LEVEL, _COVARIANCE, _AGES = 36, 38, 40, 48, 68
_RAMPS = _AGES + _ONSETS
_CREEP = _RAMPS + 2 * _RAMP
_GRIP_CREEP = _CREEP + 2 * _ONSETS
_LAST = _GRIP_CREEP + 2 * _ONSETS
_LAST_NOISE = _LAST + 2
_COUNT = _LAST_NOISE + 1
SLIP_COUNT = _COUNT
SLIP_WORK = 7 * _ONSETS
SLIP_SLICES = {
    "label": slice(_LABEL, _LABEL + 1),  # index of MOTION_CLASSES
    "log_odds": slice(_LOG_ODDS, _LOG_ODDS + 1),  # ln of the odds of slip
    "slipping": slice(_SLIPPING, _SLIPPING + 1),  # 1 while the centroid moves
    "slips": slice(_SLIPS, _SLIPS + 1),  # of this contact so far
    "samples": slice(_SAMPLES, _SAMPLES + 1),
    "age_s": slice(_AGE, _AGE + 1),  # from its first sample to its last
    "position_m": slice(_POSITION, _POSITION + 2),  # on the pad, filtered
    "velocity_m_per_s": slice(_VELOCITY, _VELOCITY + 2),
    "velocity_variance": slice(_VAR_VV, _VAR_VV + 2),
    "force_n": slice(_FORCE, _FORCE + 1),  # smoothed
    "force_rate_n_per_s": slice(_RATE, _RATE + 1),
    "slip_start_m": slice(_SLIP_START, _SLIP_START + 2),  # position at the onset
    "log_ratio": slice(_LOG_RATIO, _LOG_RATIO + 1),  # ln R
    "onset_age_s": slice(_ONSET_AGE, _ONSET_AGE + 1),  # of the likeliest onset, where slip is likely
    "slip_velocity_m_per_s": slice(_SLIP_VELOCITY, _SLIP_VELOCITY + 2),  # since that onset
    "log_tremor_variance": slice(_TREMOR, _TREMOR + 2),  # as learnt
    "onset_ages_s": slice(_AGES, _AGES + _ONSETS),  # 0: unused
    "information_x": slice(_RAMPS + _INFORMATION, _RAMPS + _INFORMATION + _ONSETS),  # of a ramp of 1 m/s
    "information_y": slice(_RAMPS + _RAMP + _INFORMATION, _RAMPS + _RAMP + _INFORMATION + _ONSETS),
}
"""Parts of a pad's row that others may read."""
MOTION_CLASSES = ("sticking", "incipient", "sliding", "rolling", "lift-off")
"""Classes of motion; rolling isn't detected here, as that needs joint states."""
_STICKING, _INCIPIENT, _SLIDING, _LIFT_OFF = 0, 1, 2, 4

_VALUES, _PAD_M, _COVARIANCE_M2, _PAD_NOISE, _FORCE_N = (
    VALUE_COUNT,
    VALUE_SLICES["pad_m"].start,
    VALUE_SLICES["covariance_m2"].start,
    VALUE_SLICES["pad_noise_m2"].start,
    VALUE_SLICES["force_n"].start,
)
_NO_SLIP, _INFINITY = -math.inf, math.inf
_MIN_VARIANCE_M2 = 1e-14
_FIRM_CURRENT_FACTOR = 10.0  # current of a firm contact over that at its begin
_START_VELOCITY_VARIANCE = 1e-4
_ACCELERATION_DENSITY = 0.01 * 0.01  # of the centroid, spectral density [m^2/s^3]
_FORCE_RATE_TIME_S = 0.02  # of smoothing
_LIFT_OFF_HORIZON_S = 0.04  # lift-off if the force, at its present rate, vanishes within this time
_SLIP_RATE_HZ = 0.05  # prior rate of slips of a contact
_UNLOADING_FACTOR = 5.0  # of that rate, while the force falls as fast as it has ever done
_ODDS_DECAY_S = 0.05  # time constant in which outdated evidence of slip decays
_MIN_REST_S = 0.06  # of a centroid, before it counts as sticking again
_MAX_REST_SPEED = 0.5e-3
_START_LEVEL_VARIANCE = 50e-6 * 50e-6  # of the level from its first sample
_PRESS_NOISE_GAIN = 0.02  # weight of a sample in the estimate of the current's noise
_MIN_LEARNING_S = 0.3
_DECREASE_FACTOR = 0.8  # decreases of the creep are learnt more slowly: tremor comes in bursts
_MIN_LOG_CREEP, _MAX_LOG_CREEP = 2.0 * math.log(20e-6), 0.0  # ln of a variance [m^2/s^2]
_MAX_SQUARED_INNOVATION = 6.0  # of an innovation squared: slip must not be learnt as tremor
_NOISE_SIGMA = 3.0  # of the difference of two positions: 1 in 370; from 2 on, one more sample of delay
_MIN_ONSET_LOG_ODDS = 3.0  # ln R above which onset and velocity are computed
# variances of the prior of each velocity component
_SLOW, _MEDIUM, _FAST = 1e-3 * 1e-3, 5e-3 * 5e-3, 30e-3 * 30e-3


class SlipStage:
    """Slip test of the contacts of n pads; arrays are flat, with a row a pad.

    parameters: as SLIP_PARAMETERS. work: (SLIP_WORK,). state: (n SLIP_COUNT,), the result, laid out as
    SLIP_SLICES; contact_id: (n,) of the contacts that `state` is about, 0 for none; sample_ns: (n,) of their
    last sample that counted. Of the tick: values (n VALUE_COUNT,), total_a (n,), times (n,) of the samples
    [ns], ids (n,) of the contacts.
    """

    def __init__(
        self,
        parameters: memoryview[float],
        work: memoryview[float],
        state: memoryview[float],
        contact_id: memoryview[int],
        sample_ns: memoryview[int],
        values: memoryview[float],
        total_a: memoryview[float],
        times: memoryview[int],
        ids: memoryview[int],
    ) -> None:
        self.parameters, self.work, self.state = parameters, work, state
        self.contact_id, self.sample_ns = contact_id, sample_ns
        self.values, self.total_a, self.times, self.ids = values, total_a, times, ids
        self.x = self.y = self.noise_x = self.noise_y = self.press = self.dt_s = 0.0
        self.f11 = self.f12 = self.f21 = self.f22 = 0.0  # tremor and its speed over dt
        self.q11 = self.q12 = self.q22 = 0.0  # what they gain, relative to the tremor's variance
        self.innovation = self.variance = 0.0
        self.alarm_ratio = _NO_SLIP  # ln R of onsets that chatter can't explain
        self.gain0 = self.gain1 = self.gain2 = self.gain3 = 0.0

    def detect_slips(self, pads: memoryview[int]) -> None:
        """Process the newest samples of the contacts on these pads."""
        for k in range(len(pads)):
            process_sample(self, pads[k])


def process_sample(stage: SlipStage, pad: int) -> None:
    """Process a contact's newest sample; one without position only ages the evidence."""
    state, row, values = stage.state, pad * _COUNT, pad * _VALUES
    _read_sample(stage, pad)
    usable = -_INFINITY < stage.x + stage.y + stage.noise_x + stage.noise_y + stage.press < _INFINITY
    force = stage.values[values + _FORCE_N]
    known = -_INFINITY < force < _INFINITY
    stage.dt_s, stage.alarm_ratio = 0.0, _NO_SLIP
    if stage.contact_id[pad] != stage.ids[pad]:
        if not usable:
            return
        stage.contact_id[pad], stage.sample_ns[pad] = stage.ids[pad], stage.times[pad]
        peak = state[row + _PEAK_CURRENT]
        state[row + _FIRM_CURRENT] = max(peak, _FIRM_CURRENT_FACTOR * stage.total_a[pad])
        stage.press = stage.total_a[pad] / max(state[row + _FIRM_CURRENT], 1e-12)
        _begin_contact(stage, row, force if known else 0.0)
        _start_test(stage, row, False)
    elif usable and stage.times[pad] > stage.sample_ns[pad]:
        stage.dt_s = (stage.times[pad] - stage.sample_ns[pad]) * 1e-9
        stage.sample_ns[pad] = stage.times[pad]
        state[row + _AGE] += stage.dt_s
        _track_motion(stage, row, force if known else state[row + _FORCE])
        _test_slip(stage, row)
        if stage.alarm_ratio > stage.parameters[_LOG_THRESHOLD] and state[row + _SLIPPING] == 0.0:
            _start_slip(stage, row)
        if state[row + _SLIPPING] != 0.0:
            _detect_rest(stage, row)
    state[row + _SAMPLES] += 1.0
    state[row + _PEAK_CURRENT] = max(state[row + _PEAK_CURRENT], stage.total_a[pad])
    _classify(stage, row)


def _read_sample(stage: SlipStage, pad: int) -> None:
    """Read position, its noise, and the current relative to that of a firm contact."""
    v, first = stage.values, pad * _VALUES
    stage.x, stage.y = v[first + _PAD_M], v[first + _PAD_M + 1]
    stage.noise_x, stage.noise_y = v[first + _PAD_NOISE], v[first + _PAD_NOISE + 2]
    stage.press = stage.total_a[pad] / max(stage.state[pad * _COUNT + _FIRM_CURRENT], 1e-12)
    if not stage.noise_x > _MIN_VARIANCE_M2 or not stage.noise_y > _MIN_VARIANCE_M2:
        c = first + _COVARIANCE_M2  # too light for a noise estimate
        whole = (v[c] + v[c + 4] + v[c + 8]) / 2.0
        if whole < _MIN_VARIANCE_M2:
            whole = _MIN_VARIANCE_M2
        if not stage.noise_x > _MIN_VARIANCE_M2:
            stage.noise_x = whole
        if not stage.noise_y > _MIN_VARIANCE_M2:
            stage.noise_y = whole


def _begin_contact(stage: SlipStage, row: int, force: float) -> None:
    """Reset what is known of the contact before."""
    s = stage.state
    for k in range(2):
        s[row + _VELOCITY + k] = s[row + _VAR_PV + k] = s[row + _SLIP_VELOCITY + k] = 0.0
        s[row + _VAR_VV + k] = _START_VELOCITY_VARIANCE
    s[row + _POSITION], s[row + _POSITION + 1] = stage.x, stage.y
    s[row + _VAR_PP], s[row + _VAR_PP + 1] = stage.noise_x, stage.noise_y
    s[row + _FORCE], s[row + _RATE], s[row + _RATE_STD] = force, 0.0, abs(force)
    s[row + _SAMPLES] = s[row + _AGE] = s[row + _SLIPPING] = s[row + _SLIPS] = s[row + _REST] = 0.0
    s[row + _LOG_ODDS] = _NO_SLIP


def _start_test(stage: SlipStage, row: int, kept: bool) -> None:
    """Start the slip test; `kept`: the contact sticks again after a slip, what is learnt of it is kept."""
    s, p = stage.state, stage.parameters
    rate = p[_TREMOR_RATE]
    for axis in range(2):
        tremor = s[row + _GRIP_TREMOR + axis] if kept else p[_TREMOR_START]
        s[row + _TREMOR + axis] = tremor
        variance, level, c = math.exp(tremor), row + _LEVEL + 4 * axis, row + _COVARIANCE + 10 * axis
        for k in range(4):
            s[level + k] = 0.0
        for k in range(10):
            s[c + k] = 0.0
        s[level] = stage.x if axis == 0 else stage.y
        s[c] = _START_LEVEL_VARIANCE + (stage.noise_x if axis == 0 else stage.noise_y)
        s[c + 4], s[c + 7], s[c + 9] = variance, variance * rate * rate, p[_COUPLING]
        for k in range(_ONSETS):
            creep = axis * _ONSETS + k
            s[row + _CREEP + creep] = s[row + _GRIP_CREEP + creep] if kept else p[_CREEP_START]
    for k in range(_ONSETS):
        s[row + _AGES + k] = 0.0
    for k in range(2 * _RAMP):
        s[row + _RAMPS + k] = 0.0
    if not kept:
        s[row + _PRESS_NOISE] = s[row + _LEARNING] = 0.0
    s[row + _FIRST_PRESS] = s[row + _LAST_PRESS] = s[row + _BEFORE_PRESS] = stage.press
    _keep_last(stage, row)
    s[row + _TESTED] = s[row + _UNTIL_ONSET] = s[row + _ONSET_NUMBER] = s[row + _ONSET_AGE] = 0.0
    s[row + _LOG_RATIO] = stage.alarm_ratio = _NO_SLIP


def _track_motion(stage: SlipStage, row: int, force: float) -> None:
    """Filter position (constant velocity with random acceleration) and the force's rate."""
    s, dt = stage.state, stage.dt_s
    density = _ACCELERATION_DENSITY * dt
    for axis in range(2):
        pp, pv, vv = s[row + _VAR_PP + axis], s[row + _VAR_PV + axis], s[row + _VAR_VV + axis]
        pp += dt * (2.0 * pv + dt * (vv + density / 3.0))
        pv += dt * (vv + density / 2.0)
        vv += density
        at = s[row + _POSITION + axis] + dt * s[row + _VELOCITY + axis]
        total = pp + (stage.noise_x if axis == 0 else stage.noise_y)
        off = (stage.x if axis == 0 else stage.y) - at
        by_position, by_velocity = pp / total, pv / total
        s[row + _POSITION + axis] = at + by_position * off
        s[row + _VELOCITY + axis] += by_velocity * off
        s[row + _VAR_VV + axis] = vv - by_velocity * pv
        s[row + _VAR_PV + axis] = pv - by_position * pv
        s[row + _VAR_PP + axis] = pp - by_position * pp
    part = 1.0 - math.exp(-dt / _FORCE_RATE_TIME_S)
    rate = (force - s[row + _FORCE]) / (dt + _FORCE_RATE_TIME_S * (1.0 - part))
    s[row + _FORCE] += part * (force - s[row + _FORCE])
    s[row + _RATE] += part * (rate - s[row + _RATE])
    slow, std = min(dt, 1.0), s[row + _RATE_STD]
    s[row + _RATE_STD] = math.sqrt((1.0 - slow) * std * std + slow * s[row + _RATE] * s[row + _RATE] + 1e-12)


def _test_slip(stage: SlipStage, row: int) -> None:
    """Run one step of the test and compute ln R."""
    s = stage.state
    press, before = s[row + _LAST_PRESS], s[row + _BEFORE_PRESS]
    bend = stage.press - 2.0 * press + before  # tremor is far slower than noise
    part = max(1.0 / (1.0 + s[row + _TESTED]), _PRESS_NOISE_GAIN)
    s[row + _PRESS_NOISE] += part * (bend * bend / 6.0 - s[row + _PRESS_NOISE])
    s[row + _BEFORE_PRESS], s[row + _LAST_PRESS] = press, stage.press
    _set_transition(stage)
    _advance_onsets(stage, row)
    s[row + _TESTED] += 1.0
    s[row + _LEARNING] += stage.dt_s
    for axis in range(2):
        _filter_axis(stage, row, axis)
        _advance_ramps(stage, row, row + _RAMPS + axis * _RAMP)
        _learn_creep(stage, row, axis)
    _sum_ratios(stage, row)
    _keep_last(stage, row)


def _keep_last(stage: SlipStage, row: int) -> None:
    """Keep the position of this sample, and the larger variance of its noise."""
    s = stage.state
    s[row + _LAST], s[row + _LAST + 1] = stage.x, stage.y
    s[row + _LAST_NOISE] = max(stage.noise_x, stage.noise_y)


def _set_transition(stage: SlipStage) -> None:
    """Set how tremor and its speed pass from the last sample to this one."""
    dt, rate = stage.dt_s, stage.parameters[_TREMOR_RATE]
    passed = rate * dt
    decay, squared = math.exp(-passed), rate * rate
    stage.f11, stage.f12 = decay * (1.0 + passed), decay * dt
    stage.f21, stage.f22 = -decay * rate * passed, decay * (1.0 - passed)
    stage.q11 = 1.0 - (stage.f11 * stage.f11 + stage.f12 * stage.f12 * squared)
    stage.q12 = -(stage.f11 * stage.f21 + stage.f12 * stage.f22 * squared)
    stage.q22 = squared - (stage.f21 * stage.f21 + stage.f22 * stage.f22 * squared)


def _filter_axis(stage: SlipStage, row: int, axis: int) -> None:
    """Run one step of an axis' Kalman filter: level, tremor, its speed, coupling to the pressure."""
    s, p, dt = stage.state, stage.parameters, stage.dt_s
    f11, f12, f21, f22 = stage.f11, stage.f12, stage.f21, stage.f22
    first, c = row + _LEVEL + 4 * axis, row + _COVARIANCE + 10 * axis
    log_tremor = s[row + _TREMOR + axis]
    tremor = math.exp(log_tremor)
    level, coupling = s[first], s[first + 3]
    shake, speed = f11 * s[first + 1] + f12 * s[first + 2], f21 * s[first + 1] + f22 * s[first + 2]
    c01, c02 = f11 * s[c + 1] + f12 * s[c + 2], f21 * s[c + 1] + f22 * s[c + 2]
    c11 = f11 * f11 * s[c + 4] + 2.0 * f11 * f12 * s[c + 5] + f12 * f12 * s[c + 7] + tremor * stage.q11
    c12 = f11 * f21 * s[c + 4] + (f11 * f22 + f12 * f21) * s[c + 5] + f12 * f22 * s[c + 7]
    c12 += tremor * stage.q12
    c22 = f21 * f21 * s[c + 4] + 2.0 * f21 * f22 * s[c + 5] + f22 * f22 * s[c + 7] + tremor * stage.q22
    c13, c23 = f11 * s[c + 6] + f12 * s[c + 8], f21 * s[c + 6] + f22 * s[c + 8]
    c00, c03, c33 = s[c] + p[_LEVEL_DRIFT] * dt, s[c + 3], s[c + 9] + p[_COUPLING_DRIFT] * dt
    pressed = stage.press - s[row + _FIRST_PRESS]
    a0, a1 = c00 + c01 + pressed * c03, c01 + c11 + pressed * c13
    a2, a3 = c02 + c12 + pressed * c23, c03 + c13 + pressed * c33
    variance = a0 + a1 + pressed * a3 + (stage.noise_x if axis == 0 else stage.noise_y)
    variance += (coupling * coupling + c33) * s[row + _PRESS_NOISE]
    innovation = (stage.x if axis == 0 else stage.y) - (level + shake + pressed * coupling)
    g0, g1, g2, g3 = a0 / variance, a1 / variance, a2 / variance, a3 / variance
    s[first], s[first + 1] = level + g0 * innovation, shake + g1 * innovation
    s[first + 2], s[first + 3] = speed + g2 * innovation, coupling + g3 * innovation
    s[c], s[c + 1], s[c + 2], s[c + 3] = c00 - g0 * a0, c01 - g0 * a1, c02 - g0 * a2, c03 - g0 * a3
    s[c + 4], s[c + 5], s[c + 6] = c11 - g1 * a1, c12 - g1 * a2, c13 - g1 * a3
    s[c + 7], s[c + 8], s[c + 9] = c22 - g2 * a2, c23 - g2 * a3, c33 - g3 * a3
    excess = min(innovation * innovation / variance, _MAX_SQUARED_INNOVATION) - 1.0
    log_tremor += excess * (dt / p[_TREMOR_TIME])
    s[row + _TREMOR + axis] = min(max(log_tremor, p[_TREMOR_MIN]), p[_TREMOR_MAX])
    stage.innovation, stage.variance = innovation, variance
    stage.gain0, stage.gain1, stage.gain2, stage.gain3 = g0, g1, g2, g3


def _advance_onsets(stage: SlipStage, row: int) -> None:
    """Age the onset hypotheses and open a new one periodically; the others shift, slots are sorted by age."""
    s, ages = stage.state, row + _AGES
    for k in range(_ONSETS):
        if s[ages + k] > 0.0:
            s[ages + k] += stage.dt_s
    if s[row + _UNTIL_ONSET] > 0.0:
        s[row + _UNTIL_ONSET] -= 1.0
        return
    s[row + _UNTIL_ONSET] = stage.parameters[_STRIDE] - 1.0
    s[row + _ONSET_NUMBER] += 1.0
    if s[row + _ONSET_NUMBER] >= _OLDER_STRIDE:  # the others between two strides are dropped
        s[row + _ONSET_NUMBER] = 0.0
        _shift_onsets(stage, row, _RECENT, _ONSETS)
    _shift_onsets(stage, row, 1, _RECENT)
    s[ages] = stage.dt_s  # it began with the previous sample
    for axis in range(2):
        for k in range(6):
            s[row + _RAMPS + axis * _RAMP + k * _ONSETS] = 0.0
        s[row + _RAMPS + axis * _RAMP + _START] = s[row + _LAST + axis]
    s[row + _RAMPS + _START_NOISE] = s[row + _LAST_NOISE]


def _shift_onsets(stage: SlipStage, row: int, first: int, stop: int) -> None:
    """Give the slots first .. stop - 1 what is in the slots before each."""
    s = stage.state
    for k in range(stop - first):
        s[row + _AGES + stop - 1 - k] = s[row + _AGES + stop - 2 - k]
    for block in range(2 * _RAMP // _ONSETS):
        slots = row + _RAMPS + block * _ONSETS
        for k in range(stop - first):
            s[slots + stop - 1 - k] = s[slots + stop - 2 - k]


def _advance_ramps(stage: SlipStage, row: int, ramps: int) -> None:
    """Update an axis' responses of the filter to ramps of 1 m/s, and the sums of f nu / S and f^2 / S."""
    s, ages = stage.state, row + _AGES
    f11, f12, f21, f22 = stage.f11, stage.f12, stage.f21, stage.f22
    g0, g1, g2, g3 = stage.gain0, stage.gain1, stage.gain2, stage.gain3
    pressed = stage.press - s[row + _FIRST_PRESS]
    precision, innovation = 1.0 / stage.variance, stage.innovation
    for k in range(_ONSETS):
        r = ramps + k
        shake = f11 * s[r + _ONSETS] + f12 * s[r + 2 * _ONSETS]
        speed = f21 * s[r + _ONSETS] + f22 * s[r + 2 * _ONSETS]
        f = s[ages + k] - (s[r] + shake + pressed * s[r + 3 * _ONSETS])
        s[r] += g0 * f
        s[r + _ONSETS] = shake + g1 * f
        s[r + 2 * _ONSETS] = speed + g2 * f
        s[r + 3 * _ONSETS] += g3 * f
        weighted = f * precision
        s[r + _SCORE] += weighted * innovation
        s[r + _INFORMATION] += weighted * f


def _learn_creep(stage: SlipStage, row: int, axis: int) -> None:
    """Learn the creep variance by onset age; set the part of the ramps' evidence that counts.

    A ramp of information I, while the contact creeps at speeds of variance v, meets 1 + I v times its own.
    """
    s, p, work = stage.state, stage.parameters, stage.work
    ramps, creeps, parts = row + _RAMPS + axis * _RAMP, row + _CREEP + axis * _ONSETS, 2 * axis * _ONSETS
    pace = stage.dt_s / min(max(s[row + _LEARNING], _MIN_LEARNING_S), p[_CREEP_TIME])
    for k in range(_ONSETS):
        score, information = s[ramps + _SCORE + k], s[ramps + _INFORMATION + k]
        if s[row + _AGES + k] > 0.0:
            more = 1.0 + information * math.exp(s[creeps + k])
            met = score * score / max(information, 1e-300)
            slope = (min(met / more, _MAX_SQUARED_INNOVATION) - 1.0) * (1.0 - 1.0 / more)
            if slope < 0.0:
                slope *= _DECREASE_FACTOR
            s[creeps + k] = min(max(s[creeps + k] + slope * pace, _MIN_LOG_CREEP), _MAX_LOG_CREEP)
            part = 1.0 / (more * math.sqrt(math.sqrt(more)))  # allows for tails that deviate from the model
            work[parts + k] = part * information
            work[parts + _ONSETS + k] = part * score * (part * score)


def _sum_ratios(stage: SlipStage, row: int) -> None:
    """Compute ln R from the onsets' likelihood ratios, each weighted by the samples it stands for; and that
    of the onsets that chatter can't explain by its return."""
    s, work = stage.state, stage.work
    most = _NO_SLIP
    for k in range(_ONSETS):
        if s[row + _AGES + k] > 0.0:
            slow, medium, fast = 4 * _ONSETS + k, 5 * _ONSETS + k, 6 * _ONSETS + k
            work[slow] = _log_ratio(work, k, _SLOW)
            work[medium] = _log_ratio(work, k, _MEDIUM)
            work[fast] = _log_ratio(work, k, _FAST)
            most = max(most, work[slow], work[medium], work[fast])
    total, left, best, largest = 0.0, 0.0, 0, -1.0
    for k in range(_ONSETS):
        if s[row + _AGES + k] > 0.0 and _is_far(stage, row, k, k):
            share = math.exp(work[4 * _ONSETS + k] - most)
            share += math.exp(work[5 * _ONSETS + k] - most)
            share += math.exp(work[6 * _ONSETS + k] - most)
            share *= (1.0 if k < _RECENT else 1.0 * _OLDER_STRIDE) / 3.0
            total += share
            if _has_left(stage, row, k):
                left += share
            if share > largest:
                largest, best = share, k
    s[row + _LOG_RATIO] = most + math.log(max(total, 1e-300) * stage.parameters[_STRIDE])
    stage.alarm_ratio = most + math.log(max(left, 1e-300) * stage.parameters[_STRIDE])
    if s[row + _LOG_RATIO] > _MIN_ONSET_LOG_ODDS:
        s[row + _ONSET_AGE] = s[row + _AGES + best]
        for axis in range(2):
            ramps = row + _RAMPS + axis * _RAMP + best
            s[row + _SLIP_VELOCITY + axis] = s[ramps + _SCORE] / max(s[ramps + _INFORMATION], 1e-12)


def _is_far(stage: SlipStage, row: int, k: int, j: int) -> bool:
    """Return whether the contact is farther from its position at onset j than chatter moves it since k, by
    more than noise does."""
    s, p = stage.state, stage.parameters
    limit = min(p[_CHATTER], p[_SWAY] + p[_CHATTER_SPEED] * s[row + _AGES + k])
    noise = max(stage.noise_x, stage.noise_y) + s[row + _RAMPS + _START_NOISE + j]
    x = stage.x - s[row + _RAMPS + _START + j]
    y = stage.y - s[row + _RAMPS + _RAMP + _START + j]
    return x * x + y * y > limit * limit + _NOISE_SIGMA * _NOISE_SIGMA * noise


def _has_left(stage: SlipStage, row: int, k: int) -> bool:
    """Return whether the contact is as far from its positions in the time before onset k in which chatter
    returns, as known from older onsets."""
    ages, since_s = row + _AGES, stage.state[row + _AGES + k] + stage.parameters[_CHATTER_TIME]
    for j in range(k + 1, _ONSETS):
        if stage.state[ages + j] == 0.0 or stage.state[ages + j] > since_s:
            return True
        if not _is_far(stage, row, k, j):
            return False
    return True


def _log_ratio(work: memoryview[float], k: int, speed_variance: float) -> float:
    """Return ln of the likelihood ratio of an onset at velocities of this variance along each axis."""
    x = work[k] * speed_variance + 1.0
    y = work[2 * _ONSETS + k] * speed_variance + 1.0
    quotient = (work[_ONSETS + k] / x + work[3 * _ONSETS + k] / y) * speed_variance
    return 0.5 * (quotient - math.log(x * y))


def _start_slip(stage: SlipStage, row: int) -> None:
    """Mark the contact as slipping since its likeliest onset: what is learnt now doesn't describe a grip."""
    s = stage.state
    s[row + _SLIPPING] = 1.0
    s[row + _SLIPS] += 1.0
    s[row + _REST] = 0.0
    for axis in range(2):
        at = stage.x if axis == 0 else stage.y
        s[row + _SLIP_START + axis] = at - s[row + _SLIP_VELOCITY + axis] * s[row + _ONSET_AGE]
        s[row + _GRIP_TREMOR + axis] = s[row + _TREMOR + axis]
    for k in range(2 * _ONSETS):
        s[row + _GRIP_CREEP + k] = s[row + _CREEP + k]


def _detect_rest(stage: SlipStage, row: int) -> None:
    """Restart the test of a contact that slipped and has come to rest."""
    s = stage.state
    vx, vy = s[row + _VELOCITY], s[row + _VELOCITY + 1]
    limit = max(2.0 * math.sqrt(s[row + _VAR_VV] + s[row + _VAR_VV + 1]), _MAX_REST_SPEED)
    s[row + _REST] = s[row + _REST] + stage.dt_s if math.sqrt(vx * vx + vy * vy) < limit else 0.0
    if s[row + _REST] > _MIN_REST_S:
        s[row + _SLIPPING] = 0.0
        s[row + _LOG_ODDS] = _NO_SLIP
        _start_test(stage, row, True)


def _classify(stage: SlipStage, row: int) -> None:
    """Update ln of the odds of slip, R times the prior rate of slips at such forces, and the label.

    Recent evidence decays slowly, or a contact near the threshold would chatter.
    """
    s = stage.state
    falls = max(-s[row + _RATE], 0.0) / max(3.0 * s[row + _RATE_STD], 1e-9)
    hazard = _SLIP_RATE_HZ * (1.0 + (_UNLOADING_FACTOR - 1.0) * min(falls, 1.0)) * stage.parameters[_PERIOD]
    s[row + _LOG_ODDS] = max(
        stage.alarm_ratio + math.log(hazard), s[row + _LOG_ODDS] - stage.dt_s / _ODDS_DECAY_S
    )
    label = _SLIDING if s[row + _SLIPPING] != 0.0 else _INCIPIENT if s[row + _LOG_ODDS] > 0.0 else _STICKING
    if s[row + _FORCE] + (_LIFT_OFF_HORIZON_S + _FORCE_RATE_TIME_S) * s[row + _RATE] < 0.0:
        label = _LIFT_OFF
    s[row + _LABEL] = 1.0 * label
