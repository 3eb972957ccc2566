"""Receive path at the rate of fully loaded buses for a long time: losses, queue length, CPU load.

Without SocketCAN: one and seven in-process buses with 8,500 frames/s each, the capacity of a 1 Mbit/s bus, in
batches a millisecond apart, as from a USB adapter. All write one slab. The processor time is that of the
receiving threads: one sends and enqueues on all buses, one drains them; --seconds sets the duration of each
run. Under `tests/socketcan/vcan-run`: the highest rate of cangen that `Port.drain` and a bare receive loop
each receive without a loss, alternately. Writes docs/benchmarks/soak_bus.{md,json}; exit status 1 if a frame
was lost in-process, or if the port is slower than the bare loop.
"""

from __future__ import annotations

import json
import os
import platform
import select
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from benchmarks.bench_receive_path import FRAME, VCAN, store
from benchmarks.page import made_by, options, output_folder
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.receivers import MAX_QUEUE_FRAMES, grow_receive_buffer
from handtouch.config import Bus
from handtouch.core.slab import Slab

PADS, ID0 = 15, 0x281
FULL_BUS = 8500
AIM = {1: 0.10, 7: 0.50}
BATCH_S = 0.001
RUN_S, TURNS = 2.0, 3
RATES = (2000, 3000, 4000, 6000, 8000, 12000, 16000, 24000, 32000, 48000, 64000)


class Feeder:
    """Fills the queues of in-process buses at a steady rate, in a thread of its own."""

    def __init__(self, buses: list[Any], rate: float) -> None:
        self.sent = 0
        self._buses = buses
        self._rate = rate
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Feeder:
        self._thread.start()
        return self

    @property
    def clock(self) -> int:
        """CPU clock of the thread."""
        return time.pthread_getcpuclockid(self._thread.ident or 0)

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        messages = [
            can.Message(arbitration_id=ID0 + n, data=bytes(8), is_extended_id=False) for n in range(PADS)
        ]
        start, count = time.monotonic(), 0  # frames on each bus
        while not self._stopped.wait(BATCH_S):
            due = int((time.monotonic() - start) * self._rate)
            for bus in self._buses:
                for number in range(count, due):  # `send` makes a deep copy, at three times the cost
                    bus.queue.put(messages[number % PADS])
            self.sent += (due - count) * len(self._buses)
            count = due


def in_process(buses: int, seconds: float) -> dict[str, Any]:
    """Run `buses` fully loaded buses into one slab for `seconds`."""
    slab = Slab(buses * PADS)
    ports = [
        Port.open(Bus(name=f"can{n}", interface="virtual", channel=f"soak{n}"), slab) for n in range(buses)
    ]
    for number, port in enumerate(ports):
        for pad in range(PADS):
            port.route(ID0 + pad, number * PADS + pad)
    receivers: list[Any] = [port._receiver for port in ports]
    busy: list[float] = []
    longest, memory = 0, resident_mb()
    with Feeder([receiver._bus for receiver in receivers], FULL_BUS) as feeder:
        clocks = [feeder.clock, time.CLOCK_THREAD_CPUTIME_ID]
        start = time.monotonic()
        before = [time.clock_gettime(clock) for clock in clocks]
        while time.monotonic() - start < seconds:
            select.select(ports, (), (), 0.1)
            for port, receiver in zip(ports, receivers, strict=True):
                longest = max(longest, len(receiver._queue))
                port.drain()
        busy = [time.clock_gettime(clock) - then for clock, then in zip(clocks, before, strict=True)]
        elapsed_s = time.monotonic() - start
    deadline = time.monotonic() + 5
    while sum(port.counters.frames for port in ports) < feeder.sent and time.monotonic() < deadline:
        for port in ports:
            port.drain()
    grown = resident_mb() - memory
    lost = feeder.sent - sum(port.counters.samples for port in ports)
    overflow = sum(port.counters.overflow for port in ports)
    for port in ports:
        port.close()
    return {
        "buses": buses,
        "seconds": round(elapsed_s, 1),
        "frames": feeder.sent,
        "frames_per_s": round(feeder.sent / elapsed_s),
        "lost": lost,
        "overflow": overflow,
        "longest_queue": longest,
        "queue_limit": MAX_QUEUE_FRAMES,
        "readers_core": round(sum(busy[:-1]) / elapsed_s, 4),
        "drain_core": round(busy[-1] / elapsed_s, 4),
        "core": round(sum(busy) / elapsed_s, 4),
        "aim": AIM[buses],
        "memory_growth_mb": round(grown, 2),
        "machine": machine(),
    }


def resident_mb() -> float:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def port_loop() -> tuple[Callable[[], int], Callable[[], None]]:
    """Open a port on vcan0; return functions that read, returning the frames read, and close it."""
    port = Port.open(Bus(name="port", interface="socketcan", channel="vcan0"), Slab(PADS))
    for pad in range(PADS):
        port.route(ID0 + pad, pad)

    def read() -> int:
        before = port.counters.frames
        select.select([port], (), (), 0.1)
        port.drain()
        return port.counters.frames - before

    return read, port.close


def bare_loop() -> tuple[Callable[[], int], Callable[[], None]]:
    """Open a bare socket likewise, without stamps, counters and checks."""
    bus = can.Bus(interface="socketcan", channel="vcan0")
    sock: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketcanBus has it
    grow_receive_buffer(sock)
    keep, recv, unpack = store(Slab(PADS)), sock.recv, FRAME.unpack

    def read() -> int:
        count = 0
        select.select([sock], (), (), 0.1)
        while True:
            try:
                can_id, _, data = unpack(recv(16, socket.MSG_DONTWAIT))
            except BlockingIOError:
                return count
            keep(can_id, data)
            count += 1

    return read, bus.shutdown


def keeps_up(loop: Callable[[], tuple[Callable[[], int], Callable[[], None]]], rate: int) -> float:
    """Return the frames/s received while cangen sent `rate` a second for RUN_S, 0 if one was lost."""
    read, close = loop()
    batch = max(1, rate // 100)
    count = int(rate * RUN_S)
    start, received, last = time.monotonic(), 0, time.monotonic()
    cangen = subprocess.Popen(
        [
            "cangen",
            "vcan0",
            "-g",
            "10",
            "-c",
            str(batch),
            "-n",
            str(count),
            "-I",
            f"{ID0:X}",
            "-L",
            "8",
            "-p",
            "100",
        ]
    )
    while received < count and time.monotonic() - last < 1.0:
        if new := read():
            received, last = received + new, time.monotonic()
    cangen.wait()
    close()
    return count / (last - start) if received == count else 0.0


def without_loss() -> dict[str, Any]:
    """Find the highest rate of RATES that each loop receives without a loss."""
    best = {"bare": [0.0] * TURNS, "port": [0.0] * TURNS}
    for turn in range(TURNS):
        for name, loop in (("bare", bare_loop), ("port", port_loop)):
            for rate in RATES:
                reached = keeps_up(loop, rate)
                best[name][turn] = max(best[name][turn], reached)
                print(f"{name} {rate:6} requested: {reached:8.0f} frames/s")
                if reached < 0.7 * rate:  # a loss, or cangen can't send faster
                    break
    bare, port = (statistics.median(best[name]) for name in ("bare", "port"))
    return {
        "bare_per_s": round(bare),
        "port_per_s": round(port),
        "ratio": round(port / bare, 3),
        "machine": machine(),
    }


def machine() -> str:
    """Describe the machine."""
    host = os.environ.get("VCAN_RUN", "host")
    return f"{host}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def report(new: dict[str, Any], out: Path) -> None:
    """Add the figures to those of earlier runs."""
    path = out / "soak_bus.json"
    figures: dict[str, Any] = (json.loads(path.read_text()) if path.exists() else {}) | new
    path.write_text(json.dumps(figures, indent=1) + "\n")
    lines = [
        "# Fully loaded buses for a long time",
        "",
        f"In-process buses with {FULL_BUS} frames/s each, all into one slab. CPU loads are those of the",
        "threads: one sends and enqueues on all buses, one drains them.",
        f"{made_by()}.",
        "",
        "| buses | seconds | frames/s | lost | longest queue | limit "
        "| enqueue | drain | CPU | aim | machine |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        "| {buses} | {seconds} | {frames_per_s} | {lost} | {longest_queue} | {queue_limit} "
        "| {readers_core:.1%} | {drain_core:.1%} | {core:.1%} | {aim:.0%} | {machine} |".format(**row)
        for row in figures.get("in_process", [])
    ]
    if "socketcan" in figures:
        lines += [
            "",
            "Highest rate of cangen without a loss on SocketCAN, medians of "
            f"{TURNS} runs; a bare loop reads, looks up and stores:",
            "",
            "| bare loop, frames/s | port, frames/s | ratio | machine |",
            "|---|---|---|---|",
            "| {bare_per_s} | {port_per_s} | {ratio} | {machine} |".format(**figures["socketcan"]),
        ]
    (out / "soak_bus.md").write_text("\n".join(lines) + "\n")


def main() -> int:
    parser = options(__doc__)
    parser.add_argument(
        "--seconds", type=float, default=600.0, help="duration of each in-process run (default: 600)"
    )
    arguments = parser.parse_args()
    seconds, out = 2.0 if arguments.quick else arguments.seconds, output_folder(arguments.quick)
    if VCAN.exists():
        figures = without_loss()
        report({"socketcan": figures}, out)
        print(figures)
        return int(figures["ratio"] < 1 / 1.5)
    rows = []
    for buses in AIM:
        rows.append(in_process(buses, seconds))
        print(rows[-1], flush=True)
    report({"in_process": rows}, out)
    return int(any(row["lost"] or row["overflow"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
