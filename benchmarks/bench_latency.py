"""From the last frame of a SYNC to the subscriber: latency, processor share and losses of the real daemon.

Nodes, daemon and subscriber are three processes on a udp_multicast bus over loopback (in a network namespace
of their own where that is to be had). The floor, measured in the same run, is a bare loop in place of the
daemon: it sends SYNC, receives the same frames with the same library, sends a message of the same size when
the last has come, and computes nothing. Writes docs/benchmarks/latency.{md,json}.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import can
import numpy as np
import zmq

from handtouch import shipped
from handtouch.canbus.device import DeviceBus
from handtouch.client import connect, request
from handtouch.config import load
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.world import World

OUT = Path(__file__).parents[1] / "docs" / "benchmarks"
CHANNEL, PORT = "239.74.163.9", 43999
TOUCHED = 5


class StampedBus:
    """A bus that remembers when the last frame of each answer to SYNC was sent."""

    def __init__(self, bus: can.BusABC, last_id: int, stamps: Any) -> None:
        self._bus, self._last_id, self._stamps = bus, last_id, stamps

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == self._last_id:  # before, for it may be answered before `send` returns
            count = int(self._stamps[0])
            self._stamps[1 + count % (len(self._stamps) - 1)] = time.monotonic_ns()
            self._stamps[0] = count + 1
        self._bus.send(message, timeout)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


def open_bus() -> can.BusABC:
    return can.Bus(CHANNEL, interface="udp_multicast", port=PORT, ignore_config=True)


def scenario(links: list[str], touched: int) -> Scenario:
    """`touched` pads pressed for good, each sliding a little so that no two samples are alike."""
    touches = "\n".join(
        f'[[touch]]\nlink = "{link}"\nfrom_s = 0.5\nduration_s = 3600.0\nforce_n = [1.5]\nradius_mm = 2.5\n'
        "path = [[0.4, 0.4], [0.6, 0.6]]"
        for link in links[:touched]
    )
    return Scenario.parse(touches)


def nodes(config: Path, touched: int, stamps: Any, stop: Event) -> None:
    """The simulated nodes, as a process."""
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    virtual = VirtualHand(deployment, scenario([pad.link for pad in pads], touched), World.ideal_parts())
    start_ns = time.monotonic_ns()
    last_id = 0x280 + pads[-1].node_id
    with open_bus() as bus:
        devices = DeviceBus(
            StampedBus(bus, last_id, stamps),  # type: ignore[arg-type]  # it quacks like one
            lambda t_ns: virtual.sample((t_ns - start_ns) * 1e-9),
        )
        for pad in pads:
            devices.add(pad.node_id, serial=pad.serial)
        devices.start()
        stop.wait()
        devices.stop()


def bare_loop(endpoint: str, count: int, size: int, period_s: float, stop: Event) -> None:
    """The floor: receive, store, send; nothing computed. Starts the nodes by NMT, each by its id."""
    context = zmq.Context()
    socket = context.socket(zmq.PUB)
    socket.bind(endpoint)
    slab = bytearray(8 * 128)
    payload = bytes(size)
    with open_bus() as bus:
        booted: set[int] = set()
        while len(booted) < count:
            message = bus.recv(1.0)
            if message is not None and message.arbitration_id > 0x700:
                booted.add(message.arbitration_id - 0x700)
        for node_id in booted:
            bus.send(can.Message(arbitration_id=0, data=[1, node_id], is_extended_id=False))
        next_s = time.monotonic()
        while not stop.is_set():
            time.sleep(max(0.0, next_s - time.monotonic()))
            t_ns = time.monotonic_ns()
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            missing = count
            while missing:
                message = bus.recv(period_s)
                if message is None:
                    break
                if 0x280 < message.arbitration_id < 0x300:
                    start = 8 * (message.arbitration_id - 0x280)
                    slab[start : start + 8] = message.data
                    missing -= 1
            socket.send_multipart([b"hand/floor", t_ns.to_bytes(8, "little") + payload])
            next_s += period_s
    socket.close()
    context.term()


def latencies_us(sent_ns: np.ndarray[Any, Any], received: list[tuple[int, int]]) -> np.ndarray[Any, Any]:
    """From the last frame of each SYNC to the message of the tick that took it in."""
    sync_ns = np.array([sync for sync, _ in received])
    got_ns = np.array([got for _, got in received])
    which = np.searchsorted(sent_ns, sync_ns)
    known = which < len(sent_ns)
    late_us = (got_ns[known] - sent_ns[which[known]]) * 1e-3
    return np.asarray(
        late_us[late_us > 0]
    )  # a message that left without the last frame has none to count from


def measure_floor(config: Path, seconds: float, size: int, period_s: float, pads: int) -> dict[str, Any]:
    endpoint = f"ipc://{config.parent}/floor"
    stamps, stop = multiprocessing.Array("q", 1 + 400_000, lock=False), multiprocessing.Event()
    workers = [
        multiprocessing.Process(target=nodes, args=(config, TOUCHED, stamps, stop)),
        multiprocessing.Process(target=bare_loop, args=(endpoint, pads, size, period_s, stop)),
    ]
    for worker in workers:
        worker.start()
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe("")
    socket.connect(endpoint)
    received: list[tuple[int, int]] = []
    cpu = ProcessorShare()
    end_s = float("inf")
    warm_up = round(1.0 / period_s)
    while time.monotonic() < end_s:
        _, payload = socket.recv_multipart()
        received.append((int.from_bytes(payload[:8], "little"), time.monotonic_ns()))
        if end_s == float("inf") and len(received) == warm_up:
            received.clear()
            cpu.start(workers[1].pid or 0)
            end_s = time.monotonic() + seconds
    share = cpu.stop()
    stop.set()
    for worker in workers:
        worker.join()
    socket.close()
    context.term()
    return summary(latencies_us(np.array(stamps[1 : 1 + stamps[0]]), received), share)


def measure_daemon(config: Path, seconds: float) -> dict[str, Any]:
    deployment = load(config)
    stamps, stop = multiprocessing.Array("q", 1 + 400_000, lock=False), multiprocessing.Event()
    worker = multiprocessing.Process(target=nodes, args=(config, TOUCHED, stamps, stop))
    worker.start()
    daemon = subprocess.Popen([sys.executable, "-m", "handtouch", "run", str(config)])
    received: list[tuple[int, int]] = []
    cpu = ProcessorShare()
    with connect("hand/*", endpoint=deployment.daemon.live, queue=100_000) as messages:
        while messages.recv().state.count(1) != TOUCHED:  # all up and touched
            time.sleep(0)
        before = request("status", endpoint=deployment.daemon.control)
        cpu.start(daemon.pid)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            message = messages.recv()
            received.append((message.t_ns, time.monotonic_ns()))
        share = cpu.stop()
        gaps = messages.gaps
    after = request("status", endpoint=deployment.daemon.control)
    daemon.terminate()
    daemon.wait()
    stop.set()
    worker.join()
    result = summary(latencies_us(np.array(stamps[1 : 1 + stamps[0]]), received), share)
    missed = sum(pad["missed"] for pad in after["pads"]) - sum(pad["missed"] for pad in before["pads"])
    return {
        **result,
        "messages_lost": gaps,
        "samples_missed": missed,
        "overruns": after["service"]["overruns"] - before["service"]["overruns"],
        "tick_us": after["service"]["tick_us"],
    }


class ProcessorShare:
    """Share of one processor that a process takes between `start` and `stop`."""

    def start(self, pid: int) -> None:
        self._pid, self._ticks, self._since_s = pid, self._read(pid), time.monotonic()

    def stop(self) -> float:
        ticks = self._read(self._pid) - self._ticks
        return float(ticks / os.sysconf("SC_CLK_TCK") / (time.monotonic() - self._since_s))

    @staticmethod
    def _read(pid: int) -> int:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return int(fields[11]) + int(fields[12])


def summary(late_us: np.ndarray[Any, Any], share: float) -> dict[str, Any]:
    p50, p99, worst = np.percentile(late_us, [50, 99, 100]).tolist()
    return {"n": len(late_us), "p50_us": p50, "p99_us": p99, "max_us": worst, "processor_share": share}


def write(results: dict[str, Any]) -> str:
    rows = "\n".join(
        f"| {name} | {r['p50_us']:.0f} | {r['p99_us']:.0f} | {r['max_us']:.0f} "
        f"| {100 * r['processor_share']:.0f} % |"
        for name, r in results["runs"].items()
    )
    daemon, floor = results["runs"]["daemon"], results["runs"]["floor"]
    text = f"""# Latency: last frame of a SYNC to the subscriber

{results["pads"]} pads at {results["rate_hz"]:.0f} Hz, {TOUCHED} touched, for {results["seconds"]:.0f} s each.
Nodes, daemon and subscriber are three processes; udp_multicast over loopback, ZeroMQ over ipc.
{results["machine"]}.

| | p50, us | p99, us | worst, us | processor share |
| --- | --- | --- | --- | --- |
{rows}

Ratio to the floor (a bare loop that receives the same frames and sends a message of the same size): median
{daemon["p50_us"] / floor["p50_us"]:.2f}, p99 {daemon["p99_us"] / floor["p99_us"]:.2f}.

Of {daemon["n"]} ticks: {daemon["messages_lost"]} messages lost, {daemon["samples_missed"]} samples missed,
{daemon["overruns"]} overruns. The tick itself, from the last sample read to the last message out: median
{daemon["tick_us"]["p50"]:.0f} us.

Made by `make bench ONLY=latency`.
"""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "latency.md").write_text(text)
    (OUT / "latency.json").write_text(json.dumps(results, indent=1) + "\n")
    return text


def in_own_network() -> None:
    """Run this program again in a network namespace with multicast over loopback, if one can be had."""
    if os.environ.get("HANDTOUCH_BENCH_NETWORK"):
        return
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    inside = 'ip link set lo up && ip route add 239.0.0.0/8 dev lo && exec "$@"'
    try:
        subprocess.run(["unshare", "--net", *user, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return  # then over this host's own network
    os.environ["HANDTOUCH_BENCH_NETWORK"] = "1"
    command = ["unshare", "--net", *user, "sh", "-c", inside, "sh", sys.executable, *sys.argv]
    os.execvp("unshare", command)


def on_loopback(folder: Path, port: int) -> Path:
    """The shipped hand on a udp_multicast bus, its endpoints in `folder`; path of the deployment."""
    endpoints = "\n".join(f'{s} = "ipc://{folder}/{s}"' for s in ("live", "complete", "control", "inputs"))
    text = shipped.path("utah_mit.toml").read_text().replace("[daemon]\n", f"[daemon]\n{endpoints}\n")
    channel = f'channel = "{CHANNEL}"\noptions = {{ port = {port} }}'
    text = text.replace('"socketcan"', '"udp_multicast"').replace('channel = "can0"', channel)
    config = folder / "hand.toml"
    config.write_text(text)
    return config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    asked = parser.parse_args()
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = on_loopback(Path(folder), PORT)
        deployment = load(config)
        period_s = deployment.daemon.sync_period_ms * 1e-3
        pads = sum(len(hand.pads) for hand in deployment.hands)
        runs = {"daemon": measure_daemon(config, asked.seconds)}
        runs["floor"] = measure_floor(config, asked.seconds, 1300, period_s, pads)
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    print(
        write(
            {
                "runs": runs,
                "pads": pads,
                "rate_hz": 1 / period_s,
                "seconds": asked.seconds,
                "machine": machine,
            }
        )
    )


if __name__ == "__main__":
    main()
