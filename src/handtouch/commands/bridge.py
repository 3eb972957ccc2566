"""The command `bridge`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, command


def add(commands: Commands) -> None:
    """Add `bridge`."""
    bridge = command(commands, "bridge", _bridge, "carry the topics of daemons over a Zenoh network")
    bridge.add_argument("config", type=Path, nargs="*", help="deployment files of daemons on this machine")
    bridge.add_argument(
        "--endpoint",
        action="append",
        default=[],
        metavar="NAME=ENDPOINT",
        help="a daemon by its complete stream, and what to call it on the network",
    )
    for option, text in (("connect", "of a router or peer to connect to"), ("listen", "to be reached at")):
        bridge.add_argument(
            f"--{option}", action="append", default=[], metavar="tcp/HOST:PORT", help=f"Zenoh endpoint {text}"
        )
    bridge.add_argument("--prefix", default="handtouch", help="before NAME/TOPIC (default: handtouch)")
    bridge.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="PATTERN",
        help="topics to carry (default: all but raw)",
    )
    bridge.add_argument(
        "--control",
        action="store_true",
        help="pass on commands too, whoever on the network gives them",
    )
    bridge.add_argument("--key", metavar="FILE", help="key for daemons that ask for one")
    bridge.add_argument("--zenoh", type=Path, metavar="FILE", help="Zenoh configuration: TLS, access control")


def _bridge(asked: argparse.Namespace) -> int:
    from handtouch import bridge

    return bridge.run(
        bridge.Options(
            configs=asked.config,
            endpoints=asked.endpoint,
            connect=asked.connect,
            listen=asked.listen,
            prefix=asked.prefix,
            topics=asked.topic,
            control=asked.control,
            key=asked.key,
            zenoh=asked.zenoh,
        )
    )
