"""Control endpoint: every request gets a reply or is counted, whatever its bytes."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.control import (
    LOOP_FRACTION,
    MAX_JOBS,
    MAX_JOBS_PER_CLIENT,
    MAX_REQUEST_BYTES,
    ControlServer,
    RefusedError,
)

MILLISECOND_NS = 1_000_000
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text() | st.integers(0, 9), inner, max_size=4)
    ),
    max_leaves=20,
)


class PendingJob:
    """A job that ends when `answer` is set."""

    def __init__(self) -> None:
        self.answer: dict[str, Any] | None = None
        self.polls = 0

    def poll(self, _: int) -> dict[str, Any] | None:
        self.polls += 1
        return self.answer


class Bench:
    """A control endpoint with a quick command, one that refuses, one that fails and a long one."""

    def __init__(self) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.authenticator = Authenticator(self.context)
        self.control = ControlServer.open(
            self.context, "tcp://127.0.0.1:*", self.authenticator, clock=lambda: self.work_ns
        )
        self.work_ns = 0
        self.jobs: list[PendingJob] = []
        self.control.commands.update(
            quick=lambda arguments, now_ns: {"arguments": arguments, "now_ns": now_ns},
            refusing=self._refuse,
            failing=lambda _, __: {"x": 1 / 0},
            unpackable=lambda _, __: {"x": object()},
            slow=self._work,
        )
        self.control.jobs["long"] = self._begin
        self.now_ns = 0

    def _refuse(self, _: dict[str, Any], __: int) -> dict[str, Any]:
        raise RefusedError("not now")

    def _work(self, _: dict[str, Any], __: int) -> dict[str, Any]:
        self.work_ns += MILLISECOND_NS
        return {}

    def _begin(self, _: dict[str, Any], __: int) -> PendingJob:
        self.jobs.append(PendingJob())
        return self.jobs[-1]

    def asker(self, kind: int = zmq.REQ) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = self.context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self.control.endpoint)
        return socket

    def poll(self) -> None:
        self.now_ns += 5 * MILLISECOND_NS
        self.control.poll(self.now_ns)

    def answer(self, asker: zmq.Socket[bytes]) -> dict[str, Any]:
        """Poll until the reply arrives."""
        for _ in range(3000):
            self.poll()
            if asker.poll(1):
                return dict(msgpack.unpackb(asker.recv_multipart()[-1]))
        raise AssertionError("no answer")

    def ask(self, request: bytes | dict[str, Any]) -> dict[str, Any]:
        with self.asker() as asker:
            asker.send(request if isinstance(request, bytes) else msgpack.packb({"v": 1, **request}))
            return self.answer(asker)


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    made = Bench()
    logging.getLogger("handtouch.control").setLevel(logging.CRITICAL)
    yield made
    logging.getLogger("handtouch.control").setLevel(logging.NOTSET)
    made.control.close()
    made.authenticator.close()
    made.context.destroy(0)


def test_command_gets_its_arguments_and_the_reply_is_ok(bench: Bench) -> None:
    answer = bench.ask({"command": "quick", "x": [1, "a"]})
    assert (answer["v"], answer["ok"], answer["arguments"]) == (1, True, {"x": [1, "a"]})


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (b"", "malformed"),
        (b"\xc1", "malformed"),
        (msgpack.packb([1, 2]), "malformed"),
        (msgpack.packb({1: 2}), "malformed"),
        (b"\x91" * 5000 + b"\x01", "malformed"),
        (b"\x81\xa1v" + b"\x91" * 1010 + b"\xc0", "v = a nested list: this daemon supports v = 1"),
        (b"\x82\xa1v\x01\xa7command" + b"\x91" * 1010 + b"\xc0", "command = a nested list is not a string"),
        (msgpack.packb({"v": {b"x": 1}, "command": "quick"}), "v = a map"),
        (msgpack.packb({"v": 1}), "not a string"),
        (msgpack.packb({"command": "quick"}), "v = null: this daemon supports v = 1"),
        (msgpack.packb({"v": 2, "command": "quick"}), "supports v = 1"),
        (msgpack.packb({"v": True, "command": "quick"}), "supports v = 1"),
        (msgpack.packb({"v": 1, "command": ["quick"]}), "not a string"),
        (msgpack.packb({"v": 1, "command": "nonsense"}), "unknown command"),
        (msgpack.packb({"v": 1, "command": "quick", "x": b"x" * MAX_REQUEST_BYTES}), "the limit is"),
        (msgpack.packb({"v": 1, "command": "refusing"}), "refusing: not now"),
        (msgpack.packb({"v": 1, "command": "failing"}), "failing failed: division by zero"),
        (msgpack.packb({"v": 1, "command": "unpackable"}), "can't be encoded"),
    ],
)
def test_invalid_request_gets_an_error_reply_and_is_counted(bench: Bench, request_: bytes, why: str) -> None:
    before = bench.control.refused
    answer = bench.ask(request_)
    assert (answer["v"], answer["ok"]) == (1, False)
    assert why in answer["error"]
    assert len(answer["error"]) < 1000
    assert bench.control.refused == before + 1


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200) | VALUES.map(msgpack.packb))
@example(b"\xc7\x0c\xff" + b"\xff" * 12)  # an invalid timestamp
@example(b"\xd6\xff\x00\x00\x00\x00")
def test_any_bytes_get_a_reply(bench: Bench, data: bytes) -> None:
    _, answer = bench.control.start_request(data, 0)
    assert isinstance(answer, dict)
    assert answer["v"] == 1
    msgpack.packb(answer)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=5))
def test_any_parts_from_any_socket_leave_the_endpoint_working(bench: Bench, parts: list[bytes]) -> None:
    with bench.asker(zmq.DEALER) as stranger:
        stranger.send_multipart(parts)
        if parts[0] == b"" and len(parts) > 1:
            assert bench.answer(stranger)["v"] == 1
    assert bench.ask({"command": "quick"})["ok"]


def test_long_command_blocks_no_other_client_and_replies_when_done(bench: Bench) -> None:
    with bench.asker() as patient:
        patient.send(msgpack.packb({"v": 1, "command": "long"}))
        while not bench.jobs:
            bench.poll()
        assert bench.ask({"command": "quick"})["ok"]
        assert not patient.poll(0)
        assert bench.jobs[0].polls > 0
        bench.jobs[0].answer = {"found": 3}
        assert bench.answer(patient)["found"] == 3
    bench.jobs.clear()


def test_jobs_are_bounded_and_outlive_their_client(bench: Bench) -> None:
    askers = [bench.asker() for _ in range(MAX_JOBS)]
    for asker in askers:
        asker.send(msgpack.packb({"v": 1, "command": "long"}))
    while len(bench.jobs) < MAX_JOBS:
        bench.poll()
    assert "long); retry later" in bench.ask({"command": "long"})["error"]
    assert bench.ask({"command": "quick"})["ok"]
    for asker in askers:
        asker.close()
    for job in bench.jobs:
        job.answer = {}
    bench.poll()
    assert bench.ask({"command": "quick"})["ok"]
    bench.jobs.clear()


def test_one_client_does_not_take_the_places_of_all_jobs(bench: Bench) -> None:
    with bench.asker(zmq.DEALER) as greedy, bench.asker() as other:
        for _ in range(MAX_JOBS_PER_CLIENT + 1):
            greedy.send_multipart([b"", msgpack.packb({"v": 1, "command": "long"})])
        assert "of this client" in bench.answer(greedy)["error"]
        assert len(bench.jobs) == MAX_JOBS_PER_CLIENT
        other.send(msgpack.packb({"v": 1, "command": "long"}))
        while len(bench.jobs) == MAX_JOBS_PER_CLIENT:
            bench.poll()
        for job in bench.jobs:
            job.answer = {}
        assert bench.answer(other)["ok"]
    bench.jobs.clear()


def test_flood_takes_its_fraction_of_the_loop_and_others_get_their_turn(bench: Bench) -> None:
    with bench.asker(zmq.DEALER) as flood:
        for _ in range(500):
            flood.send_multipart([b"", msgpack.packb({"v": 1, "command": "slow"})])
        bench.answer(flood)
        begin_ns, work_ns = bench.now_ns, bench.work_ns
        for _ in range(5):
            assert bench.ask({"command": "quick"})["ok"]
        passed_ns = bench.now_ns - begin_ns
        assert bench.work_ns - work_ns <= LOOP_FRACTION * passed_ns + 2 * MILLISECOND_NS
        while flood.poll(1):
            flood.recv_multipart()
    bench.now_ns += 10**12
    bench.poll()


def test_message_of_many_parts_is_read_over_many_polls(bench: Bench) -> None:
    with bench.asker(zmq.DEALER) as stranger:
        stranger.send_multipart([b"", *[b"x"] * 10_000])
        polls = itertools.count()
        while not stranger.poll(1):
            bench.poll()
            next(polls)
        assert "malformed" in msgpack.unpackb(stranger.recv_multipart()[-1])["error"]
        assert next(polls) >= 10
    assert bench.ask({"command": "quick"})["ok"]


def test_flood_is_answered_a_few_requests_per_poll(bench: Bench) -> None:
    with bench.asker(zmq.DEALER) as flood:
        for _ in range(50):
            flood.send_multipart([b"", msgpack.packb({"v": 1, "command": "quick"})])
        answers, polls = 0, itertools.count(1)
        while answers < 50:
            bench.poll()
            next(polls)
            arrived = 0
            while flood.poll(2):
                flood.recv_multipart()
                arrived += 1
            assert arrived <= 16  # of two polls, if one is slow
            answers += arrived


def test_waiting_client_gets_an_error_when_the_daemon_stops() -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    authenticator = Authenticator(context)
    control = ControlServer.open(context, "tcp://127.0.0.1:*", authenticator)
    jobs = [PendingJob()]
    control.jobs["long"] = lambda _, __: jobs[0]
    with context.socket(zmq.REQ) as asker:
        asker.connect(control.endpoint)
        asker.send(msgpack.packb({"v": 1, "command": "long"}))
        while not jobs[0].polls:
            control.poll(0)
        control.close()
        assert asker.poll(10_000)
        assert "stopping" in msgpack.unpackb(asker.recv())["error"]
    authenticator.close()
    context.destroy(0)
