"""Cost of a received frame: `Port.drain` against a bare receive-and-store loop on the same interface.

For in-process buses and udp_multicast or, with a vcan0, SocketCAN. Bursts of samples are sent on the bus, and
the time until the last one is in the slab is measured (in-process: processor time, from putting them into the
bus's queue). The bare loop reads with the cheapest call for the interface, looks up the slot and stores data
and arrival time, without counters, checks or routes. Both run alternately. Writes
docs/benchmarks/receive_path.{md,json}.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import select
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from benchmarks.page import made_by, options, output_folder
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.receivers import grow_receive_buffer
from handtouch.config import Bus
from handtouch.core.slab import Slab

PADS, BURST, TURNS = 15, 400, 100
GROUP = "239.74.163.77"
VCAN = Path("/sys/class/net/vcan0")
ID0 = 0x281
FRAME = struct.Struct("=IB3x8s")


def store(slab: Slab) -> Callable[[int, bytes | bytearray], None]:
    """Return the bare loop's store function: slot of the identifier, data, arrival."""
    slots = dict.fromkeys(range(ID0, ID0 + PADS), 0) | {ID0 + slot: slot for slot in range(PADS)}
    data_view, arrival_ns, clock = memoryview(bytearray(8 * PADS)), slab.arrival_ns.data, time.monotonic_ns

    def keep(can_id: int, data: bytes | bytearray) -> None:
        slot = slots[can_id]
        data_view[8 * slot : 8 * slot + 8] = data
        arrival_ns[slot] = clock()

    return keep


def bare_recv(bus: can.BusABC, slab: Slab) -> int:
    """Read with python-can's `recv` until no frame is waiting; return the frames read."""
    keep, recv, count = store(slab), bus.recv, 0
    while (message := recv(0)) is not None:
        keep(message.arbitration_id, message.data)
        count += 1
    return count


def bare_socket(bus: can.BusABC, slab: Slab) -> int:
    """Read from SocketCAN's socket, without stamps, until it is empty; return the frames read."""
    sock: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketcanBus has it
    keep, recv, unpack, count = store(slab), sock.recv, FRAME.unpack, 0
    while True:
        try:
            can_id, _, data = unpack(recv(16, socket.MSG_DONTWAIT))
        except BlockingIOError:
            return count
        keep(can_id, data)
        count += 1


def fill(bus: can.BusABC) -> None:
    """Send one burst at full speed."""
    for number in range(BURST):
        data = number.to_bytes(2, "little") * 4
        bus.send(can.Message(arbitration_id=ID0 + number % PADS, data=data, is_extended_id=False))


def drained(port: Port) -> None:
    """Drain as the daemon does: wait on the descriptor, then read all."""
    target = port.counters.samples + BURST
    while port.counters.samples < target:
        if not select.select([port.fileno()], [], [], 2)[0]:
            raise RuntimeError(f"frames were lost: {port.counters}")
        port.drain()


def in_process(turns: int) -> dict[str, Any]:
    """Measure in-process buses: both include queueing the frames, but not the copies that `send` makes."""
    messages = [
        can.Message(arbitration_id=ID0 + n % PADS, data=bytes(8), is_extended_id=False) for n in range(BURST)
    ]
    slab = Slab(PADS)
    bare, port_us = [], []
    with can.Bus(interface="virtual", channel="bare") as bus:
        port = Port.open(Bus(name="port", interface="virtual", channel="port"), slab)
        route(port)
        inner = port._receiver._bus  # type: ignore[attr-defined]  # to fill its queue

        def through_bare() -> None:
            put(bus, messages)
            check(bare_recv(bus, slab))

        def through_port() -> None:
            put(inner, messages)
            drained(port)

        for _ in range(turns):
            bare.append(cost(through_bare, time.process_time_ns))
            port_us.append(cost(through_port, time.process_time_ns))
        port.close()
    return summary("in-process", bare, port_us)


def put(bus: Any, messages: list[can.Message]) -> None:
    """Put messages into an in-process bus's own queue."""
    for message in messages:
        bus.queue.put(message)


def over_socket(
    name: str, interface: str, channel: str, bare_loop: Callable[[can.BusABC, Slab], int], turns: int
) -> dict[str, Any]:
    """Measure a socket interface; both receivers stay open and each receives every frame."""
    slab = Slab(PADS)
    bare, port_us = [], []
    sender = can.Bus(interface=interface, channel=channel)
    bus = can.Bus(interface=interface, channel=channel)
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        grow_receive_buffer(same)
    port = Port.open(Bus(name="port", interface=interface, channel=channel), slab)
    route(port)
    for _ in range(turns):
        fill(sender)
        bare.append(cost(lambda: check(bare_loop(bus, slab))))
        port_us.append(cost(lambda: drained(port)))
        while sender.recv(0) is not None:  # udp_multicast echoes sent frames
            pass
    port.close()
    bus.shutdown()
    sender.shutdown()
    return summary(name, bare, port_us)


def check(count: int) -> None:
    if count != BURST:
        raise RuntimeError(f"the bare loop read {count} of {BURST} frames")


def route(port: Port) -> None:
    for slot in range(PADS):
        port.route(ID0 + slot, slot)


def cost(work: Callable[[], object], clock: Callable[[], int] = time.perf_counter_ns) -> float:
    """Return the time of a burst in microseconds per frame."""
    start = clock()
    work()
    return (clock() - start) / BURST / 1e3


def summary(name: str, bare: list[float], port: list[float]) -> dict[str, Any]:
    host = os.environ.get("VCAN_RUN", "host")
    row = {
        "interface": name,
        "bare_us": round(statistics.median(bare), 3),
        "port_us": round(statistics.median(port), 3),
        "machine": f"{host}, {platform.machine()}, Python {platform.python_version()}",
        "made_by": made_by(),
        "ratio": round(statistics.median(port) / statistics.median(bare), 3),
    }
    print(f"{name:14} bare {row['bare_us']:6.2f} us  port {row['port_us']:6.2f} us  ratio {row['ratio']:.2f}")
    return row


def report(rows: list[dict[str, Any]], out: Path) -> None:
    """Add the rows to those of earlier runs on other interfaces."""
    path = out / "receive_path.json"
    kept = json.loads(path.read_text())["rows"] if path.exists() else []
    names = {row["interface"] for row in rows}
    rows = [row for row in kept if row["interface"] not in names] + rows
    path.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    lines = [
        "# Cost of a received frame",
        "",
        "`Port.drain` against a bare receive-and-store loop on the same interface, in the same run; medians.",
        "SocketCAN is measured under `tests/socketcan/vcan-run`.",
        "",
        "| interface | bare, us | port, us | ratio | machine | |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        "| {interface} | {bare_us} | {port_us} | {ratio} | {machine} | {made_by} |".format(**row)
        for row in rows
    ]
    (out / "receive_path.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Run in a network namespace of its own, except for SocketCAN."""
    parser = options(__doc__)
    parser.add_argument("--in-namespace", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    turns, out = 3 if asked.quick else TURNS, output_folder(asked.quick)
    if VCAN.exists():
        report([over_socket("socketcan", "socketcan", "vcan0", bare_socket, turns)], out)
        return
    if not asked.in_namespace:
        ready = "ip link set lo up && ip route add 239.0.0.0/8 dev lo"
        rootless = [] if os.geteuid() == 0 else ["--map-root-user"]
        shell = [
            "sh",
            "-c",
            f'{ready} && exec "$@"',
            "sh",
            sys.executable,
            __file__,
            *sys.argv[1:],
            "--in-namespace",
        ]
        sys.exit(subprocess.call(["unshare", "--net", *rootless, *shell]))
    report([in_process(turns), over_socket("udp_multicast", "udp_multicast", GROUP, bare_recv, turns)], out)


if __name__ == "__main__":
    main()
