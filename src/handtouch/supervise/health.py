"""What is wrong with a pad, in plain words: cause, evidence and remedy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.wire import PadState


def explain(
    state: PadState,
    node: NodeState,
    node_reason: str,
    counts: NDArray[np.int64],
    railed: NDArray[np.bool_],
) -> str:
    """Why a pad is in its state and what helps; empty when all is well.

    `node_reason` is the master's word on the node, `counts` (4,) the pad's newest sample, `railed` (4,)
    which of them are at the end of their range.
    """
    if state <= PadState.TOUCHED or (state == PadState.STARTING and node == NodeState.OPERATIONAL):
        return ""
    if node not in (NodeState.OPERATIONAL, NodeState.STALE):
        return node_reason
    if state == PadState.FAULTED:
        channels = dict(zip(ELECTRODES, counts.tolist(), strict=True))
        if at_end := [name for name, at in zip(ELECTRODES, railed.tolist(), strict=True) if at]:
            return (
                f"channel {' and '.join(at_end)} at the end of its range: "
                "look for a short, a loose electrode or a force beyond full scale"
            )
        return (
            f"channel {min(channels, key=channels.__getitem__)} reads {min(channels.values())} counts, and "
            "no electrode can give current: look at its amplifier and its wiring"
        )
    return "its heartbeat comes, its samples don't: look at its SYNC and PDO settings and at the bus load"
