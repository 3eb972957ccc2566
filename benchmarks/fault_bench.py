"""Around a fault campaign: the nodes' cable, a unknown_device, what nodes measure, what the daemon takes.

Public names: `Bench`, `Cable`, `UnknownDevice`, `Resources`, `sampler`, `open_bus`, `PRESSED`.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from benchmarks.bench_latency import CHANNEL, PORT
from handtouch.config import Deployment
from handtouch.device import DeviceBus

S = 1_000_000_000
TPDO = 0x280
PRESSED = ("thumb_distal", "index_distal", "palm_heel")
TOUCH = np.array([900, 700, 800, 600])
LONG_NS = 250_000_000  # a pause that may cost a node its heartbeats


class Cable:
    """The nodes' bus: can be cut, counts the samples that went out, and notes the nodes' pauses."""

    def __init__(self, bus: can.BusABC, period_ns: int) -> None:
        self.silent = False
        self.samples = 0
        self.pauses: list[tuple[int, int, int]] = []  # node id, from, to
        self._bus, self._period_ns = bus, period_ns
        self._last_ns: dict[int, int] = {}

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self.silent:
            return
        self._bus.send(message, timeout)
        node_id = message.arbitration_id - TPDO
        if not 0 < node_id < 128:
            return
        self.samples += len(message.data) == 8
        now_ns = time.monotonic_ns()
        before_ns = self._last_ns.get(node_id, now_ns)
        self._last_ns[node_id] = now_ns
        if now_ns - before_ns > 1.5 * self._period_ns:
            self.pauses.append((node_id, before_ns, now_ns))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = self._bus.recv(timeout)
        return None if self.silent else message

    def paused(self, node_id: int, t_ns: int, lag: float = 0.0) -> bool:
        """Return True if the node's program or SYNC paused at this time, for two periods less `lag`.

        A pad is stale after three, counted from the SYNC of its newest sample, not from its sending. After a
        long pause the node has to be restarted.
        """
        least_ns = (2 - lag) * self._period_ns
        return any(
            node == node_id
            and end - start > least_ns
            and start <= t_ns <= end + (S if end - start > LONG_NS else S // 10)
            for node, start, end in self.pauses
        )


class Resources:
    """Memory, descriptors and threads of a process, once a second."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process, self._pid = process, process.pid
        self.rows: list[tuple[float, int, int, int]] = []

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def look(self, t_ns: int) -> None:
        if self.rows and t_ns * 1e-9 - self.rows[-1][0] < 1:
            return
        if not self.alive:
            raise RuntimeError("the daemon has ended")
        status = Path(f"/proc/{self._pid}/status").read_text()
        rss_kb, threads = (int(re.search(rf"{name}:\s+(\d+)", status)[1]) for name in ("VmRSS", "Threads"))  # type: ignore[index]
        self.rows.append((t_ns * 1e-9, rss_kb, len(os.listdir(f"/proc/{self._pid}/fd")), threads))

    def summary(self) -> dict[str, Any]:
        """The slope is that of the second half, if that is long enough: by then all has happened once."""
        rows = np.array(self.rows)
        late = rows[len(rows) // 2 :]
        slope = np.polyfit(late[:, 0], late[:, 1], 1)[0] * 60 if len(late) > 60 else 0.0
        return {
            "rss_mb": [round(float(v) / 1024, 1) for v in (rows[0, 1], late[0, 1], rows[-1, 1])],
            "rss_kb_per_min": round(float(slope), 1),
            "descriptors": [int(v) for v in (rows[0, 2], late[0, 2], rows[-1, 2], rows[:, 2].max())],
            "threads": [int(v) for v in (rows[0, 3], late[0, 3], rows[-1, 3], rows[:, 3].max())],
        }


class UnknownDevice:
    """Another device on the bus; `pump` sends what is due."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._jobs: dict[int, tuple[Callable[[], can.Message], int, int]] = {}  # fault -> next, period, due

    def start(self, key: int, frame: Callable[[], can.Message], rate_hz: float) -> None:
        self._jobs[key] = (frame, int(S / rate_hz), time.monotonic_ns())

    def stop(self, key: int) -> None:
        self._jobs.pop(key, None)

    @property
    def busy(self) -> bool:
        return bool(self._jobs)

    def pump(self, t_ns: int) -> None:
        for key, (frame, period_ns, due_ns) in list(self._jobs.items()):
            due_ns = max(due_ns, t_ns - 20 * period_ns)
            while due_ns <= t_ns:
                self.send(frame())
                due_ns += period_ns
            self._jobs[key] = (frame, period_ns, due_ns)

    def send(self, message: can.Message) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(message)


@dataclass
class Bench:
    """Devices, bus and frames that faults act on."""

    devices: DeviceBus
    unknown_device: UnknownDevice
    period_ns: int
    cable: Any
    """the nodes' side of the bus, with `silent` to cut it"""


def open_bus(interface: str) -> can.BusABC:
    if interface == "socketcan":
        return can.Bus("vcan0", interface="socketcan", ignore_config=True)
    return can.Bus(CHANNEL, interface="udp_multicast", port=PORT, ignore_config=True)


def sampler(deployment: Deployment, seed: int) -> Any:
    """Counts of all pads: noise, and a steady touch on those that are pressed."""
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    noise = np.random.default_rng(seed)
    pressed = np.array([TOUCH if pad.link in PRESSED else 0 * TOUCH for pad in pads])
    return lambda _: pressed + np.rint(noise.standard_normal((len(pads), 4))).astype(np.int64)
