"""Installed systemd services: units are valid, restart rules are correct, and the daemon starts."""

from __future__ import annotations

import configparser
import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from handtouch import config

from .conftest import ROOT, Installation

pytestmark = pytest.mark.timeout(900)  # the first of these tests waits for a wheel, which compiles

UNITS = ("handtouch@.service", "handtouch-can@.service", "handtouch-node@.service")


def unit(installation: Installation, name: str) -> configparser.ConfigParser:
    """Return an installed unit file; the last of repeated settings counts."""
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=["="])
    parser.optionxform = str  # type: ignore[assignment, method-assign]  # the documented way
    parser.read(installation.prefix / "lib/systemd/system" / name)
    return parser


def command(installation: Installation, deployment: str, options: str = "") -> list[str]:
    """Return ExecStart of the daemon for a deployment, expanded as by systemd."""
    line = unit(installation, UNITS[0])["Service"]["ExecStart"]
    return shlex.split(line.replace("%i", deployment).replace("$HANDTOUCH_RUN_OPTIONS", options))


def analyze(installation: Installation, name: str, *command: str) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze on an installed unit."""
    if shutil.which("systemd-analyze") is None:
        assert os.environ.get("CI") != "true", "CI needs systemd-analyze"
        pytest.skip("systemd-analyze is missing (Debian package systemd)")
    path = installation.prefix / "lib/systemd/system" / name
    return subprocess.run(
        ["systemd-analyze", *command, str(path)], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", UNITS)
def test_systemd_analyze_reports_no_problem(installation: Installation, name: str) -> None:
    done = analyze(installation, name, "verify")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("name", UNITS)
def test_every_unit_is_sandboxed(installation: Installation, name: str) -> None:
    """Exposure 2.5 of 10 at most; 9.6 without a sandbox."""
    done = analyze(installation, name, "security", "--offline=yes", "--no-pager", "--threshold=25")
    assert done.returncode == 0, done.stdout[-2000:]


def test_the_can_unit_has_one_capability_and_no_root(installation: Installation) -> None:
    service = unit(installation, UNITS[1])["Service"]
    assert service["DynamicUser"] == "yes"
    assert service["CapabilityBoundingSet"] == service["AmbientCapabilities"] == "CAP_NET_ADMIN"
    assert service["RestrictAddressFamilies"] == "AF_NETLINK"


def test_no_staging_path_or_placeholder_remains(installation: Installation) -> None:
    scripts = (installation.prefix / "lib/handtouch/bin").iterdir()
    units = (installation.prefix / "lib/systemd/system").iterdir()
    for path in [*scripts, *units]:
        if not path.is_symlink():
            assert "/stage/" not in path.read_text(), path
            assert not re.search("@[A-Z]+@", path.read_text()), path


def test_a_stalled_or_failed_daemon_restarts_and_a_wrong_deployment_does_not(
    installation: Installation,
) -> None:
    service = unit(installation, UNITS[0])["Service"]
    assert (service["Type"], service["Restart"], service["WatchdogSec"]) == ("notify", "on-failure", "2")
    assert service["RestartPreventExitStatus"] == "2"
    assert unit(installation, UNITS[0])["Unit"]["StartLimitIntervalSec"] == "0"


def test_a_node_may_reach_its_inputs_without_any_capability(installation: Installation) -> None:
    path = installation.prefix / "lib/systemd/system" / UNITS[2]
    lines = path.read_text().splitlines()
    devices = [f"DeviceAllow=char-{name} rw" for name in ("iio", "gpiochip", "ttyACM", "ttyUSB")]
    assert {*devices, "CapabilityBoundingSet="} <= set(lines)
    service = unit(installation, UNITS[2])["Service"]
    assert {"DynamicUser", "ProtectKernelTunables", "PrivateDevices"}.isdisjoint(service)  # /sys is root's
    assert (service["Type"], service["Restart"], service["RestartPreventExitStatus"]) == (
        "notify",
        "on-failure",
        "2",
    )
    words = shlex.split(service["ExecStart"].replace("%i", "missing"))
    environment = installation.environment
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, "missing.toml: the file: No such file" in done.stderr) == (2, True), done.stderr


def test_example_ipc_endpoint_is_writable_by_the_service(
    installation: Installation,
) -> None:
    folder = unit(installation, UNITS[0])["Service"]["RuntimeDirectory"].replace("%i", "hand")
    with pytest.raises(config.ConfigError, match=re.escape(f" ipc:///run/{folder}/live")):
        config.parse(
            (ROOT / "config/utah_mit.toml").read_text().replace("[daemon]", '[daemon]\nlive = "5580"')
        )


def test_wrong_deployment_exits_with_status_2(installation: Installation) -> None:
    done = subprocess.run(
        command(installation, "missing"),
        env=installation.environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert "missing.toml: the file: No such file" in done.stderr


def with_families(families: list[str], command: list[str]) -> list[str]:
    """Return a command that runs another one with the socket families of a sandbox only."""
    program = """if True:
        import ctypes, errno, os, platform, struct, sys
        allowed, command = [int(word) for word in sys.argv[1].split(",")], sys.argv[2:]
        socket_call = {"x86_64": 41, "aarch64": 198}[platform.machine()]
        load, equal, end = 0x20, 0x15, 0x06
        allow, refuse = 0x7FFF0000, 0x00050000 | errno.EAFNOSUPPORT
        steps = [(load, 0, 0, 0), (equal, 0, len(allowed) + 2, socket_call), (load, 0, 0, 16)]
        steps += [(equal, len(allowed) - i, 0, family) for i, family in enumerate(allowed)]
        steps += [(end, 0, 0, refuse), (end, 0, 0, allow)]
        code = b"".join(struct.pack("HBBI", *step) for step in steps)
        class Filter(ctypes.Structure):
            _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]
        libc = ctypes.CDLL(None, use_errno=True)
        assert libc.prctl(38, 1, 0, 0, 0) == 0  # no new privileges
        assert libc.prctl(22, 2, ctypes.byref(Filter(len(steps), code)), 0, 0) == 0, ctypes.get_errno()
        os.execv(command[0], command)
    """
    numbers = ",".join(str(int(getattr(socket, family))) for family in families)
    return [sys.executable, "-c", program, numbers, *command]


def test_service_in_its_sandbox_notifies_ready_and_watchdog_and_stops(
    installation: Installation, network: list[str], tmp_path: Path, free_port: int
) -> None:
    families = unit(installation, UNITS[0])["Service"]["RestrictAddressFamilies"].split()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(0.5)
        environment = {
            **installation.environment,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "2000000",
        }
        run = command(installation, "hand", f"--bus can0=udp_multicast:239.74.163.2:{free_port}")
        with subprocess.Popen([*network, *with_families(families, run)], env=environment) as daemon:
            try:
                received = ""
                deadline = time.monotonic() + 60
                while "READY=1" not in received or received.count("WATCHDOG=1") < 2:
                    assert daemon.poll() is None, "it ended"
                    assert time.monotonic() < deadline, received
                    with contextlib.suppress(TimeoutError):
                        received += systemd.recv(4096).decode() + "\n"
                assert received.index("READY=1") < received.rindex("WATCHDOG=1")
                start = time.monotonic()
                daemon.send_signal(signal.SIGTERM)
                assert daemon.wait(10) == 0
                assert time.monotonic() - start < 10
            finally:
                daemon.kill()


def test_reinstalling_keeps_edited_files(installation: Installation, wheel: Path, tmp_path: Path) -> None:
    own = Installation(tmp_path / "root")
    shutil.copytree(installation.root, own.root, symlinks=True)
    deployment = own.settings / "hand.toml"
    edited = deployment.read_text().replace('name = "right"', 'name = "left"')
    deployment.write_text(edited)
    own.install(wheel, PIP_ARGS="--no-index --no-compile")
    assert deployment.read_text() == edited


def test_uninstalling_keeps_settings(tmp_path: Path, wheel: Path) -> None:
    fresh = Installation(tmp_path)
    for path in ("usr/lib/handtouch/bin/python", "usr/bin/handtouch", "etc/handtouch/hand.toml"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    for name in (*UNITS, "other.service"):
        (tmp_path / "usr/lib/systemd/system").mkdir(parents=True, exist_ok=True)
        (tmp_path / "usr/lib/systemd/system" / name).touch()
    fresh.install(wheel, "uninstall")
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert left == ["etc/handtouch/hand.toml", "usr/lib/systemd/system/other.service"]


SCRIPTS = [
    *("services/install.sh", ".ci/run"),
    *(f"debian/handtouch.{name}" for name in ("postinst", "prerm", "postrm")),
]


@pytest.mark.parametrize("script", SCRIPTS)
def test_shell_scripts_are_valid(script: str) -> None:
    if not (ROOT / script).exists():
        pytest.skip("not in the source archive")
    subprocess.run(["sh", "-n", str(ROOT / script)], check=True)
