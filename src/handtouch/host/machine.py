"""Facts about this machine and this process: kernel parameters, network, routes, resources in use.

Public names: `Machine`, `HostCheck`, `CheckState`, `check_multicast_route`, `NoRouteError`,
`process_statistics` (for `service`).
"""

from __future__ import annotations

import errno
import gc
import json
import logging
import os
import re
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from handtouch.host.logs import BoundedLogHandler

CheckState = Literal["ok", "warn", "fail"]
_NET_ADMIN_BIT = 12
_ANY_PORT = 9


@dataclass(frozen=True)
class HostCheck:
    """Result of one check, with a remedy where it isn't ok."""

    subject: str
    state: CheckState
    detail: str
    remedy: str = ""


class NoRouteError(OSError):
    """No route leads to a multicast group; `remedy` is the command that adds one."""

    def __init__(self, group: str, error: OSError) -> None:
        super().__init__(f"no route to {group}: {error}")
        self.remedy = (
            "ip -6 route add ff00::/8 dev lo table local"
            if ":" in group
            else "ip route add 239.0.0.0/8 dev lo"
        )


def check_multicast_route(group: str) -> None:
    """Raise NoRouteError if the routing table has no route to a multicast address; nothing is sent."""
    family = socket.AF_INET6 if ":" in group else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((group, _ANY_PORT))
    except OSError as error:
        raise NoRouteError(group, error) from error


@dataclass(frozen=True)
class Machine:
    """The kernel's file systems; tests give folders of their own."""

    proc: Path = Path("/proc")
    sys: Path = Path("/sys")

    def read_sysctl(self, name: str) -> int | None:
        """Return a kernel parameter by its path below /proc/sys."""
        try:
            return int((self.proc / "sys" / name).read_text())
        except (OSError, ValueError):
            return None

    def read_link(self, name: str) -> dict[str, Any] | None:
        """Return a network interface as `ip -details -json link` describes it; None without iproute2."""
        try:
            done = subprocess.run(
                ["ip", "-details", "-json", "link", "show", "dev", name],
                capture_output=True,
                text=True,
                timeout=10,
                check=False,
            )
            answer = json.loads(done.stdout) if done.returncode == 0 else []
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return None
        return next((dict(link) for link in answer if link), None)

    def bit_rate(self, name: str) -> int | None:
        """Return the bit rate that `ip link set` has given a SocketCAN interface."""
        link = self.read_link(name) or {}
        rate = link.get("linkinfo", {}).get("info_data", {}).get("bittiming", {}).get("bitrate")
        return rate if isinstance(rate, int) else None

    def restart_ms(self, name: str) -> int | None:
        """Return the delay after which the kernel restarts a SocketCAN interface after bus-off [ms], 0 for
        never; None if unknown, or for an interface that can't go bus-off."""
        info = (self.read_link(name) or {}).get("linkinfo", {})
        return int(info.get("info_data", {}).get("restart_ms", 0)) if info.get("info_kind") == "can" else None

    def raw_socket_problem(self) -> tuple[str, str] | None:
        """Return why a raw CAN socket can't be opened, with the remedy."""
        try:
            socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        except OSError as error:
            if error.errno in (errno.EPERM, errno.EACCES):
                return (
                    "raw CAN sockets are not permitted",
                    "run outside the sandbox, or allow AF_CAN in it",
                )
            return (
                f"the kernel has no SocketCAN ({error.strerror})",
                "modprobe can_raw; if the kernel is built without it, as in many containers, use another "
                "interface: --bus NAME=udp_multicast:239.74.163.2, or slcan with a serial adapter",
            )
        return None

    def has_net_admin(self) -> bool:
        """Check for CAP_NET_ADMIN, with which socket buffers may exceed rmem_max."""
        try:
            status = (self.proc / "self/status").read_text()
        except OSError:
            return False
        found = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
        return found is not None and bool(int(found[1], 16) >> _NET_ADMIN_BIT & 1)


_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def process_statistics() -> dict[str, Any]:
    """Return memory, CPU time (`loop_cpu_s`: of the calling thread), collections and lost log messages."""
    with open("/proc/self/statm", "rb") as statm:
        resident_pages = int(statm.read().split()[1])
    handlers = logging.getLogger().handlers
    log = next((handler for handler in handlers if isinstance(handler, BoundedLogHandler)), None)
    return {
        "memory_bytes": resident_pages * _PAGE_BYTES,
        "cpu_s": time.process_time(),
        "loop_cpu_s": time.thread_time(),
        "collections": [generation["collections"] for generation in gc.get_stats()],
        "log_dropped": log.dropped if log else 0,
        "log_suppressed": log.suppressed if log else 0,
    }
