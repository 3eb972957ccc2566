"""The supervisor process: started by a helper thread; the hot thread exchanges messages without blocking.

Public name: `SupervisorProcess`.
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

from handtouch.supervisor.ipc import MAX_WORKER_MESSAGE_BYTES

_MIN_RESTART_DELAY_NS, _MAX_RESTART_DELAY_NS = 1_000_000_000, 60_000_000_000
_MIN_STABLE_UPTIME_NS = 60_000_000_000
"""After this uptime the restart delay starts at its minimum again"""
_HANG_TIMEOUT_NS = 60_000_000_000
"""Without a message for this long, the process counts as hung"""
_SEND_BUFFER_BYTES = 1 << 20
_MAX_MESSAGES_PER_POLL = 8
_STOP_TIMEOUT_S = 2.0
_log = logging.getLogger("handtouch.supervisor")


class SupervisorProcess:
    """Keeps `python -m handtouch.supervisor.child` running; `make_start_message` returns its configuration.

    `restarts`: number of restarts; `dropped`: messages dropped because the process was too slow;
    `exit_reason`: reason of its last exit. Times in ns.
    """

    def __init__(self, make_start_message: Callable[[], bytes]) -> None:
        self.restarts = self.dropped = 0
        self.exit_reason = ""
        self._make_start_message = make_start_message
        self._cpus = os.sched_getaffinity(0)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._helper_thread = threading.Thread(
            target=self._run_tasks, name="handtouch-supervise", daemon=True
        )
        self._started: queue.SimpleQueue[tuple[subprocess.Popen[bytes], socket.socket] | None] = (
            queue.SimpleQueue()
        )
        self._starting = False
        self._started_ns = self._last_message_ns = self._next_start_ns = 0
        self._restart_delay_ns = _MIN_RESTART_DELAY_NS
        self._enabled = False

    @property
    def pid(self) -> int | None:
        """Process id; None while it isn't running."""
        return self._process.pid if self._process is not None and self._socket is not None else None

    @property
    def state(self) -> str:
        """running, starting, waiting (for the next restart) or stopped."""
        if not self._enabled:
            return "stopped"
        return "running" if self._socket is not None else "starting" if self._starting else "waiting"

    def start(self, now_ns: int) -> None:
        """Enable the process: `poll` starts it and keeps it running."""
        self._enabled, self._next_start_ns = True, now_ns
        self._helper_thread.start()  # now, as starting a thread blocks

    def restart(self, now_ns: int) -> None:
        """Stop the process and start a new one at once: its configuration has changed."""
        if self._socket is not None:
            self._discard_process("deployment reloaded", now_ns)
            self._next_start_ns = now_ns

    def poll(self, now_ns: int) -> bool:
        """Start, supervise and restart the process; return True if a new process has just started."""
        if self._socket is not None:
            if now_ns - self._last_message_ns > _HANG_TIMEOUT_NS:
                self._discard_process("no message for 60 s", now_ns)
            return False
        if self._starting:
            return self._finish_start(now_ns)
        if self._enabled and now_ns >= self._next_start_ns:
            self._starting = True
            self._tasks.put(self._start_process)
        return False

    def send(self, message: bytes) -> bool:
        """Send a message; return False if it was dropped, which is counted."""
        if self._socket is None:
            return False
        try:
            self._socket.send(message, socket.MSG_DONTWAIT)
        except BlockingIOError:
            self.dropped += 1
            return False
        except OSError:  # disconnected: `receive` handles it
            return False
        return True

    def receive(self, now_ns: int) -> list[bytes]:
        """Return waiting messages, a bounded number of them; one that is too long is truncated."""
        messages: list[bytes] = []
        while self._socket is not None and len(messages) < _MAX_MESSAGES_PER_POLL:
            try:
                data = self._socket.recv(MAX_WORKER_MESSAGE_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError as error:
                self._discard_process(str(error), now_ns)
                break
            if not data:
                self._discard_process("", now_ns)
                break
            self._last_message_ns = now_ns
            messages.append(data)
        return messages

    def close(self) -> None:
        """Stop the process: it stores its data, and is killed if that takes longer than 2 s."""
        self._enabled = False
        if self._helper_thread.ident is not None:
            self._tasks.put(None)
            self._helper_thread.join(_STOP_TIMEOUT_S)
        self._finish_start(0)
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            try:
                self._process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    # Details ----------------------------------------------------------------------------------------------

    def _run_tasks(self) -> None:
        """Run tasks in the helper thread: starting a process and waiting for its end take milliseconds."""
        while (task := self._tasks.get()) is not None:
            task()

    def _start_process(self) -> None:
        """Start the process; runs in the helper thread."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            ours.setblocking(False)
            cpus = ",".join(map(str, sorted(self._cpus)))
            command = [sys.executable, "-m", "handtouch.supervisor.child", str(theirs.fileno()), cpus]
            environment = {
                name: value for name, value in os.environ.items()
                if name not in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
            } | {"OPENBLAS_NUM_THREADS": "1"}  # fmt: skip
            try:
                process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, pass_fds=[theirs.fileno()], env=environment
                )
            except OSError as error:
                self.exit_reason = f"start failed: {error}"
                ours.close()
                self._started.put(None)
                return
        assert process.stdin is not None
        with contextlib.suppress(OSError), process.stdin:  # an early exit is detected by `receive`
            process.stdin.write(self._make_start_message())
        self._started.put((process, ours))

    def _finish_start(self, now_ns: int) -> bool:
        """Take over a started process; return True if there is one."""
        try:
            started = self._started.get_nowait()
        except queue.Empty:
            return False
        self._starting = False
        self._started_ns = self._last_message_ns = now_ns
        if started is None:
            self._schedule_restart(now_ns)
            return False
        self._process, self._socket = started
        return True

    def _discard_process(self, reason: str, now_ns: int) -> None:
        """Kill the process if it still runs, and schedule its restart."""
        assert self._socket is not None
        assert self._process is not None
        self._socket.close()
        self._socket = None
        self._process.kill()
        process, self._process = self._process, None
        if now_ns - self._started_ns >= _MIN_STABLE_UPTIME_NS:
            self._restart_delay_ns = _MIN_RESTART_DELAY_NS
        self.exit_reason = reason or "exited"

        def reap() -> None:
            status = process.wait()
            if not reason:
                self.exit_reason = f"signal {-status}" if status < 0 else f"exit status {status}"
            _log.error(
                "supervisor process: exited (%s); restarting, contact output is unaffected", self.exit_reason
            )

        self._tasks.put(reap)
        self._schedule_restart(now_ns)

    def _schedule_restart(self, now_ns: int) -> None:
        self.restarts += 1
        self._next_start_ns = now_ns + self._restart_delay_ns
        self._restart_delay_ns = min(2 * self._restart_delay_ns, _MAX_RESTART_DELAY_NS)
