"""Process of the ROS 2 bridge.

Public names: `RosOptions`, `run_ros_bridge`.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handtouch.bridge.options import BridgeError
from handtouch.bridge.ros2.conflation import Conflation
from handtouch.client import Subscriber
from handtouch.client.robot import Robot
from handtouch.config import Deployment, load
from handtouch.hand.robot_models import RobotModels
from handtouch.hand.urdf import read_urdf
from handtouch.host.endpoints import to_connect

_QUEUE_MESSAGES = 20_000
_POLL_S = 0.02
_JOINTS_POLL_S = 0.002


@dataclass(frozen=True)
class RosOptions:
    """Options of `handtouch bridge ros2`."""

    config_path: Path
    namespace: str = "handtouch"
    frame_prefix: str = ""
    domain: int | None = None
    """None: $ROS_DOMAIN_ID, or 0"""
    joint_states: str = "/joint_states"
    """topic; empty: none"""
    key: str | None = None


def run_ros_bridge(options: RosOptions, stop: threading.Event) -> None:
    """Relay until `stop`.

    Raises ValueError for wrong options or files, RosNetworkError, ImportError without the extra, and
    PermissionError if the daemon rejects the key.
    """
    from handtouch.bridge.ros2 import relay
    from handtouch.bridge.ros2.conversion import Stamper
    from handtouch.bridge.ros2.network import RosNetwork, ros_name

    deployment = load(options.config_path)
    _check_names(deployment, ros_name)
    settings, stamper = deployment.daemon, Stamper(options.frame_prefix)
    with ExitStack() as opened:
        network = RosNetwork(_domain(options.domain), options.namespace)
        stream = to_connect(settings.complete)
        objects = [f"percept/{hand.name}/object" for hand in deployment.hands if hand.object]
        source = Subscriber[Any].open((*relay.TOPICS, *objects), stream, _QUEUE_MESSAGES, options.key)
        opened.callback(source.close)
        robot = opened.enter_context(Robot(to_connect(settings.inputs), options.key))
        outgoing = relay.RosRelay(network, stamper, _palm_links(deployment))
        models = RobotModels(deployment)
        joints = dict(zip(models.hands, models.joint_names, strict=True))
        if options.joint_states and joints:
            incoming = relay.JointStateRelay(network, options.joint_states, robot, stamper, joints)
            thread = threading.Thread(target=incoming.run, args=(stop, _JOINTS_POLL_S), name="joints")
            thread.start()
            opened.callback(thread.join)
            opened.callback(stop.set)  # also when the daemon rejects the key
        waiting = Conflation()
        while not stop.is_set():
            if not relay.relay_received(source, waiting, outgoing, _POLL_S):
                if source.has_received and not source.alive:
                    outgoing.end_session()
                else:
                    outgoing.expire()
        outgoing.end_session()


def _domain(given: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if given is None and not text.isdigit():
        raise BridgeError(f"ROS_DOMAIN_ID={text}: must be a number from 0 to 232")
    domain = int(text) if given is None else given
    if not 0 <= domain <= 232:
        raise BridgeError(f"domain {domain}: must be from 0 to 232")
    return domain


def _check_names(deployment: Deployment, ros_name: Callable[[str], str]) -> None:
    """Raise BridgeError for pads or hands whose topics would be one."""
    owner: dict[tuple[str, ...], str] = {}
    for name in (*(hand.name for hand in deployment.hands), *deployment.pad_names):
        topic = tuple(map(ros_name, name.split("/")))
        if (other := owner.setdefault(topic, name)) != name:
            raise BridgeError(
                f"{other} and {name} have one topic in ROS 2, {'/'.join(topic)}, whose names have letters, "
                "digits and single underscores; rename one of them"
            )


def _palm_links(deployment: Deployment) -> dict[str, str]:
    """Return the palm's link by hand, for hands with a URDF."""
    return {
        hand.name: hand.palm_link or read_urdf(Path(hand.urdf)).root for hand in deployment.hands if hand.urdf
    }
