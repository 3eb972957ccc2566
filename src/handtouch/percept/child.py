"""Percept process: `python -m handtouch.percept.child FD CPUS`, started by the daemon only."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from handtouch.host.child import Worker, child_logging, run_child


@contextlib.contextmanager
def _open_worker(start_message: bytes) -> Iterator[Worker]:
    from handtouch.config import Deployment
    from handtouch.percept.messages import pack_message, pack_status, unpack_input
    from handtouch.percept.worker import PerceptWorker

    deployment = Deployment.model_validate_json(start_message)
    with child_logging(deployment.daemon.log_level, "percept"):
        worker = PerceptWorker(deployment)

        def process_message(data: bytes) -> Iterator[bytes]:
            message = unpack_input(data)
            yield from map(pack_message, worker.process_input(message))
            if (status := worker.status_if_due(message.t_ns)) is not None:
                yield pack_status(status)

        yield process_message


if __name__ == "__main__":
    sys.exit(run_child(_open_worker))
