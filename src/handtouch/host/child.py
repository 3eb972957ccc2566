"""Main of the daemon's child processes: `python -m MODULE FD CPUS`, started by the daemon only.

The configuration arrives on standard input, all else over the socket pair FD; the process ends with the
daemon. CPUS are the numbers of the processors it may use.

Public names: `run_child`, `child_logging`, `MAX_CHILD_MESSAGE_BYTES`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from handtouch.host import logs

MAX_CHILD_MESSAGE_BYTES = 3 << 17
"""Longer messages of a child process are not read. A calibration of 16 electrodes with all that can be
learned of them has 71,229 bytes, of 32 four times as many."""
_MAX_DAEMON_MESSAGE_BYTES = 1 << 20
_NICENESS = 10
_OOM_SCORE = 500

Worker = Callable[[bytes], Iterable[bytes]]
"""Function that processes a message of the daemon and returns those to send back"""


def run_child(open_worker: Callable[[bytes], AbstractContextManager[Worker]]) -> int:
    """Serve until the daemon closes its end; return the exit status.

    `open_worker` makes the worker from the configuration; it also imports what is heavy, as it is called at
    lowered priority.
    """
    _lower_priority({int(number) for number in sys.argv[2].split(",")})
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # sent to the whole process group; the daemon ends this one
        signal.signal(number, signal.SIG_IGN)
    with open_worker(sys.stdin.buffer.read()) as worker, socket.socket(fileno=int(sys.argv[1])) as daemon:
        while data := _receive(daemon):
            try:
                for message in worker(data):
                    daemon.send(message)
            except (BrokenPipeError, ConnectionResetError):
                break
    return 0


@contextlib.contextmanager
def child_logging(level: str, name: str) -> Iterator[None]:
    """Write log messages, and an error that nothing handled; the daemon restarts the process then."""
    handler = logs.start_logging(level)
    try:
        yield
    except Exception:
        logging.getLogger(f"handtouch.{name}").exception(
            "%s process: unhandled error; the daemon restarts it", name
        )
        raise SystemExit(1) from None
    finally:
        handler.close()


def _receive(daemon: socket.socket) -> bytes:
    """Return the next message; empty once the daemon has closed, even with unread messages."""
    try:
        return daemon.recv(_MAX_DAEMON_MESSAGE_BYTES)
    except ConnectionResetError:
        return b""


def _lower_priority(cpus: set[int]) -> None:
    """Yield to all other processes, and be the first to be killed when memory runs out."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, cpus)
    with contextlib.suppress(OSError):  # inherited from a real-time daemon, where niceness has no effect
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))
