"""Supervisor process: `python -m handtouch.supervisor.child FD CPUS`, started by the daemon only.

The deployment arrives on standard input, all else over the socket pair FD; the process ends with the daemon.
CPUS are the numbers of the processors it may use.
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

if TYPE_CHECKING:  # heavy imports follow once the priority is lowered
    from handtouch.supervisor.worker import SupervisorWorker

_MAX_MESSAGE_BYTES = 1 << 20
_NICENESS = 10
_OOM_SCORE = 500


def main() -> int:
    """Serve until the daemon closes its end."""
    _lower_priority({int(number) for number in sys.argv[2].split(",")})
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # sent to the whole process group; the daemon ends this process
        signal.signal(number, signal.SIG_IGN)
    from handtouch.calibration.store_client import StoreClient
    from handtouch.host import logs
    from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
    from handtouch.supervisor.ipc import WorkerConfig
    from handtouch.supervisor.worker import SupervisorWorker

    start = WorkerConfig.load(sys.stdin.buffer.read())
    log = logs.start_logging(start.deployment.daemon.log_level)
    try:
        with socket.socket(fileno=int(sys.argv[1])) as daemon:
            worker = SupervisorWorker(
                start, StoreClient(Path(start.store)), DeploymentDiagnostics(start.deployment)
            )
            try:
                _serve(daemon, worker)
            finally:
                worker.finish(datetime.now(UTC))
    except Exception:  # so that the log has the reason
        logging.getLogger("handtouch.supervisor").exception(
            "supervisor process: unhandled error; the daemon restarts it"
        )
        return 1
    finally:
        log.close()
    return 0


def _serve(daemon: socket.socket, worker: SupervisorWorker) -> None:
    import msgpack

    from handtouch.supervisor.ipc import pack_worker_message

    while data := _receive(daemon):
        messages = worker.process_message(msgpack.unpackb(data), datetime.now(UTC))
        try:
            for message in messages:
                daemon.send(pack_worker_message(message))
        except (BrokenPipeError, ConnectionResetError):
            return


def _receive(daemon: socket.socket) -> bytes:
    """Return the next message; empty once the daemon has closed, even with unread messages."""
    try:
        return daemon.recv(_MAX_MESSAGE_BYTES)
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


if __name__ == "__main__":
    sys.exit(main())
