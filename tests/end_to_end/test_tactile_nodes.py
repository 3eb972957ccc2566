"""Nodes that sense a MuJoCo simulation: the real daemon and a real client see its contacts."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from handtouch import wire
from handtouch.cli.demo import in_process_deployment
from handtouch.client.hand import Hand
from handtouch.config import load, shipped
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.learn import TouchFeatures
from tests.end_to_end.conftest import run_in_threads

pytest.importorskip("mujoco", reason="the extra isn't installed: pip install 'handtouch[mujoco]'")
pytest.importorskip("gymnasium", reason="the extra isn't installed: pip install 'handtouch[gym]'")

TIPS = ("thumb_tip", "index_tip")
DEADLINE_S = 60.0


def wait_for(hand: Hand, state: wire.PadState) -> Any:
    """Return the first arrays in which both pads have a state."""
    end_s = time.monotonic() + DEADLINE_S
    while time.monotonic() < end_s:
        if hand.wait(1.0) and (arrays := hand.latest()) and set(arrays.state.values()) == {state}:
            return arrays
    raise AssertionError(f"never {state.name.lower()}: {hand}")


def test_a_daemon_and_a_policys_features_see_what_a_simulated_grip_presses(tmp_path: Path) -> None:
    from handtouch.simulate import TactileNodes
    from handtouch.simulate.tactile.grip_environment import GripScene

    scene, deployment = GripScene(), in_process_deployment(load(shipped.path("two_finger.toml")))
    with (
        TactileNodes(deployment, scene.model, "ideal") as nodes,
        HandtouchDaemon.open(deployment, folder=tmp_path) as daemon,
        run_in_threads(daemon.run),
        Hand("gripper", endpoint=daemon.publisher.endpoints["live"], control=daemon.control.endpoint) as hand,
    ):
        wait_for(hand, wire.PadState.CLEAR)
        scene.reset(0.05, 0.9)
        for _ in range(15):  # before its support is taken away
            scene.step(0.0)
        nodes.update(scene.data)
        touched = wait_for(hand, wire.PadState.TOUCHED)
        assert [touched.force_n[tip] for tip in TIPS] == pytest.approx([scene.force_n] * 2, rel=0.3)
        features = TouchFeatures(TIPS)
        values = dict(zip(features.names, features.of(hand).tolist(), strict=True))
        assert [values[f"{tip}.touched"] for tip in TIPS] == [1, 1]
        nodes.update(None)
        wait_for(hand, wire.PadState.CLEAR)


def test_pads_on_several_buses_and_unknown_worlds_are_refused() -> None:
    from handtouch.simulate import TactileNodes
    from handtouch.simulate.tactile.grip_environment import GripScene

    deployment, model = in_process_deployment(load(shipped.path("two_finger.toml"))), GripScene().model
    with pytest.raises(ValueError, match="no world"):
        TactileNodes(deployment, model, "perfect")
    (hand,) = deployment.hands
    other = deployment.buses[0].model_copy(update={"name": "can1"})
    moved = (hand.pads[0].model_copy(update={"bus": "can1"}), *hand.pads[1:])
    split = deployment.model_copy(
        update={"buses": (*deployment.buses, other), "hands": (hand.model_copy(update={"pads": moved}),)}
    )
    with pytest.raises(ValueError, match="can0, can1"):
        TactileNodes(split, model)
