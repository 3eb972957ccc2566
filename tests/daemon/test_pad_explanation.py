"""A pad's state is that of the last tick, its node's the present one: the reason fits both."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.daemon.pad_explanation import explain_pad_state
from handtouch.wire import PadState


@pytest.mark.parametrize("node", NodeState)
@pytest.mark.parametrize("pad", [PadState.CLEAR, PadState.TOUCHED])
def test_a_node_that_is_not_operational_has_its_reason_before_the_next_tick(
    pad: PadState, node: NodeState
) -> None:
    counts, railed = np.zeros(4, dtype=np.int64), np.zeros(4, dtype=np.bool_)
    reason = explain_pad_state(pad, node, "the node's reason", counts, railed)
    assert reason == ("" if node is NodeState.OPERATIONAL else "the node's reason")
