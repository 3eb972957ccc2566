"""What is wrong with a pad, in plain words: cause, evidence and remedy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.lifecycle import NodeState
from handtouch.wire import PadState

CHANNELS = ("x0", "xa", "y0", "yb")
_RAIL = 32767


def explain(state: PadState, node: NodeState, node_reason: str, counts: NDArray[np.int16]) -> str:
    """Why a pad is in its state and what helps; empty when all is well.

    `node_reason` is the master's word on the node, `counts` (4,) the pad's newest sample.
    """
    if state <= PadState.TOUCHED:
        return ""
    if node not in (NodeState.OPERATIONAL, NodeState.STALE):
        return node_reason
    if state == PadState.FAULTED:
        railed = [name for name, count in zip(CHANNELS, counts.tolist(), strict=True) if abs(count) >= _RAIL]
        return (
            f"channel {' and '.join(railed) or 'unknown'} at the end of its range: "
            "look for a short, a loose electrode or a force beyond full scale"
        )
    return "its heartbeat comes, its samples don't: look at its SYNC and PDO settings and at the bus load"
