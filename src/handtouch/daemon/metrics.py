"""Metrics for Prometheus: passes the daemon's messages to an HTTP server process, which answers scrapes.

Public names: `MetricsExporter`, `METRICS_PATH`.

The server is a process because a thread would hold the interpreter lock when the tick needs it. A scrape
costs the tick nothing, and if the daemon hangs, handtouch_up becomes 0.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import subprocess
import sys
import threading

from handtouch import wire
from handtouch.daemon.endpoints import EndpointError

METRICS_PATH = "/metrics"
_RESTART_DELAY_S = 2.0
_log = logging.getLogger("handtouch.metrics")


class MetricsExporter:
    """Runs the server process of http://HOST:PORT/metrics; `send` never blocks. Created by `open`.

    `dropped` counts messages that the process was too slow to read.
    """

    def __init__(self, listener: socket.socket, pipe: tuple[socket.socket, socket.socket]) -> None:
        """Serve at `listener`; `pipe`: the non-blocking end of `send`, and that of the server process."""
        self.dropped = 0
        self.address = "{}:{}".format(*listener.getsockname())
        self.process_id: int | None = None
        """id of the server process, once it runs"""
        self._listener = listener
        self._parent_socket, self._child_socket = pipe
        self._closing = threading.Event()
        self._restart_thread = threading.Thread(
            target=self._keep_running, name="handtouch-metrics", daemon=True
        )

    @classmethod
    def open(cls, address: str) -> MetricsExporter:
        """Listen at HOST:PORT and start the server process. Raises EndpointError."""
        host, _, port = address.rpartition(":")
        try:
            listener = socket.create_server((host, int(port)))
        except OSError as error:
            raise EndpointError(
                f"[daemon] metrics can't be served at {address}: {error.strerror}; is another daemon running "
                "there? Set another port, or remove the key"
            ) from error
        pipe = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        pipe[0].setblocking(False)
        exporter = cls(listener, pipe)
        exporter._restart_thread.start()
        return exporter

    def send(self, message: wire.Health | wire.Service) -> None:
        """Pass a message to the server process."""
        try:
            self._parent_socket.send(wire.to_datagram(message))
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """Stop the server process."""
        self._closing.set()
        for end in (self._parent_socket, self._child_socket, self._listener):
            end.close()
        self._restart_thread.join()

    def _keep_running(self) -> None:
        files = (self._listener.fileno(), self._child_socket.fileno())
        command = [sys.executable, "-m", "handtouch.daemon.metrics_server", *map(str, files)]
        while not self._closing.is_set():
            with contextlib.suppress(OSError, ValueError):  # closed meanwhile
                started = subprocess.Popen(command, pass_fds=files, stdin=subprocess.DEVNULL)
                self.process_id = started.pid
                status = started.wait()
                if not self._closing.wait(_RESTART_DELAY_S):
                    _log.warning("metrics server process: exit status %d; restarting", status)
