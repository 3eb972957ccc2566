"""Options of the bridge, and the daemons that they name.

Public names: `BridgeOptions`, `BridgedDaemon`, `BridgeError`, `bridged_daemons`, `is_key_part`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handtouch.config import load
from handtouch.host.endpoints import to_connect

DEFAULT_PREFIX = "handtouch"
DEFAULT_TOPICS = ("contact/*/*", "hand/*", "health/*/*", "service")


class BridgeError(ValueError):
    """Options that can't be fulfilled; the text contains the remedy."""

    exit_status = 2


@dataclass(frozen=True)
class BridgedDaemon:
    """A bridged daemon: its name on the network, its complete stream, its control endpoint if known."""

    name: str
    stream: str
    control: str | None = None


@dataclass(frozen=True)
class BridgeOptions:
    """Options of `handtouch bridge zenoh`."""

    configs: Sequence[Path] = ()
    endpoints: Sequence[str] = ()
    """NAME=ENDPOINT of complete streams"""
    connect: Sequence[str] = ()
    """Zenoh endpoints of routers or peers, such as tcp/10.0.0.1:7447"""
    listen: Sequence[str] = ()
    prefix: str = DEFAULT_PREFIX
    topics: Sequence[str] = ()
    control: bool = False
    key: str | None = None
    zenoh: Path | None = None
    """configuration file of Zenoh: TLS, access control, scouting"""


def bridged_daemons(options: BridgeOptions) -> list[BridgedDaemon]:
    """Return the daemons named by the options. Raises BridgeError, ConfigError, ValueError."""
    daemons = [_daemon_of_config(path) for path in options.configs]
    for text in options.endpoints:
        name, equals, endpoint = text.partition("=")
        if not equals or not is_key_part(name):
            raise BridgeError(f"--endpoint {text}: must be NAME=ENDPOINT, e.g. left=tcp://127.0.0.1:5582")
        daemons.append(BridgedDaemon(name, endpoint))
    if not daemons:
        raise BridgeError("no daemon to bridge; give deployment files, or --endpoint NAME=ENDPOINT")
    names = [daemon.name for daemon in daemons]
    for name in names:
        if names.count(name) > 1:
            raise BridgeError(
                f'two daemons have the name "{name}" on the network; give --endpoint another name'
            )
    if options.control and any(daemon.control is None for daemon in daemons):
        raise BridgeError("--control needs deployment files: --endpoint doesn't contain the control endpoint")
    return daemons


def is_key_part(text: str) -> bool:
    """Return True if a text can be a part of a Zenoh key expression."""
    return bool(text) and not set(text) & set("*$#?/ ")


def _daemon_of_config(path: Path) -> BridgedDaemon:
    settings = load(path).daemon
    name = path.stem
    if not is_key_part(name):
        raise BridgeError(
            f"{path}: the file's name can't be one on the network; use --endpoint NAME=ENDPOINT"
        )
    return BridgedDaemon(name, to_connect(settings.complete), to_connect(settings.control))
