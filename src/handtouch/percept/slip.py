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

Public names: `SlipTest`, `Grip`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_SPEEDS = np.array([1e-3, 5e-3, 30e-3])  # standard deviations of the prior of each component [m/s]
_BEGINS_M = 50e-6  # how far a level may be from its first sample
_PRESS_PART = 0.02  # of a sample, in what is known of the noise of that
_ONSETS = 96
_ONSET_S = 0.005
_LEVEL, _WANDER, _COUPLING, _STATES = 0, slice(1, 3), 3, 4
_CLIP = 6.0  # of an innovation squared: a slip must not pass for a new tremor


@dataclass(frozen=True, slots=True)
class Grip:
    """What a contact may do without sliding."""

    level_m: float = 20e-6
    """standard deviation of where the level drifts in a second"""
    wander_m: float = 30e-6
    """standard deviation of the tremor's wander at the start; then it is learnt from the innovations"""
    wander_range_m: tuple[float, float] = (2e-6, 300e-6)
    wander_hz: float = 5.0
    """corner frequency of that"""
    learn_s: float = 1.0
    """time constant of learning it"""
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
        """of the ramp from then on, most likely [m/s]"""
        rate = 2 * np.pi * self.grip.wander_hz
        self._still = np.diag([1.0, rate**2])  # covariance of wander and its speed, relative
        self._stride = max(1, round(_ONSET_S / period_s))
        self._state = np.zeros((pads, 2, _STATES))
        self._cov = np.zeros((pads, 2, _STATES, _STATES))
        self._press0 = np.zeros(pads)
        self._wander = np.zeros((pads, 2))  # ln of its variance
        self._wander_then = np.zeros((pads, 2))
        self._pressed = np.zeros((pads, 2))  # the last two
        self._press_noise = np.zeros(pads)  # variance of what is new in it with every sample
        self._steps = np.zeros(pads, dtype=np.int64)
        shape = (pads, 2, _ONSETS)
        self._ramp = np.zeros((pads, _ONSETS))  # s since each onset, 0: none yet
        self._bias = np.zeros((_STATES, *shape))  # what a ramp of 1 m/s has done to the states
        self._gain = np.zeros(shape)  # sum of f nu / S
        self._information = np.zeros(shape)  # sum of f^2 / S

    def begin(self, pads: IntArray, place: FloatArray, press: FloatArray, keep: bool = False) -> None:
        """Contacts (k,) begin at places (k, 2), so hard pressed (k,), or stick again: `keep` the tremor."""
        self._state[pads, :, _LEVEL], self._state[pads, :, _WANDER] = place, 0.0
        cov = np.zeros((len(pads), 2, _STATES, _STATES))
        cov[:, :, _LEVEL, _LEVEL] = _BEGINS_M**2
        cov[:, :, _COUPLING, _COUPLING] = self.grip.coupling_m**2
        self._state[pads, :, _COUPLING] = 0.0
        self._wander[pads] = self._wander_then[pads] if keep else 2 * np.log(self.grip.wander_m)
        if not keep:
            self._press_noise[pads] = 0.0
        self._pressed[pads] = press[:, None]
        cov[:, :, _WANDER, _WANDER] = np.exp(self._wander[pads])[:, :, None, None] * self._still
        self._cov[pads] = cov
        self._press0[pads] = press
        self._steps[pads] = 0
        self._ramp[pads] = 0.0
        self._bias[:, pads] = 0.0
        self._gain[pads] = self._information[pads] = 0.0
        self.log_odds[pads] = -np.inf

    def runs(self, pads: IntArray) -> None:
        """They slip: what is learnt from now on is none of a grip's."""
        self._wander_then[pads] = self._wander[pads]

    def step(
        self, pads: IntArray, dt_s: FloatArray, place: FloatArray, noise_m2: FloatArray, press: FloatArray
    ) -> BoolArray:
        """Take in samples (k,) that follow those before by dt (k,): places (k, 2), variances of their noise
        (k, 2), relative currents (k,). Returns which raise an alarm (k,)."""
        gain, innovation, variance, forward, row = self._filter(pads, dt_s, place, noise_m2, press)
        ramp = self._open(pads, dt_s)
        level, wander, speed, coupling = self._bias[:, pads]
        stays, comes, slows, keeps = forward.reshape(-1, 4).T[:, :, None, None]
        wander, speed = stays * wander + comes * speed, slows * wander + keeps * speed
        f = ramp[:, None] - level - wander - row[:, _COUPLING, None, None] * coupling
        gains = gain.transpose(2, 0, 1)[:, :, :, None]
        self._bias[:, pads] = np.stack([level, wander, speed, coupling]) + gains * f
        weighted = f / variance[:, :, None]
        self._information[pads] += weighted * f
        self._gain[pads] += weighted * innovation[:, :, None]
        return self._judge(pads)

    def _filter(
        self, pads: IntArray, dt_s: FloatArray, place: FloatArray, noise_m2: FloatArray, press: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """One step of the Kalman filter: gains (k, 2, states), innovations and variances (k, 2), what becomes
        of wander (k, 2, 2), and the row (k, states) of the place."""
        grip, state, cov = self.grip, self._state[pads], self._cov[pads]
        forward = self._forward(dt_s)
        turned = forward.transpose(0, 2, 1)
        state[:, :, _WANDER] = state[:, :, _WANDER] @ turned
        cov[:, :, _WANDER, :] = forward[:, None] @ cov[:, :, _WANDER, :]
        cov[:, :, :, _WANDER] = cov[:, :, :, _WANDER] @ turned[:, None]
        cov[:, :, _LEVEL, _LEVEL] += (grip.level_m**2 * dt_s)[:, None]
        renewed = self._still - forward @ self._still @ turned
        cov[:, :, _WANDER, _WANDER] += np.exp(self._wander[pads])[:, :, None, None] * renewed[:, None]
        coupling = (grip.coupling_m * grip.coupling_rate) ** 2
        cov[:, :, _COUPLING, _COUPLING] += (coupling * dt_s)[:, None]
        row = np.zeros((len(pads), _STATES))
        row[:, :2], row[:, _COUPLING] = 1.0, press - self._press0[pads]
        across = (cov @ row[:, None, :, None])[..., 0]
        vague = state[:, :, _COUPLING] ** 2 + cov[:, :, _COUPLING, _COUPLING]
        variance = np.einsum("kai,ki->ka", across, row) + noise_m2 + vague * self._noise(pads, press)[:, None]
        innovation = place - np.einsum("kai,ki->ka", state, row)
        gain = across / variance[:, :, None]
        self._state[pads] = state + gain * innovation[:, :, None]
        self._cov[pads] = cov - gain[..., None] * across[:, :, None]
        excess = np.minimum(innovation**2 / variance, _CLIP) - 1
        least, most = (2 * np.log(edge) for edge in grip.wander_range_m)
        learnt = self._wander[pads] + excess * (dt_s / grip.learn_s)[:, None]
        self._wander[pads] = np.clip(learnt, least, most)
        return gain, innovation, variance, forward, row

    def _noise(self, pads: IntArray, press: FloatArray) -> FloatArray:
        """Variance (k,) of the noise of that, from second differences: tremor is far slower."""
        before, last = self._pressed[pads].T
        bend = (press - 2 * last + before) ** 2 / 6
        part = np.maximum(1 / (1 + self._steps[pads]), _PRESS_PART)
        self._press_noise[pads] += part * (bend - self._press_noise[pads])
        self._pressed[pads, 0], self._pressed[pads, 1] = last, press
        return np.asarray(self._press_noise[pads])

    def _forward(self, dt_s: FloatArray) -> FloatArray:
        """What becomes of wander and its speed in dt (k,): (k, 2, 2)."""
        rate = 2 * np.pi * self.grip.wander_hz
        passed = rate * dt_s
        rows = [[1 + passed, dt_s], [-rate * passed, 1 - passed]]
        return np.asarray(np.exp(-passed) * np.array(rows)).transpose(2, 0, 1)

    def _open(self, pads: IntArray, dt_s: FloatArray) -> FloatArray:
        """Let ramps grow (k, onsets), and a new one begin now and then, in the place of the oldest."""
        ramp = self._ramp[pads]
        ramp += np.where(ramp > 0, dt_s[:, None], 0.0)
        due = self._steps[pads] % self._stride == 0
        fresh, slot = pads[due], (self._steps[pads][due] // self._stride) % _ONSETS
        ramp[due, slot] = dt_s[due]  # it began with the sample before
        self._bias[:, fresh, :, slot] = 0.0
        self._gain[fresh, :, slot] = self._information[fresh, :, slot] = 0.0
        self._ramp[pads] = ramp
        self._steps[pads] += 1
        return ramp

    def _judge(self, pads: IntArray) -> BoolArray:
        """ln R from the onsets' likelihood ratios, each standing for `stride` samples."""
        d, information = self._gain[pads][:, None], self._information[pads][:, None]
        more = information + (1 / _SPEEDS**2)[:, None, None]  # (k, speeds, 2, onsets)
        quotient = (d * d / more).sum(axis=2)
        relative = more[:, :, 0] * more[:, :, 1] * (_SPEEDS**4)[:, None]
        ratios = 0.5 * (quotient - np.log(relative))
        most = ratios.max(axis=(1, 2))
        total = np.exp(ratios - most[:, None, None]).sum(axis=1) / len(_SPEEDS)
        total *= self._ramp[pads] > 0  # slots that no onset has yet
        log_odds = most + np.log(total.sum(axis=1) * self._stride)
        self.log_odds[pads] = log_odds
        best = total.argmax(axis=1)
        rows = np.arange(len(pads))
        self.onset_s[pads] = self._ramp[pads, best]
        information = self._information[pads][rows, :, best]
        self.speed[pads] = self._gain[pads][rows, :, best] / np.maximum(information, 1e-12)
        return np.asarray(log_odds > np.log(self.per_alarm))

    def tremor_m(self, pads: IntArray) -> FloatArray:
        """Standard deviation (k, 2) of the wander as learnt."""
        return np.asarray(np.exp(0.5 * self._wander[pads]))
