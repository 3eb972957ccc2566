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
    from handtouch.calibration.store_client import StoreClient
    from handtouch.config import Deployment
    from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
    from handtouch.supervisor.ipc import pack_message, unpack_daemon_message
    from handtouch.supervisor.worker import SupervisorWorker

    deployment = Deployment.model_validate_json(start_message)
    with child_logging(deployment.daemon.log_level, "supervisor"):
        store = StoreClient(Path(deployment.daemon.store or ""))
        worker = SupervisorWorker(deployment, store, DeploymentDiagnostics(deployment))

        def process_message(data: bytes) -> Iterable[bytes]:
            return map(pack_message, worker.process_message(unpack_daemon_message(data), datetime.now(UTC)))

        try:
            yield process_message
        finally:
            worker.finish(datetime.now(UTC))


if __name__ == "__main__":
    sys.exit(run_child(_open_worker))
