"""Resource usage of this process, for the `service` message.

Public name: `process_statistics`.
"""

from __future__ import annotations

import gc
import logging
import os
import time
from typing import Any

from handtouch.host.logs import BoundedLogHandler

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def process_statistics() -> dict[str, Any]:
    """Return memory, CPU time (`loop_cpu_s`: of the calling thread), collections and lost log messages."""
    with open("/proc/self/statm", "rb") as statm:
        resident_pages = int(statm.read().split()[1])
    handlers = logging.getLogger().handlers
    log = next((handler for handler in handlers if isinstance(handler, BoundedLogHandler)), None)
    return {
        "memory_bytes": resident_pages * _PAGE_BYTES,
        "cpu_s": time.process_time(),
        "loop_cpu_s": time.thread_time(),
        "collections": [generation["collections"] for generation in gc.get_stats()],
        "log_dropped": log.dropped if log else 0,
        "log_suppressed": log.suppressed if log else 0,
    }
