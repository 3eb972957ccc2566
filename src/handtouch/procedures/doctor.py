"""Checks of this machine for running the daemon: packages, clock, buffers, CAN interfaces, endpoints, keys.

Public names: `check_host`. Read-only: nothing is configured and no frame is sent. Without a deployment only
the machine and the default endpoints are checked.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import socket
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import zmq

from handtouch import config
from handtouch.canbus.bus.receivers import RECEIVE_BUFFER_BYTES
from handtouch.client import keys, request
from handtouch.config.checks import UDP_MULTICAST_PORT
from handtouch.core.compiled import Compilation
from handtouch.host import realtime
from handtouch.host.endpoints import to_connect
from handtouch.host.installation import compile_command, extra_command
from handtouch.host.machine import CheckState, HostCheck, Machine, NoRouteError, check_multicast_route
from handtouch.procedures.timing_checks import check_timing

_ENDPOINT_IN_USE_REMEDY = (
    "stop the daemon that uses it (`handtouch status`), or choose another endpoint in [daemon]"
)
_NO_ADDRESS_REMEDY = "name an address or interface of this machine in [daemon] (`ip -br address` lists them)"
_DAEMON_TIMEOUT_S = 0.5
"""Time for a running daemon to answer; it takes milliseconds"""
FAST_CLOCK_SOURCES = ("tsc", "arch_sys_counter", "kvm-clock")


def check_host(deployment: config.Deployment | None, machine: Machine | None = None) -> Iterator[HostCheck]:
    """Yield the results of all checks."""
    machine = machine or Machine()
    yield from check_python()
    yield check_core()
    yield from check_clock(machine)
    yield from check_receive_buffer(machine)
    for bus in deployment.buses if deployment else ():
        yield from check_bus(bus, machine)
    hands = {hand.name for hand in deployment.hands} if deployment else None
    daemon = deployment.daemon if deployment else config.Daemon()
    yield from check_endpoints(daemon, hands)
    yield from check_keys(daemon)
    yield from check_realtime(daemon)
    yield from check_timing(deployment, machine)


def check_realtime(daemon: config.Daemon) -> Iterator[HostCheck]:
    """Check that the daemon can get the configured priority, CPUs and locked memory."""
    if not (daemon.realtime_priority or daemon.cpus or daemon.lock_memory):
        return
    problems = realtime.check_realtime_settings(daemon)
    for problem in problems:
        yield HostCheck("real time", "warn", *problem.split("; ", 1))
    if not problems:
        yield HostCheck("real time", "ok", "priority, CPUs and locked memory available as configured")


def check_keys(daemon: config.Daemon) -> Iterator[HostCheck]:
    """Check the daemon's keys, and that pyzmq supports CURVE."""
    if not zmq.has("curve"):
        state: CheckState = "fail" if daemon.keys else "warn"
        yield HostCheck(
            "keys", state, "this pyzmq was built without CURVE", "pip install --force-reinstall pyzmq"
        )
    elif daemon.keys:
        clients, problems = keys.load_clients(Path(daemon.keys))
        try:
            keys.load_server(Path(daemon.keys))
        except keys.KeyFileError as error:
            problems.insert(0, str(error))
        for problem in dict.fromkeys(problems):
            yield HostCheck("keys", "fail", *problem.split(": ", 1))
        if not problems:
            yield HostCheck("keys", "ok", f"{daemon.keys}: {len(clients)} authorised clients")


def check_python() -> Iterator[HostCheck]:
    """Check the packages that handtouch requires."""
    yield HostCheck("python", "ok", f"{platform.python_version()} in {sys.prefix}")
    missing, found = [], []
    for requirement in importlib.metadata.requires("handtouch") or []:
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        if "extra ==" in requirement:
            continue
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        yield HostCheck(
            "packages",
            "fail",
            f"missing: {', '.join(missing)}",
            "reinstall: pip install --force-reinstall handtouch",
        )
    else:
        yield HostCheck("packages", "ok", ", ".join(found))


def check_core() -> HostCheck:
    """Check that the stages of the core are compiled."""
    state = Compilation.current()
    if state.compiled:
        return HostCheck("core", "ok", "compiled")
    text = f"uncompiled, some fifty times slower per contact: {state.reason}"
    return HostCheck("core", "warn", text, state.remedy or compile_command())


def check_clock(machine: Machine) -> Iterator[HostCheck]:
    """Check the clock source that stamps samples: a slow one costs microseconds per frame."""
    path = machine.sys / "devices/system/clocksource/clocksource0/current_clocksource"
    try:
        source = path.read_text().strip()
    except OSError:
        yield HostCheck("clock", "warn", "clock source unknown", f"make {path} readable")
        return
    if source in FAST_CLOCK_SOURCES:
        yield HostCheck("clock", "ok", source)
    else:
        yield HostCheck(
            "clock",
            "warn",
            f"{source} is slow to read",
            "find out why the kernel rejected tsc: dmesg | grep -i tsc",
        )


def check_receive_buffer(machine: Machine) -> Iterator[HostCheck]:
    """Check the socket receive buffer: the kernel's default holds 17 ms of frames of a busy bus."""
    limit = machine.read_sysctl("net/core/rmem_max")
    if limit is None:
        yield HostCheck("receive buffer", "warn", "net.core.rmem_max can't be read", "mount /proc")
    elif limit >= RECEIVE_BUFFER_BYTES or machine.has_net_admin():
        yield HostCheck("receive buffer", "ok", f"{RECEIVE_BUFFER_BYTES >> 10} KiB available")
    else:
        yield HostCheck(
            "receive buffer",
            "warn",
            f"limited to {limit >> 10} of {RECEIVE_BUFFER_BYTES >> 10} KiB: a busy machine loses frames",
            f"sysctl -w net.core.rmem_max={RECEIVE_BUFFER_BYTES} (services/install.sh makes it permanent)",
        )


def check_bus(bus: config.Bus, machine: Machine) -> Iterator[HostCheck]:
    """Check one bus of the deployment."""
    subject = f"bus {bus.name}"
    if bus.interface == "socketcan":
        yield from _check_socketcan(subject, bus, machine)
    elif bus.interface == "udp_multicast":
        yield _check_multicast(subject, bus)
    elif bus.interface == "virtual":
        yield HostCheck(
            subject,
            "warn",
            "virtual connects no other process",
            "use udp_multicast to connect processes; virtual works within one program only",
        )
    elif str(bus.channel).startswith("/dev/"):
        yield from _check_serial_device(subject, bus)
    else:
        yield HostCheck(subject, "ok", f"{bus.interface} {bus.channel}: not checked")


def check_endpoints(daemon: config.Daemon, hands: Collection[str] | None = None) -> Iterator[HostCheck]:
    """Check that the daemon can bind its endpoints, or that it is a running daemon of these hands that has.

    `hands`: names, None: any.
    """
    running: str | None = None
    for name in ("live", "complete", "control", "inputs"):
        endpoint = getattr(daemon, name)
        subject = f"endpoint {name}"
        check = (
            _check_ipc_endpoint(subject, Path(endpoint.removeprefix("ipc://")))
            if endpoint.startswith("ipc://")
            else _check_tcp_endpoint(subject, endpoint)
        )
        if check.remedy == _ENDPOINT_IN_USE_REMEDY:
            running = _running_daemon(daemon, hands) if running is None else running
            if running:
                check = HostCheck(subject, "ok", f"{endpoint} is used by {running}")
        yield check


def _running_daemon(daemon: config.Daemon, hands: Collection[str] | None) -> str:
    """Return which daemon of these hands answers at the control endpoint, empty if none does."""
    try:
        answer = request("status", endpoint=to_connect(daemon.control), timeout_s=_DAEMON_TIMEOUT_S)
        service = answer["service"]
        known = hands is None or set(service["hands"]) == set(hands)
        return f"the running daemon, process {service['pid']}" if known else ""
    except PermissionError:  # it runs, and requires a key that only its clients have
        return "a running daemon that requires a key"
    except (TimeoutError, ValueError, RuntimeError, KeyError):
        return ""


def _check_tcp_endpoint(subject: str, endpoint: str) -> HostCheck:
    with zmq.Context() as context, context.socket(zmq.PUB) as probe:
        try:
            probe.bind(endpoint)  # accepts interface names too
        except zmq.ZMQError as error:
            if error.errno == zmq.EADDRINUSE:
                return HostCheck(subject, "fail", f"{endpoint} is in use", _ENDPOINT_IN_USE_REMEDY)
            problem = os.strerror(error.errno or 0).lower()
            return HostCheck(subject, "fail", f"{endpoint}: {problem}", _NO_ADDRESS_REMEDY)
    return HostCheck(subject, "ok", f"{endpoint} is free")


def _check_socketcan(subject: str, bus: config.Bus, machine: Machine) -> Iterator[HostCheck]:
    if problem := machine.raw_socket_problem():  # whatever the interface
        yield HostCheck(subject, "fail", *problem)
        return
    name = str(bus.channel)
    bring_up = f"ip link set {name} up type can bitrate {bus.bitrate_bit_s} restart-ms 100"
    if not (machine.sys / "class/net" / name).exists():
        yield HostCheck(
            subject,
            "fail",
            f"no interface {name}",
            "plug the adapter in and load its driver; without one: ip link add "
            f"{name} type vcan && ip link set {name} up",
        )
        return
    link = machine.read_link(name)
    if link is None:
        yield HostCheck(subject, "warn", f"{name} exists; its state is unknown", "install iproute2")
        return
    if "UP" not in link.get("flags", []):
        yield HostCheck(subject, "fail", f"{name} is down", bring_up)
        return
    info = link.get("linkinfo", {})
    if info.get("info_kind") == "vcan":
        yield HostCheck(subject, "ok", f"{name} is up (vcan)")
        return
    data = info.get("info_data", {})
    yield from _check_adapter(subject, bus, data, f"ip link set {name} down; {bring_up}")


def _check_adapter(subject: str, bus: config.Bus, data: dict[str, Any], bring_up: str) -> Iterator[HostCheck]:
    """Check a CAN adapter's bit rate and state, as the kernel reports them."""
    name = bus.channel
    rate = data.get("bittiming", {}).get("bitrate")
    state = str(data.get("state", "unknown"))
    if rate is not None and rate != bus.bitrate_bit_s:
        yield HostCheck(
            subject, "fail", f"{name} runs at {rate} bit/s, the deployment has {bus.bitrate_bit_s}", bring_up
        )
    if state == "BUS-OFF":
        yield HostCheck(
            subject, "fail", f"{name} is bus-off", f"check wiring, termination, bit rate; then {bring_up}"
        )
    elif state in ("ERROR-WARNING", "ERROR-PASSIVE"):
        yield HostCheck(
            subject,
            "warn",
            f"{name} is {state}",
            "check wiring, termination (120 ohm at both ends), bit rate",
        )
    elif rate in (None, bus.bitrate_bit_s):
        yield HostCheck(
            subject, "ok", f"{name} is up, {state}" + (f", {rate} bit/s" if rate is not None else "")
        )
    if not data.get("restart_ms") and state != "BUS-OFF":
        yield HostCheck(subject, "warn", f"{name} does not restart after a bus-off", bring_up)


def _check_multicast(subject: str, bus: config.Bus) -> HostCheck:
    group, port = str(bus.channel), bus.options.get("port", UDP_MULTICAST_PORT)
    try:
        check_multicast_route(group)
    except NoRouteError as error:
        return HostCheck(subject, "fail", str(error), error.remedy)
    return HostCheck(subject, "ok", f"{group} port {port} has a route")


def _check_serial_device(subject: str, bus: config.Bus) -> Iterator[HostCheck]:
    device = str(bus.channel).split("@")[0]
    if importlib.util.find_spec("serial") is None:
        yield HostCheck(subject, "fail", f"{bus.interface} needs pyserial", extra_command("slcan"))
    if not Path(device).exists():
        yield HostCheck(subject, "fail", f"no device {device}", "plug the adapter in")
    elif not os.access(device, os.R_OK | os.W_OK):
        yield HostCheck(subject, "fail", f"{device}: permission denied", "add the user to the group dialout")
    else:
        yield HostCheck(subject, "ok", f"{device} exists")


def _check_ipc_endpoint(subject: str, path: Path) -> HostCheck:
    """Check an ipc endpoint: a stale socket file is ok, one that accepts connections is in use."""
    folder = path.parent
    if not folder.is_dir():
        return HostCheck(
            subject,
            "fail",
            f"no folder {folder}",
            f"mkdir -p {folder}; the service handtouch@NAME creates /run/handtouch/NAME itself",
        )
    if path.exists() and not path.is_socket():
        remedy = "choose a path in [daemon] that doesn't exist; the daemon replaces sockets only"
        return HostCheck(subject, "fail", f"{path} is a file", remedy)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
            return HostCheck(subject, "fail", f"ipc://{path} is in use", _ENDPOINT_IN_USE_REMEDY)
        except (FileNotFoundError, ConnectionRefusedError):
            pass
        except OSError as error:
            detail = f"ipc://{path}: {str(error.strerror or error).lower()}"
            remedy = "change its permissions, or choose another path in [daemon]"
            return HostCheck(subject, "fail", detail, remedy)
    if not os.access(folder, os.W_OK | os.X_OK):
        return HostCheck(
            subject, "fail", f"{folder} is not writable", f"give this user write permission: ls -ld {folder}"
        )
    return HostCheck(subject, "ok", f"ipc://{path} is free")
