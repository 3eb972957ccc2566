"""A node that sends far more samples than SYNC asks for is told; one SYNC too many is not its fault."""

from __future__ import annotations

import re
from typing import Any

import pytest

from handtouch.canbus.device import Line
from handtouch.canbus.lifecycle import Babble, Life, NodeState, Role, Timing, advance

OPERATIONAL, FAULTED = NodeState.OPERATIONAL, NodeState.FAULTED
MS = 1_000_000


def test_babbling_node_is_told_once_and_used_again_when_it_is_quiet(rig: Any) -> None:
    rig.boot()
    rig.node(2).babble(2000)
    (event,) = rig.run(8000)
    assert (event.slot, event.new) == (1, FAULTED)
    assert re.search(r"samples come \d+ times as often as SYNC asks", event.reason)
    rig.node(2).hush()
    rig.run(1200)
    assert [rig.state(n) for n in (1, 2, 3)] == [OPERATIONAL] * 3


def test_duplicate_samples_are_no_babble(rig: Any) -> None:
    rig.boot()
    rig.node(2).line = Line(duplicate=1.0)
    assert rig.run(3000) == []


def test_babble_that_goes_on_through_a_reboot_is_told_again(rig: Any) -> None:
    rig.boot()
    rig.node(2).babble(2000)
    rig.run(1000)
    rig.node(2).reboot()
    rig.node(2).babble(2000)
    rig.run(1500)
    assert rig.state(2) is FAULTED
    assert "times as often" in rig.status(2).reason


@pytest.mark.parametrize("role", [Role.GUEST, Role.LISTENER])
def test_node_that_another_master_configures_may_send_as_it_likes(role: Role) -> None:
    life = Life(state=OPERATIONAL)
    assert advance(life, Babble(11), 0, Timing(100 * MS, 350 * MS, role)) == (life, ())
