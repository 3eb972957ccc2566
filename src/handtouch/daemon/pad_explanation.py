"""Explanation of a pad's state for `health`: cause, evidence and remedy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.wire import PadState

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
