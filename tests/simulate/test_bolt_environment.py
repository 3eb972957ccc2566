"""The bolt as a Gymnasium task: its interface, its touch, and that the showcase's program can drive it."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
pytest.importorskip("mujoco")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.utils.seeding import np_random  # noqa: E402

from handtouch.config import load, shipped  # noqa: E402
from handtouch.learn import TouchFeatures  # noqa: E402
from handtouch.simulate.tactile.bolt_environment import (  # noqa: E402
    MAX_JOINT_RAD_S,
    MAX_SPEED_M_S,
    MAX_TURN_RAD_S,
    BoltEnvironment,
)
from handtouch.simulate.tactile.bolt_scene import HOLE_M, BoltStart  # noqa: E402

EXAMPLES = Path(__file__).parents[2] / "examples"
ACROSS = BoltStart(0.0, 0.0, np.pi / 2)  # of the fingers
SEED, MOVES = 4, 250


@pytest.fixture(scope="module")
def bolt() -> BoltEnvironment:
    return BoltEnvironment("ideal")


@pytest.fixture
def program() -> Iterator[Any]:
    sys.path.insert(0, str(EXAMPLES))
    yield __import__("start_bolt")
    sys.path.remove(str(EXAMPLES))


@pytest.mark.filterwarnings("ignore::UserWarning")  # of unbounded observations
def test_environment_follows_gymnasiums_interface(bolt: BoltEnvironment) -> None:
    check_env(bolt, skip_render_check=True)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_touch_has_the_layout_of_the_hands_features(bolt: BoltEnvironment) -> None:
    pads = load(shipped.path("utah_mit.toml")).pads
    touch = TouchFeatures([pad.link for _, pad in pads])
    made = gymnasium.make("handtouch/Bolt-v0", world="ideal")
    observation, _ = made.reset(seed=SEED)
    for name, values in observation.items():
        feature = made.unwrapped.features[name]
        assert (values.dtype, values.shape) == (feature["dtype"], feature["shape"])
        assert len(feature["names"]) == values.size
    assert bolt.features["observation.touch"] == touch.declaration()
    same, _ = bolt.reset(seed=SEED)
    assert {name: values.tobytes() for name, values in same.items()} == {
        name: values.tobytes() for name, values in observation.items()
    }


def test_a_seed_reproduces_an_episode(bolt: BoltEnvironment) -> None:
    first = _episode(bolt, SEED)
    assert _episode(bolt, SEED + 1) != first
    assert _episode(bolt, SEED) == first


def _episode(bolt: BoltEnvironment, seed: int) -> bytes:
    seen, place = [bolt.reset(seed=seed)[0]], bolt.cell.scene.bolt_pose[0].tobytes()
    action = np.zeros(bolt.action_space.shape or (), np.float32)
    action[2] = -1.0  # onto the table
    seen += [bolt.step(action)[0] for _ in range(30)]
    return place + b"".join(values.tobytes() for one in seen for values in one.values())


def test_a_lowered_hand_touches_the_bolt_and_is_rewarded_once(bolt: BoltEnvironment) -> None:
    bolt.reset(seed=SEED, options={"start": ACROSS})
    down = np.zeros(bolt.action_space.shape or (), np.float32)
    down[2] = -0.1 / MAX_SPEED_M_S
    flags = [name.endswith(".touched") for name in bolt.touch.names]
    total = 0.0
    for _ in range(200):
        observation, reward, over, _, info = bolt.step(down)
        total += reward
        if observation["observation.touch"][flags].any():
            break
    assert observation["observation.touch"][flags].any()
    assert bolt.cell.scene.hand_touches
    assert (total, info["stage"], over) == (1.0, "touched", False)
    assert bolt.step(0 * down)[1] == 0.0


def test_an_inserted_bolt_ends_the_episode(bolt: BoltEnvironment) -> None:
    bolt.reset(seed=SEED)
    scene = bolt.cell.scene
    scene.place_bolt(HOLE_M + np.array([0.0, 6e-3 - scene.bolt.total_m / 2, 0.0]), np.array([0.0, 1.0, 0.0]))
    _, reward, over, _, info = bolt.step(np.zeros(bolt.action_space.shape or (), np.float32))
    assert (reward, over, info["stage"]) == (3.0, True, "inserted")
    assert info["inserted_m"] == pytest.approx(6e-3, abs=1e-3)


def test_the_showcases_program_can_drive_it(bolt: BoltEnvironment, program: Any) -> None:
    """Its first commands, as velocities, give the same joints and touch."""
    moved: list[tuple[Any, Any, Any]] = []
    cell = bolt.cell
    cell.restart(ACROSS, int(np_random(SEED)[0].integers(2**31)))

    class Recorder:
        urdf, joints, links, period_s = cell.urdf, cell.joints, cell.links, cell.period_s
        scene = cell.scene  # whose bolt is known
        start_at = staticmethod(cell.start_at)

        def move(self, flange: Any, joint_rad: Any) -> Any:
            if len(moved) > MOVES:
                raise StopIteration
            moved.append((flange, joint_rad, cell.move(flange, joint_rad)))
            return moved[-1][2]

    with pytest.raises(StopIteration):
        program.BoltStarter(Recorder()).run()
    observation, _ = bolt.reset(seed=SEED, options={"start": ACROSS})
    limits = np.array([MAX_SPEED_M_S] * 3 + [MAX_TURN_RAD_S] * 3 + [MAX_JOINT_RAD_S] * len(cell.joints))
    force = np.array(["force" in name for name in bolt.touch.names])
    touched = False
    for before, (flange, joint_rad, sensed) in itertools.pairwise(moved):
        turn = Rotation.from_matrix(flange[1]) * Rotation.from_matrix(before[0][1]).inv()
        change = np.concatenate([flange[0] - before[0][0], turn.as_rotvec(), joint_rad - before[1]])
        action = change / cell.period_s / limits
        assert np.abs(action).max() <= 1
        observation = bolt.step(action)[0]
        expected = bolt.touch.of(sensed.touch, links=cell.links)
        touched |= bool(sensed.touch.touched.any())
        off = np.abs(observation["observation.touch"] - expected)
        assert off[~force].max() < 1e-4
        assert off[force].max() < 0.02  # newtons
    assert touched
    count = len(cell.joints)
    np.testing.assert_allclose(observation["observation.state"][:count], sensed.joint_rad, atol=1e-4)
