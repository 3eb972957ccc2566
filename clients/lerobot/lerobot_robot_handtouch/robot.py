"""The robot `handtouch`: another robot, and the touch of its hand."""

from __future__ import annotations

import logging
from typing import Any, cast

import draccus
from lerobot.robots import Robot, RobotConfig, make_robot_from_config

from handtouch import Hand
from handtouch.learn import TouchFeatures
from lerobot_robot_handtouch.config_handtouch import HandtouchConfig

PREFIX = "touch."
_FIRST_FRAME_S = 5.0
_log = logging.getLogger(__name__)


class Handtouch(Robot):
    """Another robot, whose observations have the touch of a hand, too.

    What isn't known is 0, and its flag says so. Raises ValueError for options that `TouchFeatures` refuses.
    """

    config_class = HandtouchConfig
    name = "handtouch"

    def __init__(self, config: HandtouchConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot = make_robot_from_config(draccus.decode(RobotConfig, dict(config.robot)))
        self.touch = TouchFeatures(config.links, frame=cast(Any, config.frame), vector=config.vector)
        self._hand: Hand | None = None

    @property
    def cameras(self) -> dict[str, Any]:
        """Cameras of the wrapped robot."""
        return getattr(self.robot, "cameras", {})

    @property
    def observation_features(self) -> dict[str, Any]:
        """Those of the wrapped robot, and a number for each feature of touch."""
        return {**self.robot.observation_features, **{PREFIX + name: float for name in self.touch.names}}

    @property
    def action_features(self) -> dict[str, Any]:
        """Those of the wrapped robot."""
        return self.robot.action_features

    @property
    def is_connected(self) -> bool:
        """True while both are connected; a daemon that is gone later shows as touch that isn't known."""
        return self._hand is not None and self.robot.is_connected

    def connect(self, calibrate: bool = True) -> None:
        """Connect the robot, then the daemon. Raises ConnectionError without a frame of the hand."""
        self.robot.connect(calibrate)
        config = self.config
        hand = Hand(config.hand, endpoint=config.endpoint, key=config.key)
        if hand.wait(_FIRST_FRAME_S) is None:
            hand.close()
            self.robot.disconnect()
            raise ConnectionError(
                f"no frame of hand {config.hand!r} from {config.endpoint} within {_FIRST_FRAME_S:g} s; "
                "start `handtouch run FILE`, and check hand and endpoint"
            )
        self._hand = hand

    @property
    def is_calibrated(self) -> bool:
        """That of the wrapped robot; pads are calibrated by the daemon."""
        return self.robot.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the wrapped robot."""
        self.robot.calibrate()

    def configure(self) -> None:
        """Configure the wrapped robot."""
        self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        """Return the observation of the wrapped robot, with the newest touch. Raises ConnectionError."""
        if self._hand is None:
            raise ConnectionError(f"{self} isn't connected; call connect() first")
        observation = dict(self.robot.get_observation())
        if self._hand.latest() is None:
            _log.debug("no recent frame of the hand: its touch isn't known")
            values = [0.0] * self.touch.size
        else:
            values = self.touch.of(self._hand).tolist()
        return observation | {
            PREFIX + name: value for name, value in zip(self.touch.names, values, strict=True)
        }

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send an action to the wrapped robot."""
        return dict(self.robot.send_action(action))

    def disconnect(self) -> None:
        """Disconnect both."""
        if self._hand is not None:
            self._hand.close()
            self._hand = None
        self.robot.disconnect()
