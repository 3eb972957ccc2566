"""The page over HTTP: files, and a stream of changes (server-sent events, which browsers follow and reopen).

Public names: `PageServer`. Each page has a thread of its own, which always sends the newest values: a page
that is slow gets fewer changes, and holds up nobody.
"""

from __future__ import annotations

import json
import socket
import threading
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from handtouch.view.page.picture import Board

_TYPES = {".html": "text/html", ".svg": "image/svg+xml", ".js": "text/javascript", ".css": "text/css"}
_STATIC = files("handtouch.view.page") / "static"
_RETRY_MS = 300
_ALIVE_S = 1.0
"""After so long without a change a page is told that we are still here, and we learn whether it is."""
_SEND_BYTES = 65_536
"""In the kernel for a page that doesn't read: a fraction of a second, so that it lags behind no more."""


class PageServer:
    """Serves the board at `url`; hold `changed` while changing it, then `tell`.

    Raises OSError when it can't listen there.
    """

    def __init__(self, board: Board, host: str, port: int) -> None:
        self.pages = 0
        """open now"""
        self.updates = 0
        """change sets sent, to all pages together"""
        self.seen = 0
        """pages that were ever opened"""
        self.changed = threading.Condition()
        self.board = board
        self.closing = False
        self.told = 0
        self._http = _Server((host, port), partial(_Handler, self))
        port = self._http.server_address[1]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        names = {host, "localhost", "127.0.0.1", "[::1]"}
        self.hosts = {f"{name}:{port}" for name in names} if _is_loopback(host) else None
        """what pages may call us: another name is a page from elsewhere that was led here (DNS rebinding)"""
        serve = partial(self._http.serve_forever, poll_interval=0.1)
        threading.Thread(target=serve, name="handtouch-page", daemon=True).start()

    def tell(self) -> None:
        """Wake the threads of the pages."""
        with self.changed:
            self.told += 1
            self.changed.notify_all()

    def close(self) -> None:
        """Hang up."""
        self.closing = True
        self.tell()
        self._http.shutdown()
        self._http.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_port = False

    def __init__(self, address: tuple[str, int], handler: Any) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        super().__init__(address, handler)

    def handle_error(self, *_: Any) -> None:
        """A browser that hung up is nothing to tell."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, owner: PageServer, *arguments: Any) -> None:
        self._owner = owner
        super().__init__(*arguments)

    def do_GET(self) -> None:
        if self._owner.hosts is not None and self.headers.get("Host") not in self._owner.hosts:
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        name = self.path.partition("?")[0].lstrip("/") or "index.html"
        if name == "changes":
            self._stream()
            return
        kind = _TYPES.get(name[name.rfind(".") :])
        file = _STATIC / name
        if kind is None or "/" in name or not file.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._begin(kind, len(body := file.read_bytes()))
        self.wfile.write(body)

    def _begin(self, kind: str, length: int | None) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", "default-src 'self'")
        if length is None:
            self.send_header("Connection", "close")
        else:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _stream(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
        self._begin("text/event-stream", None)
        self.close_connection = True
        self.wfile.write(f"retry: {_RETRY_MS}\n\n".encode())
        owner, known, told = self._owner, 0, -1
        with owner.changed:
            owner.pages += 1
            owner.seen += 1
        try:
            while not owner.closing:
                with owner.changed:
                    if owner.told == told:
                        owner.changed.wait(_ALIVE_S)
                    changes, known, told = owner.board.since(known), owner.board.changes, owner.told
                if changes:
                    self.wfile.write(f"data: {json.dumps(changes, separators=(',', ':'))}\n\n".encode())
                    owner.updates += 1
                else:
                    self.wfile.write(b": here\n\n")
        except OSError:
            pass  # the page was closed
        finally:
            with owner.changed:
                owner.pages -= 1

    def log_message(self, *_: Any) -> None:
        """Requests are nothing to tell."""


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
