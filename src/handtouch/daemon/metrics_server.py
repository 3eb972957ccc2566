"""HTTP server process for Prometheus: `python -m handtouch.daemon.metrics_server LISTENER FEED`.

LISTENER and FEED are file descriptors. It keeps the daemon's latest message of each topic and renders the
page for every scrape.
"""

from __future__ import annotations

import contextlib
import http.server
import os
import signal
import socket
import sys
import threading
import time

from handtouch import wire
from handtouch.daemon.metrics_page import CONTENT_TYPE, METRICS_PATH, render_metrics

_MAX_PACKET_BYTES = 1 << 20
_CLIENT_TIMEOUT_S = 5.0


class _LatestMessages:
    """The latest message of each topic."""

    def __init__(self) -> None:
        self._messages: dict[str, wire.Message] = {}
        self._service_arrival_s = float("-inf")
        self._lock = threading.Lock()

    def store(self, packet: bytes, now_s: float) -> None:
        topic, _, payload = packet.partition(b"\0")
        message = wire.decode([topic, payload])
        with self._lock:
            self._messages[topic.decode()] = message
            if isinstance(message, wire.Service):
                self._service_arrival_s = now_s

    def render_page(self, now_s: float) -> bytes:
        with self._lock:
            messages = list(self._messages.values())
            age_s = now_s - self._service_arrival_s
        service = next((message for message in messages if isinstance(message, wire.Service)), None)
        return render_metrics(service, [m for m in messages if isinstance(m, wire.Health)], age_s).encode()


class _MetricsRequestHandler(http.server.BaseHTTPRequestHandler):
    latest: _LatestMessages
    timeout = _CLIENT_TIMEOUT_S

    def do_GET(self) -> None:
        if self.path.partition("?")[0] != METRICS_PATH:
            self.send_error(404, f"metrics are at {METRICS_PATH}")
            return
        page = self.latest.render_page(time.monotonic())
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        self.wfile.write(page)

    def log_message(self, *_: object) -> None:
        """Do nothing: scrapes don't belong in the daemon's log."""


class _MetricsHttpServer(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, listener: socket.socket, latest: _LatestMessages) -> None:
        handler = type("Handler", (_MetricsRequestHandler,), {"latest": latest})
        super().__init__(listener.getsockname()[:2], handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener

    def handle_error(self, *_: object) -> None:
        """Ignore clients that disconnect early."""


def main(listener: int, feed: int) -> None:
    """Serve until the daemon closes the feed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the daemon, which closes the feed
    with contextlib.suppress(OSError):
        os.nice(10)
    latest = _LatestMessages()
    server = _MetricsHttpServer(socket.socket(fileno=listener), latest)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    messages = socket.socket(fileno=feed)
    while packet := messages.recv(_MAX_PACKET_BYTES):
        with contextlib.suppress(wire.WireError):  # another version, during an update
            latest.store(packet, time.monotonic())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
