"""Percept `friction`: friction ratio and incipient slip of contacts above shear pads.

Public name: `FrictionEstimator`. The belief about the limit is in `handtouch.percept.friction`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import IntArray
from handtouch.percept.estimator import PerceptEstimator
from handtouch.percept.friction import FrictionLimit, FrictionMonitor, FrictionState
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

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
