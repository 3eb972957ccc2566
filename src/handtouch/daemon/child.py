"""Process of the slow half: `python -m handtouch.daemon.child FD CPUS`, started by the daemon alone.

The deployment comes on standard input, everything else over the socket pair FD; it ends when the daemon does.
CPUS are the processors it may use, by their numbers.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the heavy ones are imported once it is modest
    from handtouch.supervise.slow import SlowHalf

_LARGEST_MESSAGE = 1 << 20
_NICE = 10
_OOM_SCORE = 500


def main() -> int:
    """Serve until the daemon closes its end."""
    _be_modest({int(number) for number in sys.argv[2].split(",")})
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for all of a group: the daemon ends us
        signal.signal(number, signal.SIG_IGN)
    from handtouch.daemon import logs
    from handtouch.supervise.archive import Archive
    from handtouch.supervise.diagnoses import Diagnoses
    from handtouch.supervise.link import Start
    from handtouch.supervise.slow import SlowHalf

    start = Start.load(sys.stdin.buffer.read())
    said = logs.start(start.deployment.daemon.log_level)
    try:
        with socket.socket(fileno=int(sys.argv[1])) as daemon:
            half = SlowHalf(start, Archive(Path(start.store)), Diagnoses(start.deployment))
            try:
                _serve(daemon, half)
            finally:
                half.finish(datetime.now(UTC))
    except Exception:  # the journal has to know why it is gone
        logging.getLogger("handtouch.supervise").exception("the slow half fails")
        return 1
    finally:
        said.close()
    return 0


def _serve(daemon: socket.socket, half: SlowHalf) -> None:
    import msgpack

    from handtouch.supervise.link import write_word

    while data := _received(daemon):
        words = half.take(msgpack.unpackb(data), datetime.now(UTC))
        try:
            for word in words:
                daemon.send(write_word(word))
        except (BrokenPipeError, ConnectionResetError):
            return


def _received(daemon: socket.socket) -> bytes:
    """The next message; empty when the daemon is gone, even if it left words of ours unread."""
    try:
        return daemon.recv(_LARGEST_MESSAGE)
    except ConnectionResetError:
        return b""


def _be_modest(cpus: set[int]) -> None:
    """Everything else on this machine goes first, and when memory runs out this process goes first."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, cpus)
    with contextlib.suppress(OSError):  # nice means nothing to a real-time one, as its daemon may be
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))


if __name__ == "__main__":
    sys.exit(main())
