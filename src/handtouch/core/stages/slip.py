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

Public names: `SlipDetector`, `GripModel`, `SLIP_SLICES`, `MOTION_CLASSES`, `FALSE_ALARM_S`,
`INFORMATION` (block of a row's ramps).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from handtouch.core.memory import RowArray, row_count, slices_of, view_memory, view_rows
from handtouch.core.stages.rows import SLIP_ONSETS, SLIP_RAMP_BLOCKS, SLIP_ROW, VALUE_ROW

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch.arrays import FloatArray
    from handtouch.core.state import TickState

    BoolArray = NDArray[np.bool_]
    IntArray = NDArray[np.intp]

FALSE_ALARM_S = 600.0
"""Lower bound on the mean time between two false alarms of one contact, under the grip model."""
_ONSET_PERIOD_S = 0.005
_ONSETS, _RECENT, _OLDER_STRIDE = SLIP_ONSETS, 12, 4
"""Onset hypotheses; the latest of them; of older ones each has so many times their period"""
_LEVEL, _TREMOR, _SPEED, _COUPLING, _SCORE, _INFORMATION, _START, _START_NOISE = range(8)
"""States of an axis: level, tremor, its speed, coupling to the pressure; their responses to a ramp of 1 m/s
from each onset, with its score, information, and the position at the onset with the variance of its noise"""
INFORMATION = _INFORMATION
_BLOCKS = SLIP_RAMP_BLOCKS
_LEVEL_LEVEL, _LEVEL_TREMOR, _LEVEL_SPEED, _LEVEL_COUPLING, _TREMOR_TREMOR = range(5)
_TREMOR_SPEED, _TREMOR_COUPLING, _SPEED_SPEED, _SPEED_COUPLING, _COUPLING_COUPLING = range(5, 10)
"""Covariances of the states, those of one with itself and those after it"""

SLIP_SLICES, SLIP_COUNT = slices_of(SLIP_ROW), row_count(SLIP_ROW)
"""Place of each value in a row, and their number"""
GRIP_ROW = np.dtype(
    [
        ("period_s", "<f8"),
        ("log_threshold", "<f8"),
        ("onset_stride", "<f8"),
        ("log_creep_variance", "<f8"),
        ("level_drift_variance", "<f8"),
        ("log_tremor_variance", "<f8"),
        ("min_log_tremor_variance", "<f8"),
        ("max_log_tremor_variance", "<f8"),
        ("tremor_rate", "<f8"),
        ("tremor_time_constant_s", "<f8"),
        ("creep_time_constant_s", "<f8"),
        ("coupling_variance", "<f8"),
        ("coupling_drift_variance", "<f8"),
        ("chatter_m", "<f8"),
        ("chatter_speed", "<f8"),
        ("chatter_time_s", "<f8"),
        ("sway_m", "<f8"),
    ]
)
"""Parameters of the stage, see `GripModel`"""
MOTION_CLASSES = ("sticking", "incipient", "sliding", "rolling", "lift-off")
"""Classes of motion; rolling isn't detected here, as that needs joint states."""
_STICKING, _INCIPIENT, _SLIDING, _LIFT_OFF = 0, 1, 2, 4

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


@dataclass(frozen=True, slots=True)
class GripModel:
    """Motion of a contact that doesn't slide."""

    creep_std_m_per_s: float = 0.7e-3
    """standard deviation of the speed at which soft contacts creep and roll; initial value, then learnt"""
    level_drift_std_m: float = 20e-6
    """standard deviation of the level's drift in one second"""
    tremor_std_m: float = 30e-6
    """standard deviation of the tremor; initial value, then learnt from the innovations"""
    tremor_std_range_m: tuple[float, float] = (2e-6, 300e-6)
    tremor_corner_hz: float = 5.0
    """corner frequency of the tremor"""
    tremor_time_constant_s: float = 1.0
    """time constant of learning the tremor"""
    creep_time_constant_s: float = 2.0
    """time constant of learning the creep; shorter at the start"""
    coupling_std_m: float = 1e-3
    """standard deviation of the centroid's displacement per relative current of a firm contact"""
    coupling_drift_per_s: float = 0.05
    """relative change of that coupling in one second"""
    chatter_m: float = 0.35e-3
    """displacement that bursts of chatter don't reach, as it returns: those of 9 Hz and 0.1 mm amplitude that
    bench_slip plays move a contact by 0.2 mm, noise and tremor of a light contact by some more. Chosen: on a
    hand of the tuning family, world `default`, double misses 3 mm/s (found after 0.23 s at 0.5 N) and finds
    10 mm/s 5 ms later, half finds it 15 to 20 ms sooner; bursts raise no alarm in 25 min (half: in 3 min)"""
    chatter_speed_m_per_s: float = 8e-3
    """speed that they don't reach: 2 pi 9 Hz 0.1 mm is 5.7 mm/s, and noise adds to it"""
    chatter_time_s: float = 0.12
    """time in which they return: one period of 9 Hz"""
    sway_m: float = 80e-6
    """displacement that counts at higher speeds"""

    def parameters(self, period_s: float, samples_per_false_alarm: float) -> RowArray:
        """Return the parameters of the stage (1,), as GRIP_ROW."""
        least, most = self.tremor_std_range_m
        named = {
            "period_s": period_s,
            "log_threshold": math.log(samples_per_false_alarm),
            "onset_stride": max(1, round(_ONSET_PERIOD_S / period_s)),
            "log_creep_variance": 2 * math.log(self.creep_std_m_per_s),
            "level_drift_variance": self.level_drift_std_m**2,
            "log_tremor_variance": 2 * math.log(self.tremor_std_m),
            "min_log_tremor_variance": 2 * math.log(least),
            "max_log_tremor_variance": 2 * math.log(most),
            "tremor_rate": 2 * math.pi * self.tremor_corner_hz,
            "tremor_time_constant_s": self.tremor_time_constant_s,
            "creep_time_constant_s": self.creep_time_constant_s,
            "coupling_variance": self.coupling_std_m**2,
            "coupling_drift_variance": (self.coupling_std_m * self.coupling_drift_per_s) ** 2,
            "chatter_m": self.chatter_m,
            "chatter_speed": self.chatter_speed_m_per_s,
            "chatter_time_s": self.chatter_time_s,
            "sway_m": self.sway_m,
        }
        row = np.zeros(1, GRIP_ROW)
        for name in named:
            row[name] = named[name]
        return view_rows(row, GRIP_ROW)


class SlipDetector:
    """Detects slip and lift-off of contacts on n pads, in the results of a tick.

    values (n, VALUE_COUNT), total_a, times [ns] and ids (n,) are those of the tick, of the contacts' newest
    samples; they are read in place.

    `state` (n, SLIP_COUNT), in rows of SLIP_ROW, the `contact_id` (n,) that it is about, 0 for none, and
    `sample_ns` (n,) of the last sample that counted are all that survives a tick; they are in `held`.
    `requested` (n,): pads it runs for. `samples_per_false_alarm` is the lower bound on the mean number of
    samples of a contact from one false alarm to the next.
    """

    def __init__(
        self,
        period_s: float,
        values: FloatArray,
        total_a: FloatArray,
        times: NDArray[np.int64],
        ids: NDArray[np.uint32],
        held: TickState,
        false_alarm_s: float = FALSE_ALARM_S,
        grip: GripModel | None = None,
    ) -> None:
        self.state, self.contact_id = held.slip, held.slip_contact_id
        self.sample_ns, self.requested = held.slip_sample_ns, held.slip_requested
        self.any_requested = False
        self.samples_per_false_alarm = max(false_alarm_s / period_s, 2.0)
        self.grip = (grip or GripModel()).parameters(period_s, self.samples_per_false_alarm)
        self.rows, self.values = view_rows(held.slip, SLIP_ROW), view_rows(values, VALUE_ROW)
        self.known, self.counted = view_memory(held.slip_contact_id), view_memory(held.slip_sample_ns)
        self.total_a, self.times, self.ids = view_memory(total_a), view_memory(times), view_memory(ids)
        self.work = view_memory(np.zeros(7 * _ONSETS))
        self.x = self.y = self.noise_x = self.noise_y = self.press = self.dt_s = 0.0
        self.f11 = self.f12 = self.f21 = self.f22 = 0.0  # tremor and its speed over dt
        self.q11 = self.q12 = self.q22 = 0.0  # what they gain, relative to the tremor's variance
        self.innovation = self.variance = 0.0
        self.alarm_ratio = _NO_SLIP  # ln R of onsets that chatter can't explain
        self.gain0 = self.gain1 = self.gain2 = self.gain3 = 0.0

    def set_requested(self, pads: BoolArray) -> None:
        """Set the pads (n,) it runs for; contacts on changed ones start afresh."""
        self.restart_contacts(np.flatnonzero(pads != self.requested))
        self.requested[:] = pads
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        self.any_requested = bool(self.requested.any())

    def restart_contacts(self, pads: IntArray) -> None:
        """Start the contacts on these pads (k,) afresh with their next sample."""
        self.contact_id[pads] = 0

    def detect_slips(self, pads: IntArray) -> None:
        """Process the newest sample of the contact on each of these pads (k,), if requested."""
        for pad in pads[self.requested[pads]].tolist():
            process_sample(self, pad)

    def contacts(self) -> Any:
        """Return the state in rows of SLIP_ROW (n,), as a view."""
        return view_rows(self.state, SLIP_ROW)


def process_sample(slips: SlipDetector, pad: int) -> None:
    """Process a contact's newest sample; one without position only ages the evidence."""
    _read_sample(slips, pad)
    usable = -_INFINITY < slips.x + slips.y + slips.noise_x + slips.noise_y + slips.press < _INFINITY
    force = slips.values[pad].force_n
    known = -_INFINITY < force < _INFINITY
    slips.dt_s, slips.alarm_ratio = 0.0, _NO_SLIP
    if slips.known[pad] != slips.ids[pad]:
        if not usable:
            return
        slips.known[pad], slips.counted[pad] = slips.ids[pad], slips.times[pad]
        peak = slips.rows[pad].peak_current_a
        slips.rows[pad].firm_current_a = max(peak, _FIRM_CURRENT_FACTOR * slips.total_a[pad])
        slips.press = slips.total_a[pad] / max(slips.rows[pad].firm_current_a, 1e-12)
        _begin_contact(slips, pad, force if known else 0.0)
        _start_test(slips, pad, False)
    elif usable and slips.times[pad] > slips.counted[pad]:
        slips.dt_s = (slips.times[pad] - slips.counted[pad]) * 1e-9
        slips.counted[pad] = slips.times[pad]
        slips.rows[pad].age_s += slips.dt_s
        _track_motion(slips, pad, force if known else slips.rows[pad].force_n)
        _test_slip(slips, pad)
        if slips.alarm_ratio > slips.grip[0].log_threshold and slips.rows[pad].slipping == 0.0:
            _start_slip(slips, pad)
        if slips.rows[pad].slipping != 0.0:
            _detect_rest(slips, pad)
    slips.rows[pad].samples += 1.0
    slips.rows[pad].peak_current_a = max(slips.rows[pad].peak_current_a, slips.total_a[pad])
    _classify(slips, pad)


def _read_sample(slips: SlipDetector, pad: int) -> None:
    """Read position, its noise, and the current relative to that of a firm contact."""
    slips.x, slips.y = slips.values[pad].pad_m[0], slips.values[pad].pad_m[1]
    slips.noise_x, slips.noise_y = slips.values[pad].pad_noise_m2[0], slips.values[pad].pad_noise_m2[2]
    slips.press = slips.total_a[pad] / max(slips.rows[pad].firm_current_a, 1e-12)
    if not slips.noise_x > _MIN_VARIANCE_M2 or not slips.noise_y > _MIN_VARIANCE_M2:
        whole = slips.values[pad].covariance_m2[0] + slips.values[pad].covariance_m2[4]
        whole = (whole + slips.values[pad].covariance_m2[8]) / 2.0  # too light for a noise estimate
        if whole < _MIN_VARIANCE_M2:
            whole = _MIN_VARIANCE_M2
        if not slips.noise_x > _MIN_VARIANCE_M2:
            slips.noise_x = whole
        if not slips.noise_y > _MIN_VARIANCE_M2:
            slips.noise_y = whole


def _begin_contact(slips: SlipDetector, pad: int, force: float) -> None:
    """Reset what is known of the contact before."""
    for k in range(2):
        slips.rows[pad].velocity_m_per_s[k] = slips.rows[pad].mixed_variance[k] = slips.rows[
            pad
        ].slip_velocity_m_per_s[k] = 0.0
        slips.rows[pad].velocity_variance[k] = _START_VELOCITY_VARIANCE
    slips.rows[pad].position_m[0], slips.rows[pad].position_m[1] = slips.x, slips.y
    slips.rows[pad].position_variance[0], slips.rows[pad].position_variance[1] = slips.noise_x, slips.noise_y
    slips.rows[pad].force_n, slips.rows[pad].force_rate_n_per_s, slips.rows[pad].force_rate_std = (
        force,
        0.0,
        abs(force),
    )
    slips.rows[pad].samples = slips.rows[pad].age_s = slips.rows[pad].slipping = slips.rows[
        pad
    ].slips = slips.rows[pad].rest_s = 0.0
    slips.rows[pad].log_odds = _NO_SLIP


def _start_test(slips: SlipDetector, pad: int, kept: bool) -> None:
    """Start the slip test; `kept`: the contact sticks again after a slip, what is learnt of it is kept."""
    rate = slips.grip[0].tremor_rate
    for axis in range(2):
        tremor = slips.rows[pad].grip_log_tremor_variance[axis] if kept else slips.grip[0].log_tremor_variance
        slips.rows[pad].log_tremor_variance[axis] = tremor
        variance = math.exp(tremor)
        for k in range(4):
            slips.rows[pad].motion[axis][k] = 0.0
        for k in range(10):
            slips.rows[pad].covariance[axis][k] = 0.0
        slips.rows[pad].motion[axis][_LEVEL] = slips.x if axis == 0 else slips.y
        slips.rows[pad].covariance[axis][_LEVEL_LEVEL] = _START_LEVEL_VARIANCE + (
            slips.noise_x if axis == 0 else slips.noise_y
        )
        slips.rows[pad].covariance[axis][_TREMOR_TREMOR] = variance
        slips.rows[pad].covariance[axis][_SPEED_SPEED] = variance * rate * rate
        slips.rows[pad].covariance[axis][_COUPLING_COUPLING] = slips.grip[0].coupling_variance
        for k in range(_ONSETS):
            creep = (
                slips.rows[pad].grip_log_creep_variance[axis][k] if kept else slips.grip[0].log_creep_variance
            )
            slips.rows[pad].log_creep_variance[axis][k] = creep
    for k in range(_ONSETS):
        slips.rows[pad].onset_ages_s[k] = 0.0
        for block in range(_BLOCKS):
            slips.rows[pad].ramps[0][block][k] = slips.rows[pad].ramps[1][block][k] = 0.0
    if not kept:
        slips.rows[pad].press_noise = slips.rows[pad].learning_s = 0.0
    slips.rows[pad].first_press = slips.rows[pad].last_press = slips.rows[pad].before_press = slips.press
    _keep_last(slips, pad)
    slips.rows[pad].tested = slips.rows[pad].until_onset = slips.rows[pad].onset_number = slips.rows[
        pad
    ].onset_age_s = 0.0
    slips.rows[pad].log_ratio = slips.alarm_ratio = _NO_SLIP


def _track_motion(slips: SlipDetector, pad: int, force: float) -> None:
    """Filter position (constant velocity with random acceleration) and the force's rate."""
    dt = slips.dt_s
    density = _ACCELERATION_DENSITY * dt
    for axis in range(2):
        pp, pv, vv = (
            slips.rows[pad].position_variance[axis],
            slips.rows[pad].mixed_variance[axis],
            slips.rows[pad].velocity_variance[axis],
        )
        pp += dt * (2.0 * pv + dt * (vv + density / 3.0))
        pv += dt * (vv + density / 2.0)
        vv += density
        at = slips.rows[pad].position_m[axis] + dt * slips.rows[pad].velocity_m_per_s[axis]
        total = pp + (slips.noise_x if axis == 0 else slips.noise_y)
        off = (slips.x if axis == 0 else slips.y) - at
        by_position, by_velocity = pp / total, pv / total
        slips.rows[pad].position_m[axis] = at + by_position * off
        slips.rows[pad].velocity_m_per_s[axis] += by_velocity * off
        slips.rows[pad].velocity_variance[axis] = vv - by_velocity * pv
        slips.rows[pad].mixed_variance[axis] = pv - by_position * pv
        slips.rows[pad].position_variance[axis] = pp - by_position * pp
    part = 1.0 - math.exp(-dt / _FORCE_RATE_TIME_S)
    rate = (force - slips.rows[pad].force_n) / (dt + _FORCE_RATE_TIME_S * (1.0 - part))
    slips.rows[pad].force_n += part * (force - slips.rows[pad].force_n)
    slips.rows[pad].force_rate_n_per_s += part * (rate - slips.rows[pad].force_rate_n_per_s)
    slow, std = min(dt, 1.0), slips.rows[pad].force_rate_std
    slips.rows[pad].force_rate_std = math.sqrt(
        (1.0 - slow) * std * std
        + slow * slips.rows[pad].force_rate_n_per_s * slips.rows[pad].force_rate_n_per_s
        + 1e-12
    )


def _test_slip(slips: SlipDetector, pad: int) -> None:
    """Run one step of the test and compute ln R."""
    press, before = slips.rows[pad].last_press, slips.rows[pad].before_press
    bend = slips.press - 2.0 * press + before  # tremor is far slower than noise
    part = max(1.0 / (1.0 + slips.rows[pad].tested), _PRESS_NOISE_GAIN)
    slips.rows[pad].press_noise += part * (bend * bend / 6.0 - slips.rows[pad].press_noise)
    slips.rows[pad].before_press, slips.rows[pad].last_press = press, slips.press
    _set_transition(slips)
    _advance_onsets(slips, pad)
    slips.rows[pad].tested += 1.0
    slips.rows[pad].learning_s += slips.dt_s
    for axis in range(2):
        _filter_axis(slips, pad, axis)
        _advance_ramps(slips, pad, axis)
        _learn_creep(slips, pad, axis)
    _sum_ratios(slips, pad)
    _keep_last(slips, pad)


def _keep_last(slips: SlipDetector, pad: int) -> None:
    """Keep the position of this sample, and the larger variance of its noise."""
    slips.rows[pad].last_m[0], slips.rows[pad].last_m[1] = slips.x, slips.y
    slips.rows[pad].last_noise_m2 = max(slips.noise_x, slips.noise_y)


def _set_transition(slips: SlipDetector) -> None:
    """Set how tremor and its speed pass from the last sample to this one."""
    dt, rate = slips.dt_s, slips.grip[0].tremor_rate
    passed = rate * dt
    decay, squared = math.exp(-passed), rate * rate
    slips.f11, slips.f12 = decay * (1.0 + passed), decay * dt
    slips.f21, slips.f22 = -decay * rate * passed, decay * (1.0 - passed)
    slips.q11 = 1.0 - (slips.f11 * slips.f11 + slips.f12 * slips.f12 * squared)
    slips.q12 = -(slips.f11 * slips.f21 + slips.f12 * slips.f22 * squared)
    slips.q22 = squared - (slips.f21 * slips.f21 + slips.f22 * slips.f22 * squared)


def _filter_axis(slips: SlipDetector, pad: int, axis: int) -> None:
    """Run one step of an axis' Kalman filter: level, tremor, its speed, coupling to the pressure."""
    dt = slips.dt_s
    f11, f12, f21, f22 = slips.f11, slips.f12, slips.f21, slips.f22
    log_tremor = slips.rows[pad].log_tremor_variance[axis]
    tremor = math.exp(log_tremor)
    level, coupling = slips.rows[pad].motion[axis][_LEVEL], slips.rows[pad].motion[axis][_COUPLING]
    c11, c12 = slips.rows[pad].motion[axis][_TREMOR], slips.rows[pad].motion[axis][_SPEED]
    shake, speed = f11 * c11 + f12 * c12, f21 * c11 + f22 * c12
    c11, c12 = slips.rows[pad].covariance[axis][_LEVEL_TREMOR], slips.rows[pad].covariance[axis][_LEVEL_SPEED]
    c01, c02 = f11 * c11 + f12 * c12, f21 * c11 + f22 * c12
    c11 = slips.rows[pad].covariance[axis][_TREMOR_COUPLING]
    c12 = slips.rows[pad].covariance[axis][_SPEED_COUPLING]
    c13, c23 = f11 * c11 + f12 * c12, f21 * c11 + f22 * c12
    tt, ts = slips.rows[pad].covariance[axis][_TREMOR_TREMOR], slips.rows[pad].covariance[axis][_TREMOR_SPEED]
    ss = slips.rows[pad].covariance[axis][_SPEED_SPEED]
    c11 = f11 * f11 * tt + 2.0 * f11 * f12 * ts + f12 * f12 * ss + tremor * slips.q11
    c12 = f11 * f21 * tt + (f11 * f22 + f12 * f21) * ts + f12 * f22 * ss
    c12 += tremor * slips.q12
    c22 = f21 * f21 * tt + 2.0 * f21 * f22 * ts + f22 * f22 * ss + tremor * slips.q22
    c00 = slips.rows[pad].covariance[axis][_LEVEL_LEVEL] + slips.grip[0].level_drift_variance * dt
    c03 = slips.rows[pad].covariance[axis][_LEVEL_COUPLING]
    c33 = slips.rows[pad].covariance[axis][_COUPLING_COUPLING] + slips.grip[0].coupling_drift_variance * dt
    pressed = slips.press - slips.rows[pad].first_press
    a0, a1 = c00 + c01 + pressed * c03, c01 + c11 + pressed * c13
    a2, a3 = c02 + c12 + pressed * c23, c03 + c13 + pressed * c33
    variance = a0 + a1 + pressed * a3 + (slips.noise_x if axis == 0 else slips.noise_y)
    variance += (coupling * coupling + c33) * slips.rows[pad].press_noise
    innovation = (slips.x if axis == 0 else slips.y) - (level + shake + pressed * coupling)
    g0, g1, g2, g3 = a0 / variance, a1 / variance, a2 / variance, a3 / variance
    slips.rows[pad].motion[axis][_LEVEL] = level + g0 * innovation
    slips.rows[pad].motion[axis][_TREMOR] = shake + g1 * innovation
    slips.rows[pad].motion[axis][_SPEED] = speed + g2 * innovation
    slips.rows[pad].motion[axis][_COUPLING] = coupling + g3 * innovation
    slips.rows[pad].covariance[axis][_LEVEL_LEVEL] = c00 - g0 * a0
    slips.rows[pad].covariance[axis][_LEVEL_TREMOR] = c01 - g0 * a1
    slips.rows[pad].covariance[axis][_LEVEL_SPEED] = c02 - g0 * a2
    slips.rows[pad].covariance[axis][_LEVEL_COUPLING] = c03 - g0 * a3
    slips.rows[pad].covariance[axis][_TREMOR_TREMOR] = c11 - g1 * a1
    slips.rows[pad].covariance[axis][_TREMOR_SPEED] = c12 - g1 * a2
    slips.rows[pad].covariance[axis][_TREMOR_COUPLING] = c13 - g1 * a3
    slips.rows[pad].covariance[axis][_SPEED_SPEED] = c22 - g2 * a2
    slips.rows[pad].covariance[axis][_SPEED_COUPLING] = c23 - g2 * a3
    slips.rows[pad].covariance[axis][_COUPLING_COUPLING] = c33 - g3 * a3
    excess = min(innovation * innovation / variance, _MAX_SQUARED_INNOVATION) - 1.0
    log_tremor += excess * (dt / slips.grip[0].tremor_time_constant_s)
    slips.rows[pad].log_tremor_variance[axis] = min(
        max(log_tremor, slips.grip[0].min_log_tremor_variance), slips.grip[0].max_log_tremor_variance
    )
    slips.innovation, slips.variance = innovation, variance
    slips.gain0, slips.gain1, slips.gain2, slips.gain3 = g0, g1, g2, g3


def _advance_onsets(slips: SlipDetector, pad: int) -> None:
    """Age the onset hypotheses and open a new one periodically; the others shift, slots are sorted by age."""
    for k in range(_ONSETS):
        if slips.rows[pad].onset_ages_s[k] > 0.0:
            slips.rows[pad].onset_ages_s[k] += slips.dt_s
    if slips.rows[pad].until_onset > 0.0:
        slips.rows[pad].until_onset -= 1.0
        return
    slips.rows[pad].until_onset = slips.grip[0].onset_stride - 1.0
    slips.rows[pad].onset_number += 1.0
    if slips.rows[pad].onset_number >= _OLDER_STRIDE:  # the others between two strides are dropped
        slips.rows[pad].onset_number = 0.0
        _shift_onsets(slips, pad, _RECENT, _ONSETS)
    _shift_onsets(slips, pad, 1, _RECENT)
    slips.rows[pad].onset_ages_s[0] = slips.dt_s  # it began with the previous sample
    for axis in range(2):
        for block in range(_START):
            slips.rows[pad].ramps[axis][block][0] = 0.0
        slips.rows[pad].ramps[axis][_START][0] = slips.rows[pad].last_m[axis]
    slips.rows[pad].ramps[0][_START_NOISE][0] = slips.rows[pad].last_noise_m2


def _shift_onsets(slips: SlipDetector, pad: int, first: int, stop: int) -> None:
    """Give the slots first .. stop - 1 what is in the slots before each."""
    for k in range(stop - first):
        slips.rows[pad].onset_ages_s[stop - 1 - k] = slips.rows[pad].onset_ages_s[stop - 2 - k]
    for axis in range(2):
        for block in range(_BLOCKS):
            for k in range(stop - first):
                slips.rows[pad].ramps[axis][block][stop - 1 - k] = slips.rows[pad].ramps[axis][block][
                    stop - 2 - k
                ]


def _advance_ramps(slips: SlipDetector, pad: int, axis: int) -> None:
    """Update an axis' responses of the filter to ramps of 1 m/s, and the sums of f nu / S and f^2 / S."""
    f11, f12, f21, f22 = slips.f11, slips.f12, slips.f21, slips.f22
    g0, g1, g2, g3 = slips.gain0, slips.gain1, slips.gain2, slips.gain3
    pressed = slips.press - slips.rows[pad].first_press
    precision, innovation = 1.0 / slips.variance, slips.innovation
    for k in range(_ONSETS):
        tremor, rate = slips.rows[pad].ramps[axis][_TREMOR][k], slips.rows[pad].ramps[axis][_SPEED][k]
        shake, speed = f11 * tremor + f12 * rate, f21 * tremor + f22 * rate
        met = slips.rows[pad].ramps[axis][_LEVEL][k] + shake
        f = slips.rows[pad].onset_ages_s[k] - (met + pressed * slips.rows[pad].ramps[axis][_COUPLING][k])
        slips.rows[pad].ramps[axis][_LEVEL][k] += g0 * f
        slips.rows[pad].ramps[axis][_TREMOR][k] = shake + g1 * f
        slips.rows[pad].ramps[axis][_SPEED][k] = speed + g2 * f
        slips.rows[pad].ramps[axis][_COUPLING][k] += g3 * f
        weighted = f * precision
        slips.rows[pad].ramps[axis][_SCORE][k] += weighted * innovation
        slips.rows[pad].ramps[axis][_INFORMATION][k] += weighted * f


def _learn_creep(slips: SlipDetector, pad: int, axis: int) -> None:
    """Learn the creep variance by onset age; set the part of the ramps' evidence that counts.

    A ramp of information I, while the contact creeps at speeds of variance v, meets 1 + I v times its own.
    """
    work, parts = slips.work, 2 * axis * _ONSETS
    pace = slips.dt_s / min(
        max(slips.rows[pad].learning_s, _MIN_LEARNING_S), slips.grip[0].creep_time_constant_s
    )
    for k in range(_ONSETS):
        score = slips.rows[pad].ramps[axis][_SCORE][k]
        information = slips.rows[pad].ramps[axis][_INFORMATION][k]
        if slips.rows[pad].onset_ages_s[k] > 0.0:
            more = 1.0 + information * math.exp(slips.rows[pad].log_creep_variance[axis][k])
            met = score * score / max(information, 1e-300)
            slope = (min(met / more, _MAX_SQUARED_INNOVATION) - 1.0) * (1.0 - 1.0 / more)
            if slope < 0.0:
                slope *= _DECREASE_FACTOR
            creep = slips.rows[pad].log_creep_variance[axis][k] + slope * pace
            slips.rows[pad].log_creep_variance[axis][k] = min(max(creep, _MIN_LOG_CREEP), _MAX_LOG_CREEP)
            part = 1.0 / (more * math.sqrt(math.sqrt(more)))  # allows for tails that deviate from the model
            work[parts + k] = part * information
            work[parts + _ONSETS + k] = part * score * (part * score)


def _sum_ratios(slips: SlipDetector, pad: int) -> None:
    """Compute ln R from the onsets' likelihood ratios, each weighted by the samples it stands for; and that
    of the onsets that chatter can't explain by its return."""
    work = slips.work
    most = _NO_SLIP
    for k in range(_ONSETS):
        if slips.rows[pad].onset_ages_s[k] > 0.0:
            slow, medium, fast = 4 * _ONSETS + k, 5 * _ONSETS + k, 6 * _ONSETS + k
            work[slow] = _log_ratio(work, k, _SLOW)
            work[medium] = _log_ratio(work, k, _MEDIUM)
            work[fast] = _log_ratio(work, k, _FAST)
            most = max(most, work[slow], work[medium], work[fast])
    total, left, best, largest = 0.0, 0.0, 0, -1.0
    for k in range(_ONSETS):
        if slips.rows[pad].onset_ages_s[k] > 0.0 and _is_far(slips, pad, k, k):
            share = math.exp(work[4 * _ONSETS + k] - most)
            share += math.exp(work[5 * _ONSETS + k] - most)
            share += math.exp(work[6 * _ONSETS + k] - most)
            share *= (1.0 if k < _RECENT else 1.0 * _OLDER_STRIDE) / 3.0
            total += share
            if _has_left(slips, pad, k):
                left += share
            if share > largest:
                largest, best = share, k
    slips.rows[pad].log_ratio = most + math.log(max(total, 1e-300) * slips.grip[0].onset_stride)
    slips.alarm_ratio = most + math.log(max(left, 1e-300) * slips.grip[0].onset_stride)
    if slips.rows[pad].log_ratio > _MIN_ONSET_LOG_ODDS:
        slips.rows[pad].onset_age_s = slips.rows[pad].onset_ages_s[best]
        for axis in range(2):
            score = slips.rows[pad].ramps[axis][_SCORE][best]
            information = slips.rows[pad].ramps[axis][_INFORMATION][best]
            slips.rows[pad].slip_velocity_m_per_s[axis] = score / max(information, 1e-12)


def _is_far(slips: SlipDetector, pad: int, k: int, j: int) -> bool:
    """Return whether the contact is farther from its position at onset j than chatter moves it since k, by
    more than noise does."""
    limit = min(
        slips.grip[0].chatter_m,
        slips.grip[0].sway_m + slips.grip[0].chatter_speed * slips.rows[pad].onset_ages_s[k],
    )
    noise = max(slips.noise_x, slips.noise_y) + slips.rows[pad].ramps[0][_START_NOISE][j]
    x = slips.x - slips.rows[pad].ramps[0][_START][j]
    y = slips.y - slips.rows[pad].ramps[1][_START][j]
    far: bool = x * x + y * y > limit * limit + _NOISE_SIGMA * _NOISE_SIGMA * noise
    return far


def _has_left(slips: SlipDetector, pad: int, k: int) -> bool:
    """Return whether the contact is as far from its positions in the time before onset k in which chatter
    returns, as known from older onsets."""
    since_s = slips.rows[pad].onset_ages_s[k] + slips.grip[0].chatter_time_s
    for j in range(k + 1, _ONSETS):
        if slips.rows[pad].onset_ages_s[j] == 0.0 or slips.rows[pad].onset_ages_s[j] > since_s:
            return True
        if not _is_far(slips, pad, k, j):
            return False
    return True


def _log_ratio(work: memoryview[float], k: int, speed_variance: float) -> float:
    """Return ln of the likelihood ratio of an onset at velocities of this variance along each axis."""
    x = work[k] * speed_variance + 1.0
    y = work[2 * _ONSETS + k] * speed_variance + 1.0
    quotient = (work[_ONSETS + k] / x + work[3 * _ONSETS + k] / y) * speed_variance
    return 0.5 * (quotient - math.log(x * y))


def _start_slip(slips: SlipDetector, pad: int) -> None:
    """Mark the contact as slipping since its likeliest onset: what is learnt now doesn't describe a grip."""
    slips.rows[pad].slipping = 1.0
    slips.rows[pad].slips += 1.0
    slips.rows[pad].rest_s = 0.0
    for axis in range(2):
        at = slips.x if axis == 0 else slips.y
        slips.rows[pad].slip_start_m[axis] = (
            at - slips.rows[pad].slip_velocity_m_per_s[axis] * slips.rows[pad].onset_age_s
        )
        slips.rows[pad].grip_log_tremor_variance[axis] = slips.rows[pad].log_tremor_variance[axis]
        for k in range(_ONSETS):
            slips.rows[pad].grip_log_creep_variance[axis][k] = slips.rows[pad].log_creep_variance[axis][k]


def _detect_rest(slips: SlipDetector, pad: int) -> None:
    """Restart the test of a contact that slipped and has come to rest."""
    vx, vy = slips.rows[pad].velocity_m_per_s[0], slips.rows[pad].velocity_m_per_s[1]
    limit = max(
        2.0 * math.sqrt(slips.rows[pad].velocity_variance[0] + slips.rows[pad].velocity_variance[1]),
        _MAX_REST_SPEED,
    )
    slips.rows[pad].rest_s = (
        slips.rows[pad].rest_s + slips.dt_s if math.sqrt(vx * vx + vy * vy) < limit else 0.0
    )
    if slips.rows[pad].rest_s > _MIN_REST_S:
        slips.rows[pad].slipping = 0.0
        slips.rows[pad].log_odds = _NO_SLIP
        _start_test(slips, pad, True)


def _classify(slips: SlipDetector, pad: int) -> None:
    """Update ln of the odds of slip, R times the prior rate of slips at such forces, and the label.

    Recent evidence decays slowly, or a contact near the threshold would chatter.
    """
    falls = max(-slips.rows[pad].force_rate_n_per_s, 0.0) / max(3.0 * slips.rows[pad].force_rate_std, 1e-9)
    hazard = _SLIP_RATE_HZ * (1.0 + (_UNLOADING_FACTOR - 1.0) * min(falls, 1.0)) * slips.grip[0].period_s
    slips.rows[pad].log_odds = max(
        slips.alarm_ratio + math.log(hazard), slips.rows[pad].log_odds - slips.dt_s / _ODDS_DECAY_S
    )
    label = (
        _SLIDING
        if slips.rows[pad].slipping != 0.0
        else _INCIPIENT
        if slips.rows[pad].log_odds > 0.0
        else _STICKING
    )
    if (
        slips.rows[pad].force_n
        + (_LIFT_OFF_HORIZON_S + _FORCE_RATE_TIME_S) * slips.rows[pad].force_rate_n_per_s
        < 0.0
    ):
        label = _LIFT_OFF
    slips.rows[pad].label = 1.0 * label
