"""The command `bridge`: arguments and output."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from handtouch.cli.errors import failing, needing
from handtouch.cli.options import Subparsers, add_command, add_config, add_key


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of `bridge`."""
    bridges = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_ros2(bridges)
    _add_zenoh(bridges)


def _add_ros2(bridges: Subparsers) -> None:
    ros2 = add_command(
        bridges,
        "ros2",
        run_ros2,
        "publish contacts, wrenches, markers and diagnostics in ROS 2, and forward its joint states",
    )
    add_config(ros2, "deployment file of a daemon on this machine")
    ros2.add_argument("--namespace", default="handtouch", help="of the topics (default: handtouch)")
    ros2.add_argument(
        "--frame-prefix", default="", metavar="PREFIX", help="put before the names of links in frame_id"
    )
    ros2.add_argument("--domain", type=int, metavar="ID", help="DDS domain (default: ROS_DOMAIN_ID, or 0)")
    ros2.add_argument(
        "--joint-states",
        default="/joint_states",
        metavar="TOPIC",
        help="topic of joint states to forward to the daemon; empty for none (default: /joint_states)",
    )
    add_key(ros2)


def _add_zenoh(bridges: Subparsers) -> None:
    bridge = add_command(bridges, "zenoh", run_zenoh, "forward the topics of daemons over Zenoh")
    bridge.add_argument(
        "configs", metavar="CONFIG", type=Path, nargs="*", help="deployment files of daemons on this machine"
    )
    bridge.add_argument(
        "--endpoint",
        dest="endpoints",
        action="append",
        default=[],
        metavar="NAME=ENDPOINT",
        help="another daemon: its name in Zenoh keys and the endpoint of its complete stream (port 5582 by "
        "default); repeatable",
    )
    for option, text in (("connect", "of a router or peer to connect to"), ("listen", "to listen on")):
        bridge.add_argument(
            f"--{option}",
            action="append",
            default=[],
            metavar="tcp/HOST:PORT",
            help=f"Zenoh endpoint {text}; repeatable",
        )
    bridge.add_argument(
        "--prefix",
        default="handtouch",
        help="first part of Zenoh keys PREFIX/NAME/TOPIC (default: handtouch)",
    )
    bridge.add_argument(
        "--topic",
        dest="topics",
        action="append",
        default=[],
        metavar="PATTERN",
        help="topics to forward; repeatable (default: all but raw)",
    )
    bridge.add_argument(
        "--control",
        action="store_true",
        help="also forward control requests, from any client on the Zenoh network",
    )
    add_key(bridge)
    bridge.add_argument(
        "--zenoh", type=Path, metavar="FILE", help="Zenoh configuration file: TLS, access control"
    )


def run_zenoh(**options: Any) -> int:
    """Run the Zenoh bridge until SIGINT or SIGTERM.

    Exit status 0; 1 if a daemon rejects the key; 2 for wrong usage or deployment file.
    """
    from handtouch.bridge.options import BridgeOptions
    from handtouch.bridge.runner import run_bridge

    return _run("zenoh", lambda stop: run_bridge(BridgeOptions(**options), stop))


def run_ros2(**options: Any) -> int:
    """Run the ROS 2 bridge until SIGINT or SIGTERM; exit status as `run_zenoh`."""
    from handtouch.bridge.ros2.runner import RosOptions, run_ros_bridge

    return _run("ros2", lambda stop: run_ros_bridge(RosOptions(**options), stop))


def _run(extra: str, relay: Callable[[threading.Event], None]) -> int:
    from handtouch.host import logs
    from handtouch.host.signals import stop_on_signals

    stop = stop_on_signals()
    with (
        contextlib.closing(logs.start_logging()),
        needing(extra),
        failing(1, PermissionError),
        failing(2, ValueError),
    ):
        relay(stop)
    return 0
