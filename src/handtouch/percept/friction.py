"""Percept `friction`: tangential over normal force above shear pads, its limit, incipient slip before motion.

Public names: `FrictionEstimator`; `FrictionLimit`, `FrictionMonitor` -> `FrictionState`.

A contact sticks while the ratio of tangential to normal force is below the limit of friction. Sticking raises
a lower bound of the limit, and a slip that was observed otherwise, by position, states it. The limit is
learned in ratios as they are measured: what is wrong with a pad's stiffness is the same in both and cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from handtouch.arrays import IntArray
from handtouch.percept.estimator import PerceptEstimator
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

# Constants without an origin beside them were chosen; docs/benchmarks/shear_slip.md measures what they yield.
PRIOR_LIMIT, PRIOR_LOG_STD = 0.95, 0.35
"""Limit of friction before anything is known, with the standard deviation of its logarithm: objects differ by
that, and so do pads."""
_SLIP_LOG_STD = 0.4  # spread of one observed slip: pads and spots differ, and slips are observed late
_MIN_LOG_STD = 0.1
_MIN_SLIP_PROBABILITY = 0.003
"""Probability of a limit below an observed slip's ratio; a rarer slip was none: the pad rolled."""
_SLIP_SPAN_S = 0.1  # before a slip is observed, in which the greatest ratio was the limit
_STICK_LOG_STD = 0.1  # noise of the ratio of a contact that sticks
_RATE_TIME_S = 0.02  # smoothing of the ratio's rate
_HORIZON_S = 0.05
_MIN_NORMAL_SIGMA = 1.5  # normal force in its standard deviations, below which there is no ratio
_STICK_S = 0.1  # a ratio that a contact held for so long stuck; a faster rise teaches nothing yet
_ALARM, _CLEAR = 0.6, 0.3  # probability of incipient slip that raises and clears it
_MIN_ALARM_S = 0.05  # a ratio that fluctuates at the limit is one alarm
_MAX_GAP_S = 0.1
_MAX_RELATIVE_STD = 1.0


@dataclass(frozen=True)
class FrictionLimit:
    """Belief about the limit of friction: ln(limit) is normal, above the greatest ratio that stuck.

    mean, log_std: of the normal part. stuck: greatest ratio without slip, 0 at first.
    """

    mean: float = PRIOR_LIMIT
    log_std: float = PRIOR_LOG_STD
    stuck: float = 0.0

    def after_sticking(self, ratio: float) -> FrictionLimit:
        """Return the belief after a contact stuck at a ratio."""
        return replace(self, stuck=max(self.stuck, ratio))

    def after_slip(self, ratio: float) -> FrictionLimit:
        """Return the belief after a contact began to slip at a ratio.

        The same belief if the limit can't be so low: then the motion was no slip. Raises ValueError for a
        ratio that isn't positive.
        """
        if not ratio > 0:
            raise ValueError(f"ratio must be positive, got {ratio}")
        if self.probability_below(ratio) < _MIN_SLIP_PROBABILITY:
            return self
        before, now = self.log_std**-2, _SLIP_LOG_STD**-2
        mean = (before * math.log(self.mean) + now * math.log(ratio)) / (before + now)
        spread = max((before + now) ** -0.5, _MIN_LOG_STD)
        return replace(self, mean=math.exp(mean), log_std=spread)

    def probability_below(self, ratio: float, relative_std: float = 0.0) -> float:
        """Return the probability that the limit is below a ratio of this relative error, given that `stuck`
        stuck.
        """
        if ratio <= 0:
            return 0.0
        width = math.sqrt(self.log_std**2 + _STICK_LOG_STD**2 + min(relative_std, _MAX_RELATIVE_STD) ** 2)
        above = float(log_ndtr((math.log(self.mean) - math.log(ratio)) / width))
        if self.stuck > 0:
            above -= float(log_ndtr((math.log(self.mean) - math.log(self.stuck)) / width))
        return -math.expm1(min(above, 0.0))


@dataclass(frozen=True, slots=True)
class FrictionState:
    """Friction of one contact at one sample.

    ratio, ratio_std: tangential over normal force. rate_per_s: of the ratio. margin: 1 - ratio / limit, below
    0 beyond the mean limit. probability: that the limit is reached within 50 ms at this rate. label:
    "sticking" or "incipient".
    """

    ratio: float
    ratio_std: float
    rate_per_s: float
    margin: float
    probability: float
    label: str


@dataclass(slots=True)
class _Contact:
    """Memory of the contact on one pad."""

    time_s: float
    ratio: float
    rate: float = 0.0
    alarmed: bool = False
    alarm_s: float = -math.inf
    """last sample with a probability that raises an alarm or keeps it"""
    slips: bool = False
    held_since_s: float = math.nan
    held: float = math.nan
    """least ratio since then"""
    peak_s: float = -math.inf
    peak: float = 0.0
    """greatest ratio of the last `_SLIP_SPAN_S`, and its time"""


class FrictionMonitor:
    """Friction of the contacts of one hand, which hold one object with one limit; pads are any numbers.

    `limit` is what is known of it; assign a new `FrictionLimit` for another object.
    """

    def __init__(self, limit: FrictionLimit | None = None) -> None:
        self.limit = limit or FrictionLimit()
        self._contacts: dict[int, _Contact] = {}

    def end_contact(self, pad: int) -> None:
        """Forget the contact on a pad."""
        self._contacts.pop(pad, None)

    def update(
        self,
        pad: int,
        t_s: float,
        tangential: tuple[float, float],
        normal: tuple[float, float],
        *,
        slips: bool = False,
    ) -> FrictionState | None:
        """Process a sample; return None where the normal force is too uncertain for a ratio.

        tangential, normal: forces [N], each with its standard deviation, the tangential one's along itself.
        slips: its motion shows a slip.
        """
        (size_n, size_std_n), (normal_n, normal_std_n) = tangential, normal
        if not (normal_n > _MIN_NORMAL_SIGMA * normal_std_n and math.isfinite(size_n + size_std_n)):
            self.end_contact(pad)
            return None
        ratio = size_n / normal_n
        spread = math.hypot(size_std_n / normal_n, ratio * normal_std_n / normal_n)
        contact = self._contacts.get(pad)
        if contact is None or not t_s - contact.time_s < _MAX_GAP_S:
            contact = self._contacts[pad] = _Contact(t_s, ratio)
        if (elapsed := t_s - contact.time_s) > 0:
            share = -math.expm1(-elapsed / _RATE_TIME_S)
            contact.rate += share * ((ratio - contact.ratio) / elapsed - contact.rate)
        contact.time_s, contact.ratio = t_s, ratio
        if ratio >= contact.peak or t_s - contact.peak_s > _SLIP_SPAN_S:
            contact.peak_s, contact.peak = t_s, ratio
        ahead = ratio + _HORIZON_S * max(contact.rate, 0.0)
        probability = self.limit.probability_below(ahead, spread / ratio if ratio > 0 else 0.0)
        if probability > (_CLEAR if contact.alarmed else _ALARM):
            contact.alarm_s = t_s
        contact.alarmed = t_s - contact.alarm_s < _MIN_ALARM_S
        if slips and not contact.slips and contact.peak > 0:
            self.limit = self.limit.after_slip(contact.peak)
        contact.slips = slips
        self._learn_sticking(contact, sticks=not (slips or contact.alarmed))
        label = "incipient" if contact.alarmed else "sticking"
        return FrictionState(
            ratio=ratio,
            ratio_std=spread,
            rate_per_s=contact.rate,
            margin=1 - ratio / self.limit.mean,
            probability=probability,
            label=label,
        )

    def _learn_sticking(self, contact: _Contact, *, sticks: bool) -> None:
        """Learn the least ratio of each span of `_STICK_S` in which a contact sticks."""
        if not sticks:
            contact.held_since_s = math.nan
        elif contact.time_s - contact.held_since_s < _STICK_S:
            contact.held = min(contact.held, contact.ratio)
        else:
            if not math.isnan(contact.held_since_s):
                self.limit = self.limit.after_sticking(contact.held)
            contact.held_since_s, contact.held = contact.time_s, contact.ratio


_EMPTY_NS = 1_000_000_000
"""A hand without contacts for so long grasps another object then."""
_NO_VECTOR = "no force vector: force_vector_status of contact has the reason"
_NO_RATIO = "the normal force is less than 1.5 of its standard deviations"


class FrictionEstimator(PerceptEstimator):
    """Estimates the friction of the contacts on n pads, those of one hand with one limit.

    shear_pads: (n,) pads above shear pads; the others have no friction percept.
    """

    kind = "friction"

    def __init__(self, shear_pads: NDArray[np.bool_]) -> None:
        super().__init__(len(shear_pads))
        self._shear_pads = shear_pads.copy()
        self._monitors: dict[int, FrictionMonitor] = {}
        """by hand"""
        self._sample_ns: dict[int, int] = {}
        """last sample of a hand"""

    def process_samples(self, buffer: ContactBuffer, sample: ContactSamples) -> Sequence[PerceptEstimate]:
        """Process a tick's samples of requested pads; return the friction of those above shear pads."""
        found = []
        for k in np.flatnonzero(self._shear_pads[sample.pads]).tolist():
            pad, sample_ns = int(sample.pads[k]), int(sample.sample_ns[k])
            hand = int(buffer.hand_index[pad])
            monitor = self._monitors.setdefault(hand, FrictionMonitor())
            if sample_ns - self._sample_ns.get(hand, sample_ns) > _EMPTY_NS:
                monitor.limit = FrictionLimit()
            self._sample_ns[hand] = sample_ns
            found.append(self._estimate(monitor, sample, k, hand))
        return found

    def end_contacts(self, buffer: ContactBuffer, pads: IntArray) -> None:
        """Forget the contacts that ended."""
        for pad in pads.tolist():
            if monitor := self._monitors.get(int(buffer.hand_index[pad])):
                monitor.end_contact(pad)

    def _estimate(
        self, monitor: FrictionMonitor, sample: ContactSamples, k: int, hand: int
    ) -> PerceptEstimate:
        pad, contact, t_ns = int(sample.pads[k]), int(sample.contact_id[k]), int(sample.sample_ns[k])
        vector_n, normal = sample["force_vector_n"][k], sample["normal"][k]
        tangential_n = vector_n - normal * (normal @ vector_n)
        size_n = float(np.linalg.norm(tangential_n))
        if not math.isfinite(size_n):
            monitor.end_contact(pad)
            return PerceptEstimate("friction", hand, pad, contact, t_ns, "undetermined", reason=_NO_VECTOR)
        covariance_n2 = sample["force_vector_covariance_n2"][k]
        way = tangential_n / size_n if size_n > 0 else np.zeros(3)
        std_n = math.sqrt(max(float(way @ covariance_n2 @ way), 0.0))
        state = monitor.update(
            pad,
            t_ns * 1e-9,
            (size_n, std_n),
            (float(sample["force_n"][k]), float(sample["force_std_n"][k])),
            slips=bool(sample["slip_log_odds"][k] == math.inf),
        )
        if state is None:
            return PerceptEstimate("friction", hand, pad, contact, t_ns, "undetermined", reason=_NO_RATIO)
        values = {"tangential_force_n": size_n, "tangential_force_n_std": std_n} | _values(
            state, monitor.limit
        )
        return PerceptEstimate(
            "friction",
            hand,
            pad,
            contact,
            t_ns,
            "estimated",
            state.label,
            probabilities={"sticking": 1 - state.probability, "incipient": state.probability},
            values=values,
        )


def _values(state: FrictionState, limit: FrictionLimit) -> dict[str, float]:
    return {
        "ratio": state.ratio,
        "ratio_std": state.ratio_std,
        "ratio_rate_per_s": state.rate_per_s,
        "margin": state.margin,
        "limit": limit.mean,
        "limit_log_std": limit.log_std,
        "stuck_ratio": limit.stuck,
    }
