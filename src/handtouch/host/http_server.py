"""Threaded HTTP server that clients can't exhaust: bounds on connections and their time, and a Host check.

Public names: `BoundedHttpServer`, `BoundedRequestHandler`.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

MAX_CONNECTIONS = 64
"""Connections, each of which has a thread; a browser opens six at a time, and keeps one of them."""
REQUEST_TIMEOUT_S = 5.0
"""Longest time from accepting a connection to the end of its request's headers."""
WRITE_TIMEOUT_S = 15.0
"""Longest time of one write to a client that doesn't read."""
_EVICTION_TIMEOUT_S = 1.0


class BoundedHttpServer(ThreadingHTTPServer):
    """Answers one request per connection, in a thread each. Where there are `MAX_CONNECTIONS`, a new one
    replaces the oldest whose request is incomplete, and is refused without such a one.

    On a loopback address, a Host header must have one of its names (with any port, as of a tunnel), because
    others are DNS rebinding by a website. Pages of other websites can link here, and nothing else.
    `listener` is a socket that listens already. Raises OSError or OverflowError if the server can't listen.
    """

    daemon_threads = True
    request_queue_size = MAX_CONNECTIONS
    allow_reuse_port = False

    def __init__(self, address: tuple[str, int], handler: Any, listener: socket.socket | None = None) -> None:
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._deadlines_s: dict[socket.socket, float] = {}  # deadlines of incomplete requests, oldest first
        self._lock = threading.Lock()
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        super().__init__(address, handler, bind_and_activate=listener is None)
        if listener is not None:
            self.socket.close()
            self.socket, self.server_address = listener, listener.getsockname()
        host = str(self.server_address[0])
        names = frozenset({address[0].lower(), host, "localhost", "127.0.0.1", "::1"})
        self._names = names if ipaddress.ip_address(host).is_loopback else None

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection, or close the connection."""
        if not self._acquire_slot():
            self.shutdown_request(request)
            return
        with self._lock:
            self._deadlines_s[request] = time.monotonic() + REQUEST_TIMEOUT_S
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._release_slot(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._release_slot(request)

    def service_actions(self) -> None:
        """Close connections whose request is late; called by `serve_forever` at every poll."""
        now_s = time.monotonic()
        with self._lock:
            for request, deadline_s in self._deadlines_s.items():
                if deadline_s > now_s:
                    break
                _end_connection(request)

    def set_request_complete(self, request: socket.socket) -> None:
        """Exempt a connection from the timeout of requests."""
        with self._lock:
            self._deadlines_s.pop(request, None)
        request.settimeout(WRITE_TIMEOUT_S)

    def allows_host(self, header: str) -> bool:
        """Return True if requests with this Host header are answered."""
        try:
            return self._names is None or urlsplit(f"//{header}").hostname in self._names
        except ValueError:
            return False

    def allows_origin(self, origin: str | None, host: str) -> bool:
        """Return True if a page of this origin may read from here: only one that this server sent."""
        return origin is None or urlsplit(origin).netloc == host

    def handle_error(self, *_: Any) -> None:
        """Ignore clients that disconnect early."""

    def _acquire_slot(self) -> bool:
        if self._slots.acquire(blocking=False):
            return True
        with self._lock:
            oldest = next(iter(self._deadlines_s), None)
            if oldest is None:
                return False
            _end_connection(oldest)
        return self._slots.acquire(timeout=_EVICTION_TIMEOUT_S)

    def _release_slot(self, request: socket.socket) -> None:
        with self._lock:
            self._deadlines_s.pop(request, None)
        self._slots.release()


class BoundedRequestHandler(BaseHTTPRequestHandler):
    """Handler of a `BoundedHttpServer`: subclasses implement `answer_get`."""

    protocol_version = "HTTP/1.1"
    server: BoundedHttpServer

    def do_GET(self) -> None:
        """Check the Host header, then answer."""
        self.server.set_request_complete(self.connection)
        self.close_connection = True
        if not self.server.allows_host(self.headers.get("Host", "")):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        is_foreign = self.headers.get("Sec-Fetch-Site") in ("cross-site", "same-site")
        if (is_foreign and self.headers.get("Sec-Fetch-Mode") != "navigate") or not self.server.allows_origin(
            self.headers.get("Origin"), self.headers.get("Host", "")
        ):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        self.answer_get(self.path.partition("?")[0])

    def answer_get(self, path: str) -> None:
        """Answer a request for a path (without its query)."""
        raise NotImplementedError

    def send_headers(self, content_type: str, length: int | None = None, **headers: str) -> None:
        """Send status 200 and the headers; `length` [bytes], None: until the connection ends."""
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", content_type)
        self.send_header("Connection", "close")
        if length is not None:
            self.send_header("Content-Length", str(length))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Log no requests."""


def _end_connection(request: socket.socket) -> None:
    """End the reads and writes of a connection, whose thread then closes it."""
    with contextlib.suppress(OSError):  # already disconnected
        request.shutdown(socket.SHUT_RDWR)
