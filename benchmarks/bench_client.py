"""Cost of reading the newest state: `handtouch.Hand` in a control loop, beside bare ZeroMQ calls.

A publisher in the same process sends hand frames of 15 pads over a local socket. *Cost*: median of a call,
beside `zmq_poll` where no message waits, and `recv_multipart` with `unpackb` where one does. *Age*: of a
program that pauses for 1 s while 200 frames a second arrive.
"""

from __future__ import annotations

import itertools
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import zmq

import handtouch
from benchmarks.page import Report, options
from handtouch import wire
from handtouch.client.hand import Hand
from tests.client.hand_messages import make_frame

LINKS = tuple(f"finger_{number}" for number in range(15))
PERIOD_S, PAUSE_S = 0.005, 1.0
JOIN_MS = 10_000
ARRIVAL_S = 0.001
"""From the arrival at one subscriber to that at the other"""


def encoded_frame(seq: int) -> list[bytes]:
    """Return an encoded frame of 15 touched pads, stamped now."""
    touched = np.full(len(LINKS), wire.PadState.TOUCHED)
    return wire.encode(make_frame(seq, links=LINKS, t_ns=time.monotonic_ns(), state=touched))


@contextmanager
def publisher() -> Iterator[tuple[Any, str]]:
    """Open a publisher; yield it with its endpoint."""
    with (
        tempfile.TemporaryDirectory() as folder,
        zmq.Context() as context,
        context.socket(zmq.XPUB) as socket,
    ):
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        endpoint = f"ipc://{folder}/live"
        socket.bind(endpoint)
        yield socket, endpoint


def join(socket: Any, count: int) -> None:
    """Wait for subscriptions."""
    for _ in range(count):
        if not socket.poll(JOIN_MS):
            raise TimeoutError("no subscription")
        socket.recv()


def microseconds(call: Callable[[], object], before: Callable[[], None], repeat: int, number: int) -> float:
    """Return the median time of a call; `before` runs before every `number` calls."""
    times = []
    for _ in range(repeat):
        before()
        begin_s = time.perf_counter()
        for _ in range(number):
            call()
        times.append((time.perf_counter() - begin_s) / number * 1e6)
    return statistics.median(times)


def measure_cost(repeat: int) -> list[dict[str, Any]]:
    """Return the time of calls of `Hand` and of bare ZeroMQ [us], and their ratio."""
    sent = itertools.count(1)
    with (
        publisher() as (socket, endpoint),
        Hand("right", endpoint=endpoint) as hand,
        zmq.Context() as context,
        context.socket(zmq.SUB) as bare,
    ):
        bare.connect(endpoint)
        bare.subscribe("hand/right")
        join(socket, 4)
        items = [(bare, int(zmq.POLLIN))]

        def poll() -> None:
            zmq.zmq_poll(items, 0)

        def receive() -> None:
            msgpack.unpackb(bare.recv_multipart()[1])

        def read() -> None:
            hand.latest()
            _ = hand.force_n["finger_3"], hand.touched.get("finger_3")

        def send() -> None:
            hand.latest()
            while bare.poll(0):
                bare.recv_multipart()
            socket.send_multipart(encoded_frame(next(sent)))
            bare.poll(JOIN_MS)
            time.sleep(ARRIVAL_S)

        def settle() -> None:
            send()
            hand.latest()
            bare.recv_multipart()

        rows = []
        for name, call in (("latest()", hand.latest), ("latest() and two values", read)):
            for waits, reference, before, number in (
                ("no message", poll, settle, 200),
                ("one frame", receive, send, 1),
            ):
                many = repeat if number > 1 else 10 * repeat
                time_us, bare_us = (microseconds(c, before, many, number) for c in (call, reference))
                values = {"Hand, us": time_us, "bare, us": bare_us, "ratio": time_us / bare_us}
                rows.append({"call": name, "waiting": waits, **values})
        return rows


@contextmanager
def publishing(socket: Any) -> Iterator[None]:
    """Send a frame every `PERIOD_S` in a thread."""
    stop = threading.Event()

    def publish() -> None:
        for seq in itertools.count(1):
            if stop.wait(PERIOD_S):
                break
            socket.send_multipart(encoded_frame(seq))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def measure_age() -> list[dict[str, Any]]:
    """Return the age [ms] of what `recv` and `latest` return after a pause, and the frames behind it."""
    with (
        publisher() as (socket, endpoint),
        Hand("right", endpoint=endpoint) as hand,
        handtouch.connect("hand/right", endpoint=endpoint) as frames,
    ):
        join(socket, 5)
        with publishing(socket):
            hand.wait(10.0)
            frames.recv(10.0)
            time.sleep(PAUSE_S)
            received, received_ns = frames.recv(0), time.monotonic_ns()
            newest, newest_ns = hand.latest(), time.monotonic_ns()
        assert received is not None
        assert newest is not None
        behind = sum(1 for _ in iter(lambda: frames.recv(0.1), None))
    return [
        {"call": "recv()", "age, ms": (received_ns - received.t_ns) * 1e-6, "frames behind it": behind},
        {"call": "latest()", "age, ms": (newest_ns - newest.t_ns) * 1e-6, "frames behind it": 0},
    ]


def main() -> None:
    """Measure and write the page."""
    quick = options(__doc__).parse_args().quick
    report = Report(quick, pyzmq=zmq.__version__)
    report.table("Cost", measure_cost(20 if quick else 500))
    report.table("Age after a pause", measure_age())
    report.keep()


if __name__ == "__main__":
    main()
