"""Percept `motion`: sticking, incipient slip, sliding, rolling or lift-off of every contact.

At every tick `SlipTest` tests whether the centroid has begun to move, and a Kalman filter tracks its velocity
on the pad. Once it moves, joint states distinguish sliding from rolling: the surfaces' relative velocity is
that of the link's material less that of the object, which is a rigid body held by the hand's other sticking
contacts, or static in the palm frame without any. Without joint states a moving centroid counts as sliding,
with a fixed prior probability of rolling.

Public names: `MotionEstimator`, `MOTION_CLASSES`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.relative_motion import LinkMotions, RelativeMotion, relative_to_object
from handtouch.percept.samples import (
    ContactBuffer,
    ContactSamples,
    IntArray,
    PerceptEstimate,
)
from handtouch.percept.slip import SlipTest

FloatArray = NDArray[np.float64]

MOTION_CLASSES = ("sticking", "incipient", "sliding", "rolling", "lift-off")
FALSE_ALARM_S = 600.0
"""Lower bound on the mean time between two false alarms of one contact, under the grip model."""
_SLIP_RATE_HZ = 0.05  # prior rate of slips of a contact
_UNLOADING_SLIP_RATE_FACTOR = 5.0  # while its force falls as fast as it has ever done
_ROLLING_PRIOR = 0.2  # fraction of moving centroids that roll, without joint states
_ODDS_DECAY_S = 0.05  # time constant in which outdated evidence of slip decays
_MIN_QUESTION_LOG_ODDS = math.log(0.25)  # ln of the odds of slip above which a question is posed
_REQUESTED_HOLD_S = 0.5
_FIRM_CURRENT_FACTOR = 10.0  # current of a firm contact over that at its begin
_MIN_SAMPLES = 4  # of a contact, before which its motion is undetermined
_MIN_VARIANCE_M2 = 1e-14
_REPORT_PERIOD_NS = 50_000_000
_POSITION_ROW, _VELOCITY_VARIANCE_ROW = 0, 4  # rows of the velocity filter
_ACCELERATION_DENSITY = 0.01  # of the centroid, root of spectral density [m/s^1.5]
_LIFT_OFF_HORIZON_S = 0.04  # lift-off if the force, at its present rate, vanishes within this time
_FORCE_RATE_TIME_CONSTANT_S = 0.02  # of smoothing
_MAX_STICKING_LOG_ODDS = -3.0  # ln of the odds of slip below which a contact holds the object
_MIN_REST_S = 0.06  # of a centroid, before it counts as sticking again
_MAX_REST_SPEED_M_PER_S = 0.5e-3


class MotionEstimator:
    """Estimates the motion of every contact, 20 times a second and at once when its class changes."""

    kind = "motion"

    def __init__(self, buffer: ContactBuffer, period_ns: int, false_alarm_s: float = FALSE_ALARM_S) -> None:
        n = buffer.size
        self.requested = np.zeros(n, dtype=np.bool_)
        self.slip_test = SlipTest(n, period_ns * 1e-9, false_alarm_s)
        self.slipping = np.zeros(n, dtype=np.bool_)
        """contacts (n,) whose centroid moves"""
        self.slip_count = 0
        self._last_sample_ns = np.zeros(n, dtype=np.int64)
        self._last_report_ns = np.zeros(n, dtype=np.int64)
        self._label = np.zeros(n, dtype=np.intp)
        self._quick_label = np.zeros(n, dtype=np.intp)  # class without joint states
        self._velocity_filter = np.zeros((5, n, 2))  # position, velocity; variance, covariance, variance
        self._force = np.zeros(n)  # smoothed
        self._force_rate = np.zeros(n)
        self._force_rate_std = np.zeros(n)
        self._slip_start_m = np.zeros((n, 2))  # position at the onset
        self._rest_s = np.zeros(n)
        self._contact_slip_count = np.zeros(n, dtype=np.int64)
        self._firm_current_a, self._peak_current_a = np.zeros((2, n))
        self._slip_uncertain = np.zeros(n, dtype=np.bool_)
        self._slip_log_odds = np.full(n, -np.inf)
        self._hand_and_contact = np.zeros((n, 2), dtype=np.int64)  # hand and id

    def process_samples(
        self, buffer: ContactBuffer, sample: ContactSamples, began: IntArray
    ) -> Sequence[PerceptEstimate]:
        """Update every contact that has a new sample."""
        position, force = sample["pad_m"], sample["force_n"]
        variance = np.diagonal(sample["pad_noise_m2"], axis1=1, axis2=2)
        if not (variance > _MIN_VARIANCE_M2).all():  # too light for a noise estimate
            whole = np.trace(sample["covariance_m2"], axis1=1, axis2=2)[:, None] / 2
            variance = np.where(variance > _MIN_VARIANCE_M2, variance, np.maximum(whole, _MIN_VARIANCE_M2))
        force = np.where(np.isfinite(force), force, self._force[sample.pads])
        new = np.isin(sample.pads, began) if len(began) else np.zeros(len(sample.pads), dtype=np.bool_)
        press = self._relative_current(sample.pads, sample["total_current_a"], new)
        usable = np.isfinite(position.sum(axis=1) + variance.sum(axis=1) + press)
        if len(began):
            self._begin_contacts(
                sample.pads[new], position[new], variance[new], force[new], sample.sample_ns[new]
            )
            self.slip_test.start_contacts(sample.pads[new], position[new], variance[new], press[new])
        dt_s = np.asarray((sample.sample_ns - self._last_sample_ns[sample.pads]) * 1e-9, dtype=np.float64)
        go = usable & ~new & (dt_s > 0)
        if np.count_nonzero(go):
            pads = sample.pads[go]
            self._last_sample_ns[pads] = sample.sample_ns[go]
            self._update_velocity_filter(pads, dt_s[go], position[go], variance[go], force[go])
            alarm = self.slip_test.process_samples(pads, dt_s[go], position[go], variance[go], press[go])
            self._start_slip(pads[alarm & ~self.slipping[pads]], buffer)
            self._detect_rest(pads, dt_s[go], position[go], variance[go], press[go])
        quick_labels = self.classify(sample.pads, dt_s)
        rows = self._rows_to_report(sample, quick_labels)
        if not len(rows):
            return ()
        known = LinkMotions.from_buffer(buffer, int(sample.sample_ns.max()), self.slip_test.period_s)
        return [
            self._estimate_motion(
                buffer, int(sample.pads[k]), int(sample.sample_ns[k]), int(quick_labels[k]), known
            )
            for k in rows.tolist()
        ]

    def _rows_to_report(self, sample: ContactSamples, quick_labels: IntArray) -> IntArray:
        """Return the rows whose class changed, and some of those whose report period has passed."""
        news = quick_labels != self._quick_label[sample.pads]
        waits = sample.sample_ns - self._last_report_ns[sample.pads]
        due = np.flatnonzero((waits >= _REPORT_PERIOD_NS) & ~news)
        few = math.ceil(1.25 * len(sample.pads) * self.slip_test.period_s * 1e9 / _REPORT_PERIOD_NS)
        if len(due) > few:
            due = due[np.argsort(-waits[due], kind="stable")[:few]]
        return np.concatenate([news.nonzero()[0], due])

    def next_pad_to_fit(self, buffer: ContactBuffer, now_ns: int) -> int | None:  # noqa: ARG002
        """Return None: motion needs no slow fits."""
        return None

    def fit_contact(self, buffer: ContactBuffer, pad: int, now_ns: int) -> Sequence[PerceptEstimate]:  # noqa: ARG002
        """Return nothing: motion needs no slow fits."""
        return ()

    def open_questions(self, now_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Return a slip question for uncertain contacts; holding still separates a ramp from tremor."""
        return [self._slip_question(pad) for pad in np.flatnonzero(self._slip_uncertain).tolist()]

    def end_contacts(self, buffer: ContactBuffer, pads: IntArray, now_ns: int) -> Sequence[PerceptEstimate]:
        """Report lift-off for contacts that ended."""
        estimates = []
        for pad in pads.tolist():
            probabilities = {name: float(name == "lift-off") for name in MOTION_CLASSES}
            estimates.append(self._percept(buffer, pad, now_ns, probabilities, at_once=True))
            self.slipping[pad] = self._slip_uncertain[pad] = False
        return estimates

    def velocity(self, pads: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return velocities (k, 2) on the pads and their standard deviations [m/s]."""
        return self._velocity_filter[1, pads], np.sqrt(self._velocity_filter[_VELOCITY_VARIANCE_ROW, pads])

    # Details ----------------------------------------------------------------------------------------------

    def _relative_current(self, pads: IntArray, current_a: FloatArray, new: NDArray[np.bool_]) -> FloatArray:
        """Return currents (k,) relative to a firm contact on each pad: its peak so far, or a start value."""
        self._firm_current_a[pads[new]] = np.fmax(
            self._peak_current_a[pads[new]], _FIRM_CURRENT_FACTOR * current_a[new]
        )
        self._peak_current_a[pads] = np.fmax(self._peak_current_a[pads], current_a)
        return np.asarray(current_a / np.maximum(self._firm_current_a[pads], 1e-12))

    def _begin_contacts(
        self,
        pads: IntArray,
        position: FloatArray,
        variance: FloatArray,
        force: FloatArray,
        now_ns: NDArray[np.int64],
    ) -> None:
        if not len(pads):
            return
        self._velocity_filter[:, pads] = 0.0
        (
            self._velocity_filter[_POSITION_ROW, pads],
            self._velocity_filter[2, pads],
            self._velocity_filter[_VELOCITY_VARIANCE_ROW, pads],
        ) = (
            position,
            variance,
            1e-4,
        )
        self._force[pads], self._force_rate[pads], self._force_rate_std[pads] = force, 0.0, np.abs(force)
        self._last_sample_ns[pads] = now_ns
        self._last_report_ns[pads] = 0
        self._label[pads] = self._quick_label[pads] = -1
        self.slipping[pads] = self._slip_uncertain[pads] = False
        self._contact_slip_count[pads] = 0
        self._slip_log_odds[pads] = -np.inf

    def _update_velocity_filter(
        self, pads: IntArray, dt_s: FloatArray, position: FloatArray, variance: FloatArray, force: FloatArray
    ) -> None:
        """Update the filters of position (constant velocity with random acceleration) and of the force's
        rate.
        """
        dt = dt_s[:, None]
        density = _ACCELERATION_DENSITY**2 * dt
        at, velocity, pp, pv, vv = self._velocity_filter[:, pads]
        pp += dt * (2 * pv + dt * (vv + density / 3))
        pv += dt * (vv + density / 2)
        vv += density
        at += dt * velocity
        total, off = pp + variance, position - at
        of_place, of_velocity = pp / total, pv / total
        at += of_place * off
        velocity += of_velocity * off
        vv -= of_velocity * pv
        pv -= of_place * pv
        pp -= of_place * pp
        self._velocity_filter[:, pads] = at, velocity, pp, pv, vv
        part = 1 - np.exp(-dt_s / _FORCE_RATE_TIME_CONSTANT_S)
        rate = (force - self._force[pads]) / (dt_s + _FORCE_RATE_TIME_CONSTANT_S * (1 - part))
        self._force[pads] += part * (force - self._force[pads])
        self._force_rate[pads] += part * (rate - self._force_rate[pads])
        slow = np.minimum(dt_s / 1.0, 1.0)
        self._force_rate_std[pads] = np.sqrt(
            (1 - slow) * self._force_rate_std[pads] ** 2 + slow * self._force_rate[pads] ** 2 + 1e-12
        )

    def _start_slip(self, pads: IntArray, buffer: ContactBuffer) -> None:
        """Mark contacts as slipping, from their most likely onset on."""
        for pad in pads.tolist():
            self.slip_count += 1
            self._contact_slip_count[pad] += 1
            window = buffer.window(pad)
            at = int(np.searchsorted(window.relative_s, -self.slip_test.onset_age_s[pad]))
            self._slip_start_m[pad] = window["pad_m"][min(at, len(window) - 1)]
            self.slipping[pad] = True
            self.slip_test.mark_slipping(np.array([pad]))
            self._rest_s[pad] = 0.0

    def _detect_rest(
        self, pads: IntArray, dt_s: FloatArray, position: FloatArray, variance: FloatArray, press: FloatArray
    ) -> None:
        """Restart the slip test of contacts that slipped and have come to rest."""
        if not np.count_nonzero(self.slipping[pads]):
            return
        velocity, std = self.velocity(pads)
        speed = np.hypot(*velocity.T)
        quiet = speed < np.maximum(2 * np.hypot(*std.T), _MAX_REST_SPEED_M_PER_S)
        self._rest_s[pads] = np.where(quiet, self._rest_s[pads] + dt_s, 0.0)
        at_rest = self.slipping[pads] & (self._rest_s[pads] > _MIN_REST_S)
        if np.count_nonzero(at_rest):
            self.slipping[pads[at_rest]] = False
            self._slip_log_odds[pads[at_rest]] = -np.inf
            self.slip_test.start_contacts(
                pads[at_rest], position[at_rest], variance[at_rest], press[at_rest], keep=True
            )

    def classify(self, pads: IntArray, dt_s: FloatArray) -> NDArray[np.intp]:
        """Update contacts (k,) with the slip test's odds; return their likeliest class without joint states.

        dt_s: times (k,) since their previous samples [s].
        """
        self._update_slip_log_odds(pads, dt_s)
        odds, runs = self._slip_log_odds[pads], self.slipping[pads]
        self._slip_uncertain[pads] = (odds > _MIN_QUESTION_LOG_ODDS) & ~runs
        quick_labels = np.where(runs, 2, np.where(odds > 0, 1, 0))
        return np.where(self._extrapolated_force(pads) < 0, 4, quick_labels)

    def _estimate_motion(
        self, buffer: ContactBuffer, pad: int, now_ns: int, quick_labels: int, known: LinkMotions
    ) -> PerceptEstimate:
        """Return the percept of one contact."""
        slips, leaves = self._slip_probability(pad), self._lift_off_probability(pad)
        self._hand_and_contact[pad] = buffer.hand_index[pad], buffer.contact_id[pad]
        uncertain = self.slipping | (self._slip_log_odds > _MAX_STICKING_LOG_ODDS)
        relative = relative_to_object(known, pad, buffer.hand_index, uncertain)
        probabilities = self._class_probabilities(pad, slips, leaves, relative)
        best = max(range(len(MOTION_CLASSES)), key=lambda k: probabilities[MOTION_CLASSES[k]])
        news = best != self._label[pad]
        self._label[pad], self._quick_label[pad], self._last_report_ns[pad] = best, quick_labels, now_ns
        return self._percept(buffer, pad, now_ns, probabilities, at_once=bool(news), relative=relative)

    def _slip_question(self, pad: int) -> Question:
        slips = self._slip_probability(pad)
        tremor = float(np.hypot(*self.slip_test.tremor_std_m(np.array([pad]))[0]))
        ramp = _REQUESTED_HOLD_S * float(np.hypot(*self.slip_test.slip_velocity_m_per_s[pad]))
        hold = CandidateAction(
            "hold",
            {"duration_s": _REQUESTED_HOLD_S},
            {"sticks": (0.0, tremor), "slides": (ramp, math.hypot(tremor, ramp / 2))},
            outcome_name="further displacement of the centroid in m",
        )
        hand, contact = self._hand_and_contact[pad].tolist()
        return Question("slip", hand, pad, contact, {"sticks": 1 - slips, "slides": slips}, [hold])

    def _update_slip_log_odds(self, pads: IntArray, dt_s: FloatArray) -> None:
        """Update ln of the odds of slip: R times the prior rate of slips at such forces.

        Recent evidence decays slowly, or a contact near the threshold would chatter.
        """
        falls = np.maximum(-self._force_rate[pads], 0.0) / np.maximum(3 * self._force_rate_std[pads], 1e-9)
        hazard = (
            _SLIP_RATE_HZ
            * (1 + (_UNLOADING_SLIP_RATE_FACTOR - 1) * np.minimum(falls, 1.0))
            * self.slip_test.period_s
        )
        odds = self.slip_test.log_odds[pads] + np.log(hazard)
        self._slip_log_odds[pads] = np.fmax(odds, self._slip_log_odds[pads] - dt_s / _ODDS_DECAY_S)

    def _slip_probability(self, pad: int) -> float:
        if self.slipping[pad]:
            return 1.0
        odds = float(self._slip_log_odds[pad])
        return 1 / (1 + math.exp(min(max(-odds, -50.0), 50.0)))

    def _extrapolated_force(self, pads: IntArray) -> FloatArray:
        """Return forces (k,) extrapolated at their rate of change, the lag of smoothing included."""
        return np.asarray(
            self._force[pads] + (_LIFT_OFF_HORIZON_S + _FORCE_RATE_TIME_CONSTANT_S) * self._force_rate[pads]
        )

    def _lift_off_probability(self, pad: int) -> float:
        """Return the probability that the force is zero by then."""
        ahead = float(self._extrapolated_force(np.array([pad]))[0])
        std = max(_LIFT_OFF_HORIZON_S * 0.3 * abs(self._force_rate[pad]), 0.03 * self._force[pad], 1e-3)
        return 0.5 * math.erfc(ahead / (std * math.sqrt(2)))

    def _class_probabilities(
        self, pad: int, slips: float, leaves: float, relative: RelativeMotion | None
    ) -> dict[str, float]:
        stays = 1 - leaves
        slides = (1 - _ROLLING_PRIOR) if relative is None else relative.sliding_probability
        runs = stays * slips if self.slipping[pad] else 0.0
        still = stays * (1 - slips)
        creeps = stays * slips - runs
        if relative is not None and not self.slipping[pad]:  # a contact that slides may rest on the pad
            runs += still * relative.sliding_at_rest_probability
            still *= 1 - relative.sliding_at_rest_probability
            slides = 1.0 if relative.sliding_at_rest_probability > slides else slides
        found = (still, creeps, runs * slides, runs * (1 - slides), leaves)
        return dict(zip(MOTION_CLASSES, map(float, found), strict=True))

    def _percept(
        self,
        buffer: ContactBuffer,
        pad: int,
        now_ns: int,
        probabilities: dict[str, float],
        at_once: bool,
        relative: RelativeMotion | None = None,
    ) -> PerceptEstimate:
        (velocity,), (std,) = self.velocity(np.array([pad]))
        count = int(buffer.sample_count[pad])
        times = buffer.window(pad).sample_ns
        label = max(probabilities, key=lambda name: probabilities[name])
        few = count < _MIN_SAMPLES and label == "sticking"
        values: dict[str, float | str | Sequence[float] | None] = {
            "velocity_m_per_s": velocity.tolist(),
            "velocity_m_per_s_std": std.tolist(),
            "force_rate_n_per_s": float(self._force_rate[pad]),
            "tremor_std_m": self.slip_test.tremor_std_m(np.array([pad]))[0].tolist(),
        }
        if self.slipping[pad]:
            way = self._velocity_filter[_POSITION_ROW, pad] - self._slip_start_m[pad]
            values["slip_distance_m"] = float(np.hypot(*way))
        if relative is not None:
            values |= relative.message_values()
        odds = float(self.slip_test.log_odds[pad])
        return PerceptEstimate(
            self.kind,
            int(buffer.hand_index[pad]),
            pad,
            int(buffer.contact_id[pad]),
            now_ns,
            "undetermined" if few else "estimated",
            label,
            probabilities,
            values,
            {
                "samples": count,
                "span_s": float(times[-1] - times[0]) * 1e-9 if count else 0.0,
                "log_odds": odds if math.isfinite(odds) else 0.0,
                "slips": int(self._contact_slip_count[pad]),
            },
            f"contact has just begun: at least {_MIN_SAMPLES} samples are needed" if few else "",
            at_once,
        )
