"""Scene of a bolt in MuJoCo, and examples/start_bolt.py, which starts the bolt in a hole."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from handtouch.config import load, shipped
from handtouch.simulate.tactile.bolt_scene import HOLE_M, BoltScene, BoltStart
from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell
from handtouch.simulate.worlds import world_named

EXAMPLES = Path(__file__).parents[2] / "examples"
CLEARANCE_M = 1e-3
PAD_FRICTION = 0.9


@pytest.fixture
def program() -> Iterator[Any]:
    """Import the example."""
    sys.path.insert(0, str(EXAMPLES))
    yield __import__("start_bolt")
    sys.path.remove(str(EXAMPLES))


def scene(start: BoltStart) -> BoltScene:
    hand = load(shipped.path("utah_mit.toml")).hands[0]
    made = BoltScene(hand, world_named("ideal").draw(1), start, CLEARANCE_M)
    made.place_arm(np.array([0.0, -0.3, 0.6]), np.eye(3), np.zeros(len(made.joints)))
    return made


def test_a_bolt_rests_on_its_head_and_its_tip() -> None:
    made = scene(BoltStart(0.01, -0.01, 0.5))
    made.step(500)
    position, rotation = made.bolt_pose
    assert position[:2] == pytest.approx([0.01, -0.01], abs=1e-3)
    assert rotation[:2, 2] == pytest.approx([np.cos(0.5), np.sin(0.5)], abs=0.02)
    assert np.degrees(np.arcsin(-rotation[2, 2])) == pytest.approx(4.2, abs=0.5)  # 3 mm over 40 mm


@pytest.mark.parametrize(("aside_m", "fits"), [(0.4 * CLEARANCE_M, True), (1.5 * CLEARANCE_M, False)])
def test_a_bolt_enters_the_hole_only_within_its_clearance(aside_m: float, fits: bool) -> None:
    made = scene(BoltStart(0.0, 0.0, 0.0))
    made.place_bolt(HOLE_M + np.array([aside_m, -0.026, 0.0]), np.array([0.0, 1.0, 0.0]))
    made.model.opt.gravity[:] = 0.0
    made.data.joint("bolt").qvel[1] = 0.05
    deepest_m = 0.0
    for _ in range(200):
        made.step()
        deepest_m = max(deepest_m, made.deepest_m)
    assert (made.inserted_m > 5e-3) == fits
    assert deepest_m < 0.1 * CLEARANCE_M


@pytest.mark.timeout(900)  # it takes some 20 s of a processor
def test_a_bolt_in_reach_is_started_by_touch_alone(program: Any) -> None:
    told: list[str] = []
    cell = BoltWorkcell(5, BoltStart(0.005, -0.005, 0.3), "default", CLEARANCE_M)
    starter = program.BoltStarter(cell, log=told.append)
    assert starter.run()
    names = [step.value for step in starter.steps]
    assert names == ["search", "grasp", "lift", "feel", "orient", "insert", "done"]
    assert cell.scene.inserted_m >= 5e-3
    assert [text.split()[0] for text in told if not text.startswith(("touched", "asks"))] == [
        "bolt",
        "lifted",
        "in",
        "in",
        "inserted,",
    ]


class _SeenError(Exception):
    """What a test waits for has been seen."""


@pytest.mark.timeout(900)  # it takes some 8 s of a processor
def test_a_bolt_that_slips_in_the_grip_is_put_back_where_it_was(program: Any) -> None:
    start = BoltStart(0.005, -0.005, 0.3)
    cell, told = BoltWorkcell(5, start, "ideal", CLEARANCE_M), []
    friction = cell.scene.model.geom_friction[:, 0]

    def hear(text: str) -> None:
        told.append(text.split(":")[0])
        if text.startswith("bolt at"):  # it will be grasped: from now on the skin is slippery
            friction[friction == PAD_FRICTION] = 0.4
        if text.startswith("touched") and "it slips" in told:
            raise _SeenError

    starter = program.BoltStarter(cell, log=hear)
    with pytest.raises(_SeenError):
        starter.run()
    names = [step.value for step in starter.steps]
    assert names == ["search", "grasp", "lift", "search"]
    assert cell.scene.bolt_pose[0][:2] == pytest.approx([start.x_m, start.y_m], abs=8e-3)
