"""A robot for LeRobot that adds the touch of a handtouch daemon to the observations of another robot."""

from lerobot_robot_handtouch.config_handtouch import HandtouchConfig
from lerobot_robot_handtouch.robot import Handtouch

__all__ = ["Handtouch", "HandtouchConfig"]
