"""Thread that sends the joint states of a simulated hand to the daemon, as a robot's controller would.

Public name: `JointFeed`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

from handtouch import config
from handtouch.client.robot import Robot
from handtouch.config import Deployment
from handtouch.hand import urdf
from handtouch.simulate.stimulus import JointTrajectory

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
