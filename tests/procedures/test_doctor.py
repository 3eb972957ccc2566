"""`handtouch doctor` checks a machine, and gives a remedy for each problem."""

from __future__ import annotations

import errno
import json
import socket
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from handtouch import cli, config
from handtouch.canbus.bus.port import BusError, Port, open_bus
from handtouch.client import key_maker
from handtouch.config import shipped
from handtouch.core.slab import Slab
from handtouch.host.machine import HostCheck, Machine
from handtouch.procedures import doctor

HAND = shipped.path("utah_mit.toml")


@dataclass(frozen=True)
class Fake(Machine):
    """A machine that permits raw sockets, with an interface can0 with a given answer of `ip`."""

    link: dict[str, Any] | None = None

    def read_link(self, name: str) -> dict[str, Any] | None:
        del name
        return self.link

    def raw_socket_problem(self) -> None:
        return None


def fake(root: Path, link: dict[str, Any] | None = None) -> Fake:
    (root / "sys/class/net/can0").mkdir(parents=True)
    return Fake(root / "proc", root / "sys", link)


def bus(interface: str = "socketcan", channel: str = "can0", **options: int) -> config.Bus:
    return config.Bus(name="can0", interface=interface, channel=channel, options=dict(options))


def link_state(**change: Any) -> dict[str, Any]:
    """The answer of `ip` for a healthy adapter, with changes."""
    data = {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 1_000_000}} | change
    return {"flags": ["UP"], "linkinfo": {"info_kind": "can", "info_data": data}}


def test_healthy_adapter_is_ok(tmp_path: Path) -> None:
    assert list(doctor.check_bus(bus(), fake(tmp_path, link_state()))) == [
        HostCheck("bus can0", "ok", "can0 is up, ERROR-ACTIVE, 1000000 bit/s")
    ]


@pytest.mark.parametrize(
    ("link", "state", "detail", "remedy"),
    [
        ({"flags": []}, "fail", "can0 is down", "ip link set can0 up type can bitrate 1000000"),
        (
            link_state(bittiming={"bitrate": 500_000}),
            "fail",
            "can0 runs at 500000 bit/s",
            "ip link set can0 down;",
        ),
        (link_state(state="BUS-OFF"), "fail", "can0 is bus-off", "check wiring, termination, bit rate"),
        (link_state(state="ERROR-PASSIVE"), "warn", "can0 is ERROR-PASSIVE", "termination (120 ohm"),
        (link_state(restart_ms=0), "warn", "can0 does not restart after a bus-off", "restart-ms 100"),
        (None, "warn", "its state is unknown", "install iproute2"),
    ],
)
def test_adapter_problems_are_detected(
    tmp_path: Path, link: dict[str, Any] | None, state: str, detail: str, remedy: str
) -> None:
    (check,) = [f for f in doctor.check_bus(bus(), fake(tmp_path, link)) if f.state != "ok"]
    assert check.state == state
    assert detail in check.detail
    assert remedy in check.remedy


def test_missing_interface_is_detected(tmp_path: Path) -> None:
    (check,) = doctor.check_bus(bus(channel="can7"), fake(tmp_path))
    assert (check.state, check.detail) == ("fail", "no interface can7")


def test_virtual_bus_is_a_warning_and_missing_serial_device_a_failure() -> None:
    assert [f.state for f in doctor.check_bus(bus("virtual", "x"), Machine())] == ["warn"]
    details = [f.detail for f in doctor.check_bus(bus("slcan", "/dev/handtouch0@115200"), Machine())]
    assert "no device /dev/handtouch0" in details


def test_small_buffers_and_slow_clocks_are_detected(tmp_path: Path) -> None:
    machine = fake(tmp_path)
    (tmp_path / "proc/sys/net/core").mkdir(parents=True)
    (tmp_path / "proc/sys/net/core/rmem_max").write_text("212992\n")
    clock = tmp_path / "sys/devices/system/clocksource/clocksource0"
    clock.mkdir(parents=True)
    (clock / "current_clocksource").write_text("hpet\n")
    (buffer,) = doctor.check_receive_buffer(machine)
    assert (buffer.state, buffer.remedy.split(" (")[0]) == ("warn", "sysctl -w net.core.rmem_max=4194304")
    (clock_check,) = doctor.check_clock(machine)
    assert (clock_check.state, clock_check.detail) == ("warn", "hpet is slow to read")


def test_port_in_use_is_detected() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        checks = list(doctor.check_endpoints(config.Daemon(live=f"tcp://127.0.0.1:{port}")))
    assert checks[0].state == "fail"
    assert "is in use" in checks[0].detail
    assert "handtouch status" in checks[0].remedy


@pytest.mark.parametrize(("hands", "state"), [(None, "ok"), (["right"], "ok"), (["left"], "fail")])
def test_endpoints_of_a_running_daemon_of_these_hands_are_ok(hands: list[str] | None, state: str) -> None:
    with zmq.Context() as context, context.socket(zmq.REP) as control, context.socket(zmq.PUB) as live:
        daemon = config.Daemon(
            control=f"tcp://127.0.0.1:{control.bind_to_random_port('tcp://127.0.0.1')}",
            live=f"tcp://127.0.0.1:{live.bind_to_random_port('tcp://127.0.0.1')}",
        )

        def answer() -> None:
            control.recv()
            control.send(msgpack.packb({"ok": True, "service": {"pid": 4711, "hands": {"right": ["tip"]}}}))

        thread = threading.Thread(target=answer)
        thread.start()
        found = {check.subject: check for check in doctor.check_endpoints(daemon, hands)}
        thread.join()
    for name in ("live", "control"):
        assert found[f"endpoint {name}"].state == state
        assert ("process 4711" in found[f"endpoint {name}"].detail) is (state == "ok")


@pytest.mark.parametrize(("host", "state"), [("*", "ok"), ("lo", "ok"), ("no-such0", "fail")])
def test_endpoint_requires_its_interface(free_port: int, host: str, state: str) -> None:
    found = next(doctor.check_endpoints(config.Daemon(live=f"tcp://{host}:{free_port}")))
    assert found.state == state


def test_unusable_keys_are_named(tmp_path: Path) -> None:
    key_maker.make_server_keys(tmp_path / "keys", "robot1")
    key_maker.add_client(tmp_path / "keys", "viewer", "read", tmp_path / "viewer.key")
    daemon = config.Daemon(keys=str(tmp_path / "keys"))
    (keys_check,) = doctor.check_keys(daemon)
    assert (keys_check.state, "1 authorised clients" in keys_check.detail) == ("ok", True)
    (tmp_path / "keys/server.key").chmod(0o640)
    (tmp_path / "keys/clients/viewer.pub").write_text("")
    found = list(doctor.check_keys(daemon))
    assert {check.state for check in found} == {"fail"}
    assert any("chmod 600" in check.remedy for check in found)
    assert any("viewer.pub" in check.detail for check in found)


@pytest.mark.parametrize(("daemon", "state"), [(config.Daemon(), "warn"), (config.Daemon(keys="k"), "fail")])
def test_pyzmq_without_curve_is_detected(
    monkeypatch: pytest.MonkeyPatch, daemon: config.Daemon, state: str
) -> None:
    monkeypatch.setattr(zmq, "has", lambda _: False)
    (found,) = doctor.check_keys(daemon)
    assert (found.state, "pyzmq" in found.remedy) == (state, True)


def test_ipc_endpoint_is_in_use_while_it_accepts_connections(tmp_path: Path) -> None:
    def check_endpoint() -> HostCheck:
        return next(doctor.check_endpoints(config.Daemon(live=f"ipc://{tmp_path}/live")))

    assert check_endpoint() == HostCheck("endpoint live", "ok", f"ipc://{tmp_path}/live is free")
    with socket.socket(socket.AF_UNIX) as taken:
        taken.bind(str(tmp_path / "live"))
        taken.listen()
        check = check_endpoint()
    assert (check.state, check.detail) == ("fail", f"ipc://{tmp_path}/live is in use")
    assert "handtouch status" in check.remedy
    assert check_endpoint().state == "ok", "a stale socket file is ok"


def test_missing_folder_of_an_ipc_endpoint_is_named(tmp_path: Path) -> None:
    check = next(doctor.check_endpoints(config.Daemon(live=f"ipc://{tmp_path}/no/live")))
    assert (check.state, check.detail) == ("fail", f"no folder {tmp_path}/no")
    assert check.remedy.startswith(f"mkdir -p {tmp_path}/no")


def test_ipc_path_too_long_for_a_socket_is_detected(tmp_path: Path) -> None:
    check = next(doctor.check_endpoints(config.Daemon(live=f"ipc://{tmp_path}/{'x' * 120}")))
    assert (check.state, check.remedy[:6]) == ("fail", "change")


def test_kernel_without_socketcan_is_one_failure_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "socket", refuse)
    (check,) = doctor.check_bus(bus(channel="can7"), Machine(tmp_path / "proc", tmp_path / "sys"))
    assert (check.state, "no SocketCAN" in check.detail) == ("fail", True)
    assert "udp_multicast" in check.remedy


def test_multicast_group_without_a_route_is_detected() -> None:
    (check,) = doctor.check_bus(bus("udp_multicast", "ff02::1"), Machine())  # link-local, without its link
    assert (check.state, "no route to ff02::1" in check.detail) == ("fail", True)
    assert "ip -6 route add" in check.remedy


def test_a_missing_multicast_route_is_the_reason_why_a_bus_cannot_be_opened() -> None:
    with pytest.raises(BusError, match=r"no route to ff02::1.*; ip -6 route add"):
        Port.open(bus("udp_multicast", "ff02::1"), Slab(1))
    with pytest.raises(BusError, match=r"no route to ff02::1.*; ip -6 route add"):
        open_bus(bus("udp_multicast", "ff02::1"))  # of simulated nodes


def test_multicast_group_with_a_route_is_ok(network: list[str]) -> None:
    code = (
        "from handtouch import config\n"
        "from handtouch.host.machine import Machine\n"
        "from handtouch.procedures import doctor\n"
        "bus = config.Bus(name='b', interface='udp_multicast', channel='239.74.163.2')\n"
        "(check,) = doctor.check_bus(bus, Machine())\n"
        "print(check.state)"
    )
    done = subprocess.run([*network, sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "ok\n"


def test_json_report_has_remedies(capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(["doctor", str(HAND), "--json"])
    checks = json.loads(capsys.readouterr().out)
    assert {"python", "packages", "receive buffer", "bus can0", "endpoint live"} <= {
        check["subject"] for check in checks
    }
    assert status == (1 if any(check["state"] == "fail" for check in checks) else 0)
    assert all(check["remedy"] for check in checks if check["state"] != "ok")


def test_invalid_deployment_exits_with_status_2(tmp_path: Path) -> None:
    assert cli.main(["doctor", str(tmp_path / "none.toml")]) == 2


@pytest.mark.socketcan
def test_vcan_is_ok() -> None:
    assert list(doctor.check_bus(bus(channel="vcan0"), Machine())) == [
        HostCheck("bus can0", "ok", "vcan0 is up (vcan)")
    ]
