"""Joint motion of a scenario: smooth trajectories of the joints of a URDF.

Public names: `JointMotion` (`[[joint]]`), `ScenarioJoints` and `ReportedJoints` (each a `JointTrajectory`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

from pydantic import Field

from handtouch import config
from handtouch.client.robot import Robot
from handtouch.config import Deployment
from handtouch.config.base import Positive, Table
from handtouch.hand import urdf
from handtouch.simulate import noise
from handtouch.simulate.smoothstep import smoothstep
from handtouch.simulate.stimulus import JointTrajectory
from handtouch.simulate.worlds import DrawnWorld

_ROTARY_TYPES = tuple(kind for kind in urdf.MOVABLE_JOINT_TYPES if kind != "prismatic")


class JointMotion(Table):
    """`[[joint]]`: a motion of one or several joints; outside it they hold its first or last position."""

    joints: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = Field(
        description='joints of the URDF, as patterns: "index_*", "*_mcp"'
    )
    from_s: float = Field(0.0, ge=0, description="begin, in seconds since the start of the scenario")
    duration_s: Positive = Field(description="duration of the motion")
    position_deg: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] = Field(
        description="positions at evenly spaced times, smoothly interpolated; prismatic joints: mm"
    )

    def position_at(self, t_s: float) -> float:
        """Return the position at `t_s` [degrees, or mm]."""
        legs = len(self.position_deg) - 1
        progress = min(max((t_s - self.from_s) / self.duration_s, 0.0), 1.0) * legs
        leg = min(int(progress), max(legs - 1, 0))
        before, after = self.position_deg[leg], self.position_deg[min(leg + 1, legs)]
        return before + (after - before) * smoothstep(progress - leg)


class ScenarioJoints:
    """The movable joints of a hand with the motions that a scenario defines for them."""

    def __init__(self, joints: Iterable[urdf.UrdfJoint], motions: Sequence[JointMotion]) -> None:
        self._motions = [
            (joint, [m for m in motions if any(fnmatchcase(joint.name, pattern) for pattern in m.joints)])
            for joint in joints
            if joint.kind in urdf.MOVABLE_JOINT_TYPES and not joint.mimic
        ]

    def positions_at(self, t_s: float) -> dict[str, float]:
        """Return the joint positions [rad or m]; of several motions of a joint the one begun last counts."""
        positions = {}
        for joint, motions in self._motions:
            begun = [motion for motion in motions if motion.from_s <= t_s] or motions[:1]
            position = begun[-1].position_at(t_s) if begun else 0.0
            positions[joint.name] = position * 1e-3 if joint.kind == "prismatic" else math.radians(position)
        return positions


class ReportedJoints:
    """Joint positions as the encoders of a hand report them; prismatic joints are reported exactly."""

    def __init__(
        self, true: JointTrajectory, robot: urdf.RobotDescription, world: DrawnWorld, hand: str
    ) -> None:
        self._true = true
        self._names = sorted(name for name, joint in robot.joints.items() if joint.kind in _ROTARY_TYPES)
        self._errors = world.joints(hand, len(self._names))
        self._keys = [noise.stream_key(world.seed, "encoder", hand, name) for name in self._names]

    def positions_at(self, t_s: float) -> dict[str, float]:
        """Return the reported positions at `t_s` [rad or m]."""
        errors = self._errors
        positions = dict(self._true.positions_at(max(t_s - errors.delay_s, 0.0)))
        readings = errors.noise_deg * noise.standard_normal(self._keys, round(t_s * 1e9))
        for name, offset_deg, noise_deg in zip(
            self._names, errors.offset_deg, readings.tolist(), strict=True
        ):
            if name in positions:
                positions[name] += math.radians(offset_deg + noise_deg)
        return positions


_PERIOD_S = 0.01
_logger = logging.getLogger(__name__)


class JointFeed:
    """Sends the joint states of every hand with a URDF, from `start` until `close`.

    `trajectory` returns the reported motion of a hand's joints, or None; `scenario_time_s` is the time in the
    scenario, at which `base_pose` returns the keywords of `send_joints` that a hand's base has. If the daemon
    rejects the connection, that is logged once and the thread ends.
    """

    def __init__(
        self,
        deployment: Deployment,
        trajectory: Callable[[str, urdf.RobotDescription], JointTrajectory | None],
        scenario_time_s: Callable[[], float],
        endpoint: str,
        key: Path | str | None = None,
        base_pose: Callable[[config.HandTable, float], dict[str, tuple[float, ...]]] = lambda _, __: {},
    ) -> None:
        self._base_pose = base_pose
        self._scenario_time_s, self._endpoint, self._key = scenario_time_s, endpoint, key
        self._hands = [
            (hand, joints)
            for hand in deployment.hands
            if hand.urdf and (joints := trajectory(hand.name, urdf.read_urdf(Path(hand.urdf))))
        ]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated-joints", daemon=True)

    def start(self) -> None:
        """Start sending."""
        self._thread.start()

    def close(self) -> None:
        """Stop sending; call it once, after `start`."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        if not self._hands:
            return
        try:
            with Robot(self._endpoint, self._key) as robot:
                while not self._stop.wait(_PERIOD_S):
                    self._send_joints(robot)
        except (PermissionError, ValueError) as error:
            _logger.error("joint states: not sent: %s", error)

    def _send_joints(self, robot: Robot) -> None:
        sample_ns, t_s = time.monotonic_ns(), self._scenario_time_s()
        for hand, joints in self._hands:
            positions = {
                hand.joint_names.get(name, hand.joint_prefix + name): position
                for name, position in joints.positions_at(t_s).items()
            }
            robot.send_joints(hand.name, positions, t_ns=sample_ns, **self._base_pose(hand, t_s))
