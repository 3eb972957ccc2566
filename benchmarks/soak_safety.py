"""What a controller may believe: times from the loss of a publisher to what a client sees, and a checker.

A process publishes frames of a touched hand at 200 Hz and `service` twice a second, as a daemon does. It is
killed, stopped (as a daemon that hangs, or a cable that is pulled: nothing arrives and nobody disconnects),
stopped while the client computes, and restarted. A checker looks at every frame that the client returns: it
may be no older than the stated limit of 50 ms by its own time, whatever happens. The restart contains the
start of a Python process, and ZeroMQ's reconnection. Exit status 1 if a frame was older.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zmq

from benchmarks.client_checks import HandCheck, Truth
from benchmarks.page import Report, options, progress
from handtouch import wire
from handtouch.client.daemon_clock import MIN_AGE_LIMIT_S
from handtouch.client.hand import Hand
from handtouch.simulate.scenario import Scenario
from tests.client.hand_messages import LINKS, make_frame, make_service

PERIOD_S = 0.005
TURNS, QUICK_TURNS = 100, 3
COMPUTE_S = 0.5
POLL_S = 0.0005
HELD = "repeat = true" + "".join(
    f"""
[[touch]]
link = "{link}"
from_s = 0
duration_s = 600
path = [[0.5, 0.5]]
force_n = [1.0]"""
    for link in LINKS
)


def publish(port: int) -> None:
    """Publish until the process is killed."""
    publisher: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
    publisher.bind(f"tcp://127.0.0.1:{port}")
    session = time.monotonic_ns()
    for seq in itertools.count(1):
        t_ns = time.monotonic_ns()
        frame = make_frame(
            seq, session=session, t_ns=t_ns, sample_ns=(t_ns,) * 3, state=(wire.PadState.TOUCHED,) * 3
        )
        publisher.send_multipart(wire.encode(frame))
        if seq % 100 == 1:
            publisher.send_multipart(wire.encode(make_service(seq, session, t_ns=t_ns, period_s=PERIOD_S)))
        time.sleep(PERIOD_S)


class Publisher:
    """The publisher as a process, which can be killed, stopped and started again."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.endpoint = f"tcp://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        """Start it."""
        self._process = subprocess.Popen([sys.executable, __file__, "--publish", str(self.port)])

    def signal(self, number: int) -> None:
        """Send it a signal."""
        assert self._process is not None
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        """Kill it, and wait until it is gone."""
        self.signal(signal.SIGKILL)
        assert self._process is not None
        self._process.wait()


class Reader(HandCheck):
    """Reads a hand that is always touched, and checks every frame."""

    def __init__(self, hand: Hand) -> None:
        super().__init__(hand, Truth(Scenario.parse(HELD), lambda: 1), MIN_AGE_LIMIT_S)

    def wait_until(self, is_known: bool) -> float:
        """Read until there is a frame, or none; return the time that took [s]."""
        begin_s = time.monotonic()
        while self.look() != is_known:
            time.sleep(POLL_S)
        return time.monotonic() - begin_s

    def settle(self) -> None:
        """Read a while with frames."""
        self.wait_until(True)
        end_s = time.monotonic() + 0.1
        while time.monotonic() < end_s:
            self.look()
            time.sleep(POLL_S)


@contextmanager
def running() -> Iterator[tuple[Publisher, Reader]]:
    """Start a publisher and a client of it."""
    publisher = Publisher()
    try:
        with Hand("right", endpoint=publisher.endpoint) as hand:
            yield publisher, Reader(hand)
    finally:
        publisher.kill()


def measure(turns: int) -> tuple[list[dict[str, Any]], int]:
    """Return a row of times [ms] for each event, and the number of frames that were too old."""

    def kill(publisher: Publisher, reader: Reader) -> float:
        begin_s = time.monotonic()
        publisher.signal(signal.SIGKILL)
        reader.wait_until(False)
        passed_s = time.monotonic() - begin_s
        publisher.kill()
        reader.truth.deaths_ns.append(time.monotonic_ns())
        publisher.start()
        return passed_s

    def hang(publisher: Publisher, reader: Reader) -> float:
        publisher.signal(signal.SIGSTOP)
        passed_s = reader.wait_until(False)
        publisher.signal(signal.SIGCONT)
        return passed_s

    def hang_while_computing(publisher: Publisher, reader: Reader) -> float:
        time.sleep(0.1)  # frames wait
        publisher.signal(signal.SIGSTOP)
        time.sleep(COMPUTE_S)
        passed_s = reader.wait_until(False)
        publisher.signal(signal.SIGCONT)
        return passed_s

    def compute(_: Publisher, reader: Reader) -> float:
        time.sleep(COMPUTE_S)
        return reader.wait_until(True)

    def restart(publisher: Publisher, reader: Reader) -> float:
        publisher.kill()
        reader.truth.deaths_ns.append(time.monotonic_ns())
        publisher.start()
        reader.wait_until(False)
        return reader.wait_until(True)

    events: dict[str, Callable[[Publisher, Reader], float]] = {
        "killed, until nothing is returned": kill,
        "hangs or cable pulled, until nothing is returned": hang,
        "hangs while the client computes, until nothing is returned": hang_while_computing,
        "client computes, until a fresh frame": compute,
        "killed and started, until a fresh frame": restart,
    }
    rows, violations = [], 0
    for name, event in events.items():
        with running() as (publisher, reader):
            times_s = []
            for _ in range(turns):
                reader.settle()
                times_s.append(event(publisher, reader))
            rows.append(
                {
                    "event": name,
                    "median, ms": 1e3 * statistics.median(times_s),
                    "worst, ms": 1e3 * max(times_s),
                    "frames checked": reader.found.checked["reads"],
                    "oldest frame returned, ms": 1e3 * reader.worst_age_s,
                    "contradictions": len(reader.finish().texts),
                }
            )
            violations += len(reader.found.texts)
            progress(rows[-1])
    return rows, violations


def main() -> int:
    """Measure and write the page."""
    parser = options(__doc__)
    parser.add_argument("--publish", type=int, metavar="PORT", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.publish is not None:
        publish(arguments.publish)
        return 0
    turns = QUICK_TURNS if arguments.quick else TURNS
    report, (rows, violations) = Report(arguments.quick, turns=turns), measure(turns)
    report.table("Loss and return", rows)
    report.limit("frames that contradict the truth", violations, 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
