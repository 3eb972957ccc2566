"""`handtouch doctor` finds what a machine lacks, and says what to do about it."""

from __future__ import annotations

import errno
import json
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zmq

from handtouch import config, doctor, keys, shipped
from handtouch.doctor import Finding, Machine

TROUBLE_OPENING_RAW = doctor._trouble_opening_raw
HAND = shipped.path("utah_mit.toml")


@dataclass(frozen=True)
class Fake(Machine):
    """A machine with an interface can0 of which `ip` says what the test wants."""

    said: dict[str, Any] | None = None

    def link(self, name: str) -> dict[str, Any] | None:
        del name
        return self.said


def fake(root: Path, said: dict[str, Any] | None = None) -> Fake:
    (root / "sys/class/net/can0").mkdir(parents=True)
    return Fake(root / "proc", root / "sys", said)


@pytest.fixture(autouse=True)
def _raw_sockets_may_be_opened(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if not request.node.get_closest_marker("socketcan"):
        monkeypatch.setattr(doctor, "_trouble_opening_raw", lambda: None)


def bus(interface: str = "socketcan", channel: str = "can0", **options: int) -> config.Bus:
    return config.Bus(name="can0", interface=interface, channel=channel, options=dict(options))


def link(**change: Any) -> dict[str, Any]:
    """What `ip` says of a healthy adapter, but for a change."""
    data = {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 1_000_000}} | change
    return {"flags": ["UP"], "linkinfo": {"info_kind": "can", "info_data": data}}


def test_a_healthy_adapter_is_well(tmp_path: Path) -> None:
    assert list(doctor.bus_findings(bus(), fake(tmp_path, link()))) == [
        Finding("bus can0", "ok", "can0 is up, ERROR-ACTIVE, 1000000 bit/s")
    ]


@pytest.mark.parametrize(
    ("said", "state", "detail", "remedy"),
    [
        ({"flags": []}, "fail", "can0 is down", "ip link set can0 up type can bitrate 1000000"),
        (link(bittiming={"bitrate": 500_000}), "fail", "can0 runs at 500000 bit/s", "ip link set can0 down;"),
        (link(state="BUS-OFF"), "fail", "can0 is bus-off", "check wiring, termination, bit rate"),
        (link(state="ERROR-PASSIVE"), "warn", "can0 is ERROR-PASSIVE", "termination (120 ohm"),
        (link(restart_ms=0), "warn", "can0 stays off after a bus-off", "restart-ms 100"),
        (None, "warn", "its state is unknown", "install iproute2"),
    ],
)
def test_an_ailing_adapter_is_found(
    tmp_path: Path, said: dict[str, Any] | None, state: str, detail: str, remedy: str
) -> None:
    (finding,) = [f for f in doctor.bus_findings(bus(), fake(tmp_path, said)) if f.state != "ok"]
    assert finding.state == state
    assert detail in finding.detail
    assert remedy in finding.remedy


def test_a_missing_interface_is_found(tmp_path: Path) -> None:
    (finding,) = doctor.bus_findings(bus(channel="can7"), fake(tmp_path))
    assert (finding.state, finding.detail) == ("fail", "there is no interface can7")


def test_virtual_is_doubted_and_a_missing_serial_device_found() -> None:
    assert [f.state for f in doctor.bus_findings(bus("virtual", "x"), Machine())] == ["warn"]
    details = [f.detail for f in doctor.bus_findings(bus("slcan", "/dev/handtouch0@115200"), Machine())]
    assert "there is no /dev/handtouch0" in details


def test_small_buffers_and_slow_clocks_are_found(tmp_path: Path) -> None:
    machine = fake(tmp_path)
    (tmp_path / "proc/sys/net/core").mkdir(parents=True)
    (tmp_path / "proc/sys/net/core/rmem_max").write_text("212992\n")
    clock = tmp_path / "sys/devices/system/clocksource/clocksource0"
    clock.mkdir(parents=True)
    (clock / "current_clocksource").write_text("hpet\n")
    (room,) = doctor.buffer_findings(machine)
    assert (room.state, room.remedy.split(" (")[0]) == ("warn", "sysctl -w net.core.rmem_max=4194304")
    (ticking,) = doctor.clock_findings(machine)
    assert (ticking.state, ticking.detail) == ("warn", "hpet is slow to read")


def test_a_taken_port_is_found() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        findings = list(doctor.endpoint_findings(config.Daemon(live=f"tcp://127.0.0.1:{port}")))
    assert findings[0].state == "fail"
    assert "address already in use" in findings[0].detail
    assert "handtouch status" in findings[0].remedy


@pytest.mark.parametrize(("host", "state"), [("*", "ok"), ("lo", "ok"), ("no-such0", "fail")])
def test_an_endpoint_on_an_interface_needs_that_interface(free_port: int, host: str, state: str) -> None:
    found = next(doctor.endpoint_findings(config.Daemon(live=f"tcp://{host}:{free_port}")))
    assert found.state == state


def test_keys_that_cannot_be_used_are_found_and_named(tmp_path: Path) -> None:
    keys.make(tmp_path / "keys", "robot1")
    keys.add_client(tmp_path / "keys", "viewer", "read", tmp_path / "viewer.key")
    daemon = config.Daemon(keys=str(tmp_path / "keys"))
    (well,) = doctor.key_findings(daemon)
    assert (well.state, "lets 1 clients in" in well.detail) == ("ok", True)
    (tmp_path / "keys/server.key").chmod(0o640)
    (tmp_path / "keys/clients/viewer.pub").write_text("")
    found = list(doctor.key_findings(daemon))
    assert {finding.state for finding in found} == {"fail"}
    assert any("chmod 600" in finding.remedy for finding in found)
    assert any("viewer.pub" in finding.detail for finding in found)


@pytest.mark.parametrize(("daemon", "state"), [(config.Daemon(), "warn"), (config.Daemon(keys="k"), "fail")])
def test_a_pyzmq_without_cryptography_is_found(
    monkeypatch: pytest.MonkeyPatch, daemon: config.Daemon, state: str
) -> None:
    monkeypatch.setattr(zmq, "has", lambda _: False)
    (found,) = doctor.key_findings(daemon)
    assert (found.state, "pyzmq" in found.remedy) == (state, True)


def test_an_ipc_endpoint_is_free_only_while_nobody_answers_there(tmp_path: Path) -> None:
    def look() -> Finding:
        return next(doctor.endpoint_findings(config.Daemon(live=f"ipc://{tmp_path}/live")))

    assert look() == Finding("endpoint live", "ok", f"ipc://{tmp_path}/live is free")
    with socket.socket(socket.AF_UNIX) as taken:
        taken.bind(str(tmp_path / "live"))
        taken.listen()
        finding = look()
    assert (finding.state, finding.detail) == ("fail", f"ipc://{tmp_path}/live: somebody answers there")
    assert "handtouch status" in finding.remedy
    assert look().state == "ok", "a file left behind is in nobody's way"


def test_a_missing_folder_of_an_ipc_endpoint_is_named(tmp_path: Path) -> None:
    finding = next(doctor.endpoint_findings(config.Daemon(live=f"ipc://{tmp_path}/no/live")))
    assert (finding.state, finding.detail) == ("fail", f"there is no folder {tmp_path}/no")
    assert finding.remedy.startswith(f"mkdir -p {tmp_path}/no")


def test_an_ipc_path_too_long_for_a_socket_is_found(tmp_path: Path) -> None:
    finding = next(doctor.endpoint_findings(config.Daemon(live=f"ipc://{tmp_path}/{'x' * 120}")))
    assert (finding.state, finding.remedy[:4]) == ("fail", "give")


def test_a_kernel_without_socketcan_is_one_failure_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(doctor, "_trouble_opening_raw", TROUBLE_OPENING_RAW)
    monkeypatch.setattr(socket, "socket", refuse)
    (finding,) = doctor.bus_findings(bus(channel="can7"), fake(tmp_path))
    assert (finding.state, "no SocketCAN" in finding.detail) == ("fail", True)
    assert "udp_multicast" in finding.remedy


def test_a_multicast_group_that_cant_be_reached_is_found() -> None:
    (finding,) = doctor.bus_findings(bus("udp_multicast", "239.74.163.2", port=99_999_999), Machine())
    assert (finding.state, finding.remedy) == ("fail", "ip route add 239.0.0.0/8 dev lo")


def test_a_multicast_group_with_a_route_is_well(network: list[str]) -> None:
    code = (
        "from handtouch import config, doctor\n"
        "bus = config.Bus(name='b', interface='udp_multicast', channel='239.74.163.2')\n"
        "(finding,) = doctor.bus_findings(bus, doctor.Machine())\n"
        "print(finding.state)"
    )
    done = subprocess.run([*network, sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "ok\n"


def test_the_report_is_readable_by_a_program(capsys: pytest.CaptureFixture[str]) -> None:
    status = doctor.run(HAND, json=True)
    findings = json.loads(capsys.readouterr().out)
    assert {"python", "packages", "receive buffer", "bus can0", "endpoint live"} <= {
        finding["subject"] for finding in findings
    }
    assert status == (1 if any(finding["state"] == "fail" for finding in findings) else 0)
    assert all(finding["remedy"] for finding in findings if finding["state"] != "ok")


def test_a_wrong_deployment_has_status_2(tmp_path: Path) -> None:
    assert doctor.run(tmp_path / "none.toml", json=False) == 2


@pytest.mark.socketcan
def test_vcan_is_well() -> None:
    assert list(doctor.bus_findings(bus(channel="vcan0"), Machine())) == [
        Finding("bus can0", "ok", "vcan0 is up (vcan)")
    ]
