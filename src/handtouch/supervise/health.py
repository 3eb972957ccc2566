"""What is wrong with a pad, in plain words: cause, evidence and remedy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.lifecycle import NodeState
from handtouch.canbus.slab import FULL_SCALE
from handtouch.wire import PadState

CHANNELS = ("x0", "xa", "y0", "yb")


def explain(state: PadState, node: NodeState, node_reason: str, counts: NDArray[np.int16]) -> str:
    """Why a pad is in its state and what helps; empty when all is well.

    `node_reason` is the master's word on the node, `counts` (4,) the pad's newest sample.
    """
    if state <= PadState.TOUCHED or (state == PadState.STARTING and node == NodeState.OPERATIONAL):
        return ""
    if node not in (NodeState.OPERATIONAL, NodeState.STALE):
        return node_reason
    if state == PadState.FAULTED:
        channels = dict(zip(CHANNELS, counts.tolist(), strict=True))
        if railed := [name for name, count in channels.items() if abs(count) >= FULL_SCALE]:
            return (
                f"channel {' and '.join(railed)} at the end of its range: "
                "look for a short, a loose electrode or a force beyond full scale"
            )
        return (
            f"channel {min(channels, key=channels.__getitem__)} reads {min(channels.values())} counts, and "
            "no electrode can give current: look at its amplifier and its wiring"
        )
    return "its heartbeat comes, its samples don't: look at its SYNC and PDO settings and at the bus load"
