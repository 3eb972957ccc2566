"""Perception in a real daemon: it costs nothing until somebody subscribes, and then it tells."""

from __future__ import annotations

from typing import Any

from handtouch import wire


def perceived_s(rig: Any) -> float:
    """Time that the daemon has spent on perception so far."""
    with rig.subscribe("service") as messages:
        while not isinstance(message := messages.recv(), wire.Service) or message.repeat:
            pass
    return float(message.loop["stages"]["perceive"]["sum_s"])


def test_motion_is_told_to_a_subscriber_and_costs_nothing_before(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    with rig.subscribe("contact/*/*") as contacts:
        assert contacts.recv(60.0) is not None
    assert perceived_s(rig) == 0.0
    with rig.subscribe("percept/*/motion") as percepts:
        percept = percepts.recv(60.0)
        assert isinstance(percept, wire.Percept)
        assert percept.kind == "motion"
        assert percept.label in percept.probabilities
    assert perceived_s(rig) > 0.0
