"""Real-time scheduling, CPU affinity and memory locking for the calling thread.

Public names: `apply_realtime_settings`, `check_realtime_settings`, `zmq_io_threads`.
"""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path
from typing import Protocol

_MCL_CURRENT, _MCL_FUTURE = 1, 2


class RealtimeSettings(Protocol):
    """Keys of `[daemon]` in a deployment that this module applies."""

    @property
    def cpus(self) -> tuple[int, ...]: ...
    @property
    def realtime_priority(self) -> int: ...
    @property
    def lock_memory(self) -> bool: ...


def apply_realtime_settings(settings: RealtimeSettings) -> list[str]:
    """Apply `[daemon]` settings to the calling thread; return one text with a remedy for each refused one.

    CPU affinity applies to the calling thread only (sched(7)). ZeroMQ's I/O threads, which send its messages,
    get SCHED_FIFO too, one priority lower. Child processes start with the ordinary scheduling policy.
    """
    refused = []
    if settings.cpus:
        try:
            os.sched_setaffinity(0, settings.cpus)
        except OSError as error:
            refused.append(_cpus_refused(settings.cpus, error.strerror))
    if settings.realtime_priority:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        try:
            os.sched_setscheduler(0, policy, os.sched_param(settings.realtime_priority))
            for thread in zmq_io_threads():
                os.sched_setscheduler(thread, policy, os.sched_param(max(1, settings.realtime_priority - 1)))
        except OSError as error:
            refused.append(_priority_refused(settings.realtime_priority, error.strerror))
    if settings.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        refused.append(_memory_lock_refused(os.strerror(ctypes.get_errno())))
    return refused


def check_realtime_settings(settings: RealtimeSettings) -> list[str]:
    """Return the texts that `apply_realtime_settings` would return for this user's limits; change nothing."""
    found = []
    missing = set(settings.cpus) - os.sched_getaffinity(0)
    if missing:
        found.append(
            _cpus_refused(settings.cpus, f"no {', '.join(map(str, sorted(missing)))} for this process")
        )
    if os.geteuid() == 0:  # resource limits don't apply to root
        return found
    most = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    if (
        settings.realtime_priority
        and most not in (resource.RLIM_INFINITY,)
        and settings.realtime_priority > most
    ):
        found.append(_priority_refused(settings.realtime_priority, f"the limit of this user is {most}"))
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if settings.lock_memory and locked != resource.RLIM_INFINITY:
        found.append(_memory_lock_refused(f"the limit of this user is {locked >> 10} KiB"))
    return found


def zmq_io_threads() -> list[int]:
    """Return ids of ZeroMQ's I/O threads in this process, found by name (libzmq 4.2 and later)."""
    threads = Path("/proc/self/task").iterdir()
    return [int(thread.name) for thread in threads if (thread / "comm").read_text().startswith("ZMQbg/IO/")]


def _cpus_refused(cpus: tuple[int, ...], why: str | None) -> str:
    have = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    return f"[daemon] cpus = {list(cpus)} is refused ({why}); this process may use {have}"


def _priority_refused(priority: int, why: str | None) -> str:
    return (
        f"[daemon] realtime_priority = {priority} is refused ({why}); the service unit has LimitRTPRIO=99, a "
        'login gets it by "USER - rtprio 99" in /etc/security/limits.conf, a container by --cap-add SYS_NICE'
    )


def _memory_lock_refused(why: str) -> str:
    return (
        f"[daemon] lock_memory is refused ({why}); the service unit has LimitMEMLOCK=infinity, a login gets "
        'it by "USER - memlock unlimited" in /etc/security/limits.conf, a container by --ulimit memlock=-1'
    )
