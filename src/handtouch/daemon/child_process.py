"""A child process of the daemon: a helper thread starts it, the hot thread exchanges messages with it.

Public names: `ChildProcess`, `child_statistics`.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from handtouch.host.child import MAX_CHILD_MESSAGE_BYTES

_MIN_RESTART_DELAY_NS, _MAX_RESTART_DELAY_NS = 1_000_000_000, 60_000_000_000
_MIN_STABLE_UPTIME_NS = 60_000_000_000
"""After this uptime the restart delay starts at its minimum again"""
_SEND_BUFFER_BYTES = 1 << 20
_STOP_TIMEOUT_S = 2.0


class ChildProcess:
    """Keeps `python -m MODULE` running, whose main is `host.child.run_child`.

    `name` is that in logs, "supervisor" for instance. `make_start_message` returns its configuration, in the
    helper thread. Without a message from it for `hang_timeout_ns`, it counts as hung and is killed.

    `restarts`: number of restarts; `dropped`: messages dropped because the process was too slow;
    `exit_reason`: reason of its last exit. Times in ns.
    """

    def __init__(
        self,
        module: str,
        name: str,
        make_start_message: Callable[[], bytes],
        hang_timeout_ns: int = 60_000_000_000,
    ) -> None:
        self.restarts = self.dropped = 0
        self.exit_reason = ""
        self.enabled = False
        """the process is kept running; set by `start` and `stop`"""
        self._module, self._name = module, name
        self._log = logging.getLogger(f"handtouch.{name}")
        self._make_start_message, self._hang_timeout_ns = make_start_message, hang_timeout_ns
        self._cpus = os.sched_getaffinity(0)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._received = bytearray(MAX_CHILD_MESSAGE_BYTES)
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._helper_thread = threading.Thread(target=self._run_tasks, name=f"handtouch-{name}", daemon=True)
        self._started: queue.SimpleQueue[tuple[subprocess.Popen[bytes], socket.socket] | None] = (
            queue.SimpleQueue()
        )
        self._starting = self._outdated = False
        self._started_ns = self._last_message_ns = self._next_start_ns = 0
        self._restart_delay_ns = _MIN_RESTART_DELAY_NS

    @property
    def pid(self) -> int | None:
        """Process id; None while it isn't running."""
        return self._process.pid if self._process is not None and self._socket is not None else None

    @property
    def state(self) -> str:
        """running, starting, waiting (for the next restart) or stopped."""
        if not (self.enabled or self._starting):
            return "stopped"
        return "running" if self._socket is not None else "starting" if self._starting else "waiting"

    def start(self, now_ns: int) -> None:
        """Enable the process: `poll` starts it and keeps it running."""
        self.enabled, self._next_start_ns = True, now_ns
        if self._helper_thread.ident is None:
            self._helper_thread.start()

    def stop(self) -> None:
        """Stop the process until `start` is called again: it stores its data, and is killed after 2 s."""
        self.enabled = False
        self._end_process()

    def restart(self, now_ns: int) -> None:
        """Replace the process, as its configuration has changed: the new one starts when the old has ended.

        The old one stores its data first, as in `stop`; one that is still starting is replaced, too.
        """
        if self._socket is not None:
            self.restarts += 1
            self._next_start_ns = now_ns
            self.exit_reason = "deployment reloaded"
            self._end_process()
        self._outdated = self._starting

    def poll(self, now_ns: int) -> bool:
        """Start, supervise and restart the process; return True if a new process has just started.

        Call it after `receive`: else messages that wait, as the daemon itself was paused, count as missing.
        """
        if self._socket is not None:
            if now_ns - self._last_message_ns > self._hang_timeout_ns:
                self._discard_process(f"no message for {self._hang_timeout_ns * 1e-9:.0f} s", now_ns)
            return False
        if self._starting:
            started = self._finish_start(now_ns)
            if started and self._outdated:
                self.restart(now_ns)
            elif started and not self.enabled:
                self.stop()
            return started and self._socket is not None
        if self.enabled and now_ns >= self._next_start_ns:
            self._starting = True
            self._tasks.put(self._start_process)
        return False

    def send(self, message: bytes) -> bool:
        """Send a message; return False if it was dropped, which is counted."""
        if self._socket is None:
            return False
        try:
            self._socket.send(message, socket.MSG_DONTWAIT)
        except OSError as error:  # where it is disconnected, `receive` handles it
            self.dropped += isinstance(error, BlockingIOError) or error.errno == errno.EMSGSIZE
            return False
        return True

    def receive(self, now_ns: int, max_messages: int = 8) -> list[bytes]:
        """Return waiting messages, `max_messages` at most; one that is too long is logged and dropped."""
        messages: list[bytes] = []
        while self._socket is not None and len(messages) < max_messages:
            try:
                size, _, flags, _ = self._socket.recvmsg_into([self._received], 0, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except ConnectionResetError:  # it exited with messages unread
                size = flags = 0
            except OSError as error:
                self._discard_process(str(error), now_ns)
                break
            if not size:
                self._discard_process("", now_ns)
                break
            self._last_message_ns = now_ns
            if flags & socket.MSG_TRUNC:
                self._log.error("%s process: a message of more than %d bytes was dropped", self._name, size)
                continue
            messages.append(bytes(self._received[:size]))
        return messages

    def close(self) -> None:
        """Stop the process: it stores its data, and is killed if that takes longer than 2 s."""
        self.enabled = False
        if self._helper_thread.ident is not None:
            self._tasks.put(None)
            self._helper_thread.join(_STOP_TIMEOUT_S)
        self._finish_start(0)
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            _wait_or_kill(self._process)
            self._process = None

    # Details ----------------------------------------------------------------------------------------------

    def _end_process(self) -> None:
        """Close the socket, at which the process ends; the helper thread waits for that, for 2 s."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
            process, self._process = self._process, None
            assert process is not None
            self._tasks.put(lambda: _wait_or_kill(process))

    def _run_tasks(self) -> None:
        """Run tasks in the helper thread: starting a process and waiting for its end take milliseconds."""
        while (task := self._tasks.get()) is not None:
            task()

    def _start_process(self) -> None:
        """Start the process; runs in the helper thread."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            for end in (ours, theirs):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            ours.setblocking(False)
            cpus = ",".join(map(str, sorted(self._cpus)))
            command = [sys.executable, "-m", self._module, str(theirs.fileno()), cpus]
            environment = {
                name: value
                for name, value in os.environ.items()
                if name not in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
            } | {"OPENBLAS_NUM_THREADS": "1"}
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
            self._log.error(
                "%s process: exited (%s); restarting, contact output is unaffected",
                self._name,
                self.exit_reason,
            )

        self._tasks.put(reap)
        self._schedule_restart(now_ns)

    def _schedule_restart(self, now_ns: int) -> None:
        self.restarts += 1
        self._next_start_ns = now_ns + self._restart_delay_ns
        self._restart_delay_ns = min(2 * self._restart_delay_ns, _MAX_RESTART_DELAY_NS)


def child_statistics(process: ChildProcess, sent_ns: int, processed_ns: int | None) -> dict[str, Any]:
    """Return the state of a process for the `service` message.

    sent_ns: time of the last message sent; processed_ns: up to which the process has processed, None if
    unknown.
    """
    return {
        **{name: getattr(process, name) for name in ("state", "pid", "restarts", "exit_reason", "dropped")},
        "lag_s": None if processed_ns is None else max(0, sent_ns - processed_ns) * 1e-9,
    }


def _wait_or_kill(process: subprocess.Popen[bytes]) -> None:
    """Wait for the end of a process that has been asked to stop; kill it after 2 s."""
    try:
        process.wait(_STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
