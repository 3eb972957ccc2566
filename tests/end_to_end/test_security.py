"""`handtouch run` with keys on public endpoints, and clients with and without keys."""

from __future__ import annotations

import json
import random
import shutil
import signal
import socket
import tarfile
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from handtouch.cli import main
from handtouch.client import connect, key_maker, request
from handtouch.config import shipped
from handtouch.record.recording import Recording
from tests.starter import Starter

from .conftest import START_S, Rig

_ZMTP = b"\xff" + bytes(8) + b"\x7f\x03\x00"
THROWN = [
    b"GET / HTTP/1.1\r\n\r\n" * 100,
    b"",
    _ZMTP,
    _ZMTP + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31) + b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03SUB",
    _ZMTP + b"CURVE".ljust(20, b"\0") + b"\0" + bytes(31) + b"\x06\x7f" + b"\xff" * 7 + bytes(5000),
    *(random.Random(seed).randbytes(10_000) for seed in range(20)),
]


def _free_ports(count: int) -> list[int]:
    with ExitStack() as open_still:
        probes = [open_still.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]


class Reachable(Rig):
    """A daemon on all interfaces, without nodes; it ticks nevertheless."""

    def __init__(self, folder: Path, starter: Starter, with_keys: bool) -> None:
        streams = ("live", "complete", "control", "inputs")
        self.ports = dict(zip(streams, _free_ports(len(streams)), strict=True))
        settings = {stream: f"tcp://0.0.0.0:{port}" for stream, port in self.ports.items()}
        settings |= {"keys": "keys"} if with_keys else {}
        super().__init__(folder, settings, [], ["can0=virtual:empty"], starter=starter)
        self.keys = folder / "keys"

    def at(self, stream: str) -> str:
        return f"tcp://127.0.0.1:{self.ports[stream]}"

    def key(self, name: str) -> Path:
        return self.folder / f"{name}.key"

    def ask(self, name: str) -> dict[str, Any]:
        return request("status", endpoint=self.at("control"), key=self.key(name), timeout_s=START_S)


@pytest.fixture(scope="module")
def made_keys(tmp_path_factory: pytest.TempPathFactory, host_starter: Starter) -> Path:
    """Folder with the keys of a robot and of two clients, as the commands make them."""
    made = Reachable(tmp_path_factory.mktemp("keys"), host_starter, with_keys=True)
    assert made.call("keys", "make", str(made.keys), "--name", "robot1")[0] == 0
    for name, rights in (("reader", "read"), ("pilot", "control")):
        status, printed = made.call(
            *("keys", "client", str(made.keys), name, "--rights", rights, "--out", str(made.key(name)))
        )
        assert status == 0, printed
    return made.folder


@pytest.fixture
def reachable(tmp_path: Path, host_starter: Starter, made_keys: Path) -> Iterator[Reachable]:
    made = Reachable(tmp_path, host_starter, with_keys=True)
    shutil.copytree(made_keys / "keys", made.keys)
    for file in made_keys.glob("*.key"):
        shutil.copy(file, tmp_path)
    yield made
    made.end_all()


def test_daemon_without_keys_refuses_public_endpoints(tmp_path: Path, host_starter: Starter) -> None:
    rig = Reachable(tmp_path, host_starter, with_keys=False)
    status, printed = rig.call("run", str(rig.config))
    assert status == 2
    assert "is reachable from other machines" in printed
    assert "handtouch keys make" in printed


def test_missing_key_folder_is_refused(tmp_path: Path, host_starter: Starter) -> None:
    rig = Reachable(tmp_path, host_starter, with_keys=True)
    status, printed = rig.call("run", str(rig.config))
    assert status == 2
    assert f"handtouch keys make {rig.keys}" in printed


def test_readable_secret_is_refused(reachable: Reachable) -> None:
    (reachable.keys / "server.key").chmod(0o644)
    status, printed = reachable.call("run", str(reachable.config), "--bus", reachable.bus[0])
    assert status == 2
    assert f"chmod 600 {reachable.keys / 'server.key'}" in printed
    _, printed = reachable.call("doctor", str(reachable.config))
    assert f"chmod 600 {reachable.keys / 'server.key'}" in printed


def test_each_key_grants_its_right(reachable: Reachable, tmp_path: Path) -> None:
    key_maker.make_server_keys(tmp_path / "other", "robot2")
    key_maker.add_client(tmp_path / "other", "stranger", "control", reachable.key("stranger"))
    reachable.start("run")
    assert reachable.ask("pilot")["ok"]
    with connect("service", endpoint=reachable.at("live"), key=reachable.key("reader")) as messages:
        assert messages.recv(START_S) is not None
    assert reachable.ask("reader")["ok"]
    with pytest.raises(RuntimeError, match='the command needs "control"'):
        request("disable", endpoint=reachable.at("control"), key=reachable.key("reader"), pads=["*"])
    with pytest.raises(PermissionError, match="another daemon"):
        reachable.ask("stranger")
    with pytest.raises(PermissionError, match="requires a key"):
        request("status", endpoint=reachable.at("control"), key="", timeout_s=START_S)

    key_maker.add_client(reachable.keys, "late", "control", reachable.key("late"))
    assert reachable.ask("late")["ok"]
    key_maker.revoke(reachable.keys, "late")
    with pytest.raises(PermissionError, match="unknown there"):
        reachable.ask("late")
    assert reachable.end("run") == 0
    output = reachable.printed("run")
    assert "connection refused: client has the key of another daemon" in output
    assert "connection refused: client key is unknown" in output


def test_commands_take_a_key_by_option_and_by_environment(reachable: Reachable) -> None:
    reachable.start("run")
    reachable.ask("pilot")
    control, live = ("--endpoint", reachable.at("control")), ("--endpoint", reachable.at("live"))
    pilot, reader = str(reachable.key("pilot")), str(reachable.key("reader"))
    status, printed = reachable.call("status", *control, "--key", pilot, "--json")
    assert '"pads"' in printed, printed
    status, printed = reachable.call("status", *control, "--json", HANDTOUCH_KEY=pilot)
    assert '"pads"' in printed, printed
    status, printed = reachable.call("status", *control, "--json", HANDTOUCH_KEY=reader)
    assert '"pads"' in printed, printed
    status, printed = reachable.call("tare", *control, HANDTOUCH_KEY=reader)
    assert status == 1
    assert 'tare: this key has the right "read"; the command needs "control"' in printed
    status, printed = reachable.call("watch", "service", *live, "--key", reader, "--seconds", "3")
    assert status == 0, printed
    status, printed = reachable.call("watch", "service", *live, "--seconds", "60")
    assert status == 1
    assert "--key" in printed


def test_garbage_on_raw_sockets_does_not_stop_ticks(reachable: Reachable) -> None:
    reachable.start("run")
    with (
        connect("hand/*", endpoint=reachable.at("live"), key=reachable.key("reader"), queue=100_000) as hands,
        ExitStack() as open_still,
    ):
        first = hands.recv()
        for data in THROWN:
            for stream in ("live", "complete", "control"):
                thrown = open_still.enter_context(
                    socket.create_connection(("127.0.0.1", reachable.ports[stream]), timeout=START_S)
                )
                with suppress(OSError):  # it may hang up on us
                    thrown.sendall(data)
        assert reachable.ask("pilot")["ok"]
        seen = [first.tick, *(hands.recv().tick for _ in range(100))]
        assert seen == list(range(first.tick, first.tick + 101))
        assert hands.lost_messages == 0
    assert reachable.end("run") == 0
    assert "Traceback" not in reachable.printed("run")


def test_client_with_key_reconnects_when_the_daemon_restarts(reachable: Reachable) -> None:
    with connect("service", endpoint=reachable.at("live"), key=reachable.key("reader")) as messages:
        reachable.start("run")
        before = messages.recv()
        assert reachable.end("run", signal.SIGKILL) != 0
        reachable.start("run")
        after = messages.recv(START_S)
        while after is not None and after.pid == before.pid:
            after = messages.recv(START_S)
        assert after is not None


def test_a_support_archive_has_status_and_recording_and_no_secret(reachable: Reachable) -> None:
    planted = "hunter2-Zx9"
    reachable.config.write_text(f"# upload_token = {planted}\n{reachable.config.read_text()}")
    reachable.start("run")
    reachable.ask("pilot")
    secrets = [planted, *(tomllib.loads(path.read_text())["secret_key"] for path in key_files(reachable))]
    log = reachable.folder / "daemon.log"
    log.write_text(f"started with password={planted}\nkey {secrets[1]} is loaded\nlast line\n")
    contents: dict[str, bytes] = {}
    while "recording.mcap" not in contents:  # a slow machine may receive nothing in time
        archive = reachable.folder / "report.tar.gz"
        archive.unlink(missing_ok=True)
        status, printed = reachable.call(
            *("support", str(reachable.config), "--key", str(reachable.key("pilot")), "--seconds", "1"),
            *("--log", str(log), "-o", str(archive)),
        )
        assert status in (0, 1), printed
        assert archive.stat().st_mode & 0o777 == 0o600
        with tarfile.open(archive) as opened:
            contents = {
                Path(member.name).name: file.read()
                for member in opened
                if (file := opened.extractfile(member)) is not None
            }
    assert {"versions.json", "machine.txt", "deployment.toml", "doctor.json", "log-1.txt"} <= set(contents)
    assert json.loads(contents["status.json"])["service"]["version"]
    assert b"last line" in contents["log-1.txt"]
    (reachable.folder / "recording.mcap").write_bytes(contents.pop("recording.mcap"))
    topics = set()
    for entry in Recording(reachable.folder / "recording.mcap"):
        topics.add(entry.topic)
        contents[entry.topic] = repr(entry.payload).encode()
    assert "config" in topics
    for name, content in contents.items():
        assert not [secret for secret in secrets if secret.encode() in content], name
    assert main(["support", "-o", str(archive)]) == 2  # never overwritten


def key_files(reachable: Reachable) -> list[Path]:
    return [reachable.keys / "server.key", reachable.key("reader"), reachable.key("pilot")]


@pytest.mark.parametrize(
    "command",
    [
        ["view", "--host", "0.0.0.0"],
        ["view", "--host", "192.168.1.7", "--foxglove"],
        ["view", "--host", "::"],
        ["simulate", str(shipped.path("two_finger.toml")), "--gripper", "tcp://*:5590"],
        ["simulate", str(shipped.path("two_finger.toml")), "--gripper", "tcp://0.0.0.0:5590"],
    ],
    ids=" ".join,
)
def test_programs_without_keys_refuse_public_addresses(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--seconds", "1"])
    error = capsys.readouterr().err
    assert "is reachable from other machines" in error
    assert error.count("\n") == 1
