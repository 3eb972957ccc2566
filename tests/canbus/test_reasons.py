"""The cause of what happened to a node is still told when the next thing happens at once."""

from __future__ import annotations

from typing import Any

import pytest

from handtouch.canbus.nodes.life import Answer, BootUp, Event, Heartbeat, Life, NodeState, Tick, Timing
from handtouch.canbus.nodes.lifecycle import advance


def test_status_tells_why_a_node_boots_until_it_is_up(rig: Any) -> None:
    rig.boot()
    rig.node(1).on_nmt(128)
    told = set()
    for _ in range(300):
        rig.run(1)
        told.add((rig.state(1), rig.status(1).reason))
    up = (NodeState.OPERATIONAL, NodeState.STALE)
    reasons = [reason for state, reason in told if state not in up]
    assert len(reasons) >= 2
    assert all("node is pre-operational, though it was started" in reason for reason in reasons)
    assert rig.status(1).reason == ""


def test_node_that_answers_as_soon_as_it_is_lost_is_still_said_to_be_lost(rig: Any) -> None:
    rig.boot()
    rig.node(1).send_heartbeat = False
    rig.run(1500)
    rig.node(1).send_heartbeat = True
    events = [event for event in rig.run(6000) if event.slot == 0]
    assert rig.state(1) is NodeState.OPERATIONAL, events
    rig.node(1).send_heartbeat = False
    booting = [event for event in rig.run(600) if event.new is NodeState.BOOTING]
    assert booting
    assert "lost: no heartbeat for" in booting[0].reason


@pytest.mark.parametrize(
    ("event", "told"),
    [
        (BootUp(), "boot-up message"),
        (Heartbeat(5), "heartbeat: node is operational"),
        (Answer(), "answers over SDO"),
    ],
)
def test_node_that_is_back_as_soon_as_it_is_lost_is_still_said_to_have_been_lost(
    event: Event, told: str
) -> None:
    timing = Timing(100_000_000, 350_000_000)
    running = Life(state=NodeState.OPERATIONAL, nmt=5, heartbeat_ns=0)
    lost, _ = advance(running, Tick(), 351_000_000, timing)
    back, _ = advance(lost, event, 351_000_001, timing)
    assert back.state is NodeState.BOOTING
    assert back.reason == f"{told}, but was lost: no heartbeat for 351 ms"
