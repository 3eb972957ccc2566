"""A hand with touch, an arm and a bolt, as a controller has them: commands, reported joints and touch.

Public names: `BoltWorkcell`, `Sensed`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config import shipped
from handtouch.simulate.tactile.bolt_scene import BoltScene, BoltStart
from handtouch.simulate.tactile.reading import TactileReading
from handtouch.simulate.tactile.sensor import TactileSensor
from handtouch.simulate.tactile.served_touch import ServedTouch
from handtouch.simulate.worlds import world_named

Pose = tuple[FloatArray, FloatArray]
"""Position (3,) and rotation (3, 3)."""
PERIOD_MS = 10.0
"""Of SYNC: half the shipped rate is enough for this task."""


class Sensed(NamedTuple):
    """What is known after a command."""

    joint_rad: FloatArray
    """(m,), reported positions of the hand's joints, in the order of `BoltWorkcell.joints`"""
    touch: TactileReading


class BoltWorkcell:
    """The shipped hand in a world of a seed, and a bolt on a table.

    Each `move` commands the arm's flange and the hand's joints for one SYNC period, and returns what encoders
    and pads report at its end. Motors follow their encoders, whose zeros the world draws. The pads' counts go
    through the daemon's pipeline, in this process; `slower` given: over a bus and by a daemon,
    as `ServedTouch` states; `close` stops it. `scene` has the truth, which a controller doesn't get.
    """

    def __init__(
        self,
        seed: int,
        start: BoltStart,
        world: str = "default",
        clearance_m: float = 1e-3,
        *,
        slower: int = 0,
    ) -> None:
        drawn = world_named(world).draw(seed)
        deployment = drawn.describe(config.load(shipped.path("utah_mit.toml")))
        daemon = deployment.daemon.model_copy(update={"sync_period_ms": PERIOD_MS})
        deployment = deployment.model_copy(update={"daemon": daemon})
        hand = deployment.hands[0]
        self.urdf = str(hand.urdf)
        self.scene = BoltScene(hand, drawn, start, clearance_m)
        self.joints = self.scene.joints
        of = (deployment, self.scene.model, world, seed)
        self.touch = ServedTouch(*of, slower) if slower else TactileSensor(*of)
        self.links = tuple(link.partition("/")[2] for link in self.touch.links)
        self.period_s = self.touch.period_s
        errors = drawn.joints(hand.name, len(self.joints))
        self._zero_rad, self._noise_rad = np.radians(errors.offset_deg), np.radians(errors.noise_deg)
        self._delay_steps = min(round(1e3 * errors.delay_s), self.touch.steps)
        self._begin_noise(seed)

    def close(self) -> None:
        """Stop the daemon, if there is one."""
        if isinstance(self.touch, ServedTouch):
            self.touch.close()

    def restart(self, start: BoltStart, seed: int) -> None:
        """Begin again with the bolt elsewhere, and the same hand; `seed` chooses the noise.

        What follows is the same as after any other restart with them. Raises ValueError for a cell with a
        daemon, which can't begin again.
        """
        if isinstance(self.touch, ServedTouch):
            raise ValueError("a cell with a daemon can't begin again: make another one")
        self.scene.restart(start)
        self.touch.restart(seed)
        self._begin_noise(seed)

    def _begin_noise(self, seed: int) -> None:
        self._rng = np.random.default_rng((seed, 48))

    def start_at(self, flange: Pose, joint_rad: FloatArray) -> None:
        """Put flange and joints somewhere at once, before the first `move`."""
        self.scene.place_arm(*flange, joint_rad - self._zero_rad)

    def move(self, flange: Pose, joint_rad: FloatArray) -> Sensed:
        """Command a pose of the flange and joint positions (m,); return the state a SYNC period later."""
        scene = self.scene
        scene.arm, scene.target_rad = flange, joint_rad - self._zero_rad
        scene.step(self.touch.steps - self._delay_steps)
        noise_rad = self._noise_rad * self._rng.normal(size=len(self.joints))
        reported_rad = scene.joint_rad + self._zero_rad + noise_rad
        if self._delay_steps:
            scene.step(self._delay_steps)
        return Sensed(reported_rad, self.touch.read(scene.data))
