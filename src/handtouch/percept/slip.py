"""Slip detection: a sequential test on the contact position with a bounded rate of false alarms.

While a contact sticks, its centroid is modelled, along x and along y, as a slowly drifting level, plus a part
proportional to the contact pressure (the fingertip rolls and flattens; measured by the total current, which
unlike the force doesn't jump or saturate at the end of its range), plus a smooth tremor of some hertz (Matern
3/2), plus channel noise: a Kalman filter whose innovations are white. Sliding adds a ramp from its onset on.
The response of the innovations to ramps that began at several past times is propagated (A. Willsky, H. Jones
1976), which gives the likelihood ratio of each onset; the speed is integrated out over scales from 1 to 100
mm/s. The sum over onsets is the Shiryaev-Roberts statistic R: under the model, R less the number of samples
is a martingale of mean 0, so the mean number of samples to a false alarm is at least the threshold on R.

Real hands deviate from this model: soft contacts creep and roll at about half a millimetre a second, and
tremor that fits the model from sample to sample may not over a tenth of a second. So every ramp is tested
against one of random speed, whose variance is learnt for every onset age from what ramps of that age met
while the contact stuck, starting at a prior: gradient ascent on the likelihood.

Public names: `SlipTest`, `GripModel`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_SPEED_STDS_M_PER_S = np.array([1e-3, 5e-3, 30e-3])[:, None]  # prior of each velocity component
_START_LEVEL_STD_M = 50e-6  # of the level from its first sample
_PRESS_NOISE_GAIN = 0.02  # weight of a sample in the estimate of the current's noise
_ONSET_PERIOD_S = 0.005
_RECENT_ONSETS, _OLDER_ONSETS, _OLDER_ONSET_STRIDE = (
    12,
    21,
    4,
)  # onset hypotheses: the latest, and every fourth of older ones
_ONSETS = _RECENT_ONSETS + _OLDER_ONSETS
_ONSET_WEIGHTS = np.repeat(
    [1.0, _OLDER_ONSET_STRIDE], [_RECENT_ONSETS, _OLDER_ONSETS]
)  # samples per hypothesis
_LEVEL_STATE, _COUPLING_STATE, _STATE_COUNT = 0, 3, 4  # tremor and its speed are between them
_SCORE_ROW, _INFORMATION_ROW, _RAMP_ROWS = 4, 5, 6  # rows of a ramp, after the states
_MIN_LEARNING_S = 0.3
_DECREASE_RATE_FACTOR = 0.8  # decreases are learnt more slowly: tremor comes in bursts
_MIN_LOG_CREEP_VARIANCE = 2 * math.log(20e-6)  # ln of a variance [m^2/s^2]
_MIN_ONSET_LOG_ODDS = 3.0  # ln R above which onset and velocity are computed
_MAX_SQUARED_INNOVATION = 6.0  # of an innovation squared: slip must not be learnt as tremor


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


class SlipTest:
    """Slip test of n pads; `log_odds` (n,) is ln R.

    Call `process_samples` with the samples of every tick. `samples_per_false_alarm` is the lower bound on the
    mean number of samples from one false alarm to the next.
    """

    def __init__(
        self, pads: int, period_s: float, false_alarm_s: float, grip: GripModel | None = None
    ) -> None:
        self.grip = grip or GripModel()
        self.period_s = period_s
        self.samples_per_false_alarm = max(false_alarm_s / period_s, 2.0)
        self.log_odds = np.full(pads, -np.inf)
        self.onset_age_s = np.zeros(pads)
        """time since the most likely onset"""
        self.slip_velocity_m_per_s = np.zeros((pads, 2))
        """most likely velocity since that onset; both only where slip is likely"""
        rate = 2 * np.pi * self.grip.tremor_corner_hz
        self._tremor_covariance = np.diag(
            [0.0, 1.0, rate**2, 0.0]
        )  # relative covariance of tremor and its speed
        coupling = (self.grip.coupling_std_m * self.grip.coupling_drift_per_s) ** 2
        self._drift_covariance = np.diag(
            [self.grip.level_drift_std_m**2, 0.0, 0.0, coupling]
        )  # added per second
        self._onset_stride = max(1, round(_ONSET_PERIOD_S / period_s))
        self._state = np.zeros((pads, 2, _STATE_COUNT))
        self._cov = np.zeros((pads, 2, _STATE_COUNT, _STATE_COUNT))
        self._initial_press = np.zeros(pads)
        self._log_tremor_variance = np.zeros((pads, 2))
        self._log_tremor_variance_before_slip = np.zeros((pads, 2))
        self._last_press = np.zeros((pads, 2))  # of the last two samples
        self._press_noise = np.zeros(pads)  # variance of its noise
        self._sample_count = np.zeros(pads, dtype=np.int64)
        self._onset_ages_s = np.zeros((pads, _ONSETS))  # 0: unused slot
        self._ramps = np.zeros((pads, _RAMP_ROWS, 2, _ONSETS))
        """response of the states to a ramp of 1 m/s; sums of f nu / S and of f^2 / S"""
        self._learning_s = np.zeros(pads)  # time that the contact has stuck
        self._log_creep_variance = np.zeros((2, pads, 2, _ONSETS))  # now, and before the slip; by onset age

    def start_contacts(
        self,
        pads: IntArray,
        position: FloatArray,
        noise_m2: FloatArray,
        press: FloatArray,
        keep: bool = False,
    ) -> None:
        """Start the test of contacts (k,) at positions (k, 2) with noise variances (k, 2) and relative
        currents (k,).

        keep: the contact sticks again after a slip, and its learnt tremor and creep are kept.
        """
        self._state[pads], self._state[pads, :, _LEVEL_STATE] = 0.0, position
        cov = np.zeros((len(pads), 2, _STATE_COUNT, _STATE_COUNT))
        cov[:, :, _LEVEL_STATE, _LEVEL_STATE] = _START_LEVEL_STD_M**2 + noise_m2
        cov[:, :, _COUPLING_STATE, _COUPLING_STATE] = self.grip.coupling_std_m**2
        self._log_tremor_variance[pads] = (
            self._log_tremor_variance_before_slip[pads] if keep else 2 * np.log(self.grip.tremor_std_m)
        )
        self._log_creep_variance[0, pads] = (
            self._log_creep_variance[1, pads] if keep else 2 * np.log(self.grip.creep_std_m_per_s)
        )
        if not keep:
            self._press_noise[pads] = self._learning_s[pads] = 0.0
        self._last_press[pads] = press[:, None]
        cov += np.exp(self._log_tremor_variance[pads])[:, :, None, None] * self._tremor_covariance
        self._cov[pads] = cov
        self._initial_press[pads] = press
        self._sample_count[pads] = 0
        self._onset_ages_s[pads] = 0.0
        self._ramps[pads] = 0.0
        self.log_odds[pads] = -np.inf

    def mark_slipping(self, pads: IntArray) -> None:
        """Mark contacts as slipping: what is learnt from now on doesn't describe a grip."""
        self._log_tremor_variance_before_slip[pads], self._log_creep_variance[1, pads] = (
            self._log_tremor_variance[pads],
            self._log_creep_variance[0, pads],
        )

    def process_samples(
        self,
        pads: IntArray,
        dt_s: FloatArray,
        position: FloatArray,
        noise_m2: FloatArray,
        press: FloatArray,
    ) -> BoolArray:
        """Process samples (k,), each `dt_s` (k,) after the one before it; return the alarms (k,).

        Positions (k, 2), variances of their noise (k, 2), relative currents (k,).
        """
        if (dt_s == dt_s[0]).all():
            dt_s = dt_s[:1]
        forward = self._transition_matrix(dt_s)
        gain, innovation, variance, row = self._kalman_step(pads, dt_s, forward, position, noise_m2, press)
        ramp, ramps = self._onset_ages_s[pads], self._ramps[pads]
        self._advance_onsets(pads, dt_s, ramp, ramps)
        flat = ramps.reshape(len(pads), _RAMP_ROWS, -1)  # a view
        flat[:, :_STATE_COUNT] = forward @ flat[:, :_STATE_COUNT]
        f = ramp[:, None] - (row[:, None] @ flat[:, :_STATE_COUNT]).reshape(len(pads), 2, _ONSETS)
        ramps[:, :_STATE_COUNT] += gain.transpose(0, 2, 1)[..., None] * f[:, None]
        weighted = f / variance[:, :, None]
        ramps[:, _SCORE_ROW] += weighted * innovation[:, :, None]
        ramps[:, _INFORMATION_ROW] += weighted * f
        self._onset_ages_s[pads], self._ramps[pads] = ramp, ramps
        part = self._learn_creep(pads, dt_s, ramps)
        return self._detect_slips(pads, ramp, ramps, part)

    def _kalman_step(
        self,
        pads: IntArray,
        dt_s: FloatArray,
        forward: FloatArray,
        position: FloatArray,
        noise_m2: FloatArray,
        press: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Run one step of the Kalman filter; dt_s and forward may be shared by all.

        Returns gains (k, 2, states), innovations and variances (k, 2), and the measurement rows (k, states).
        """
        turned, log_tremor = forward.transpose(0, 2, 1), self._log_tremor_variance[pads]
        state, cov = self._state[pads] @ turned, forward[:, None] @ self._cov[pads] @ turned[:, None]
        cov += (self._drift_covariance * dt_s[:, None, None])[:, None]
        cov += (
            np.exp(log_tremor)[:, :, None, None]
            * (self._tremor_covariance - forward @ self._tremor_covariance @ turned)[:, None]
        )
        row = np.ones((len(pads), _STATE_COUNT))
        row[:, 2], row[:, _COUPLING_STATE] = 0.0, press - self._initial_press[pads]
        across = (cov @ row[:, None, :, None])[..., 0]
        coupling_variance = state[:, :, _COUPLING_STATE] ** 2 + cov[:, :, _COUPLING_STATE, _COUPLING_STATE]
        variance = (
            (across * row[:, None]).sum(axis=2)
            + noise_m2
            + coupling_variance * self._press_variance(pads, press)[:, None]
        )
        innovation = position - (state * row[:, None]).sum(axis=2)
        gain = across / variance[:, :, None]
        self._state[pads] = state + gain * innovation[:, :, None]
        self._cov[pads] = cov - gain[..., None] * across[:, :, None]
        excess = np.minimum(innovation * innovation / variance, _MAX_SQUARED_INNOVATION) - 1
        log_tremor += excess * (dt_s / self.grip.tremor_time_constant_s)[:, None]
        least, most = self.grip.tremor_std_range_m
        self._log_tremor_variance[pads] = np.minimum(
            np.maximum(log_tremor, 2 * math.log(least)), 2 * math.log(most)
        )
        return gain, innovation, variance, row

    def _press_variance(self, pads: IntArray, press: FloatArray) -> FloatArray:
        """Return the noise variance (k,) of the relative current, from second differences: tremor is far
        slower.
        """
        before, last = self._last_press[pads].T
        bend = (press - 2 * last + before) ** 2 / 6
        part = np.maximum(1 / (1 + self._sample_count[pads]), _PRESS_NOISE_GAIN)
        self._press_noise[pads] += part * (bend - self._press_noise[pads])
        self._last_press[pads, 0], self._last_press[pads, 1] = last, press
        return np.asarray(self._press_noise[pads])

    def _transition_matrix(self, dt_s: FloatArray) -> FloatArray:
        """Return the transition matrices (k, states, states) over dt (k,)."""
        rate = 2 * np.pi * self.grip.tremor_corner_hz
        passed = rate * dt_s
        decay, forward = np.exp(-passed), np.zeros((len(dt_s), _STATE_COUNT, _STATE_COUNT))
        forward[:, _LEVEL_STATE, _LEVEL_STATE] = forward[:, _COUPLING_STATE, _COUPLING_STATE] = 1.0
        forward[:, 1, 1], forward[:, 1, 2] = decay * (1 + passed), decay * dt_s
        forward[:, 2, 1], forward[:, 2, 2] = -decay * rate * passed, decay * (1 - passed)
        return forward

    def _advance_onsets(self, pads: IntArray, dt_s: FloatArray, ramp: FloatArray, ramps: FloatArray) -> None:
        """Age the onset hypotheses and open a new one periodically; the others shift, so slots are ordered by
        age.
        """
        ramp += np.where(ramp > 0, dt_s[:, None], 0.0)
        number, rest = np.divmod(self._sample_count[pads], self._onset_stride)
        self._sample_count[pads] += 1
        due = rest == 0
        if np.count_nonzero(due):
            last = due & (
                number % _OLDER_ONSET_STRIDE == _OLDER_ONSET_STRIDE - 1
            )  # the others between two strides are dropped
            if np.count_nonzero(last):
                ramp[last, _RECENT_ONSETS:] = ramp[last, _RECENT_ONSETS - 1 : -1]
                ramps[last, ..., _RECENT_ONSETS:] = ramps[last, ..., _RECENT_ONSETS - 1 : -1]
            every = slice(None) if due.all() else due
            ramp[every, 1:_RECENT_ONSETS] = ramp[every, : _RECENT_ONSETS - 1]
            ramps[every, ..., 1:_RECENT_ONSETS] = ramps[every, ..., : _RECENT_ONSETS - 1]
            ramp[every, 0] = np.broadcast_to(dt_s, due.shape)[every]  # it began with the previous sample
            ramps[every, ..., 0] = 0.0

    def _learn_creep(self, pads: IntArray, dt_s: FloatArray, ramps: FloatArray) -> FloatArray:
        """Learn the creep variance by onset age; return the part (k, 2, onsets) of the ramps' evidence that
        counts.

        A ramp of information I, while the contact creeps at speeds of variance v, meets 1 + I v times its
        own.
        """
        creep, information = self._log_creep_variance[0, pads], ramps[:, _INFORMATION_ROW]
        more = 1 + information * np.exp(creep)
        met = ramps[:, _SCORE_ROW] ** 2 / np.maximum(information, 1e-300)
        self._learning_s[pads] += dt_s
        lasts = np.minimum(
            np.maximum(self._learning_s[pads], _MIN_LEARNING_S), self.grip.creep_time_constant_s
        )
        slope = (np.minimum(met / more, _MAX_SQUARED_INNOVATION) - 1) * (
            1 - 1 / more
        )  # of the likelihood by ln of the creep variance
        slope *= np.where(slope < 0, _DECREASE_RATE_FACTOR, 1.0)
        creep += slope * (dt_s / lasts)[:, None, None]
        self._log_creep_variance[0, pads] = np.maximum(creep, _MIN_LOG_CREEP_VARIANCE)
        return np.asarray(
            1 / (more * np.sqrt(np.sqrt(more)))
        )  # this power allows for tails that deviate from the model

    def _detect_slips(
        self, pads: IntArray, ramp: FloatArray, ramps: FloatArray, part: FloatArray
    ) -> BoolArray:
        """Compute ln R from the onsets' likelihood ratios, each weighted by the samples it stands for."""
        information = part * ramps[:, _INFORMATION_ROW]
        square = (part * ramps[:, _SCORE_ROW]) ** 2
        x, y = (
            information[:, axis, None] * _SPEED_STDS_M_PER_S**2 + 1 for axis in (0, 1)
        )  # (k, speeds, onsets)
        quotient = (square[:, 0, None] / x + square[:, 1, None] / y) * _SPEED_STDS_M_PER_S**2
        ratios = 0.5 * (quotient - np.log(x * y))
        most = ratios.max(axis=(1, 2))
        total = np.exp(ratios - most[:, None, None]).sum(axis=1) * (_ONSET_WEIGHTS / len(_SPEED_STDS_M_PER_S))
        total *= ramp > 0  # unused slots
        log_odds = most + np.log(total.sum(axis=1) * self._onset_stride)
        self.log_odds[pads] = log_odds
        if len(rows := np.flatnonzero(log_odds > _MIN_ONSET_LOG_ODDS)):
            best = total[rows].argmax(axis=1)
            self.onset_age_s[pads[rows]] = ramp[rows, best]
            known = np.maximum(ramps[rows, _INFORMATION_ROW, :, best], 1e-12)
            self.slip_velocity_m_per_s[pads[rows]] = ramps[rows, _SCORE_ROW, :, best] / known
        return np.asarray(log_odds > np.log(self.samples_per_false_alarm))

    def onset_information(self) -> tuple[FloatArray, FloatArray]:
        """Return the age [s] of every onset hypothesis (n, onsets) and its information.

        The information is twice the mean growth of ln of the likelihood ratio by a true ramp of 1 m/s along
        an axis: no test can detect it sooner.
        """
        return self._onset_ages_s.copy(), self._ramps[:, _INFORMATION_ROW].mean(axis=1)

    def tremor_std_m(self, pads: IntArray) -> FloatArray:
        """Return the learnt standard deviation (k, 2) of the tremor."""
        return np.asarray(np.exp(0.5 * self._log_tremor_variance[pads]))
