"""When does a contact begin to slide? A sequential test on where it is, with a stated rate of false alarms.

While a contact sticks, its centroid is modelled, along x and along y, as a level that hardly moves, plus a
part that follows how hard it is pressed (the fingertip rolls and flattens; the total current tells it,
which neither jumps nor flattens where the force is at the end of its range), plus a smooth wander
of some hertz (tremor; Matern 3/2), plus the noise of the channels: a Kalman filter, its innovations white.
Sliding from some sample on adds a ramp. What ramps that began at several past times would have done to the
innovations is carried along (A. Willsky, H. Jones 1976), which gives the likelihood ratio of each such onset;
the speed is integrated out over scales from 1 to 100 mm/s. Their sum over the onsets is the Shiryaev-Roberts
statistic R: under the model R less the number of samples is a martingale of mean 0, so the mean time to a
false alarm is at least as many samples as the threshold on R says.

No hand keeps to that: soft contacts creep and roll, at some half a millimetre a second, and what trembles as
modelled from one sample to the next need not over a tenth of a second. So every ramp is held against one of
a random speed, whose variance is learnt for every age of an onset by how much ramps of that age met while it
stuck, from a prior on: a slope of the likelihood.

Public names: `SlipTest`, `Grip`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_SPEEDS = np.array([1e-3, 5e-3, 30e-3])[:, None]  # standard deviations of the prior of each component [m/s]
_BEGINS_M = 50e-6  # how far a level may be from its first sample
_PRESS_PART = 0.02  # of a sample, in what is known of the noise of that
_ONSET_S = 0.005
_FRESH, _OLD, _THIN = 12, 21, 4  # onsets: the last ones, and of those before every fourth
_ONSETS = _FRESH + _OLD
_STANDS = np.repeat([1.0, _THIN], [_FRESH, _OLD])  # for so many
_LEVEL, _COUPLING, _STATES = 0, 3, 4  # between them the wander and its speed
_GAIN, _INFORMATION, _RAMPS = 4, 5, 6  # rows of a ramp, after the states
_LEAST_HEARD_S = 0.3
_FORGETS = 0.8  # times as fast as it learns: the calm between two swells of a tremor isn't its end
_LEAST_CREEP = 2 * math.log(20e-6)  # ln of a variance; so slow it always is
_DOUBTFUL = 3.0  # ln R from which on it is worth knowing when and how fast
_CLIP = 6.0  # of an innovation squared: a slip must not pass for a new tremor


@dataclass(frozen=True, slots=True)
class Grip:
    """What a contact may do without sliding."""

    creep_m_s: float = 0.7e-3
    """standard deviation of the speed at which soft contacts creep and roll, at the start; then learnt"""
    level_m: float = 20e-6
    """standard deviation of where the level drifts in a second"""
    wander_m: float = 30e-6
    """standard deviation of the tremor's wander at the start; then it is learnt from the innovations"""
    wander_range_m: tuple[float, float] = (2e-6, 300e-6)
    wander_hz: float = 5.0
    """corner frequency of that"""
    learn_s: float = 1.0
    """time constant of learning it"""
    remember_s: float = 2.0
    """the same of that speed; sooner at the start"""
    coupling_m: float = 1e-3
    """standard deviation of how far the current of a firm contact moves the centroid"""
    coupling_rate: float = 0.05
    """of that, what changes in a second"""


class SlipTest:
    """Of n pads. `step` it with the samples of a tick; `log_odds` (n,) is ln R, `alarm` when it is high.

    `per_alarm` is the least mean number of samples from one false alarm to the next.
    """

    def __init__(self, pads: int, period_s: float, false_alarm_s: float, grip: Grip | None = None) -> None:
        self.grip = grip or Grip()
        self.period_s = period_s
        self.per_alarm = max(false_alarm_s / period_s, 2.0)
        self.log_odds = np.full(pads, -np.inf)
        self.onset_s = np.zeros(pads)
        """since the most likely onset"""
        self.speed = np.zeros((pads, 2))
        """of the ramp from then on, most likely [m/s]; both of those that may slip"""
        rate = 2 * np.pi * self.grip.wander_hz
        self._still = np.diag([0.0, 1.0, rate**2, 0.0])  # covariance of wander and its speed, relative
        coupling = (self.grip.coupling_m * self.grip.coupling_rate) ** 2
        self._drift = np.diag([self.grip.level_m**2, 0.0, 0.0, coupling])  # that comes in a second
        self._stride = max(1, round(_ONSET_S / period_s))
        self._state = np.zeros((pads, 2, _STATES))
        self._cov = np.zeros((pads, 2, _STATES, _STATES))
        self._press0 = np.zeros(pads)
        self._wander = np.zeros((pads, 2))  # ln of its variance
        self._wander_then = np.zeros((pads, 2))
        self._pressed = np.zeros((pads, 2))  # the last two
        self._press_noise = np.zeros(pads)  # variance of what is new in it with every sample
        self._steps = np.zeros(pads, dtype=np.int64)
        self._ramp = np.zeros((pads, _ONSETS))  # s since each onset, 0: none yet
        self._ramps = np.zeros((pads, _RAMPS, 2, _ONSETS))
        """what a ramp of 1 m/s has done to the states; sums of f nu / S and of f^2 / S"""
        self._heard_s = np.zeros(pads)  # of the contact, as long as it doesn't slip
        self._creep = np.zeros((2, pads, 2, _ONSETS))  # ln of the variance of its speed, by age; and then

    def begin(
        self, pads: IntArray, place: FloatArray, noise_m2: FloatArray, press: FloatArray, keep: bool = False
    ) -> None:
        """Contacts (k,) begin at places (k, 2) with variances of their noise (k, 2), so hard pressed (k,), or
        stick again: `keep` the tremor."""
        self._state[pads], self._state[pads, :, _LEVEL] = 0.0, place
        cov = np.zeros((len(pads), 2, _STATES, _STATES))
        cov[:, :, _LEVEL, _LEVEL] = _BEGINS_M**2 + noise_m2
        cov[:, :, _COUPLING, _COUPLING] = self.grip.coupling_m**2
        self._wander[pads] = self._wander_then[pads] if keep else 2 * np.log(self.grip.wander_m)
        self._creep[0, pads] = self._creep[1, pads] if keep else 2 * np.log(self.grip.creep_m_s)
        if not keep:
            self._press_noise[pads] = self._heard_s[pads] = 0.0
        self._pressed[pads] = press[:, None]
        cov += np.exp(self._wander[pads])[:, :, None, None] * self._still
        self._cov[pads] = cov
        self._press0[pads] = press
        self._steps[pads] = 0
        self._ramp[pads] = 0.0
        self._ramps[pads] = 0.0
        self.log_odds[pads] = -np.inf

    def runs(self, pads: IntArray) -> None:
        """They slip: what is learnt from now on is none of a grip's."""
        self._wander_then[pads], self._creep[1, pads] = self._wander[pads], self._creep[0, pads]

    def step(
        self,
        pads: IntArray,
        dt_s: FloatArray,
        place: FloatArray,
        noise_m2: FloatArray,
        press: FloatArray,
    ) -> BoolArray:
        """Take in samples (k,) that follow those before by dt (k,): places (k, 2), variances of their noise
        (k, 2), relative currents (k,). Returns which raise an alarm (k,)."""
        if (dt_s == dt_s[0]).all():
            dt_s = dt_s[:1]
        forward = self._forward(dt_s)
        gain, innovation, variance, row = self._filter(pads, dt_s, forward, place, noise_m2, press)
        ramp, ramps = self._ramp[pads], self._ramps[pads]
        self._open(pads, dt_s, ramp, ramps)
        flat = ramps.reshape(len(pads), _RAMPS, -1)  # a view
        flat[:, :_STATES] = forward @ flat[:, :_STATES]
        f = ramp[:, None] - (row[:, None] @ flat[:, :_STATES]).reshape(len(pads), 2, _ONSETS)
        ramps[:, :_STATES] += gain.transpose(0, 2, 1)[..., None] * f[:, None]
        weighted = f / variance[:, :, None]
        ramps[:, _GAIN] += weighted * innovation[:, :, None]
        ramps[:, _INFORMATION] += weighted * f
        self._ramp[pads], self._ramps[pads] = ramp, ramps
        part = self._learn(pads, dt_s, ramps)
        return self._judge(pads, ramp, ramps, part)

    def _filter(
        self,
        pads: IntArray,
        dt_s: FloatArray,
        forward: FloatArray,
        place: FloatArray,
        noise_m2: FloatArray,
        press: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """One step of the Kalman filter: gains (k, 2, states), innovations and variances (k, 2), and the row
        (k, states) of the place. dt_s and forward may be one for all."""
        turned, wander = forward.transpose(0, 2, 1), self._wander[pads]
        state, cov = self._state[pads] @ turned, forward[:, None] @ self._cov[pads] @ turned[:, None]
        cov += (self._drift * dt_s[:, None, None])[:, None]
        cov += np.exp(wander)[:, :, None, None] * (self._still - forward @ self._still @ turned)[:, None]
        row = np.ones((len(pads), _STATES))
        row[:, 2], row[:, _COUPLING] = 0.0, press - self._press0[pads]
        across = (cov @ row[:, None, :, None])[..., 0]
        vague = state[:, :, _COUPLING] ** 2 + cov[:, :, _COUPLING, _COUPLING]
        variance = (across * row[:, None]).sum(axis=2) + noise_m2 + vague * self._noise(pads, press)[:, None]
        innovation = place - (state * row[:, None]).sum(axis=2)
        gain = across / variance[:, :, None]
        self._state[pads] = state + gain * innovation[:, :, None]
        self._cov[pads] = cov - gain[..., None] * across[:, :, None]
        excess = np.minimum(innovation * innovation / variance, _CLIP) - 1
        wander += excess * (dt_s / self.grip.learn_s)[:, None]
        least, most = self.grip.wander_range_m
        self._wander[pads] = np.minimum(np.maximum(wander, 2 * math.log(least)), 2 * math.log(most))
        return gain, innovation, variance, row

    def _noise(self, pads: IntArray, press: FloatArray) -> FloatArray:
        """Variance (k,) of the noise of that, from second differences: tremor is far slower."""
        before, last = self._pressed[pads].T
        bend = (press - 2 * last + before) ** 2 / 6
        part = np.maximum(1 / (1 + self._steps[pads]), _PRESS_PART)
        self._press_noise[pads] += part * (bend - self._press_noise[pads])
        self._pressed[pads, 0], self._pressed[pads, 1] = last, press
        return np.asarray(self._press_noise[pads])

    def _forward(self, dt_s: FloatArray) -> FloatArray:
        """What becomes of the states in dt (k,): (k, states, states)."""
        rate = 2 * np.pi * self.grip.wander_hz
        passed = rate * dt_s
        decay, forward = np.exp(-passed), np.zeros((len(dt_s), _STATES, _STATES))
        forward[:, _LEVEL, _LEVEL] = forward[:, _COUPLING, _COUPLING] = 1.0
        forward[:, 1, 1], forward[:, 1, 2] = decay * (1 + passed), decay * dt_s
        forward[:, 2, 1], forward[:, 2, 2] = -decay * rate * passed, decay * (1 - passed)
        return forward

    def _open(self, pads: IntArray, dt_s: FloatArray, ramp: FloatArray, ramps: FloatArray) -> None:
        """Let ramps grow, and a new one begin now and then: all others move on, so that they go by age."""
        ramp += np.where(ramp > 0, dt_s[:, None], 0.0)
        number, rest = np.divmod(self._steps[pads], self._stride)
        self._steps[pads] += 1
        due = rest == 0
        if np.count_nonzero(due):
            last = due & (number % _THIN == _THIN - 1)  # the others of its like leave
            if np.count_nonzero(last):
                ramp[last, _FRESH:] = ramp[last, _FRESH - 1 : -1]
                ramps[last, ..., _FRESH:] = ramps[last, ..., _FRESH - 1 : -1]
            every = slice(None) if due.all() else due
            ramp[every, 1:_FRESH] = ramp[every, : _FRESH - 1]
            ramps[every, ..., 1:_FRESH] = ramps[every, ..., : _FRESH - 1]
            ramp[every, 0] = np.broadcast_to(dt_s, due.shape)[every]  # it began with the sample before
            ramps[every, ..., 0] = 0.0

    def _learn(self, pads: IntArray, dt_s: FloatArray, ramps: FloatArray) -> FloatArray:
        """Which part (k, 2, onsets) of what ramps have met counts, by what those of such an age met before.

        A ramp of information I, while it creeps at speeds of variance v, meets 1 + I v times its own.
        """
        creep, information = self._creep[0, pads], ramps[:, _INFORMATION]
        more = 1 + information * np.exp(creep)
        met = ramps[:, _GAIN] ** 2 / np.maximum(information, 1e-300)
        self._heard_s[pads] += dt_s
        lasts = np.minimum(np.maximum(self._heard_s[pads], _LEAST_HEARD_S), self.grip.remember_s)
        slope = (np.minimum(met / more, _CLIP) - 1) * (1 - 1 / more)  # of the likelihood, over ln creep
        slope *= np.where(slope < 0, _FORGETS, 1.0)
        creep += slope * (dt_s / lasts)[:, None, None]
        self._creep[0, pads] = np.maximum(creep, _LEAST_CREEP)
        return np.asarray(1 / (more * np.sqrt(np.sqrt(more))))  # the power: tails aren't as modelled, either

    def _judge(self, pads: IntArray, ramp: FloatArray, ramps: FloatArray, part: FloatArray) -> BoolArray:
        """ln R from the onsets' likelihood ratios, each standing for `stride` samples."""
        information = part * ramps[:, _INFORMATION]
        square = (part * ramps[:, _GAIN]) ** 2
        x, y = (information[:, axis, None] * _SPEEDS**2 + 1 for axis in (0, 1))  # (k, speeds, onsets)
        quotient = (square[:, 0, None] / x + square[:, 1, None] / y) * _SPEEDS**2
        ratios = 0.5 * (quotient - np.log(x * y))
        most = ratios.max(axis=(1, 2))
        total = np.exp(ratios - most[:, None, None]).sum(axis=1) * (_STANDS / len(_SPEEDS))
        total *= ramp > 0  # slots that no onset has yet
        log_odds = most + np.log(total.sum(axis=1) * self._stride)
        self.log_odds[pads] = log_odds
        if len(rows := np.flatnonzero(log_odds > _DOUBTFUL)):
            best = total[rows].argmax(axis=1)
            self.onset_s[pads[rows]] = ramp[rows, best]
            known = np.maximum(ramps[rows, _INFORMATION, :, best], 1e-12)
            self.speed[pads[rows]] = ramps[rows, _GAIN, :, best] / known
        return np.asarray(log_odds > np.log(self.per_alarm))

    def told(self) -> tuple[FloatArray, FloatArray]:
        """Of every ramp (n, onsets): its age [s], and twice what one of 1 m/s along an axis adds to ln of its
        likelihood ratio, in the mean, if it is one: no test can know it sooner."""
        return self._ramp.copy(), self._ramps[:, _INFORMATION].mean(axis=1)

    def tremor_m(self, pads: IntArray) -> FloatArray:
        """Standard deviation (k, 2) of the wander as learnt."""
        return np.asarray(np.exp(0.5 * self._wander[pads]))
