"""`handtouch node` on SocketCAN: time to boot, delay and jitter of samples at SYNC, processor time, by mode.

The real program with two pads on files that stand in for ADCs, on vcan0, under tests/socketcan/vcan-run where
this machine has none. Node, ADCs and the sender of SYNC share the processors. SYNC at 200 Hz comes from the
kernel; a freely running ADC converts at 1000 Hz. TPDOs are timed from the latest SYNC before them, the node's
own log gives the time from SYNC to sample. *Boot*: from the start of the program to the boot-up message of
its last node.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np

from benchmarks.page import Report, options, progress
from benchmarks.served_hand import ProcessorShare
from handtouch import config
from handtouch.config import shipped
from tests.node.stand_in import AdcStandIn, node_text, raw_of_ma

SYNC_HZ, SCAN_HZ = 200.0, 1000.0
BOOT_LIMIT_S = 120.0
MODES = {
    "one-shot": "",
    "buffered, free": f'mode = "buffered"\nrate_hz = {SCAN_HZ}\naverage_scans = 4\n',
    "buffered, triggered": 'mode = "buffered"\ntrigger = "at-sync"\ntimeout_ms = 100.0\n',
}
_TIMING = re.compile(
    r"adc0: sampled ([+-][\d.]+) ms from SYNC, jitter ([\d.]+) ms \(([+-][\d.]+) to ([+-][\d.]+)\)"
)


class Node:
    """The program with the pads of a deployment on stand-ins, each for one way of sampling."""

    def __init__(self, folder: Path, mode: str) -> None:
        self.deployment = config.load(shipped.path("two_finger.toml"))
        self.adcs = [AdcStandIn(folder, number) for number in range(len(self.deployment.pads))]
        text = node_text(self.deployment, folder, "vcan0", more=MODES[mode])
        self._file = folder / "node.toml"
        self._file.write_text(text.replace('"udp_multicast"', '"socketcan"'))
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        values = raw_of_ma([0.5, 0.4, 0.3, 0.2])
        for adc in self.adcs:
            adc.set_raw(values)
        if mode == "buffered, triggered":  # the first trigger serves all: each ADC needs its own
            for number, adc in enumerate(self.adcs):
                adc.add_trigger(f"at-sync{number}", lambda: values)
            numbered = iter(range(len(self.adcs)))
            triggered = re.sub('"at-sync"', lambda _: f'"at-sync{next(numbered)}"', self._file.read_text())
            self._file.write_text(triggered)
        elif mode == "buffered, free":
            self._threads.append(threading.Thread(target=self._convert, args=(values,)))
            self._threads[0].start()
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "handtouch", "node", str(self._file)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        return self.process

    def end(self) -> str:
        """Stop the program; what it logged."""
        assert self.process is not None
        self.process.terminate()
        _, logged = self.process.communicate(timeout=BOOT_LIMIT_S)
        self.process = None
        return logged

    def close(self) -> None:
        if self.process is not None:
            self.end()
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for adc in self.adcs:
            adc.close()

    def _convert(self, values: Sequence[int]) -> None:
        """Convert at SCAN_HZ, as late as this thread is woken."""
        due_ns = time.monotonic_ns()
        while not self._stop.is_set():
            due_ns += round(1e9 / SCAN_HZ)
            time.sleep(max(0.0, 1e-9 * (due_ns - time.monotonic_ns())))
            for adc in self.adcs:
                adc.push(values, time.monotonic_ns())


@contextlib.contextmanager
def node_of(mode: str) -> Iterator[Node]:
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        node = Node(Path(folder), mode)
        try:
            yield node
        finally:
            node.close()


def boot_s(node: Node, bus: can.BusABC) -> float:
    """Time from the start of the program to the boot-up message of its last node."""
    missing = {0x700 + entry.pad.node_id for entry in node.deployment.pads}
    begin_s = time.monotonic()
    node.start()
    while missing:
        message = bus.recv(1.0)
        if message is not None and bytes(message.data) == b"\0":
            missing.discard(message.arbitration_id)
        assert time.monotonic() - begin_s < BOOT_LIMIT_S, "no boot-up message"
    return time.monotonic() - begin_s


def sample_at_sync(node: Node, bus: can.BusABC, seconds: float) -> dict[str, Any]:
    """Start the nodes and SYNC; delays of TPDOs [ms], missing ones, the share of a CPU, the node's timing."""
    assert node.process is not None
    for entry in node.deployment.pads:
        bus.send(can.Message(arbitration_id=0, data=bytes((1, entry.pad.node_id)), is_extended_id=False))
    identifiers = {0x280 + entry.pad.node_id for entry in node.deployment.pads}
    share = ProcessorShare()
    sync = can.Message(arbitration_id=0x80, data=b"", is_extended_id=False)
    sender = bus.send_periodic(sync, 1 / SYNC_HZ)
    delays, syncs, sync_s = [], 0, 0.0
    end_s = time.monotonic() + seconds
    share.start(node.process.pid)
    while time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message is None:
            continue
        if message.arbitration_id == 0x80:
            syncs, sync_s = syncs + 1, message.timestamp
        elif message.arbitration_id in identifiers and syncs:
            delays.append(1e3 * (message.timestamp - sync_s))
    cpu = share.stop()
    sender.stop()
    logged = node.end()
    timing = _TIMING.search(logged.splitlines()[-1])
    assert timing is not None, logged
    late = [float(value) for value in timing.groups()]
    return {
        "SYNCs": syncs,
        "missing TPDOs": len(identifiers) * syncs - len(delays),
        "TPDO after SYNC, median ms": float(np.median(delays)),
        "p99 ms": float(np.quantile(delays, 0.99)),
        "worst ms": max(delays),
        "sample from SYNC, mean ms": late[0],
        "jitter ms (1 sigma)": late[1],
        "earliest to latest ms": f"{late[2]:+.2f} to {late[3]:+.2f}",
        "CPU, %": 100 * cpu,
    }


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="of SYNC in each mode")
    parser.add_argument("--runs", type=int, default=3, help="starts to time")
    asked = parser.parse_args()
    if not Path("/sys/class/net/vcan0").exists() and "VCAN_RUN" not in os.environ:
        root = Path(__file__).parents[1]
        guest = [str(root / "tests/socketcan/vcan-run"), sys.executable, *sys.argv]
        return subprocess.run(guest, cwd=root, check=False).returncode
    if asked.quick:
        asked.seconds, asked.runs = 2.0, 1
    rows, boots = [], []
    filters = [{"can_id": base, "can_mask": 0x780, "extended": False} for base in (0x80, 0x280, 0x700)]
    with can.Bus(
        interface="socketcan", channel="vcan0", can_filters=filters, receive_own_messages=True
    ) as bus:
        for mode in MODES:
            with node_of(mode) as node:
                for _ in range(asked.runs - 1):
                    boots.append(boot_s(node, bus))
                    node.end()
                boots.append(boot_s(node, bus))
                rows.append({"sampling": mode, **sample_at_sync(node, bus, asked.seconds)})
            progress(rows[-1])
    report = Report(asked.quick, vcan_by=os.environ.get("VCAN_RUN", "host"), seconds_of_a_mode=asked.seconds)
    report.table(
        "Boot", [{"starts": len(boots), "median, s": float(np.median(boots)), "worst, s": max(boots)}]
    )
    report.table("Sampling", rows)
    report.keep()
    return 0


if __name__ == "__main__":
    sys.exit(main())
