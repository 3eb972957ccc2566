"""`handtouch doctor [CONFIG]`: what this machine lacks to serve a deployment, and how to mend it.

Public names: `run`, `Finding`, `examine`. Without a deployment the machine alone is looked at, and the
endpoints are the default ones. It looks only: nothing is configured, no frame is sent.
"""

from __future__ import annotations

import errno
import importlib.metadata
import importlib.util
import json as json_text
import os
import platform
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import zmq

from handtouch import config, keys
from handtouch.canbus.bus.receivers import RECEIVE_BUFFER_BYTES
from handtouch.daemon import realtime

State = Literal["ok", "warn", "fail"]
_TAKEN = "is a daemon running (`handtouch status`)? Else choose another in [daemon]"
EXACT_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")


@dataclass(frozen=True)
class Finding:
    """One thing looked at: how it is, and in words what to do about it."""

    subject: str
    state: State
    detail: str
    remedy: str = ""


@dataclass(frozen=True)
class Machine:
    """Where to look; tests look elsewhere."""

    proc: Path = Path("/proc")
    sys: Path = Path("/sys")

    def number(self, name: str) -> int | None:
        """A sysctl by its path below /proc/sys."""
        try:
            return int((self.proc / "sys" / name).read_text())
        except (OSError, ValueError):
            return None

    def link(self, name: str) -> dict[str, Any] | None:
        """What `ip -details -json link` says of an interface; None without iproute2."""
        try:
            done = subprocess.run(
                ["ip", "-details", "-json", "link", "show", "dev", name],
                capture_output=True,
                text=True,
                timeout=10,
                check=False,
            )
            answer = json_text.loads(done.stdout) if done.returncode == 0 else []
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return None
        return next((dict(link) for link in answer if link), None)


def run(path: Path | None, json: bool) -> int:
    """Print the findings; exit status 0, 1 if something fails, 2 if the deployment can't be read."""
    deployment = None
    if path is not None:
        try:
            deployment = config.load(path)
        except config.ConfigError as error:
            print(error, file=sys.stderr)
            return 2
    findings = list(examine(deployment))
    if json:
        print(json_text.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            print(f"{finding.state:<5} {finding.subject}: {finding.detail}")
            if finding.remedy:
                print(f"      -> {finding.remedy}")
    return 1 if any(finding.state == "fail" for finding in findings) else 0


def examine(deployment: config.Deployment | None, machine: Machine | None = None) -> Iterator[Finding]:
    """Everything that can be looked at."""
    machine = machine or Machine()
    yield from python_findings()
    yield from clock_findings(machine)
    yield from buffer_findings(machine)
    for bus in deployment.buses if deployment else ():
        yield from bus_findings(bus, machine)
    yield from endpoint_findings(deployment.daemon if deployment else config.Daemon())
    yield from key_findings(deployment.daemon if deployment else config.Daemon())
    yield from realtime_findings(deployment.daemon if deployment else config.Daemon())


def realtime_findings(daemon: config.Daemon) -> Iterator[Finding]:
    """Whether a daemon of this user gets the priority, processors and memory that it asks for."""
    if not (daemon.realtime_priority or daemon.cpus or daemon.lock_memory):
        return
    troubles = realtime.troubles(daemon)
    for trouble in troubles:
        yield Finding("real time", "warn", *trouble.split("; ", 1))
    if not troubles:
        yield Finding("real time", "ok", "priority, processors and memory as [daemon] asks")


def key_findings(daemon: config.Daemon) -> Iterator[Finding]:
    """Whether the daemon could use its keys, and whether there is the cryptography for any."""
    if not zmq.has("curve"):
        state: State = "fail" if daemon.keys else "warn"
        yield Finding(
            "keys", state, "this pyzmq was built without CURVE", "pip install --force-reinstall pyzmq"
        )
    elif daemon.keys:
        clients, problems = keys.clients_in(Path(daemon.keys))
        try:
            keys.load_server(Path(daemon.keys))
        except keys.KeysError as error:
            problems.insert(0, str(error))
        for problem in dict.fromkeys(problems):
            yield Finding("keys", "fail", *problem.split(": ", 1))
        if not problems:
            yield Finding("keys", "ok", f"{daemon.keys} lets {len(clients)} clients in")


def python_findings() -> Iterator[Finding]:
    """Python and the packages that handtouch requires."""
    yield Finding("python", "ok", f"{platform.python_version()} in {sys.prefix}")
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
        yield Finding("packages", "fail", f"missing: {', '.join(missing)}", "pip install handtouch again")
    else:
        yield Finding("packages", "ok", ", ".join(found))


def clock_findings(machine: Machine) -> Iterator[Finding]:
    """The clock that stamps samples: a slow source costs microseconds a frame."""
    place = machine.sys / "devices/system/clocksource/clocksource0/current_clocksource"
    try:
        source = place.read_text().strip()
    except OSError:
        yield Finding("clock", "warn", "clock source unknown", f"look why {place} can't be read")
        return
    if source in EXACT_CLOCKS:
        yield Finding("clock", "ok", source)
    else:
        yield Finding(
            "clock", "warn", f"{source} is slow to read", "see why the kernel distrusts tsc (dmesg)"
        )


def buffer_findings(machine: Machine) -> Iterator[Finding]:
    """The room for frames that wait: the default holds 17 ms of a busy bus."""
    limit = machine.number("net/core/rmem_max")
    if limit is None:
        yield Finding("receive buffer", "warn", "net.core.rmem_max can't be read", "look into /proc/sys")
    elif limit >= RECEIVE_BUFFER_BYTES or _has_net_admin(machine):
        yield Finding("receive buffer", "ok", f"{RECEIVE_BUFFER_BYTES >> 10} KiB may be had")
    else:
        yield Finding(
            "receive buffer",
            "warn",
            f"limited to {limit >> 10} of {RECEIVE_BUFFER_BYTES >> 10} KiB: a busy machine loses frames",
            f"sysctl -w net.core.rmem_max={RECEIVE_BUFFER_BYTES} (services/install.sh makes it last)",
        )


def bus_findings(bus: config.Bus, machine: Machine) -> Iterator[Finding]:
    """One bus of the deployment."""
    subject = f"bus {bus.name}"
    if bus.interface == "socketcan":
        yield from _socketcan_findings(subject, bus, machine)
    elif bus.interface == "udp_multicast":
        yield _multicast_finding(subject, bus)
    elif bus.interface == "virtual":
        yield Finding(
            subject,
            "warn",
            "virtual reaches no other process",
            "use it inside one program only; udp_multicast connects processes",
        )
    elif str(bus.channel).startswith("/dev/"):
        yield from _device_findings(subject, bus)
    else:
        yield Finding(subject, "ok", f"{bus.interface} {bus.channel}: not looked into")


def endpoint_findings(daemon: config.Daemon) -> Iterator[Finding]:
    """Whether the daemon could bind its endpoints."""
    for name in ("live", "complete", "control", "inputs"):
        endpoint = getattr(daemon, name)
        subject = f"endpoint {name}"
        if endpoint.startswith("ipc://"):
            yield _ipc_finding(subject, Path(endpoint.removeprefix("ipc://")))
        elif trouble := _trouble_binding(endpoint):
            yield Finding(subject, "fail", f"{endpoint}: {trouble}", _TAKEN)
        else:
            yield Finding(subject, "ok", f"{endpoint} is free")


def _socketcan_findings(subject: str, bus: config.Bus, machine: Machine) -> Iterator[Finding]:
    if trouble := _trouble_opening_raw():  # no interface could mend that
        yield Finding(subject, "fail", *trouble)
        return
    name = str(bus.channel)
    bring_up = f"ip link set {name} up type can bitrate {bus.bitrate_bit_s} restart-ms 100"
    if not (machine.sys / "class/net" / name).exists():
        yield Finding(
            subject,
            "fail",
            f"there is no interface {name}",
            "plug the adapter in and load its driver; without one: ip link add "
            f"{name} type vcan && ip link set {name} up",
        )
        return
    link = machine.link(name)
    if link is None:
        yield Finding(subject, "warn", f"{name} is there; its state is unknown", "install iproute2")
        return
    if "UP" not in link.get("flags", []):
        yield Finding(subject, "fail", f"{name} is down", bring_up)
        return
    info = link.get("linkinfo", {})
    if info.get("info_kind") == "vcan":
        yield Finding(subject, "ok", f"{name} is up (vcan)")
        return
    data = info.get("info_data", {})
    yield from _adapter_findings(subject, bus, data, f"ip link set {name} down; {bring_up}")


def _adapter_findings(
    subject: str, bus: config.Bus, data: dict[str, Any], bring_up: str
) -> Iterator[Finding]:
    """A real adapter, by what the kernel tells of it."""
    name = bus.channel
    rate = data.get("bittiming", {}).get("bitrate")
    state = str(data.get("state", "unknown"))
    if rate is not None and rate != bus.bitrate_bit_s:
        yield Finding(
            subject, "fail", f"{name} runs at {rate} bit/s, the deployment says {bus.bitrate_bit_s}", bring_up
        )
    if state == "BUS-OFF":
        yield Finding(
            subject, "fail", f"{name} is bus-off", f"check wiring, termination, bit rate; then {bring_up}"
        )
    elif state in ("ERROR-WARNING", "ERROR-PASSIVE"):
        yield Finding(
            subject,
            "warn",
            f"{name} is {state}",
            "check wiring, termination (120 ohm at both ends), bit rate",
        )
    elif rate in (None, bus.bitrate_bit_s):
        yield Finding(
            subject, "ok", f"{name} is up, {state}" + (f", {rate} bit/s" if rate is not None else "")
        )
    if not data.get("restart_ms") and state != "BUS-OFF":
        yield Finding(subject, "warn", f"{name} stays off after a bus-off", bring_up)


def _trouble_opening_raw() -> tuple[str, str] | None:
    """Why a raw CAN socket can't be had, with the remedy."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno in (errno.EPERM, errno.EACCES):
            return (
                "raw CAN sockets are not allowed here",
                "start it outside the sandbox, or allow AF_CAN in it",
            )
        return (
            f"the kernel has no SocketCAN ({error.strerror})",
            "modprobe can_raw; where the kernel is built without it, as in many containers, another "
            "interface works: --bus NAME=udp_multicast:239.74.163.2, or slcan with a serial adapter",
        )
    return None


def _multicast_finding(subject: str, bus: config.Bus) -> Finding:
    group, port = str(bus.channel), bus.options.get("port", 43113)
    family = socket.AF_INET6 if ":" in group else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((group, int(port)))  # sends nothing, asks the routing table
    except (OSError, OverflowError, ValueError) as error:
        return Finding(subject, "fail", f"no route to {group}: {error}", "ip route add 239.0.0.0/8 dev lo")
    return Finding(subject, "ok", f"{group} port {port} has a route")


def _device_findings(subject: str, bus: config.Bus) -> Iterator[Finding]:
    device = str(bus.channel).split("@")[0]
    if importlib.util.find_spec("serial") is None:
        yield Finding(subject, "fail", f"{bus.interface} needs pyserial", "pip install 'handtouch[slcan]'")
    if not Path(device).exists():
        yield Finding(subject, "fail", f"there is no {device}", "plug the adapter in")
    elif not os.access(device, os.R_OK | os.W_OK):
        yield Finding(subject, "fail", f"{device} may not be opened", "add the user to the group dialout")
    else:
        yield Finding(subject, "ok", f"{device} is there")


def _ipc_finding(subject: str, path: Path) -> Finding:
    """A socket file: one that a daemon has left behind is in nobody's way, one that answers is taken."""
    folder = path.parent
    if not folder.is_dir():
        return Finding(
            subject,
            "fail",
            f"there is no folder {folder}",
            f"mkdir -p {folder}; the service handtouch@NAME makes /run/handtouch/NAME by itself",
        )
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
            return Finding(subject, "fail", f"ipc://{path}: somebody answers there", _TAKEN)
        except (FileNotFoundError, ConnectionRefusedError):
            pass
        except OSError as error:
            told = f"ipc://{path}: {str(error.strerror or error).lower()}"
            return Finding(subject, "fail", told, "give its rights, or choose another path in [daemon]")
    if not os.access(folder, os.W_OK | os.X_OK):
        return Finding(
            subject, "fail", f"{folder} can't be written", f"give this user its rights: ls -ld {folder}"
        )
    return Finding(subject, "ok", f"ipc://{path} is free")


def _trouble_binding(endpoint: str) -> str | None:
    with zmq.Context() as context, context.socket(zmq.PUB) as probe:
        try:
            probe.bind(endpoint)  # knows names of interfaces too
        except zmq.ZMQError as error:
            return str(error.strerror).lower()
    return None


def _has_net_admin(machine: Machine) -> bool:
    """CAP_NET_ADMIN (bit 12) is effective: socket buffers may exceed rmem_max."""
    try:
        status = (machine.proc / "self/status").read_text()
    except OSError:
        return False
    found = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    return found is not None and bool(int(found[1], 16) >> 12 & 1)
