"""The HTTP server of the view and of metrics: no client can take its threads or keep others out."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from handtouch.host.http_server import MAX_CONNECTIONS, BoundedHttpServer, BoundedRequestHandler

LONGEST_S = 60.0


class Handler(BoundedRequestHandler):
    streaming = threading.Event()

    def answer_get(self, path: str) -> None:
        if path != "/stream":
            self.send_headers("text/plain", 5)
            self.wfile.write(b"hello")
            return
        self.send_headers("text/plain")
        with contextlib.suppress(OSError):
            while not self.streaming.wait(0.01):
                self.wfile.write(b"more\n")


@pytest.fixture
def server() -> Iterator[BoundedHttpServer]:
    Handler.streaming.clear()
    with BoundedHttpServer(("127.0.0.1", 0), Handler) as made:
        serving = threading.Thread(target=made.serve_forever, args=(0.02,))
        serving.start()
        yield made
        Handler.streaming.set()
        made.shutdown()
        serving.join()


def get(server: BoundedHttpServer, path: str = "/", host: str | None = None) -> bytes:
    request = urllib.request.Request(
        "http://{}:{}{}".format(*server.server_address, path), headers={"Host": host} if host else {}
    )
    with urllib.request.urlopen(request, timeout=LONGEST_S) as answer:
        return bytes(answer.read())


def test_half_open_requests_hold_few_threads_and_keep_no_one_out(server: BoundedHttpServer) -> None:
    before = threading.active_count()
    with contextlib.ExitStack() as opened:
        for _ in range(MAX_CONNECTIONS + 40):
            client = opened.enter_context(socket.create_connection(server.server_address[:2]))  # type: ignore[arg-type]
            client.sendall(b"GET / HTTP/1.1\r\n")
            assert threading.active_count() <= before + MAX_CONNECTIONS
        assert get(server) == b"hello"
        assert threading.active_count() <= before + MAX_CONNECTIONS


def test_a_request_that_drips_is_ended_in_time(
    server: BoundedHttpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handtouch.host.http_server.REQUEST_TIMEOUT_S", 0.2)
    with socket.create_connection(server.server_address[:2], LONGEST_S) as client:  # type: ignore[arg-type]
        end_s = time.monotonic() + LONGEST_S
        with contextlib.suppress(OSError):
            client.sendall(b"GET / HTTP/1.1\r\nX: ")
            while time.monotonic() < end_s:  # bytes arrive more often than any time-out of a single read
                client.sendall(b"x")
                time.sleep(0.01)
        assert time.monotonic() < end_s


def test_open_streams_are_not_replaced(server: BoundedHttpServer) -> None:
    url = "http://{}:{}/stream".format(*server.server_address)
    with contextlib.ExitStack() as opened:
        streams = [
            opened.enter_context(urllib.request.urlopen(url, timeout=LONGEST_S))
            for _ in range(MAX_CONNECTIONS)
        ]
        with pytest.raises(OSError):
            get(server)
        assert all(stream.readline() == b"more\n" for stream in streams)
    while True:  # until a closed stream is detected
        with contextlib.suppress(OSError):
            assert get(server) == b"hello"
            return


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "[", ""])
def test_another_host_is_rejected_on_loopback(server: BoundedHttpServer, host: str) -> None:
    with pytest.raises(urllib.error.HTTPError, match="421"):
        get(server, host=host or " ")


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8000", "127.0.0.1:22", "[::1]:80"])
def test_names_of_loopback_are_accepted_with_any_port(server: BoundedHttpServer, host: str) -> None:
    assert get(server, host=host) == b"hello"


def test_any_host_is_accepted_on_other_addresses() -> None:
    with BoundedHttpServer(("0.0.0.0", 0), Handler) as made:
        assert made.allows_host("robot.local:9464")
