"""Percept `motion`: sticking, incipient slip, sliding, rolling or lift-off of every contact.

The slip stage of the core detects whether a centroid has begun to move. Without joint states a moving
centroid counts as sliding, with a fixed prior probability of rolling. With joint states
`handtouch.percept.slip_evidence` computes the odds of slip from the motion of centroid and links;
and a contact slides, too, whose link moves against the object by more than the joints' deviations explain:
the object is a rigid body held by the hand's other sticking contacts.

Public name: `MotionReporter`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from handtouch.arrays import IntArray
from handtouch.core.stages.slip import MOTION_CLASSES, SlipDetector
from handtouch.percept.relative_motion import RelativeMotion, slip_probability
from handtouch.percept.samples import ContactBuffer, PerceptEstimate
from handtouch.percept.slip_evidence import SlipEvidence

# Constants without an origin beside them were chosen; docs/benchmarks/percept_grasp.md measures what they
# yield.
_ROLLING_PRIOR = 0.2  # fraction of moving centroids that roll, without joint states
_MIN_SAMPLES = 4  # samples of a contact before which its motion is undetermined
_REPORT_PERIOD_NS = 50_000_000
_LIFT_OFF_HORIZON_S, _FORCE_RATE_TIME_S = 0.04, 0.02  # as in the slip stage
_MIN_SLIDING_PROBABILITY = 0.8  # probability of slip by joint states, while the centroid isn't known to move


class MotionReporter:
    """Reports the motion of every contact, 20 times a second and at once when its class changes.

    poses: buffer of the contacts' last samples, for the velocities of links in the palm frame.
    """

    def __init__(self, slip: SlipDetector, poses: ContactBuffer, period_s: float) -> None:
        n = len(slip.contact_id)
        self._slip, self._poses, self._period_s = slip, poses, period_s
        self._evidence = SlipEvidence(poses, slip, period_s)
        self._log_odds = self._evidence.log_odds
        self._last_report_ns = np.zeros(n, dtype=np.int64)
        self._detected_label = np.zeros(n, dtype=np.intp)
        self._reported_contact = np.zeros(n, dtype=np.uint32)

    def report_contacts(self, pads: IntArray, now_ns: int) -> list[PerceptEstimate]:
        """Return estimates about contacts on pads (k,) whose newest sample is of `now_ns`, where due."""
        slip = self._slip
        pads = pads[slip.contact_id[pads] > 0]
        if not len(pads):
            return []
        fresh = pads[self._reported_contact[pads] != slip.contact_id[pads]]
        self._reported_contact[fresh] = slip.contact_id[fresh]
        self._detected_label[fresh] = -1
        self._last_report_ns[fresh] = 0
        self._evidence.restart_contacts(fresh)
        self._evidence.update_odds(pads, now_ns)
        due = self._pads_to_report(pads, now_ns)
        if not len(due):
            return []
        self._evidence.compute_velocities(now_ns)
        return [self._estimate_motion(pad, now_ns) for pad in due.tolist()]

    def end_contacts(self, pads: IntArray, now_ns: int) -> list[PerceptEstimate]:
        """Return the lift-off of contacts that ended on these pads."""
        pads = pads[self._slip.contact_id[pads] > 0]
        lifted = {name: float(name == "lift-off") for name in MOTION_CLASSES}
        return [self._percept(pad, now_ns, lifted) for pad in pads.tolist()]

    # Details ----------------------------------------------------------------------------------------------

    def _labels(self, pads: IntArray) -> IntArray:
        """Return numbers (k,) that change with the class of a contact."""
        with np.errstate(invalid="ignore"):
            slips = self._log_odds[pads] > 0
        known = len(MOTION_CLASSES) * (slips + 2 * np.isfinite(self._log_odds[pads]))
        return np.asarray(self._slip.contacts().label[pads].astype(np.intp) + known)

    def _pads_to_report(self, pads: IntArray, now_ns: int) -> IntArray:
        """Return the pads whose class changed, and some of those whose report period has passed."""
        changed = self._labels(pads) != self._detected_label[pads]
        waits = now_ns - self._last_report_ns[pads]
        due = np.flatnonzero((waits >= _REPORT_PERIOD_NS) & ~changed)
        few = math.ceil(1.25 * len(pads) * self._period_s * 1e9 / _REPORT_PERIOD_NS)
        if len(due) > few:
            due = due[np.argsort(-waits[due], kind="stable")[:few]]
        return np.asarray(pads[np.concatenate([changed.nonzero()[0], due])])

    def _estimate_motion(self, pad: int, now_ns: int) -> PerceptEstimate:
        relative = self._evidence.relative_motion(pad)
        probabilities = self._class_probabilities(pad, relative)
        self._last_report_ns[pad] = now_ns
        self._detected_label[pad] = int(self._labels(np.array([pad]))[0])
        return self._percept(pad, now_ns, probabilities, relative)

    def _class_probabilities(self, pad: int, relative: RelativeMotion | None) -> dict[str, float]:
        state = self._slip.contacts()[pad]
        slipping = bool(state.slipping)
        slips = 1.0 if slipping else slip_probability(float(state.log_odds))
        leaves = _lift_off_probability(float(state.force_n), float(state.force_rate_n_per_s))
        stays = 1 - leaves
        if math.isfinite(by_joints := float(self._log_odds[pad])):
            slips = slip_probability(by_joints)
            if relative is not None:
                slips = max(slips, relative.sliding_at_rest_probability)
            sure = slipping or slips > _MIN_SLIDING_PROBABILITY
            rolls = stays * (1 - slips) if slipping else 0.0
            found = (
                stays * (1 - slips) - rolls,
                stays * slips * (not sure),
                stays * slips * sure,
                rolls,
                leaves,
            )
            return dict(zip(MOTION_CLASSES, map(float, found), strict=True))
        slides = (1 - _ROLLING_PRIOR) if relative is None else relative.sliding_probability
        runs = stays * slips if slipping else 0.0
        still = stays * (1 - slips)
        creeps = stays * slips - runs
        if relative is not None and not slipping:  # a contact that slides may rest on the pad
            runs += still * relative.sliding_at_rest_probability
            still *= 1 - relative.sliding_at_rest_probability
            slides = 1.0 if relative.sliding_at_rest_probability > slides else slides
        found = (still, creeps, runs * slides, runs * (1 - slides), leaves)
        return dict(zip(MOTION_CLASSES, map(float, found), strict=True))

    def _percept(
        self,
        pad: int,
        now_ns: int,
        probabilities: dict[str, float],
        relative: RelativeMotion | None = None,
    ) -> PerceptEstimate:
        state = self._slip.contacts()[pad]
        count = int(state.samples)
        label = max(probabilities, key=lambda name: probabilities[name])
        few = count < _MIN_SAMPLES and label == "sticking"
        values: dict[str, float | str | Sequence[float] | None] = {
            "velocity_m_per_s": state.velocity_m_per_s.tolist(),
            "velocity_m_per_s_std": np.sqrt(state.velocity_variance).tolist(),
            "force_rate_n_per_s": float(state.force_rate_n_per_s),
            "tremor_std_m": np.exp(0.5 * state.log_tremor_variance).tolist(),
        }
        if state.slipping:
            values["slip_distance_m"] = float(np.hypot(*(state.position_m - state.slip_start_m)))
        if relative is not None:
            values |= relative.message_values()
        log_ratio = float(state.log_ratio)
        return PerceptEstimate(
            kind="motion",
            hand=int(self._poses.hand_index[pad]),
            pad=pad,
            contact=int(self._slip.contact_id[pad]),
            estimate_ns=now_ns,
            state="undetermined" if few else "estimated",
            label=label,
            probabilities=probabilities,
            values=values,
            evidence={
                "samples": count,
                "span_s": float(state.age_s),
                "log_odds": log_ratio if math.isfinite(log_ratio) else 0.0,
                "slips": int(state.slips),
            },
            reason=f"contact has just begun: at least {_MIN_SAMPLES} samples are needed" if few else "",
        )


def _lift_off_probability(force_n: float, rate_n_per_s: float) -> float:
    """Return the probability that the force is zero within the horizon, the lag of smoothing included."""
    ahead_n = force_n + (_LIFT_OFF_HORIZON_S + _FORCE_RATE_TIME_S) * rate_n_per_s
    std = max(_LIFT_OFF_HORIZON_S * 0.3 * abs(rate_n_per_s), 0.03 * force_n, 1e-3)
    return 0.5 * math.erfc(ahead_n / (std * math.sqrt(2)))
