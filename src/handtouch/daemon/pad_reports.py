"""Diagnoses that the daemon makes itself, without the supervisor: noise, and a contradicted contact law.

Public names: `NoiseReport`, `LawReport`, `explain_pad_state` (why a pad is in its state).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.core.sheet_force import SheetForceCompensation
from handtouch.core.tick import TickProcessor
from handtouch.wire import PadState
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


MIN_CONTACTS = 3
"""Contacts in succession whose references are refused, each more than four standard deviations off: once in
1e12 by errors that are normal, once in 1e6 where one in a hundred is so far off."""
_CONFIDENCE = 0.99


class LawReport:
    """Diagnoses of n pads whose forces references contradict."""

    def __init__(self, pads: int) -> None:
        self._since_ns: list[int | None] = [None] * pads

    def update(self, sheets: SheetForceCompensation, pad: int, now_ns: int) -> Diagnosis | None:
        """Return a pad's diagnosis, None if references don't contradict its forces."""
        contacts = int(sheets.refused_contacts[pad])
        if contacts < MIN_CONTACTS:
            self._since_ns[pad] = None
            return None
        since_ns = self._since_ns[pad] or now_ns
        self._since_ns[pad] = since_ns
        ratio = math.exp(float(sheets.refused_log_ratio[pad]))
        return Diagnosis(
            kind=FaultKind.SHEET_REPLACED,
            cause="another contact law than the stated or calibrated one, as of another sheet, or force "
            "references that aren't of this pad",
            evidence=f"force references of {contacts} contacts in succession were refused, the last was "
            f"{ratio:.2g} times the pad's force",
            remedy="after a new sheet, `handtouch calibrate PAD --new-sheet`; measure its law by weights; if "
            "the sheet is the same, check what sends the references",
            since_ns=since_ns,
            confidence=_CONFIDENCE,
        )


_ZEROS_UNKNOWN = (
    "reads a load since the start, so its zeros aren't known: if nothing touches it, `handtouch tare`; if it "
    "is touched, they are learned when it is released"
)


def explain_pad_state(
    state: PadState,
    node: NodeState,
    node_reason: str,
    electrodes: Sequence[str],
    counts: NDArray[np.int64],
    railed: NDArray[np.bool_],
    *,
    zeros_known: bool = True,
) -> str:
    """Return why a pad is in its state, and a remedy; empty if all is as it should be.

    `node_reason` is the master's explanation of the node state, `electrodes` (n,) their names, `counts` (n or
    more,) the newest sample, `railed` which channels are at the end of their range. `zeros_known`: the counts
    of the untouched pad were measured.
    """
    is_fine = state <= PadState.TOUCHED
    if node == NodeState.OPERATIONAL and (is_fine or state == PadState.STARTING):
        unknown = not zeros_known and state == PadState.TOUCHED
        return node_reason or (_ZEROS_UNKNOWN if unknown else "")  # usable, but not as it should be
    if is_fine or node not in (NodeState.OPERATIONAL, NodeState.STALE):
        return node_reason  # also of a pad whose state is that of the last tick
    if state == PadState.FAULTED:
        channels = dict(zip(electrodes, counts.tolist(), strict=False))
        if at_end := [name for name, at in zip(electrodes, railed.tolist(), strict=False) if at]:
            return (
                f"channel {' and '.join(at_end)} at the end of its range: "
                "check for a short circuit, a loose electrode or a force beyond full scale"
            )
        return (
            f"channel {min(channels, key=channels.__getitem__)} reads {min(channels.values())} counts, but "
            "electrode currents can't be negative: `handtouch tare` while nothing touches it; if it returns, "
            "check its amplifier and wiring"
        )
    return node_reason or "no sample for three SYNC periods"
