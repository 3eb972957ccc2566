"""Fixtures for tests of whole processes: endpoints and networks of their own, an installation."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zmq
from hypothesis import HealthCheck, settings

from tests.durations import Durations
from tests.starter import Starter, find_port, own_endpoints

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
# tables of pads are named by the hash of their parameters and code: all workers and sessions share them
os.environ["XDG_CACHE_HOME"] = str(ROOT / "build/tests")
BUILDS_WHEEL = "test_packaging.py"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--within`, by which `make check` chooses."""
    parser.addoption("--within", type=float, metavar="S", help="run the fastest tests that take S seconds")


def pytest_configure(config: pytest.Config) -> None:
    """Keep durations between sessions."""
    config.pluginmanager.register(Durations(ROOT / "build/tests/durations.json"), "durations")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The file that builds the wheel first, which others wait for, then long ones, so that workers end
    together. Without SocketCAN skip its tests; in vcan-run it is."""
    durations: Any = config.pluginmanager.get_plugin("durations")
    if config.option.within is not None:
        taken = durations.fastest(items, config.option.within)
        config.hook.pytest_deselected(items=list(set(items) - set(taken)))
        items[:] = taken
    durations.sort(items)
    items.sort(key=lambda item: item.path.name != BUILDS_WHEEL)
    if "VCAN_RUN" in os.environ or Path("/sys/class/net/vcan0").exists():
        return
    skip = pytest.mark.skip(reason="no vcan0 here; `make socketcan` runs these tests where there is one")
    for item in items:
        if item.get_closest_marker("socketcan"):
            item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Daemons of tests keep calibrations of simulated units outside the user's folder."""
    with pytest.MonkeyPatch.context() as changed:
        changed.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def endpoints() -> Iterator[dict[str, str]]:
    """ZeroMQ endpoints for a `[daemon]` table, private to this test."""
    with own_endpoints() as made:
        yield made


@pytest.fixture
def publisher(endpoints: dict[str, str]) -> Iterator[Any]:
    """An XPUB socket in the place of a daemon's live stream; it reports every subscription."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDHWM, 0)
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        socket.bind(endpoints["live"])
        yield socket


@pytest.fixture
def free_port() -> int:
    """A TCP and UDP port that is free on loopback (until another process takes it)."""
    return find_port()


@pytest.fixture(scope="session")
def network() -> Iterator[list[str]]:
    """Prefix of commands that are to meet in a network of their own, with loopback up and multicast over it.

    `[*network, sys.executable, "-m", "handtouch", ...]` sees the same files; its ports and its
    udp_multicast buses are private.
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
def host_starter() -> Iterator[Starter]:
    """Starts processes in the network of the tests themselves, where SocketCAN is."""
    made = Starter()
    yield made
    made.close()


@pytest.fixture(scope="session")
def starter(host_starter: Starter, network: list[str]) -> Starter:
    """Starts processes in the tests' network."""
    return host_starter.inside(network)


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
            "LOCK": "",  # the packages of the tests, see `environment`
            "PIP_ARGS": "--no-index",
            **variables,
        }
        script = [str(ROOT / "services/install.sh"), *arguments]
        done = subprocess.run(script, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Makes a folder by its name and what fills it, once for all of xdist's workers."""
    base = tmp_path_factory.getbasetemp()
    parent = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, fill: Callable[[Path], None]) -> Path:
        with (parent / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (parent / name).exists():
                fill(parent / f"{name}.part")
                (parent / f"{name}.part").rename(parent / name)
        return parent / name

    return made


def copy_compiled(source: Path) -> None:
    """Copy the compiled stages into a source tree, but the smallest, which it compiles: saves half a minute.

    Their names carry the hash of their sources; of other sources they don't count.
    """
    here = ROOT / "src/handtouch/core/stages/_compiled"
    if here.exists():
        shutil.copytree(here, source / here.relative_to(ROOT), ignore=shutil.ignore_patterns("tables-*"))


@pytest.fixture(scope="session")
def archives(shared: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """Folder with the source archive, and the wheel built from it."""

    def run_build(source: Path, kind: str, folder: Path) -> None:
        command = [
            sys.executable,
            "-m",
            "build",
            "--no-isolation",
            kind,
            "--outdir",
            str(folder),
            str(source),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr

    def build(folder: Path) -> None:
        run_build(ROOT, "--sdist", folder)
        (archive,) = folder.glob("*.tar.gz")
        subprocess.run(["tar", "-xzf", archive, "-C", folder], check=True)
        source = folder / archive.name.removesuffix(".tar.gz")
        copy_compiled(source)
        run_build(source, "--wheel", folder)
        shutil.rmtree(source)

    return shared("dist", build)


@pytest.fixture(scope="session")
def wheel(archives: Path) -> Path:
    """The wheel."""
    (found,) = archives.glob("*.whl")
    return found


@pytest.fixture(scope="session")
def installation(wheel: Path, shared: Callable[[str, Callable[[Path], None]], Path]) -> Installation:
    """handtouch installed, by way of a staging folder as a package is built. Read only: tests share it."""

    def install(folder: Path) -> None:
        installed = Installation(folder.with_name("installed") / "root")
        installed.install(wheel, DESTDIR=str(folder / "stage"))
        Path(f"{folder}/stage{installed.root}").rename(folder / "root")

    return Installation(shared("installed", install) / "root")
