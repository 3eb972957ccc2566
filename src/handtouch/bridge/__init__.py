"""`handtouch bridge`: the topics of daemons on a Zenoh network, for fleets and for other Zenoh clients.

A subscriber like any other, in a process of its own: what happens on the network never delays a tick.

Public names: `run`, `Options`, `BridgeError`, `Robot`, `robots`.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from handtouch.config import ConfigError, load
from handtouch.daemon import logs
from handtouch.signals import stop_on_signals

if TYPE_CHECKING:
    from handtouch.bridge.relay import Relay

PREFIX = "handtouch"
TOPICS = ("contact/*/*", "hand/*", "health/*/*", "service")
_log = logging.getLogger("handtouch.bridge")


class BridgeError(ValueError):
    """Something asked for that can't be, with the remedy."""


@dataclass(frozen=True)
class Robot:
    """A daemon to carry: its name on the network, its complete stream, its control endpoint if known."""

    name: str
    stream: str
    control: str | None = None


@dataclass(frozen=True)
class Options:
    """What `handtouch bridge` was asked for."""

    configs: Sequence[Path] = ()
    endpoints: Sequence[str] = ()
    """NAME=ENDPOINT of complete streams"""
    connect: Sequence[str] = ()
    """Zenoh endpoints, such as tcp/10.0.0.1:7447, of routers or peers"""
    listen: Sequence[str] = ()
    prefix: str = PREFIX
    topics: Sequence[str] = ()
    control: bool = False
    key: str | None = None
    zenoh: Path | None = None
    """configuration file of Zenoh: TLS, access control, scouting"""


def run(options: Options) -> int:
    """Carry until SIGINT or SIGTERM; exit status 0, 1 (a daemon lets us not in), 2 (wrong usage or file)."""
    stop = stop_on_signals()
    said = logs.start()
    try:
        with ExitStack() as opened:
            relays = list(_open(options, opened))
            threads = [_Thread(relay, stop) for relay in relays]
            stop.wait()
            for thread in threads:
                thread.join()
    except (BridgeError, ConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    finally:
        said.close()
    for thread in threads:
        if thread.error is not None:
            print(thread.error, file=sys.stderr)
    return 1 if any(thread.error for thread in threads) else 0


def robots(options: Options) -> list[Robot]:
    """The daemons that are asked for. Raises BridgeError, ConfigError."""
    found = [_of_config(path) for path in options.configs]
    for text in options.endpoints:
        name, equals, endpoint = text.partition("=")
        if not equals or not _is_name(name):
            raise BridgeError(f"--endpoint {text}: must be NAME=ENDPOINT, e.g. left=tcp://127.0.0.1:5582")
        found.append(Robot(name, endpoint))
    if not found:
        raise BridgeError("whom to carry? Give deployment files, or --endpoint NAME=ENDPOINT")
    names = [robot.name for robot in found]
    for name in names:
        if names.count(name) > 1:
            raise BridgeError(f'two daemons would be "{name}" on the network; give --endpoint another name')
    if options.control and any(robot.control is None for robot in found):
        raise BridgeError("--control needs deployment files: --endpoint doesn't tell where control is")
    return found


def _open(options: Options, opened: ExitStack) -> Iterator[Relay]:
    carried = robots(options)
    if not all(map(_is_name, options.prefix.split("/"))):
        raise BridgeError(f"--prefix {options.prefix}: must be names with / between them, e.g. lab/robot7")
    if not (options.connect or options.listen or options.zenoh):
        raise BridgeError("where is the Zenoh network? --connect tcp/HOST:7447, --listen, or --zenoh FILE")
    try:
        from handtouch.bridge import relay
    except ImportError as error:
        raise BridgeError(f"Zenoh is missing ({error}): pip install 'handtouch[zenoh]'") from error
    session = opened.enter_context(relay.open_session(options))
    for robot in carried:
        root = f"{options.prefix}/{robot.name}"
        try:
            made = relay.Relay(session, root, robot, options.topics or TOPICS, options.key)
        except ValueError as error:
            raise BridgeError(str(error)) from error
        opened.callback(made.close)
        if options.control and robot.control is not None:
            opened.callback(relay.Commands(session, root, robot.control, options.key).close)
        _log.info("%s is %s/** on the network", robot.stream, root)
        yield made


class _Thread(threading.Thread):
    """Runs a relay; when it can't go on, all stop."""

    def __init__(self, relay: Relay, stop: threading.Event) -> None:
        super().__init__(name=f"bridge-{relay.root}")
        self.error: PermissionError | None = None
        self._relay, self._stop_all = relay, stop
        self.start()

    def run(self) -> None:
        try:
            while not self._stop_all.is_set():
                self._relay.step(0.2)
        except PermissionError as error:
            self.error = error
        finally:
            self._stop_all.set()


def _of_config(path: Path) -> Robot:
    settings = load(path).daemon
    name = path.stem
    if not _is_name(name):
        raise BridgeError(f"{path}: its name can't be one on the network; use --endpoint NAME=ENDPOINT")
    return Robot(name, _reachable(path, settings.complete), _reachable(path, settings.control))


def _reachable(path: Path, endpoint: str) -> str:
    """Where to connect to what a daemon of this machine binds."""
    if endpoint.endswith(":*"):
        raise BridgeError(f"{path}: {endpoint} is any free port; give it a number, or use --endpoint")
    return endpoint.replace("tcp://*:", "tcp://127.0.0.1:").replace("tcp://0.0.0.0:", "tcp://127.0.0.1:")


def _is_name(text: str) -> bool:
    """Whether a text can be a part of a key expression."""
    return bool(text) and not set(text) & set("*$#?/ ")
