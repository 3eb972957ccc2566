"""A Gymnasium task on MuJoCo and `TactileSensor`: hold an object of unknown weight and friction gently.

Public names: `GripEnvironments` (many at once), `GripEnvironment` (one), `GripScene` (its physics, without
touch), `TOUCH` and `FEATURES` (observations), `objects_at`.
Needs the extra `gym`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config import shipped
from handtouch.learn import TouchFeatures
from handtouch.simulate.tactile.sensor import TactileSensor

Observation = dict[str, NDArray[np.float32]]

PERIOD_S = 0.01
"""Time of a step: the SYNC period of the deployment."""
EPISODE_STEPS = 120
MIN_FORCE_N, MAX_FORCE_N, INITIAL_FORCE_N = 0.3, 8.0, 1.0
MAX_RATE_N_S = 30.0
"""Greatest change of the grip force, for the actions -1 and 1."""
MAX_SLIP_M = 8e-3
"""The object counts as dropped when it has slid so far."""
DROP_COST = 10.0
MASS_KG, FRICTION = (0.03, 0.15), (0.3, 1.0)
"""Limits of the objects, log-uniform."""
_LIFT_S = (0.2, 0.7)
"""The object's weight is transferred from its support to the grip in this time."""
_SCENE = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="20"/>
  <default><geom condim="3" friction="0.01 0.005 0.0001"/></default>
  <worldbody>
    <body name="thumb_tip" quat="0.70710678 0 0.70710678 0">
      <geom type="box" size="0.015 0.012 0.002" pos="0 0 -0.002"/>
    </body>
    <body name="object" pos="0.02 0 0">
      <joint name="object_x" type="slide" axis="1 0 0"/>
      <joint name="object_z" type="slide" axis="0 0 1"/>
      <geom name="bead" type="sphere" size="0.0213" pos="0.0013 0 0" mass="0.05"/>
      <geom name="back" type="box" size="0.002 0.02 0.02" pos="0.025 0 0" mass="0.05"/>
    </body>
    <body name="index_tip" pos="0.0593 0 0" quat="0.70710678 0 -0.70710678 0">
      <joint name="finger" type="slide" axis="0 0 1" damping="5" range="-0.01 0.05"/>
      <geom type="sphere" size="0.012" mass="0.02"/>
    </body>
  </worldbody>
  <actuator><motor joint="finger"/></actuator>
</mujoco>
"""  # the thumb's plate faces +x, the index finger's tip closes along -x, gravity acts along -z

TOUCH = TouchFeatures(("thumb_tip", "index_tip"))
FEATURES: Mapping[str, Mapping[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["grip_force_n", "finger_m"]},
    "observation.touch": TOUCH.declaration(),
    "action": {"dtype": "float32", "shape": (1,), "names": ["grip_force_rate"]},
}
"""Observations and action as LeRobot declares the features of a dataset; its `fps` is 1 / PERIOD_S."""


class GripScene:
    """One grip in MuJoCo, `model` and `data`; begin an episode with `reset`.

    `force_n`: commanded; `dropped`: whether the object has slid too far in this episode; `steps`: of it.
    """

    def __init__(self, model: Any | None = None) -> None:
        self.model = mujoco.MjModel.from_xml_string(_SCENE) if model is None else copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.force_n, self.steps, self.dropped = INITIAL_FORCE_N, 0, False
        self._substeps = round(PERIOD_S / self.model.opt.timestep)
        self._body = self.model.body("object").id
        self._inertia_m2 = self.model.body_inertia[self._body] / self.model.body_mass[self._body]
        self._geoms = [self.model.geom(name).id for name in ("bead", "back")]

    def reset(self, mass_kg: float, friction: float) -> None:
        """Put a new object into the grip, supported."""
        model = self.model
        model.body_inertia[self._body] = mass_kg * self._inertia_m2
        model.body_mass[self._body] = mass_kg
        model.geom_friction[self._geoms, 0] = friction
        mujoco.mj_setConst(model, self.data)
        mujoco.mj_resetData(model, self.data)
        self.force_n, self.steps, self.dropped = INITIAL_FORCE_N, 0, False

    def step(self, action: float) -> float:
        """Apply an action for `PERIOD_S`; return the reward, 0 after the object was dropped."""
        if self.dropped:
            return 0.0
        change_n = PERIOD_S * MAX_RATE_N_S * min(max(action, -1.0), 1.0)
        self.force_n = min(max(self.force_n + change_n, MIN_FORCE_N), MAX_FORCE_N)
        before_m, self.steps = self.slip_m, self.steps + 1
        self.data.ctrl[0] = self.force_n
        begin_s, end_s = _LIFT_S
        supported = min(max((end_s - self.data.time) / (end_s - begin_s), 0.0), 1.0)
        weight_n = 9.81 * self.model.body_mass[self._body]
        self.data.xfrc_applied[self._body, 2] = supported * weight_n
        mujoco.mj_step(self.model, self.data, self._substeps)
        self.dropped = self.slip_m > MAX_SLIP_M
        cost = PERIOD_S * self.force_n + 100.0 * max(self.slip_m - before_m, 0.0)
        left_s = PERIOD_S * (EPISODE_STEPS - self.steps)
        return float(-cost - self.dropped * (DROP_COST + left_s * MAX_FORCE_N))

    @property
    def slip_m(self) -> float:
        """How far the object has slid down."""
        return float(-self.data.qpos[1])

    @property
    def state(self) -> tuple[float, float]:
        """Commanded force and position of the finger."""
        return self.force_n, float(self.data.qpos[2])


class _Grips:
    """Simulations of `count` grips and their touch (count, size)."""

    def __init__(self, count: int, world: str, seed: int) -> None:
        first = GripScene()
        self.scenes = [first, *(GripScene(first.model) for _ in range(count - 1))]
        deployment = config.load(shipped.path("two_finger.toml"))
        self.sensor = TactileSensor(deployment, first.model, world, seed, environments=count)
        self.touch = np.zeros((count, TOUCH.size), np.float32)

    def read(self) -> None:
        """Sense all grips."""
        states = [scene.data for scene in self.scenes]
        self.touch = TOUCH.of(self.sensor.read(states), links=self.sensor.links)

    def step(self, actions: FloatArray) -> FloatArray:
        """Apply actions (count,) for a period; return the rewards (count,)."""
        pairs = zip(self.scenes, actions.tolist(), strict=True)
        rewards = np.array([scene.step(action) for scene, action in pairs])
        self.read()
        return rewards

    def column(self, name: str) -> NDArray[Any]:
        """Return an attribute of all grips (count, ...)."""
        return np.array([getattr(scene, name) for scene in self.scenes])


def _observation_space() -> gymnasium.Space[Any]:
    state = Box(-np.inf, np.inf, FEATURES["observation.state"]["shape"], np.float32)
    return Dict({"observation.state": state, "observation.touch": Box(TOUCH.low, TOUCH.high)})


class GripEnvironments(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """`count` grips with a sensor of the world `world`, drawn by `seed`.

    An object of unknown weight and friction, held at `INITIAL_FORCE_N`, loses its support; an action
    (count, 1) in [-1, 1] changes the grip force. A reward is minus the grip's impulse [N s] and 0.1 per
    millimetre of slip; a dropped object costs `DROP_COST` and the greatest force until the end.
    Observations: see `FEATURES`. `reset` takes `options={"reset_mask": (count,)}`, as there is no autoreset.
    """

    metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": []}  # noqa: RUF012

    def __init__(self, count: int, world: str = "default", seed: int = 1) -> None:
        self.num_envs, self.render_mode = count, None
        self.single_observation_space = _observation_space()
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self._grips = _Grips(count, world, seed)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin episodes; `options["objects"]` (2, count): their masses [kg] and friction, else random.

        A seed, or a sequence of them, determines the episodes, noise of the sensor included.
        """
        number = _seed_number(seed)
        super().reset(seed=number)
        if number is not None:
            self._grips.sensor.restart(number)
        options = options or {}
        chosen = np.flatnonzero(options.get("reset_mask", np.ones(self.num_envs, np.bool_)))
        drawn = self.np_random.random((self.num_envs, 2))
        mass_kg, friction = options.get("objects", objects_at(drawn))
        for number in chosen.tolist():
            self._grips.scenes[number].reset(float(mass_kg[number]), float(friction[number]))
        self._grips.sensor.reset(chosen.tolist())
        self._grips.read()
        return self._observation(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply actions (count, 1) for `PERIOD_S`; dropped objects stay dropped."""
        reward = self._grips.step(np.asarray(actions, np.float64)[:, 0])
        truncated = self._grips.column("steps") >= EPISODE_STEPS
        info = {"slip_m": self._grips.column("slip_m"), "grip_force_n": self._grips.column("force_n")}
        return self._observation(), reward, self._grips.column("dropped"), truncated, info

    def _observation(self) -> Observation:
        state = self._grips.column("state").astype(np.float32)
        return {"observation.state": state, "observation.touch": self._grips.touch}


class GripEnvironment(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One of `GripEnvironments`."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, world: str = "default", seed: int = 1) -> None:
        self.observation_space = _observation_space()
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self._one = GripEnvironments(1, world, seed)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode."""
        number = _seed_number(seed)
        super().reset(seed=number)
        if number is not None:
            self._one.reset(seed=number)
        objects = (options or {}).get("objects", objects_at(self.np_random.random((1, 2))))
        observation, info = self._one.reset(options={"objects": objects})
        return {name: value[0] for name, value in observation.items()}, info

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action (1,) for `PERIOD_S`."""
        observation, reward, dropped, truncated, info = self._one.step(np.asarray(action)[None])
        return (
            {name: value[0] for name, value in observation.items()},
            float(reward[0]),
            bool(dropped[0]),
            bool(truncated[0]),
            {name: value[0] for name, value in info.items()},
        )


def _seed_number(seed: Any) -> int | None:
    """Return one number for a seed or a sequence of them; None for none."""
    if seed is None or isinstance(seed, int):
        return seed
    numbers = np.atleast_1d(np.asarray(seed, dtype=object))
    if all(number is None for number in numbers):
        return None
    words = [-1 if number is None else int(number) for number in numbers]
    if len(words) == 1:
        return words[0]
    return int(np.random.SeedSequence([word % 2**32 for word in words]).generate_state(1)[0])


def objects_at(quantiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return masses [kg] and coefficients of friction (n,) of objects at quantiles (n, 2) of the limits."""
    low, high = np.log([MASS_KG, FRICTION]).T
    mass_kg, friction = np.exp(low + (high - low) * quantiles).T
    return mass_kg, friction


gymnasium.register("handtouch/Grip-v0", entry_point=f"{__name__}:GripEnvironment")
