"""Limit of new connections: by given times, and by the kernel on a real endpoint."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from handtouch.daemon.authentication import MAX_BURST, MAX_PER_S, Authenticator, ConnectionLimit
from handtouch.daemon.connections import dropped_connection_requests
from handtouch.daemon.endpoints import bind_endpoint

_POLL_NS = 10_000_000
_SECOND_NS = 1_000_000_000


class Kernel:
    """Takes the share of requests that is set, of `per_poll` in each poll."""

    def __init__(self, supported: bool = True) -> None:
        self.limit = ConnectionLimit(self._set)
        self.changes: list[int] = []
        self.now_ns = _SECOND_NS
        self._supported = supported

    def _set(self, halvings: int) -> bool:
        self.changes.append(halvings)
        return self._supported

    def run(self, seconds: float, per_poll: float) -> float:
        """Return the connections per second that came through."""
        waiting, taken = 0.0, 0
        polls = round(seconds * _SECOND_NS / _POLL_NS)
        for _ in range(polls):
            self.now_ns += _POLL_NS
            waiting += per_poll / 2**self.limit.halvings
            self.limit.count(int(waiting), self.now_ns)
            taken += int(waiting)
            waiting -= int(waiting)
        return taken / seconds


@given(bursts=st.lists(st.integers(0, MAX_BURST), min_size=1, max_size=20))
def test_no_request_is_dropped_below_the_permitted_rate(bursts: list[int]) -> None:
    kernel = Kernel()
    for burst in bursts:
        kernel.limit.count(burst, kernel.now_ns)
        kernel.now_ns += round(MAX_BURST / MAX_PER_S * _SECOND_NS)
    assert kernel.changes == []


@given(per_poll=st.integers(2, 120))
def test_flood_is_reduced_to_the_permitted_rate_and_forgotten_after_it(per_poll: int) -> None:
    kernel = Kernel()
    kernel.run(20, per_poll)
    assert kernel.run(60, per_poll) <= 2 * MAX_PER_S
    assert kernel.limit.halvings <= 8
    kernel.run(100, 0)
    assert kernel.limit.halvings == 0
    assert kernel.changes[-1] == 0


def test_flood_that_the_kernel_can_not_reduce_is_taken() -> None:
    kernel = Kernel(supported=False)
    kernel.run(5, 100)
    assert kernel.limit.halvings == 0
    assert set(kernel.changes) == {1}


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.destroy(0)


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def _opens(port: int, timeout_s: float) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout_s).close()
    except TimeoutError:
        return False
    return True


def test_client_that_opens_connections_without_pause_waits_and_others_stay_connected(
    context: zmq.Context[zmq.Socket[bytes]], opened: ExitStack, caplog: pytest.LogCaptureFixture
) -> None:
    authenticator = Authenticator(context)
    opened.callback(authenticator.close)
    server = opened.enter_context(context.socket(zmq.REP))
    endpoint = bind_endpoint(server, "tcp://127.0.0.1:*", "a test", authenticator, "control")
    established = opened.enter_context(context.socket(zmq.REQ))
    established.connect(endpoint)
    established.send(b"")
    server.recv()
    server.send(b"")
    established.recv()
    port = int(endpoint.rpartition(":")[2])
    now_ns = _SECOND_NS
    for _ in range(100 * MAX_BURST):
        _opens(port, 0.2)
        now_ns += _POLL_NS
        authenticator.poll(now_ns)
        if authenticator.refused["connection_flood"]:
            break
    else:
        raise AssertionError("every request was accepted")
    assert (
        f"clients connect too fast; requests to connect are dropped at random, which delays new "
        f"connections by seconds; find the process that opens one after another: {endpoint}" in caplog.text
    )
    for _ in range(100):  # sent by a connection that was there before
        established.send(b"")
        assert server.poll(30_000)
        server.send(server.recv())
        assert established.poll(30_000)
        established.recv()
    for _ in range(100):  # the flood is over
        now_ns += _SECOND_NS
        authenticator.poll(now_ns)
    assert all(_opens(port, 30) for _ in range(20))


def test_number_of_dropped_requests_is_unknown_without_the_listener() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert dropped_connection_requests(server.fileno(), f"tcp://127.0.0.1:{port}") == 0
        assert dropped_connection_requests(server.fileno(), f"tcp://127.0.0.1:{port - 1}") is None
    assert dropped_connection_requests(-1, f"tcp://127.0.0.1:{port}") is None
