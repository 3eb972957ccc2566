"""A Gymnasium task on the scene of examples/start_bolt.py: start a bolt in a hole, by touch alone.

Public names: `BoltEnvironment`, `STAGES`, and the limits of its actions. Needs the extra `gym`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.learn import TouchFeatures
from handtouch.simulate.tactile.bolt_scene import BoltStart
from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell, Sensed

Observation = dict[str, NDArray[np.float32]]

STAGES = ("lying", "touched", "lifted", "inserted")
"""Of the bolt, as in `info["stage"]`; each one that is reached for the first time is a reward of 1."""
INSERTED_M, LIFTED_M, LOST_M = 5e-3, 0.03, -0.02
"""Depth of the tip in the hole, and heights of the bolt's middle: lifted, and beside the table"""
EPISODE_STEPS = 6000
MAX_SPEED_M_S, MAX_TURN_RAD_S, MAX_JOINT_RAD_S = 0.7, 4.5, 2.0
"""Of the flange along and about each axis, and of each joint's target, for the actions -1 and 1.
examples/start_bolt.py has up to 0.63 m/s, 3.9 rad/s and 1.3 rad/s."""
_LOW_M, _HIGH_M = np.array([-0.35, -0.35, 0.0]), np.array([0.35, 0.35, 0.45])
"""Where the flange may be commanded to; examples/start_bolt.py needs -0.2 to 0.23."""
HOME_M = np.array([-0.191266, 0.0, 0.223871])
HOME_ROTATION = Rotation.from_euler("y", -70, degrees=True) * Rotation.from_euler("x", 180, degrees=True)
"""Where the flange begins: straight fingers 15 cm above the table, pointing 20 degrees down"""
_THUMB_RAD = {"thumb_abduction": 0.78, "thumb_cmc": -0.2, "thumb_mcp": 0.05, "thumb_ip": 0.12}
_FINGER_RAD = {"index_mcp": -0.1, "middle_mcp": -0.1, "ring_mcp": -0.1}
HOME_RAD = _THUMB_RAD | _FINGER_RAD
"""Joint positions at the beginning, by name; the others are 0"""


class BoltEnvironment(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A hand of 15 pads on an arm, and a bolt on a table: `BoltWorkcell` at 100 Hz.

    An action in [-1, 1] is a velocity: 3 of the flange, along the world's axes, 3 about them, and one of each
    joint's target, over `MAX_SPEED_M_S`, `MAX_TURN_RAD_S` and `MAX_JOINT_RAD_S`. `observation.state` has
    joint positions as encoders report them, their targets, and the commanded pose of the flange: position,
    and the first two columns of its rotation. `observation.touch` is `touch`, the `TouchFeatures` of all
    pads. `features` declares them as LeRobot does.

    The reward is 1 for each of `STAGES` that is reached for the first time. An episode terminates with the
    bolt inserted or beside the table, and is truncated after `EPISODE_STEPS`.

    world, seed: of the hand, whose pads they draw; clearance_m: of bolt and hole. `cell` has the truth.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, world: str = "default", seed: int = 1, clearance_m: float = 1e-3) -> None:
        self.cell = cell = BoltWorkcell(seed, BoltStart.drawn(seed), world, clearance_m)
        self.touch = TouchFeatures(cell.links)
        pose = [f"flange_{axis}_m" for axis in "xyz"]
        pose += [f"flange_{column}_{axis}" for column in "xy" for axis in "xyz"]
        state = [*cell.joints, *(f"{joint}_target" for joint in cell.joints), *pose]
        moved = [f"flange_{kind}_{axis}" for kind in ("speed", "turn") for axis in "xyz"]
        action = [*moved, *(f"{joint}_target_rate" for joint in cell.joints)]
        self.features: Mapping[str, Mapping[str, Any]] = {
            "observation.state": {"dtype": "float32", "shape": (len(state),), "names": state},
            "observation.touch": self.touch.declaration(),
            "action": {"dtype": "float32", "shape": (len(action),), "names": action},
        }
        spaces: gymnasium.Space[Any] = Dict(
            {
                "observation.state": Box(-np.inf, np.inf, (len(state),), np.float32),
                "observation.touch": Box(self.touch.low, self.touch.high),
            }
        )
        self.observation_space = spaces
        self.action_space = Box(-1.0, 1.0, (len(action),), np.float32)
        fastest = [MAX_SPEED_M_S] * 3 + [MAX_TURN_RAD_S] * 3 + [MAX_JOINT_RAD_S] * len(cell.joints)
        self._change = cell.period_s * np.array(fastest)
        model = cell.scene.model
        self._low_rad, self._high_rad = np.array([model.joint(name).range for name in cell.joints]).T
        self._begin()

    def _begin(self) -> None:
        self._position, self._rotation = HOME_M, HOME_ROTATION
        self._target_rad = np.array([HOME_RAD.get(name, 0.0) for name in self.cell.joints])
        self._steps = self._stage = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; `options["start"]`: a `BoltStart`, else random, either way round.

        A seed determines the episode, noise included.
        """
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31))
        start = (options or {}).get("start") or BoltStart.drawn(number)
        self.cell.restart(start, number)
        self._begin()
        flange = self._position, self._rotation.as_matrix()
        self.cell.start_at(flange, self._target_rad)
        return self._observation(self.cell.move(flange, self._target_rad)), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action for `cell.period_s`."""
        change = self._change * np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        self._position = np.clip(self._position + change[:3], _LOW_M, _HIGH_M)
        self._rotation = Rotation.from_rotvec(change[3:6]) * self._rotation
        self._target_rad = np.clip(self._target_rad + change[6:], self._low_rad, self._high_rad)
        sensed = self.cell.move((self._position, self._rotation.as_matrix()), self._target_rad)
        self._steps += 1
        before, self._stage = self._stage, max(self._stage, self._reached())
        over = self._stage == len(STAGES) - 1 or self.cell.scene.bolt_pose[0][2] < LOST_M
        reward = float(self._stage - before)
        return self._observation(sensed), reward, over, self._steps >= EPISODE_STEPS, self._info()

    def _reached(self) -> int:
        """Return the number of the stage at present."""
        scene = self.cell.scene
        if scene.inserted_m >= INSERTED_M:
            return STAGES.index("inserted")
        if not scene.hand_touches:
            return STAGES.index("lying")
        return STAGES.index("lifted" if scene.bolt_pose[0][2] >= LIFTED_M else "touched")

    def _observation(self, sensed: Sensed) -> Observation:
        pose = [self._position, self._rotation.as_matrix()[:, :2].T.ravel()]
        state = np.concatenate([sensed.joint_rad, self._target_rad, *pose]).astype(np.float32)
        touch = self.touch.of(sensed.touch, links=self.cell.links)
        return {"observation.state": state, "observation.touch": touch}

    def _info(self) -> dict[str, Any]:
        return {"stage": STAGES[self._stage], "inserted_m": self.cell.scene.inserted_m}


gymnasium.register("handtouch/Bolt-v0", entry_point=f"{__name__}:BoltEnvironment")
