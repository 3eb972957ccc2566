"""Nodes that sense a MuJoCo simulation: the real daemon and a real client see its contacts."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
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


@pytest.mark.timeout(900)  # the daemon's tables and 40 readings, in slow motion
def test_the_daemon_senses_a_bolt_as_the_pipeline_in_the_simulations_process() -> None:
    from handtouch.simulate.tactile.bolt_scene import BoltStart
    from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell

    palm_up = np.array([0.0, 0.0, 0.3]), np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    readings = []
    for slower in (0, 8):
        cell = BoltWorkcell(1, BoltStart(0.0, 0.0, 0.0), "ideal", slower=slower)
        with contextlib.closing(cell):
            straight = np.zeros(len(cell.joints))
            cell.start_at(palm_up, straight)
            cell.scene.model.opt.gravity[2] = -50.0  # so that a bolt on the palm is no light touch
            cell.scene.place_bolt(np.array([0.08, 0.0, 0.33]), np.array([0.0, 1.0, 0.0]))
            touch = [cell.move(palm_up, straight).touch for _ in range(40)][-1]
        readings.append(touch)
    here, served = readings
    touched = here.touched
    assert touched.any()
    assert (served.touched == touched).all()
    assert served.position_m[touched] == pytest.approx(here.position_m[touched], abs=1e-3)
    assert served.force_n[touched] == pytest.approx(here.force_n[touched], rel=0.2)


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
