"""The hot thread's share of the machine: real-time priority, processors of its own, memory that stays.

Public names: `apply`, `troubles`.
"""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path

from handtouch.config.tables import Daemon

_MCL_CURRENT, _MCL_FUTURE = 1, 2


def apply(settings: Daemon) -> list[str]:
    """Do for the calling thread what `[daemon]` asks for; what was refused, in words with a remedy.

    Processors are the calling thread's alone (sched(7)), SCHED_FIFO is also that of ZeroMQ's threads, which
    carry its messages on, but for one step of priority; children begin as ordinary ones.
    """
    refused = []
    if settings.cpus:
        try:
            os.sched_setaffinity(0, settings.cpus)
        except OSError as error:
            refused.append(_no_cpus(settings.cpus, error.strerror))
    if settings.realtime_priority:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        try:
            os.sched_setscheduler(0, policy, os.sched_param(settings.realtime_priority))
            for thread in _carriers():
                os.sched_setscheduler(thread, policy, os.sched_param(max(1, settings.realtime_priority - 1)))
        except OSError as error:
            refused.append(_no_priority(settings.realtime_priority, error.strerror))
    if settings.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        refused.append(_no_lock(os.strerror(ctypes.get_errno())))
    return refused


def troubles(settings: Daemon) -> list[str]:
    """What `apply` would be refused in a process of this user, by its limits; changes nothing."""
    found = []
    missing = set(settings.cpus) - os.sched_getaffinity(0)
    if missing:
        found.append(_no_cpus(settings.cpus, f"no {', '.join(map(str, sorted(missing)))} for this process"))
    if os.geteuid() == 0:  # limits don't bind it
        return found
    most = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    if (
        settings.realtime_priority
        and most not in (resource.RLIM_INFINITY,)
        and settings.realtime_priority > most
    ):
        found.append(_no_priority(settings.realtime_priority, f"the limit of this user is {most}"))
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if settings.lock_memory and locked != resource.RLIM_INFINITY:
        found.append(_no_lock(f"the limit of this user is {locked >> 10} KiB"))
    return found


def _carriers() -> list[int]:
    """ZeroMQ's threads in this process that read and write sockets, by their names (zmq 4.2 and later)."""
    threads = Path("/proc/self/task").iterdir()
    return [int(thread.name) for thread in threads if (thread / "comm").read_text().startswith("ZMQbg/IO/")]


def _no_cpus(cpus: tuple[int, ...], why: str | None) -> str:
    have = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    return f"[daemon] cpus = {list(cpus)} is refused ({why}); this process may use {have}"


def _no_priority(priority: int, why: str | None) -> str:
    return (
        f"[daemon] realtime_priority = {priority} is refused ({why}); the service unit has LimitRTPRIO=99, a "
        'login gets it by "USER - rtprio 99" in /etc/security/limits.conf, a container by --cap-add SYS_NICE'
    )


def _no_lock(why: str) -> str:
    return (
        f"[daemon] lock_memory is refused ({why}); the service unit has LimitMEMLOCK=infinity, a login gets "
        'it by "USER - memlock unlimited" in /etc/security/limits.conf, a container by --ulimit memlock=-1'
    )
