"""Bridge process: one relay per daemon, each in a thread, until stopped.

Public name: `run_bridge`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

from handtouch.bridge.options import (
    DEFAULT_TOPICS,
    BridgeError,
    BridgeOptions,
    bridged_daemons,
    is_key_part,
)

if TYPE_CHECKING:
    from handtouch.bridge.relay import Relay

_log = logging.getLogger("handtouch.bridge")
_POLL_S = 0.2


def run_bridge(options: BridgeOptions, stop: threading.Event) -> None:
    """Forward topics until `stop`.

    Raises ValueError for wrong options or files, ImportError without the extra, PermissionError if daemons
    reject the key.
    """
    with ExitStack() as opened:
        threads = [_RelayThread(relay, stop) for relay in _open_relays(options, opened)]
        for thread in threads:
            thread.start()
        stop.wait()
        for thread in threads:
            thread.join()
    if errors := [str(thread.error) for thread in threads if thread.error is not None]:
        raise PermissionError("\n".join(errors))


def _open_relays(options: BridgeOptions, opened: ExitStack) -> Iterator[Relay]:
    daemons = bridged_daemons(options)
    if not all(map(is_key_part, options.prefix.split("/"))):
        raise BridgeError(f"--prefix {options.prefix}: must be names separated by /, e.g. lab/robot7")
    if not (options.connect or options.listen or options.zenoh):
        raise BridgeError("no Zenoh network given; use --connect tcp/HOST:7447, --listen, or --zenoh FILE")
    from handtouch.bridge import relay

    session = opened.enter_context(relay.open_session(options))
    for daemon in daemons:
        root = f"{options.prefix}/{daemon.name}"
        made = relay.Relay(session, root)
        made.open(daemon.stream, options.topics or DEFAULT_TOPICS, options.key)
        opened.callback(made.close)
        if options.control and daemon.control is not None:
            control = relay.ControlRelay(session, root, daemon.control, options.key)
            control.start()
            opened.callback(control.close)
        _log.info("%s: bridged to %s/**", daemon.stream, root)
        yield made


class _RelayThread(threading.Thread):
    """Thread of a relay; when the daemon rejects the key, all stop."""

    def __init__(self, relay: Relay, stop: threading.Event) -> None:
        super().__init__(name=f"bridge-{relay.root}")
        self.error: PermissionError | None = None
        self._relay, self._stop_all = relay, stop

    def run(self) -> None:
        """Relay messages until stopped."""
        try:
            while not self._stop_all.is_set():
                self._relay.relay_messages(_POLL_S)
        except PermissionError as error:
            self.error = error
        finally:
            self._stop_all.set()
