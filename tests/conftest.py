"""Fixtures for tests of whole processes: endpoints and networks of their own, an installation."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.starter import Starter

# how long an example takes says nothing on shared cores; CI tries the same ones every time
settings.register_profile(
    "shared cores",
    max_examples=50,
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("shared cores")

# as `handtouch` sets it, before anything loads numpy: on busy cores those threads cost 20 times the time
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).parents[1]
_STREAMS = ("live", "complete", "control", "inputs")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first, so that workers end together. Without SocketCAN skip its tests; in vcan-run it is."""
    items.sort(key=lambda item: "end_to_end" not in item.path.parts)
    if "VCAN_RUN" in os.environ or Path("/sys/class/net/vcan0").exists():
        return
    skip = pytest.mark.skip(reason="no vcan0 here; `make socketcan` runs these tests where there is one")
    for item in items:
        if item.get_closest_marker("socketcan"):
            item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Daemons of tests keep calibrations of simulated units, and those not in the user's store."""
    before = os.environ.get("XDG_STATE_HOME")
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
    yield
    os.environ.pop("XDG_STATE_HOME")
    if before is not None:
        os.environ["XDG_STATE_HOME"] = before


@pytest.fixture
def endpoints() -> Iterator[dict[str, str]]:
    """ZeroMQ endpoints for a `[daemon]` table, nobody else's; seen from every network namespace."""
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:  # tmp_path is longer than ipc paths may be
        yield {stream: f"ipc://{folder}/{stream}" for stream in _STREAMS}


@pytest.fixture
def free_port() -> int:
    """A TCP and UDP port that is free on loopback (until somebody takes it)."""
    while True:
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", 0))
            port = int(tcp.getsockname()[1])
            try:
                udp.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port


@pytest.fixture(scope="session")
def network() -> Iterator[list[str]]:
    """Prefix of commands that are to meet in a network of their own, with loopback up and multicast over it.

    `[*network, sys.executable, "-m", "handtouch", ...]` sees the same files; its ports and its
    udp_multicast buses are nobody else's.
    """
    rootless = [] if os.geteuid() == 0 else ["--map-root-user"]
    ready = "ip link set lo up && ip route add 239.0.0.0/8 dev lo && echo ready && exec cat"
    try:
        keeper = subprocess.Popen(
            ["unshare", "--net", *rootless, "sh", "-c", ready],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    except FileNotFoundError:
        pytest.skip("unshare (util-linux) is missing")
    assert keeper.stdin is not None
    assert keeper.stdout is not None
    with keeper:
        answer = keeper.stdout.readline().strip()
        if answer != "ready" or shutil.which("nsenter") is None:
            keeper.kill()
            pytest.skip(f"no network namespace to be had: {answer or 'nsenter is missing'}")
        user = ["--user", "--preserve-credentials"] if rootless else []
        yield ["nsenter", "--target", str(keeper.pid), *user, "--net", "--"]
        keeper.stdin.close()


@pytest.fixture(scope="session")
def starter(network: list[str]) -> Iterator[Starter]:
    """Starts processes in the tests' network."""
    made = Starter(network)
    yield made
    made.close()


@pytest.fixture(scope="session")
def vcan_starter() -> Iterator[Starter]:
    """Starts processes where SocketCAN is."""
    made = Starter([])
    yield made
    made.close()


@dataclass(frozen=True)
class Installation:
    """handtouch as services/install.sh leaves it on a controller, with `root` in place of /."""

    root: Path

    @property
    def prefix(self) -> Path:
        """PREFIX of the installation."""
        return self.root / "usr"

    @property
    def settings(self) -> Path:
        """Its folder for /etc/handtouch."""
        return self.root / "etc/handtouch"

    @property
    def environment(self) -> dict[str, str]:
        """Variables to run it with: the packages it depends on are those of the tests."""
        return {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")}

    def install(self, wheel: Path, *arguments: str, **variables: str) -> str:
        """Run services/install.sh; what it says."""
        environment = {
            **os.environ,
            "PREFIX": str(self.prefix),
            "SYSCONFDIR": str(self.root / "etc"),
            "WHEEL": str(wheel),
            "PYTHON": sys.executable,
            "PIP_ARGS": "--no-deps --no-index",
            **variables,
        }
        script = [str(ROOT / "services/install.sh"), *arguments]
        done = subprocess.run(script, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="session")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the source archive, and the wheel built from it."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="session")
def wheel(archives: Path) -> Path:
    """The wheel."""
    (found,) = archives.glob("*.whl")
    return found


@pytest.fixture(scope="session")
def installation(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """handtouch installed, by way of a staging folder as a package is built. Read only: tests share it."""
    folder = tmp_path_factory.mktemp("installed")
    installed, stage = Installation(folder / "root"), folder / "stage"
    installed.install(wheel, DESTDIR=str(stage))
    Path(f"{stage}{installed.root}").rename(installed.root)
    return installed
