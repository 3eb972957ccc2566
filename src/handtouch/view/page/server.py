"""HTTP server of the page: static files, and changes as server-sent events, which browsers reconnect to.

Public names: `PageServer`. Each open page has its own thread, which always sends the newest values: a slow
page gets fewer changes and delays no other.
"""

from __future__ import annotations

import json
import socket
import threading
from functools import partial
from http import HTTPStatus
from importlib.resources import files
from typing import Any, Self

from handtouch.host.http_server import BoundedHttpServer, BoundedRequestHandler
from handtouch.view.page.model import VersionedValues

_MEDIA_TYPES = {
    ".html": "text/html",
    ".svg": "image/svg+xml",
    ".js": "text/javascript",
    ".css": "text/css",
}
_STATIC = files("handtouch.view.page") / "static"
_RETRY_MS = 300
_KEEPALIVE_PERIOD_S = 1.0
"""After this time without changes a comment is sent, which detects closed pages."""
_SEND_BUFFER_BYTES = 65_536
"""Kernel buffer of a page that doesn't read: a fraction of a second, which bounds its delay."""


class PageServer:
    """Serves `values` once started; hold `condition` while changing them, then call `notify_pages`."""

    def __init__(self, values: VersionedValues, host: str, port: int) -> None:
        self.values = values
        self.pages_opened = 0
        """since the start"""
        self.condition = threading.Condition()
        self.closing = False
        self.notifications = 0
        self.url = ""
        self._address = host, port
        self._http: BoundedHttpServer | None = None

    def start(self) -> Self:
        """Listen at the address; port 0 takes a free port. Raises OSError or OverflowError if that fails."""
        host, port = self._address
        self._http = BoundedHttpServer((host, port), partial(_PageHandler, self))
        port = self._http.server_address[1]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        serve = partial(self._http.serve_forever, poll_interval=0.1)
        threading.Thread(target=serve, name="handtouch-page", daemon=True).start()
        return self

    def notify_pages(self) -> None:
        """Wake the threads of the open pages."""
        with self.condition:
            self.notifications += 1
            self.condition.notify_all()

    def close(self) -> None:
        """Close all connections and stop listening."""
        self.closing = True
        self.notify_pages()
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()


class _PageHandler(BoundedRequestHandler):
    def __init__(self, owner: PageServer, *arguments: Any) -> None:
        self._owner = owner
        super().__init__(*arguments)

    def answer_get(self, path: str) -> None:
        name = path.lstrip("/") or "index.html"
        if name == "changes":
            self._send_changes()
            return
        media_type = _MEDIA_TYPES.get(name[name.rfind(".") :])
        file = _STATIC / name
        if media_type is None or "/" in name or not file.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send_page_headers(media_type, len(body := file.read_bytes()))
        self.wfile.write(body)

    def _send_page_headers(self, media_type: str, length: int | None = None) -> None:
        policy = {"Cache_Control": "no-store", "Content_Security_Policy": "default-src 'self'"}
        self.send_headers(f"{media_type}; charset=utf-8", length, **policy)

    def _send_changes(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self._send_page_headers("text/event-stream")
        self.wfile.write(f"retry: {_RETRY_MS}\n\n".encode())
        owner, version, notification = self._owner, 0, -1
        with owner.condition:
            owner.pages_opened += 1
        try:
            while not owner.closing:
                with owner.condition:
                    if owner.notifications == notification:
                        owner.condition.wait(_KEEPALIVE_PERIOD_S)
                    changes = owner.values.changes_since(version)
                    version, notification = owner.values.version, owner.notifications
                if changes:
                    self.wfile.write(f"data: {json.dumps(changes, separators=(',', ':'))}\n\n".encode())
                else:
                    self.wfile.write(b": keepalive\n\n")
        except OSError:
            pass  # the page was closed
