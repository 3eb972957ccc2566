"""The hot thread gets what [daemon] asks for, alone; what is refused is said with its remedy."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from handtouch.config import Daemon
from handtouch.daemon import realtime

CHECK = """
import os, threading
import zmq
from handtouch.config import Daemon
from handtouch.daemon import realtime
cpu = min(os.sched_getaffinity(0))
everything = os.sched_getaffinity(0)
other = threading.Event()
seen = []
def look():
    other.wait()
    seen.append((os.sched_getscheduler(0), os.sched_getaffinity(0)))
thread = threading.Thread(target=look)
thread.start()
context = zmq.Context()
socket = context.socket(zmq.PUB)
refused = realtime.apply(Daemon(realtime_priority=12, cpus=(cpu,), lock_memory=True))
other.set()
thread.join()
assert seen == [(os.SCHED_OTHER, everything)], seen
assert os.sched_getaffinity(0) == {cpu}
if not any("realtime_priority" in text for text in refused):
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    assert os.sched_getparam(0).sched_priority == 12
    carriers = realtime._carriers()
    assert carriers
    assert {os.sched_getparam(carrier).sched_priority for carrier in carriers} == {11}
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


def apart(code: str, *prefix: str) -> str:
    """Run code in a process of its own: what it asks for can't be taken back. What it prints."""
    done = subprocess.run(
        [*prefix, sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_priority_and_processors_are_the_calling_threads_alone() -> None:
    for refused in apart(CHECK).split("\n"):
        assert not refused or "is refused (" in refused


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become somebody with fewer rights")
def test_what_a_user_may_not_is_refused_with_the_remedy() -> None:
    limits = "import resource as r; r.setrlimit(r.RLIMIT_MEMLOCK, (65536, 65536)); "
    limits += "r.setrlimit(r.RLIMIT_RTPRIO, (0, 0)); import os; "
    become = "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
    settings = "Daemon(realtime_priority=50, lock_memory=True)"
    code = (
        "from handtouch.config import Daemon; from handtouch.daemon import realtime\n"
        f"{limits}{become}"
        f"print(*realtime.troubles({settings}), sep='\\n'); print('--')\n"
        f"print(*realtime.apply({settings}), sep='\\n')"
    )
    foreseen, refused = apart(code).split("--\n")
    for told in (foreseen, refused):
        assert "LimitRTPRIO=99" in told
        assert "LimitMEMLOCK=infinity" in told


def test_a_processor_that_is_not_there_is_named_with_those_that_are() -> None:
    (told,) = realtime.troubles(Daemon(cpus=(4095,)))
    assert "cpus = [4095] is refused" in told
    assert str(min(os.sched_getaffinity(0))) in told
    assert realtime.apply(Daemon(cpus=(4095,))) != []


def test_who_asks_for_nothing_gets_nothing() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    assert realtime.apply(Daemon()) == realtime.troubles(Daemon()) == []
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
