"""Starts `handtouch` processes by forking one that has loaded it already.

To load it costs each process more than a second of a processor, a fork a hundredth of that. What is started
is the same: a process with arguments, environment, output, signals and an exit status of its own. Run as a
program, this file is the process that gets forked; it ends with its socket.

Public names: `Starter`, `Started`, `STACKS_SIGNAL`; where processes meet: `own_endpoints`, `find_port`.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import faulthandler
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import IO, Any

LOADED = (
    "handtouch.bridge.runner",
    "handtouch.daemon.serve",
    "handtouch.node.service",
    "handtouch.simulate.simulated_hand",
    "handtouch.simulate.worlds",
    "handtouch.cli.status",
    "can.interfaces.socketcan",
    "can.interfaces.udp_multicast",
)
STACKS_SIGNAL = signal.SIGUSR2
"""Lets a process print where its threads are"""
_REQUEST_BYTES = 1 << 20
_STREAMS = ("live", "complete", "control", "inputs")


@contextlib.contextmanager
def own_endpoints() -> Iterator[dict[str, str]]:
    """ZeroMQ endpoints for a `[daemon]` table, private to this test; seen from every network namespace."""
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:  # tmp_path is longer than ipc paths may be
        yield {stream: f"ipc://{folder}/{stream}" for stream in _STREAMS}


def find_port() -> int:
    """A TCP and UDP port that is free on loopback (until another process takes it)."""
    while True:
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", 0))
            port = int(tcp.getsockname()[1])
            try:
                udp.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port


class Started:
    """A process, as subprocess.Popen has it."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._status = status  # pipe that carries its exit status

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Exit status, negative for a signal. Raises subprocess.TimeoutExpired."""
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            status = os.read(self._status, 16)
            os.close(self._status)
            self.returncode = int(status or -signal.SIGKILL)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Starter:
    """The process that gets forked; to be closed."""

    def __init__(self) -> None:
        self._namespaces: list[str] = []
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _REQUEST_BYTES)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )

    def inside(self, prefix: list[str]) -> Starter:
        """A starter of processes in those namespaces that nsenter, with this prefix, would enter."""
        made, target = copy.copy(self), prefix[prefix.index("--target") + 1]
        made._namespaces = [f"/proc/{target}/ns/{kind}" for kind in ("user", "net") if f"--{kind}" in prefix]
        return made

    def start(self, arguments: list[str], output: IO[str], **environment: str) -> Started:
        """`handtouch ARGUMENTS`, printing to a file; `environment` adds to this process's."""
        ours, theirs = os.pipe()
        request = json.dumps(
            [arguments, os.getcwd(), {**os.environ, **environment}, self._namespaces]
        ).encode()
        socket.send_fds(self._socket, [request], [output.fileno(), theirs])
        os.close(theirs)
        pid = self._socket.recv(16)
        if not pid:
            raise RuntimeError(f"no process could be started: {self._process.wait()}")
        return Started(int(pid), ours)

    def close(self) -> None:
        self._socket.close()
        self._process.wait(60)


def _serve(requests: socket.socket) -> None:
    """Fork for each request; returns in the forked process, with its arguments in sys.argv."""
    running: dict[int, tuple[int, int]] = {}  # pidfd -> process, and the pipe that waits for its end
    while True:
        ready, _, _ = select.select([requests.fileno(), *running], [], [])
        for ended in set(ready) & running.keys():
            pid, status = running.pop(ended)
            exit_code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            with contextlib.suppress(BrokenPipeError):  # the starter has ended
                os.write(status, str(exit_code).encode())
            os.close(status)
            os.close(ended)
        if requests.fileno() in ready:
            data, (output, status), _, _ = socket.recv_fds(requests, _REQUEST_BYTES, 2)
            if (pid := os.fork()) == 0:
                for other, (_, pipe) in running.items():
                    os.close(other)
                    os.close(pipe)
                os.close(status)
                requests.close()
                _become(json.loads(data), output)
                return
            os.close(output)
            requests.send(str(pid).encode())
            running[os.pidfd_open(pid)] = pid, status


def _become(asked: Any, output: int) -> None:
    arguments, folder, environment, namespaces = asked
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    # those of the loaded process were opened as a file, and `output` may be a pipe
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    libc = ctypes.CDLL(None, use_errno=True)
    for path in namespaces:
        with open(path) as namespace:
            if libc.setns(namespace.fileno(), 0) != 0:
                raise OSError(ctypes.get_errno(), "setns", path)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["handtouch", *arguments]
    faulthandler.register(STACKS_SIGNAL, all_threads=True)


def _solve_sheets() -> None:
    """Solve the sheets of the shipped hand once for all forks; each `simulate` would take 2 s."""
    from handtouch import config
    from handtouch.config import shipped
    from handtouch.simulate.scenario import Scenario
    from handtouch.simulate.virtual_hand import VirtualHand
    from handtouch.simulate.worlds import WORLDS

    hand = config.load(shipped.path("utah_mit.toml"))
    VirtualHand(hand, Scenario.tour(hand), WORLDS["ideal"].draw(1)).prepare()


def _main() -> int:
    import importlib

    sys.path.pop(0)  # this file's folder
    from handtouch import cli

    cli.build_parser()
    for name in LOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    _solve_sheets()
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        try:
            _serve(requests)
        except ValueError:  # the other end is closed: no descriptors come
            return 0
    return cli.main()


if __name__ == "__main__":
    sys.exit(_main())
