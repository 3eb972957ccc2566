"""Supervisor process: `python -m handtouch.supervisor.child FD CPUS`, started by the daemon only."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from handtouch.host.child import Worker, child_logging, run_child


@contextlib.contextmanager
def _open_worker(start_message: bytes) -> Iterator[Worker]:
    import msgpack

    from handtouch.calibration.store_client import StoreClient
    from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
    from handtouch.supervisor.ipc import WorkerConfig, pack_worker_message
    from handtouch.supervisor.worker import SupervisorWorker

    start = WorkerConfig.load(start_message)
    with child_logging(start.deployment.daemon.log_level, "supervisor"):
        worker = SupervisorWorker(
            start, StoreClient(Path(start.store)), DeploymentDiagnostics(start.deployment)
        )

        def process_message(data: bytes) -> Iterable[bytes]:
            messages = worker.process_message(msgpack.unpackb(data), datetime.now(UTC))
            return [pack_worker_message(message) for message in messages]

        try:
            yield process_message
        finally:
            worker.finish(datetime.now(UTC))


if __name__ == "__main__":
    sys.exit(run_child(_open_worker))
