"""A simulated arm of one joint, as a robot of LeRobot's, which looks for `Arm` in this module by its name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.robots import Robot, RobotConfig


@RobotConfig.register_subclass("handtouch_test_arm")
@dataclass(kw_only=True)
class ArmConfig(RobotConfig):  # type: ignore[misc]
    """An arm."""


class Arm(Robot):  # type: ignore[misc]
    """An arm that says where it is."""

    config_class = ArmConfig
    name = "handtouch_test_arm"

    def __init__(self, config: ArmConfig) -> None:
        super().__init__(config)
        self._connected = False

    @property
    def observation_features(self) -> dict[str, Any]:
        return {"joint.pos": float}

    @property
    def action_features(self) -> dict[str, Any]:
        return {"joint.pos": float}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002
        self._connected = True

    def calibrate(self) -> None:
        return None

    def configure(self) -> None:
        return None

    def get_observation(self) -> dict[str, Any]:
        return {"joint.pos": 0.5}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action

    def disconnect(self) -> None:
        self._connected = False
