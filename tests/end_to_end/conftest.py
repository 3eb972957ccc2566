"""A whole deployment for end-to-end tests: nodes and daemon as processes of their own, on a real bus."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch.client import Subscriber, connect, request
from handtouch.config import shipped
from tests.starter import STACKS_SIGNAL, Started, Starter, find_port, own_endpoints

ROOT = Path(__file__).parents[2]
START_S = 90.0
"""Longest that anything may take on a busy machine; nothing waits so long when all is well."""


PERIOD_MS = 20.0
PATIENCE_MS = 1000
"""For a node's heartbeat: a machine that pauses for half a second loses none."""
SCENARIO = """
repeat = true
pause_s = 0.1

[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 0.8
path = [[0.2, 0.3], [0.7, 0.6]]
force_n = [0.8, 1.5]

[[touch]]
link = "palm_heel"
from_s = 0.4
duration_s = 0.9
path = [[0.5, 0.3], [0.3, 0.8]]
force_n = [2.0]
"""


@contextlib.contextmanager
def run_in_threads(*targets: Callable[[threading.Event], object]) -> Iterator[None]:
    """Run functions side by side until the end of the block, which sets the event that each is given."""
    stop = threading.Event()
    threads = [threading.Thread(target=target, args=(stop,)) for target in targets]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


class Rig:
    """Starts `handtouch simulate` and `handtouch run` for a deployment, and subscribes to it.

    Without a supervisor unless that is what is tested: its process takes a second to start.
    """

    def __init__(
        self,
        folder: Path,
        endpoints: dict[str, str],
        prefix: list[str],
        bus: list[str],
        supervise: bool = False,
        starter: Starter | None = None,
    ) -> None:
        self.folder = folder
        self.endpoints = endpoints
        self.bus = bus
        self.processes: dict[str, subprocess.Popen[str] | Started] = {}
        self._prefix, self._starter = prefix, starter
        self.config = folder / "hand.toml"
        settings = "\n".join(f'{stream} = "{endpoint}"' for stream, endpoint in endpoints.items())
        text = shipped.path("utah_mit.toml").read_text()
        assert "[daemon]\n" in text
        settings += f'\nsupervise = {str(supervise).lower()}\nstore = "calibrations.db"'
        text = text.replace("[daemon]\n", f"[daemon]\n{settings}\n")
        # slower than on a robot: a machine that tests other things too may not get round to it in 5 ms
        text, changed = re.subn(r"sync_period_ms = [\d.]+", f"sync_period_ms = {PERIOD_MS}", text)
        assert changed == 1
        text, changed = re.subn(r"heartbeat_timeout_ms = \d+", f"heartbeat_timeout_ms = {PATIENCE_MS}", text)
        assert changed == 1
        self.config.write_text(text)
        self.scenario = folder / "scenario.toml"
        self.scenario.write_text(SCENARIO)

    def command(self, *arguments: str) -> list[str]:
        return [*self._prefix, sys.executable, "-m", "handtouch", *arguments]

    def simulate(self, *arguments: str) -> None:
        """Start the nodes, with touches that come quickly and again and again."""
        self.start("simulate", "--scenario", str(self.scenario), *arguments)

    def start(self, name: str, *arguments: str) -> subprocess.Popen[str] | Started:
        """Start `handtouch NAME hand.toml --bus ... ARGUMENTS`, printing to a file beside the deployment."""
        buses = [word for bus in self.bus for word in ("--bus", bus)]
        return self.start_command(name, str(self.config), *buses, *arguments)

    def start_command(self, name: str, *arguments: str) -> subprocess.Popen[str] | Started:
        """Start `handtouch NAME ARGUMENTS`."""
        words = [name, *arguments]
        process: subprocess.Popen[str] | Started
        with (self.folder / f"{name}.txt").open("a") as output:
            if self._starter is not None:
                process = self._starter.start(words, output)
            else:
                process = subprocess.Popen(
                    self.command(*words), stdout=output, stderr=subprocess.STDOUT, text=True
                )
        self.processes[name] = process
        return process

    def call(self, *arguments: str, **environment: str) -> tuple[int, str]:
        """Exit status and output of a handtouch command."""
        assert self._starter is not None
        with (self.folder / "call.txt").open("w+") as output:
            process = self._starter.start([*arguments], output, **environment)
            try:
                status = process.wait(START_S)
            except subprocess.TimeoutExpired:
                process.send_signal(STACKS_SIGNAL)
                time.sleep(1.0)  # in which it prints them
                output.seek(0)
                pytest.fail(f"{arguments} hangs:\n{output.read()}")
            output.seek(0)
            return status, output.read()

    def printed(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text()

    def subscribe(self, *patterns: str) -> Subscriber[Any]:
        return connect(*patterns, endpoint=self.endpoints["live"], queue=100_000)

    def status(self) -> dict[str, Any]:
        try:
            return request("status", endpoint=self.endpoints["control"], timeout_s=START_S)
        except TimeoutError as error:
            raise AssertionError(f"{error}\n{self.all_printed()}") from error

    def wait(
        self, what: str, met: Callable[[dict[str, Any]], bool], longest_s: float = START_S
    ) -> dict[str, Any]:
        """Ask for the status until a condition is met."""
        end_s = time.monotonic() + longest_s
        while True:
            status = self.status()
            if met(status):
                return status
            assert time.monotonic() < end_s, (
                f"never {what}: {json.dumps(status, indent=1)}\n{self.all_printed()}"
            )
            time.sleep(0.1)  # each answer costs milliseconds of both

    def wait_operational(self, count: int = 15) -> dict[str, Any]:
        return self.wait(
            f"{count} nodes operational",
            lambda status: sum(pad["node_state"] == "operational" for pad in status["pads"]) == count,
        )

    @contextlib.contextmanager
    def recording(self) -> Iterator[Path]:
        """Record what the daemon publishes in the block, after which it ends; the recording's file."""
        out = self.folder / "session.mcap"
        self.start_command("record", str(self.config), "-o", str(out))
        self.wait("recorded", lambda status: "tick" in status["service"]["subscriptions"])
        yield out
        assert self.end("run") == 0, self.all_printed()
        self.end("record", signal.SIGINT)

    def replay(self, recording: Path) -> dict[str, Any]:
        """Replay a recording; the report of the comparison."""
        report = self.folder / "report.json"
        status, printed = self.call("replay", str(recording), "--report", str(report))
        assert status == 0, printed + self.all_printed()
        return dict(json.loads(report.read_text()))

    def all_printed(self) -> str:
        return "\n".join(f"--- {path.name}\n{path.read_text()}" for path in self.folder.glob("*.txt"))

    def end(self, name: str, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and wait for the process to end; its exit status."""
        process = self.processes.pop(name)
        process.send_signal(number)
        return process.wait(START_S)

    def end_all(self) -> None:
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _missing(why: str) -> None:
    """A test can't run here; CI must have what it needs."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"CI needs this test: {why}")
    pytest.skip(why)


@pytest.fixture(scope="session")
def javascript(pytestconfig: pytest.Config) -> Path:
    """Folder with the programs of tests/javascript and their packages, installed once for each lock file."""
    for name in ("node", "npm"):
        if shutil.which(name) is None:
            _missing(f"there is no {name}; on Debian: apt-get install nodejs npm")
    here = Path(__file__).parents[1] / "javascript"
    digest = hashlib.sha256((here / "package-lock.json").read_bytes()).hexdigest()[:12]
    folder = Path(pytestconfig.cache.mkdir(f"javascript-{digest}"))
    for file in (*here.iterdir(), ROOT / "docs/wire.schema.json"):
        shutil.copy(file, folder)
    if not (folder / "node_modules/.package-lock.json").exists():  # npm writes it last
        install = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
        done = subprocess.run(install, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            _missing(f"npm can't install the packages of tests/javascript: {done.stderr}")
    shutil.copytree(ROOT / "clients/js", folder / "node_modules/handtouch", dirs_exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def cpp(shared: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """Folder with the programs of tests/cpp, built with the installed package of clients/cpp."""
    if not all(map(shutil.which, ("cmake", "c++"))) or not Path("/usr/include/zmq.h").exists():
        _missing("no C++ compiler, cmake or zmq.h; on Debian: apt-get install g++ cmake libzmq3-dev")

    def build(folder: Path) -> None:
        package, prefix = folder / "package", folder / "prefix"
        for command in (
            ["cmake", "-S", ROOT / "clients/cpp", "-B", package, f"-DCMAKE_INSTALL_PREFIX={prefix}"],
            ["cmake", "--build", package, "--target", "install"],
            ["cmake", "-S", ROOT / "tests/cpp", "-B", folder, f"-DCMAKE_PREFIX_PATH={prefix}"],
            ["cmake", "--build", folder],
        ):
            done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout + done.stderr

    return shared("cpp_programs", build)


@pytest.fixture(scope="session")
def chromium() -> str:
    """The program of a browser."""
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        _missing("there is no chromium; on Debian: apt-get install chromium")
    assert found is not None
    return found


@contextlib.contextmanager
def own_rig(folder: Path, network: list[str], starter: Starter) -> Iterator[Rig]:
    """A deployment on a udp_multicast bus in a network of its own."""
    with own_endpoints() as endpoints:
        bus = f"can0=udp_multicast:239.74.163.2,port={find_port()}"
        made = Rig(folder, endpoints, network, [bus], starter=starter)
        try:
            yield made
        finally:
            made.end_all()


@pytest.fixture
def rig(tmp_path: Path, network: list[str], starter: Starter) -> Iterator[Rig]:
    """A deployment that a test may do with as it likes."""
    with own_rig(tmp_path, network, starter) as made:
        yield made


@pytest.fixture(scope="module")
def working(tmp_path_factory: pytest.TempPathFactory, network: list[str], starter: Starter) -> Iterator[Rig]:
    """A hand at work, touched all the time, for tests that leave it as it is."""
    with own_rig(tmp_path_factory.mktemp("working"), network, starter) as made:
        made.simulate()
        made.start("run")
        made.wait_operational()
        yield made


@pytest.fixture
def vcan_rig(tmp_path: Path, endpoints: dict[str, str], host_starter: Starter) -> Iterator[Rig]:
    """A deployment on SocketCAN; only inside vcan-run."""
    made = Rig(tmp_path, endpoints, [], ["can0=socketcan:vcan0"], starter=host_starter)
    # all processes share the guest's one processor
    text = made.config.read_text()
    made.config.write_text(text.replace(f"sync_period_ms = {PERIOD_MS}", "sync_period_ms = 50.0"))
    yield made
    made.end_all()
