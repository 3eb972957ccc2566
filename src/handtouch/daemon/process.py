"""The slow half's process: a thread starts it, the hot one watches it, speaks to it and never waits for it.

Public name: `Process`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable

from handtouch.supervise.link import LARGEST_WORD

_PAUSE_NS, _LONGEST_PAUSE_NS = 1_000_000_000, 60_000_000_000
_PROVEN_NS = 60_000_000_000
"""Having lived so long, it is started at once when it dies."""
_SILENT_NS = 60_000_000_000
"""Without a word for so long although it is spoken to, it hangs."""
_BUFFER_BYTES = 1 << 20
_WORDS_AT_ONCE = 8
_END_S = 2.0
_log = logging.getLogger("handtouch.supervise")


_Made = tuple[subprocess.Popen[bytes], socket.socket]


class Process:
    """Keeps `python -m handtouch.daemon.child` running; `hello` makes what it reads first.

    `restarts`: how often it was started again; `dropped`: messages that it was too slow to take; `why`: what
    it died of last. Times in ns.
    """

    def __init__(self, hello: Callable[[], bytes]) -> None:
        self.restarts = self.dropped = 0
        self.why = ""
        self._hello = hello
        self._cpus = os.sched_getaffinity(0)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._helper = threading.Thread(target=self._help, name="handtouch-supervise", daemon=True)
        self._made: queue.SimpleQueue[tuple[subprocess.Popen[bytes], socket.socket] | None] = (
            queue.SimpleQueue()
        )
        self._starting = False
        self._started_ns = self._heard_ns = self._due_ns = 0
        self._pause_ns = _PAUSE_NS
        self._wanted = False

    @property
    def pid(self) -> int | None:
        """Of the process; None where there is none."""
        return self._process.pid if self._process is not None and self._socket is not None else None

    @property
    def state(self) -> str:
        """running, starting, waiting (to be started again) or stopped."""
        if not self._wanted:
            return "stopped"
        return "running" if self._socket is not None else "starting" if self._starting else "waiting"

    def start(self, now_ns: int) -> None:
        """Want it to run."""
        self._wanted, self._due_ns = True, now_ns
        self._helper.start()  # now: to start a thread is to wait for it

    def renew(self, now_ns: int) -> None:
        """End it and start another one at once: what it was told first has changed."""
        if self._socket is not None:
            self._bury("the deployment was read again", now_ns)
            self._due_ns = now_ns

    def step(self, now_ns: int) -> bool:
        """Watch over it; whether it has just begun and knows nothing yet."""
        if self._socket is not None:
            if now_ns - self._heard_ns > _SILENT_NS:
                self._bury("it said nothing for a minute", now_ns)
            return False
        if self._starting:
            return self._is_up(now_ns)
        if self._wanted and now_ns >= self._due_ns:
            self._starting = True
            self._tasks.put(self._start)
        return False

    def send(self, message: bytes) -> bool:
        """Whether the message was taken; one too many is dropped and counted."""
        if self._socket is None:
            return False
        try:
            self._socket.send(message, socket.MSG_DONTWAIT)
        except BlockingIOError:
            self.dropped += 1
            return False
        except OSError:  # it is gone: `words` notices
            return False
        return True

    def words(self, now_ns: int) -> list[bytes]:
        """What it said, a few words at a time; one that is too long comes cut."""
        said: list[bytes] = []
        while self._socket is not None and len(said) < _WORDS_AT_ONCE:
            try:
                data = self._socket.recv(LARGEST_WORD, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError as error:
                self._bury(str(error), now_ns)
                break
            if not data:
                self._bury("", now_ns)
                break
            self._heard_ns = now_ns
            said.append(data)
        return said

    def close(self) -> None:
        """End it: it stores what it has, and is killed if that takes too long."""
        self._wanted = False
        if self._helper.ident is not None:
            self._tasks.put(None)
            self._helper.join(_END_S)
        self._is_up(0)
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    # Details ----------------------------------------------------------------------------------------------

    def _help(self) -> None:
        """The helping thread: to start a process, or to wait for its end, takes milliseconds."""
        while (task := self._tasks.get()) is not None:
            task()

    def _start(self) -> None:
        """In the helping thread."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            ours.setblocking(False)
            cpus = ",".join(map(str, sorted(self._cpus)))
            command = [sys.executable, "-m", "handtouch.daemon.child", str(theirs.fileno()), cpus]
            environment = {
                name: value for name, value in os.environ.items()
                if name not in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
            } | {"OPENBLAS_NUM_THREADS": "1"}  # fmt: skip
            try:
                process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, pass_fds=[theirs.fileno()], env=environment
                )
            except OSError as error:
                self.why = f"it can't be started: {error}"
                ours.close()
                self._made.put(None)
                return
        assert process.stdin is not None
        with contextlib.suppress(OSError), process.stdin:  # if it died at once, that shows soon enough
            process.stdin.write(self._hello())
        self._made.put((process, ours))

    def _is_up(self, now_ns: int) -> bool:
        """Whether its starting is over, and it is there."""
        try:
            made = self._made.get_nowait()
        except queue.Empty:
            return False
        self._starting = False
        self._started_ns = self._heard_ns = now_ns
        if made is None:
            self._wait(now_ns)
            return False
        self._process, self._socket = made
        return True

    def _bury(self, why: str, now_ns: int) -> None:
        """It is gone, or of no use any more."""
        assert self._socket is not None
        assert self._process is not None
        self._socket.close()
        self._socket = None
        self._process.kill()
        process, self._process = self._process, None
        if now_ns - self._started_ns >= _PROVEN_NS:
            self._pause_ns = _PAUSE_NS
        self.why = why or "it ended by itself"

        def reap() -> None:
            status = process.wait()
            if not why:
                self.why = f"killed by signal {-status}" if status < 0 else f"it ended with status {status}"
            _log.error("the slow half is gone (%s); contacts go on, and it is started again", self.why)

        self._tasks.put(reap)
        self._wait(now_ns)

    def _wait(self, now_ns: int) -> None:
        self.restarts += 1
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, _LONGEST_PAUSE_NS)
