"""HTTP server process for Prometheus: `python -m handtouch.daemon.metrics_server LISTENER FEED`.

LISTENER and FEED are file descriptors. It keeps the daemon's latest message of each topic and renders the
page for every scrape.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from http import HTTPStatus

from handtouch import wire
from handtouch.daemon.metrics import METRICS_PATH
from handtouch.daemon.metrics_page import CONTENT_TYPE, render_metrics
from handtouch.host.http_server import BoundedHttpServer, BoundedRequestHandler

_MAX_PACKET_BYTES = 1 << 20


class _LatestMessages:
    """The latest message of each topic."""

    def __init__(self) -> None:
        self._messages: dict[str, wire.Message] = {}
        self._service_arrival_s = float("-inf")
        self._lock = threading.Lock()

    def store(self, packet: bytes, now_s: float) -> None:
        message = wire.from_datagram(packet)
        with self._lock:
            self._messages[wire.topic_of(message)] = message
            if isinstance(message, wire.Service):
                self._service_arrival_s = now_s

    def render_page(self, now_s: float) -> bytes:
        with self._lock:
            messages = list(self._messages.values())
            age_s = now_s - self._service_arrival_s
        service = next((message for message in messages if isinstance(message, wire.Service)), None)
        return render_metrics(service, [m for m in messages if isinstance(m, wire.Health)], age_s).encode()


class _MetricsRequestHandler(BoundedRequestHandler):
    latest: _LatestMessages

    def answer_get(self, path: str) -> None:
        if path != METRICS_PATH:
            self.send_error(HTTPStatus.NOT_FOUND, f"metrics are at {METRICS_PATH}")
            return
        page = self.latest.render_page(time.monotonic())
        self.send_headers(CONTENT_TYPE, len(page))
        self.wfile.write(page)


def main(listener: int, feed: int) -> None:
    """Serve until the daemon closes the feed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the daemon, which closes the feed
    with contextlib.suppress(OSError):
        os.nice(10)
    latest = _LatestMessages()
    listening = socket.socket(fileno=listener)
    handler = type("Handler", (_MetricsRequestHandler,), {"latest": latest})
    server = BoundedHttpServer(listening.getsockname()[:2], handler, listening)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    messages = socket.socket(fileno=feed)
    while packet := messages.recv(_MAX_PACKET_BYTES):
        with contextlib.suppress(wire.WireError):  # another version, during an update
            latest.store(packet, time.monotonic())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
