"""Real-time settings apply to the calling thread only; refused ones are returned with a remedy."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from handtouch.config import Daemon
from handtouch.host import realtime

CHECK = """
import os, threading
import zmq
from handtouch.config import Daemon
from handtouch.host import realtime
cpu = min(os.sched_getaffinity(0))
all_cpus = os.sched_getaffinity(0)
other = threading.Event()
seen = []
def look():
    other.wait()
    seen.append((os.sched_getscheduler(0), os.sched_getaffinity(0)))
thread = threading.Thread(target=look)
thread.start()
context = zmq.Context()
socket, subscriber = context.socket(zmq.XPUB), context.socket(zmq.SUB)
subscriber.connect(f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}")
subscriber.subscribe(b"")
assert socket.recv() == b"\\1"  # so the I/O thread runs under its name
refused = realtime.apply_realtime_settings(Daemon(realtime_priority=12, cpus=(cpu,), lock_memory=True))
other.set()
thread.join()
assert seen == [(os.SCHED_OTHER, all_cpus)], seen
assert os.sched_getaffinity(0) == {cpu}
if not any("realtime_priority" in text for text in refused):
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    assert os.sched_getparam(0).sched_priority == 12
    io_threads = realtime.zmq_io_threads()
    assert io_threads
    assert {os.sched_getparam(thread).sched_priority for thread in io_threads} == {11}
    pid = os.fork()
    if pid == 0:
        os._exit(os.sched_getscheduler(0))
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == os.SCHED_OTHER
if not any("lock_memory" in text for text in refused):
    locked = next(line for line in open("/proc/self/status") if line.startswith("VmLck"))
    assert int(locked.split()[1]) > 10_000, locked
print("\\n".join(refused))
context.destroy()
"""


def run_isolated(code: str, *prefix: str) -> str:
    """Run code in a process of its own, as its settings can't be undone; return its output."""
    done = subprocess.run(
        [*prefix, sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_priority_and_affinity_apply_to_the_calling_thread_only() -> None:
    for refused in run_isolated(CHECK).split("\n"):
        assert not refused or "is refused (" in refused


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can drop privileges")
def test_settings_beyond_user_limits_are_refused_with_a_remedy() -> None:
    limits = "import resource as r; r.setrlimit(r.RLIMIT_MEMLOCK, (65536, 65536)); "
    limits += "r.setrlimit(r.RLIMIT_RTPRIO, (0, 0)); import os; "
    become = "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
    settings = "Daemon(realtime_priority=50, lock_memory=True)"
    code = (
        "from handtouch.config import Daemon; from handtouch.host import realtime\n"
        f"{limits}{become}"
        f"print(*realtime.check_realtime_settings({settings}), sep='\\n'); print('--')\n"
        f"print(*realtime.apply_realtime_settings({settings}), sep='\\n')"
    )
    foreseen, refused = run_isolated(code).split("--\n")
    for text in (foreseen, refused):
        assert "LimitRTPRIO=99" in text
        assert "LimitMEMLOCK=infinity" in text


def test_missing_cpu_is_reported_with_the_available_ones() -> None:
    (text,) = realtime.check_realtime_settings(Daemon(cpus=(4095,)))
    assert "cpus = [4095] is refused" in text
    assert str(min(os.sched_getaffinity(0))) in text
    assert realtime.apply_realtime_settings(Daemon(cpus=(4095,))) != []


def test_default_settings_change_nothing() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    assert realtime.apply_realtime_settings(Daemon()) == realtime.check_realtime_settings(Daemon()) == []
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
