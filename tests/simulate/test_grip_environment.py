"""The Gymnasium task: its interface, its physics, and what touch is worth in it."""

from __future__ import annotations

import copy
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
pytest.importorskip("mujoco")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from handtouch.simulate.tactile.grip_environment import (  # noqa: E402
    EPISODE_STEPS,
    FEATURES,
    TOUCH,
    GripEnvironment,
    GripEnvironments,
    objects_at,
)

EXAMPLES = Path(__file__).parents[2] / "examples"
COUNT = 6
MASS_KG = np.full(COUNT, 0.1)
FRICTION = np.array([0.3, 0.45, 0.6, 0.7, 0.85, 1.0])
LEAST_FORCE_N = 0.5 * 9.81 * MASS_KG / FRICTION


@pytest.fixture(scope="module")
def grips() -> GripEnvironments:
    return GripEnvironments(COUNT, "ideal")


@pytest.fixture(scope="module")
def example() -> Iterator[Any]:
    sys.path.insert(0, str(EXAMPLES))
    yield __import__("learn_grip")
    sys.path.remove(str(EXAMPLES))


@pytest.mark.filterwarnings("ignore::UserWarning")  # of unbounded observations
def test_one_environment_follows_gymnasiums_interface() -> None:
    check_env(GripEnvironment("ideal"), skip_render_check=True)


def test_observations_are_declared_as_features_of_a_dataset(grips: GripEnvironments) -> None:
    observation, _ = grips.reset(seed=1)
    for name, values in observation.items():
        feature = FEATURES[name]
        assert values.shape == (COUNT, *feature["shape"])
        assert values.dtype == feature["dtype"]
        assert len(feature["names"]) == feature["shape"][0]


def test_objects_are_held_or_dropped_by_the_law_of_friction(grips: GripEnvironments, example: Any) -> None:
    grip_n = 0.85
    policy = np.tile([grip_n, 0.0, 0.0], (COUNT, 1))
    outcome = example.run(grips, policy, (MASS_KG, FRICTION))
    assert outcome.dropped.tolist() == [least_n > grip_n for least_n in LEAST_FORCE_N]
    assert outcome.dropped.any()
    assert not outcome.dropped.all()
    touch = grips.reset()[0]["observation.touch"]  # an episode begins before the first sample
    assert not touch[:, [not name.endswith("age_s") for name in TOUCH.names]].any()


def test_touch_measures_the_grip_and_the_slip(grips: GripEnvironments) -> None:
    observation, _ = grips.reset(options={"objects": (MASS_KG, np.full(COUNT, 0.45))})
    for _ in range(EPISODE_STEPS):  # until it slides: 1 N holds 0.09 kg
        before = observation
        observation, _, dropped, _, info = grips.step(np.zeros((COUNT, 1), np.float32))
        if info["slip_m"].max() > 3e-3:
            break
    names = FEATURES["observation.touch"]["names"]
    touch = dict(zip(names, observation["observation.touch"].T, strict=True))
    assert not dropped.any()
    assert touch["thumb_tip.force_n"] == pytest.approx(np.ones(COUNT), rel=0.25)  # it chatters
    assert touch["thumb_tip.x_m"] == pytest.approx(info["slip_m"], abs=1e-3)  # of a fast slide, within a step
    assert before["observation.touch"].shape == observation["observation.touch"].shape


def test_a_reflex_to_slip_needs_less_force_than_any_constant_grip(
    grips: GripEnvironments, example: Any
) -> None:
    objects = objects_at(np.array([[i, j] for i in (0.1, 0.5, 0.9) for j in (0.1, 0.9)]))
    reflex = example.run(grips, np.tile([0.5, 1.0, 0.0], (COUNT, 1)), objects)
    assert not reflex.dropped.any()
    least_n = (0.5 * 9.81 * objects[0] / objects[1]).max()
    constant = example.run(grips, np.tile([1.05 * least_n, 0.0, 0.0], (COUNT, 1)), objects)
    assert not constant.dropped.any()
    assert reflex.cost.mean() < 0.7 * constant.cost.mean()


def test_a_dropped_object_changes_no_other_grip(grips: GripEnvironments, example: Any) -> None:
    reflex, mass_kg = np.tile([0.5, 1.0, 0.0], (COUNT, 1)), MASS_KG.copy()
    mass_kg[-1] = 5.0  # too heavy to hold
    outcome = example.run(grips, reflex, (mass_kg, FRICTION))
    assert outcome.dropped.tolist() == [False] * (COUNT - 1) + [True]


@pytest.mark.parametrize("seed", [5, np.int64(5), [5, 6], (7,)])
def test_a_seed_reproduces_an_episode_on_the_same_and_on_another_environment(seed: Any) -> None:
    used, fresh = GripEnvironments(2), GripEnvironments(2)
    used.reset()
    used.step(np.ones((2, 1), np.float32))
    episodes = [_episode(made, seed) for made in (used, used, fresh)]
    for other in episodes[1:]:
        np.testing.assert_array_equal(episodes[0], other)
    assert (episodes[0] != _episode(used, 8)).any()


def _episode(made: GripEnvironments, seed: Any) -> NDArray[np.float32]:
    seen = [made.reset(seed=seed)[0]]
    seen += [made.step(np.full((2, 1), 0.2, np.float32))[0] for _ in range(20)]
    return np.array([np.hstack(list(one.values())) for one in seen])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))])
def test_copy_goes_on_as_the_original(copied: Any) -> None:
    original = GripEnvironment()
    original.reset(seed=3)
    action = np.array([0.3], np.float32)
    for _ in range(10):
        original.step(action)
    other = copied(original)
    for _ in range(10):
        (one, *rest), (two, *others) = original.step(action), other.step(action)
        assert rest == others
        for name, values in one.items():
            np.testing.assert_array_equal(values, two[name])


@pytest.mark.filterwarnings("ignore::UserWarning")  # of unbounded observations
def test_task_is_made_by_its_registered_id() -> None:
    made = gymnasium.make("handtouch/Grip-v0", world="ideal")
    observation, _ = made.reset(seed=1)
    assert observation in made.observation_space
