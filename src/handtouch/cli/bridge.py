"""The command `bridge`: arguments and output."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from handtouch.cli.options import Subparsers, add_command


def add(commands: Subparsers) -> None:
    """Add `bridge`."""
    bridge = add_command(
        commands, "bridge", "handtouch.cli.bridge:run", "forward the topics of daemons over a Zenoh network"
    )
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
    bridge.add_argument("--key", metavar="FILE", help="client key, for daemons that require one")
    bridge.add_argument(
        "--zenoh", type=Path, metavar="FILE", help="Zenoh configuration file: TLS, access control"
    )


def run(**options: Any) -> int:
    """Run the bridge until SIGINT or SIGTERM.

    Exit status 0; 1 if a daemon rejects the key; 2 for wrong usage or deployment file.
    """
    from handtouch.bridge.options import BridgeError, BridgeOptions
    from handtouch.bridge.runner import run_bridge
    from handtouch.config import ConfigError
    from handtouch.host import logs
    from handtouch.host.signals import stop_on_signals

    stop = stop_on_signals()
    logging_session = logs.start_logging()
    try:
        errors = run_bridge(BridgeOptions(**options), stop)
    except (BridgeError, ConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    finally:
        logging_session.close()
    for rejection in errors:
        print(rejection, file=sys.stderr)
    return 1 if errors else 0
