"""Diagnosis of hum and noise: what is measured of them, what it changes, and what to do.

Public name: `NoiseReport`.
"""

from __future__ import annotations

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.core.tick import TickProcessor
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

MAX_NOISE_RATIO = 2.0
"""Measured over stated noise up to which nodes are accepted by `commission` and `conformance`"""
_END_RATIO = 0.8  # of the limits, at which a diagnosis ends: no flicker about them


class NoiseReport:
    """Diagnoses of n pads whose channels hum or scatter by more than is stated."""

    def __init__(self, pads: int) -> None:
        self._since_ns: list[int | None] = [None] * pads
        self._ratio = np.full(pads, MAX_NOISE_RATIO)

    def find(self, tick: TickProcessor) -> list[bool]:
        """Return which pads have raised thresholds, or more noise than is accepted."""
        too_much = _measured(tick).max(axis=1) > self._ratio * tick.model.noise_counts
        noisy: list[bool] = (too_much | (tick.baseline.noise_factor > 1.0)).tolist()
        return noisy

    def update(
        self, tick: TickProcessor, pad: int, node: str, now_ns: int, *, noisy: bool
    ) -> Diagnosis | None:
        """Return a pad's diagnosis, None if it isn't `noisy`; `node`: name of its kind."""
        if not noisy:
            self._since_ns[pad], self._ratio[pad] = None, MAX_NOISE_RATIO
            return None
        model, factor = tick.model, float(tick.baseline.noise_factor[pad])
        measured = _measured(tick)[pad, : int(model.electrode_counts[pad])]
        worst, stated = float(measured.max()), float(model.noise_counts[pad])
        self._ratio[pad] = _END_RATIO * MAX_NOISE_RATIO
        since_ns = self._since_ns[pad] or now_ns
        self._since_ns[pad] = since_ns
        scatter = ", ".join(
            f"{name} {value:.1f}"
            for name, value in zip(model.electrodes[pad], measured.tolist(), strict=True)
        )
        raised = f"; contacts begin and end at {factor:.1f} times the currents of the thresholds"
        return Diagnosis(
            kind=FaultKind.NOISE,
            cause="hum of the mains, or noise, in the channels",
            evidence=f"standard deviations {scatter} counts, stated {stated:.1f}"
            + (raised if factor > 1.0 else ""),
            remedy="ground the hand's frame and the node, keep electrode wires short, twisted and away from "
            f"mains and motors; if it stays, state noise_counts = {worst:.1f} in [node.{node}]",
            since_ns=since_ns,
        )


def _measured(tick: TickProcessor) -> FloatArray:
    """Return the standard deviations of the channels (n, c), of hum at least."""
    baseline = tick.baseline
    return np.asarray(np.maximum(baseline.noise_counts, baseline.disturbance / np.sqrt(2)))
