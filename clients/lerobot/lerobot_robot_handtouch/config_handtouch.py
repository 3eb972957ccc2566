"""Options of the robot `handtouch`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("handtouch")
@dataclass(kw_only=True)
class HandtouchConfig(RobotConfig):
    """Options of the robot `handtouch`; the package's README describes them.

    `robot`: `type` and options of the robot that moves, as a map: LeRobot's parser never ends with a robot in
    a robot.
    """

    robot: dict[str, Any]
    hand: str
    links: list[str] = field(default_factory=list)
    frame: str = "link"
    vector: bool = False
    endpoint: str = "tcp://127.0.0.1:5580"
    key: str | None = None
