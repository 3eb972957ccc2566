"""A pad's state is that of the last tick, its node's the present one: the reason fits both."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.daemon.pad_reports import explain_pad_state
from handtouch.wire import PadState


def test_a_faulty_channel_has_the_name_of_its_own_pads_electrode() -> None:
    counts, railed = np.array([5, 7, 32767, 0]), np.array([False, False, True, False])
    names = ["end", "left", "right"]  # another pad has four
    text = explain_pad_state(PadState.FAULTED, NodeState.OPERATIONAL, "", names, counts, railed)
    assert text.startswith("channel right at the end of its range")
    counts = np.array([5, 6, 7, -40, 8, 9])
    none = np.zeros(6, np.bool_)
    text = explain_pad_state(PadState.FAULTED, NodeState.OPERATIONAL, "", [*"abcdef"], counts, none)
    assert text.startswith("channel d reads -40 counts")


@pytest.mark.parametrize("node", NodeState)
@pytest.mark.parametrize("pad", [PadState.CLEAR, PadState.TOUCHED])
def test_a_node_that_is_not_operational_has_its_reason_before_the_next_tick(
    pad: PadState, node: NodeState
) -> None:
    counts, railed = np.zeros(4, dtype=np.int64), np.zeros(4, dtype=np.bool_)
    names = ["x0", "xa", "y0", "yb"]
    reason = explain_pad_state(pad, node, "the node's reason", names, counts, railed)
    assert reason == "the node's reason"  # an operational node may have one, too: a slow heartbeat
