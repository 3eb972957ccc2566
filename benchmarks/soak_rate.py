"""Soak test of many pads at 1 kHz through the real daemon in one process; rate limits; memory over an hour.

The daemon's hot loop runs in a thread, on in-process buses of 8 pads each with their bounded queues. Its
nodes are simulated ones until they are booted; then each SYNC is answered with messages made before, a tenth
of the pads touched by sliding contacts, while it is sent: their share of a core is measured separately.
With --socket the nodes are a process of their own, which answers over pairs of sockets that carry
`struct can_frame`, PADS_PER_SOCKET pads each: the daemon reads them as it does SocketCAN.

--minutes says how long the run of 60 pads at 1 kHz takes, --hours how much of the memory run, in which
samples of 15 pads at 1 kHz go through pipeline and publisher as fast as they can, contacts
begin and end, and their stamps are the clock. --trial runs a short version of all parts and writes nothing.
Writes docs/benchmarks/soak_rate.{md,json}; exit status 1 if a sample was lost or the memory grows.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import queue
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.bench_latency import PATHS, descriptors, film, machine, resident_mb
from benchmarks.page import made_by, options, output_folder
from benchmarks.socket_nodes import SocketNodes
from handtouch import wire
from handtouch.config import (
    Bus,
    Deployment,
    load,
    shipped,
)
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.publisher import Publisher
from handtouch.device import DeviceBus
from handtouch.wire import PadState

PADS_PER_BUS, PADS_PER_SOCKET = 8, 60
AIM = 0.60
LIMITS: tuple[tuple[int, int], ...] = (
    (30, 500),
    (60, 500),
    (30, 1000),
    (240, 200),
    (60, 1000),
    (120, 500),
    (480, 200),
    (240, 500),
)
"""Pads and SYNC rates [Hz] tried, by their product, to find the overrun of the loop"""
SOCKET_LIMITS = ((60, 1000), (120, 1000), (240, 500), (240, 1000), (480, 500), (480, 1000))
LIMIT_S = 8.0
MISSED = 1e-3
"""Fraction of late samples or skipped periods above which a run counts as overrun"""
PERIOD_NS = 1_000_000
HEARTBEAT_S = 0.1
"""Heartbeat period of a node"""
BOOT_PERIOD_NS = 50_000_000
SAMPLES = 1000
GROWTH_MB_PER_H = 2.0
GIL_SWITCH_S = 0.0005
"""Switch interval that `handtouch run` sets"""
REPORT_PERIOD_S = 15.0


def hands_of(
    pads: int, rate_hz: float, folder: Path, interface: str = "virtual", per_bus: int = PADS_PER_BUS
) -> Deployment:
    """Return a deployment of shipped hands with `per_bus` pads per bus."""
    shipped_hand = load(shipped.path("utah_mit.toml"))
    (hand,) = shipped_hand.hands
    hands = []
    for first in range(0, pads, len(hand.pads)):
        some = tuple(
            pad.model_copy(update={"bus": f"b{n // per_bus}", "node_id": 1 + n % per_bus, "serial": 1000 + n})
            for n, pad in enumerate(hand.pads[: pads - first], first)
        )
        hands.append(hand.model_copy(update={"name": f"h{first}", "pads": some}))
    buses = tuple(
        Bus(name=f"b{n}", interface=interface, channel=f"{folder.name}.{n}")
        for n in range(-(-pads // per_bus))
    )
    endpoints = {name: f"ipc://{folder}/{name}" for name in ("live", "complete", "control", "inputs")}
    own = {**endpoints, "store": str(folder / "calibrations.db")}
    settings = shipped_hand.daemon.model_copy(update={"sync_period_ms": 1e3 / rate_hz, **own})
    return shipped_hand.model_copy(update={"daemon": settings, "buses": buses, "hands": tuple(hands)})


class Nodes:
    """Nodes of a deployment: simulated until `feed`, then SYNC is answered with precomputed frames.

    The answers are put into the daemon's queues from within the sending of SYNC, and so are heartbeats, in
    turns: another thread would share the interpreter with the hot one, and its rests would be measured.
    """

    def __init__(self, deployment: Deployment, samples: NDArray[np.int64]) -> None:
        self._pads = [pad for hand in deployment.hands for pad in hand.pads]
        self._names = [bus.name for bus in deployment.buses]
        self._period_ms = deployment.daemon.sync_period_ms
        self._buses: list[Any] = [can.Bus(bus.channel, interface="virtual") for bus in deployment.buses]
        self._simulated = []
        for name, bus in zip(self._names, self._buses, strict=True):
            devices = DeviceBus(bus, lambda _: np.zeros((PADS_PER_BUS, 4), dtype=np.int64))
            for pad in self._pads:
                if pad.bus == name:
                    devices.add(pad.node_id, serial=pad.serial)
            devices.start()
            self._simulated.append(devices)
        self._answers = [self._answers_of(name, samples.astype("<i2")) for name in self._names]

    def feed(self, daemon: HandtouchDaemon) -> None:
        """Replace the simulated nodes after the daemon has booted them all."""
        for devices in self._simulated:
            devices.stop()
        self._receivers: list[Any] = [port._receiver for port in daemon.ports.values()]
        for receiver, bus, answers in zip(self._receivers, self._buses, self._answers, strict=True):
            answers.inbox = receiver._bus.queue
            bus.channel[bus.channel.index(bus.queue)] = bus.queue = answers

    @property
    def answered(self) -> int:
        """Number of SYNC frames."""
        return min(answers.count for answers in self._answers)

    def busy_s(self) -> float:
        """Time spent answering."""
        return 1e-9 * sum(answers.busy_ns for answers in self._answers)

    def waiting(self) -> int:
        """Frames waiting for the daemon on the bus that has most."""
        return max(len(receiver._queue) for receiver in self._receivers)

    def stop(self) -> None:
        """Stop answering."""
        for devices in self._simulated:
            devices.stop()
        for bus in self._buses:
            bus.shutdown()

    def _answers_of(self, name: str, data: NDArray[np.int16]) -> Answers:
        """Return the nodes of one bus, with samples (k, pads, 4)."""
        numbers = [(n, pad.node_id) for n, pad in enumerate(self._pads) if pad.bus == name]
        frames = [[frame(0x280 + node_id, row[n].tobytes()) for n, node_id in numbers] for row in data]
        alive = [frame(0x700 + node_id, b"\x05") for _, node_id in numbers]
        return Answers(frames, alive, max(len(alive), round(HEARTBEAT_S * 1e3 / self._period_ms)))


class Answers(queue.Queue[can.Message]):
    """Stand-in for the nodes of a bus, once the daemon's `inbox` is known."""

    inbox: Any

    def __init__(
        self, frames: list[list[can.Message]], alive: list[can.Message], heartbeat_syncs: int
    ) -> None:
        super().__init__()
        self._frames, self._alive, self._heartbeat_syncs = frames, alive, heartbeat_syncs
        self.count = self.busy_ns = 0

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:  # noqa: ARG002
        """Handle a frame from the daemon."""
        if item.arbitration_id != 0x80:
            return
        start_ns = time.perf_counter_ns()
        put = self.inbox.put
        for answer in self._frames[self.count % len(self._frames)]:
            put(answer)
        turn = self.count % self._heartbeat_syncs
        if turn < len(self._alive):
            put(self._alive[turn])
        self.count += 1
        self.busy_ns += time.perf_counter_ns() - start_ns


def frame(can_id: int, data: bytes) -> can.Message:
    """Return a frame of a node."""
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def touches(pads: int, part: float) -> NDArray[np.int64]:
    """Return counts (k, pads, 4) with a fraction of the pads touched by sliding contacts, out of phase."""
    deployment = load(shipped.path("utah_mit.toml"))
    kilohertz = deployment.daemon.model_copy(update={"sync_period_ms": 1.0})
    touched = np.linspace(0, pads - 1, round(part * pads)).astype(int).tolist()
    a_hand = len(deployment.hands[0].pads)
    of_hand = sorted({n % a_hand for n in touched})
    one = film(deployment.model_copy(update={"daemon": kilohertz}), PATHS["sliding"], of_hand)[:SAMPLES]
    there_and_back = np.concatenate([one, one[::-1]])
    noise = np.random.default_rng(1)
    counts = np.rint(noise.standard_normal((len(there_and_back), pads, 4))).astype(np.int64)
    for n in touched:
        counts[:, n] += np.roll(there_and_back[:, n % a_hand], 7 * n, axis=0)
    return counts


def served(pads: int, rate_hz: int, seconds: float, socket: bool = False) -> dict[str, Any]:
    """Run the daemon at this rate for a time, with its nodes in process or beyond sockets."""
    with tempfile.TemporaryDirectory(prefix="ht.") as folder, ExitStack() as opened:
        nodes: Nodes | SocketNodes
        if socket:
            deployment = hands_of(pads, rate_hz, Path(folder), "socketcan", PADS_PER_SOCKET)
            nodes = SocketNodes(deployment, touches(pads, 0.1))
        else:
            deployment = hands_of(pads, rate_hz, Path(folder))
            nodes = Nodes(deployment, touches(pads, 0.1))
        opened.callback(nodes.stop)
        daemon = opened.enter_context(HandtouchDaemon.open(deployment))
        period_ns = daemon.sync.period_ns
        daemon.sync.set_period(BOOT_PERIOD_NS, time.monotonic_ns())
        stop = threading.Event()
        thread = threading.Thread(target=daemon.run, args=(stop,), name="hot")
        thread.start()
        opened.callback(thread.join)
        opened.callback(stop.set)
        reader = multiprocessing.Process(target=read, args=(deployment.daemon.live,), daemon=True)
        reader.start()
        opened.callback(reader.join)
        opened.callback(reader.terminate)
        wait_until_up(daemon)
        nodes.feed(daemon)
        daemon.sync.set_period(period_ns, time.monotonic_ns())
        time.sleep(2.0)
        return watch(daemon, nodes, thread, pads, rate_hz, seconds)


def read(endpoint: str) -> None:
    """Run a subscriber to all hands in a process."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.subscribe("hand/")
        socket.connect(endpoint)
        while True:
            socket.recv_multipart()


def wait_until_up(daemon: HandtouchDaemon) -> None:
    """Wait until every node is operational. Raises RuntimeError after a minute."""
    end_s = time.monotonic() + 60
    while np.count_nonzero(daemon.pipeline.node_state) and time.monotonic() < end_s:
        time.sleep(0.05)
    if np.count_nonzero(daemon.pipeline.node_state):
        raise RuntimeError("the nodes never became operational")


def watch(
    daemon: HandtouchDaemon,
    nodes: Nodes | SocketNodes,
    thread: threading.Thread,
    pads: int,
    rate_hz: int,
    seconds: float,
) -> dict[str, Any]:
    """Measure the daemon for a time, while a subscriber reads its hand frames."""
    clock = time.pthread_getcpuclockid(thread.ident or 0)
    counters = [port.counters for port in daemon.ports.values()]

    def totals() -> NDArray[np.int64]:
        tick, bus = daemon.pipeline.tick, [(c.samples, c.overflow) for c in counters]
        samples, overflow = np.sum(bus, axis=0).tolist()
        missed, taken = int(tick.state.missed_sample_counts.sum()), int(tick.state.sample_counts.sum())
        return np.array(
            [nodes.answered, daemon.pipeline.ticks, daemon.sync.overruns, missed, taken, samples, overflow]
        )

    before, busy_s, start_s = totals(), time.clock_gettime(clock), time.monotonic()
    feeding_s = nodes.busy_s()
    longest, reported_s = 0, start_s
    while (now_s := time.monotonic()) - start_s < seconds:
        longest = max(longest, nodes.waiting())
        time.sleep(0.05)
        if now_s - reported_s > REPORT_PERIOD_S:
            reported_s = now_s
            _, ticks, overruns, missed, *_ = (totals() - before).tolist()
            print(
                f"{seconds - now_s + start_s:4.0f} s to go: {ticks} ticks, {overruns} periods skipped, "
                f"{missed} samples late",
                flush=True,
            )
    took_s, busy_s = time.monotonic() - start_s, time.clock_gettime(clock) - busy_s
    feeding_s = nodes.busy_s() - feeding_s
    answered, ticks, overruns, missed, taken, samples, overflow = (totals() - before).tolist()
    return {
        "pads": pads,
        "rate_hz": rate_hz,
        "seconds": round(took_s, 1),
        "touched": round(0.1 * pads),
        "syncs_answered": answered,
        "ticks": ticks,
        "overruns": overruns,
        "missed": missed,
        "samples": samples,
        "samples_taken": taken,
        "lost": max(0, (answered - 2) * pads - samples) + overflow,
        "longest_queue": longest,
        "hot_core": (busy_s - feeding_s) / took_s,
        "generator_core": feeding_s / took_s,
        "sustained": missed <= MISSED * samples
        and overruns <= MISSED * rate_hz * took_s
        and taken >= (1 - 10 * MISSED) * samples,  # no node timed out
    }


def remember(hours: float) -> dict[str, Any]:
    """Measure memory, descriptors and objects while hours of samples pass pipeline and publisher."""
    deployment = load(shipped.path("utah_mit.toml"))
    moving = film(deployment, PATHS["sliding"])
    untouched = np.rint(np.random.default_rng(2).standard_normal((len(moving), *moving.shape[1:])))
    script = np.concatenate([moving, untouched.astype(np.int64)]).astype("<i2")
    rows: list[tuple[float, float, int, int, int]] = []
    with tempfile.TemporaryDirectory(prefix="ht.") as folder, zmq.Context() as context:
        topics, authenticator = wire.topics_of(deployment.links_by_hand), Authenticator(context)
        live, complete = (f"ipc://{folder}/{stream}" for stream in ("live", "complete"))
        publisher = Publisher.open(context, live, complete, topics, authenticator)
        pipeline = Pipeline(PadModel(deployment), PERIOD_NS, 0.8, publisher)
        pipeline.node_state[:] = PadState.CLEAR
        reader = context.socket(zmq.SUB)
        reader.subscribe("")
        reader.connect(publisher.endpoints["complete"])
        time.sleep(0.3)
        publisher.poll_subscriptions(0)
        steps = round(hours * 3600e9 / PERIOD_NS)
        received = 0
        for step in range(steps):
            t_ns = (step + 1) * PERIOD_NS
            pipeline.begin_cycle(t_ns, t_ns)
            sample: bytes = script[step % len(script)].tobytes()
            for pad in range(pipeline.slab.size):
                pipeline.slab.write_pdo(pad, sample[8 * pad : 8 * pad + 8], t_ns + 1000 * pad)
            pipeline.tick_if_due(t_ns + 20_000)
            pipeline.prepare_next_tick()
            while reader.poll(0):
                reader.recv_multipart()
                received += 1
            if step % max(1, steps // 60) == 0:
                objects = sum(gc.get_count())
                rows.append(
                    (t_ns / 3600e9, resident_mb(os.getpid()), descriptors(os.getpid()), objects, received)
                )
                print(f"{step / steps:4.0%} of the hour: {rows[-1][1]:.1f} MB", flush=True)
        begun = pipeline.tick.contacts.begun_count
        episodes = dict(publisher.congestion_episodes)
        reader.close(0)
        publisher.close()
        authenticator.close()
    figures = np.array(rows)
    late = figures[len(figures) // 3 :]  # pools fill at first
    slope = float(np.polyfit(late[:, 0], late[:, 1], 1)[0])
    return {
        "hours": hours,
        "ticks": steps,
        "contacts": begun,
        "messages": received,
        "congestion_episodes": episodes,
        "mb_first": rows[1][1],
        "mb_third": float(late[0, 1]),
        "mb_last": rows[-1][1],
        "mb_per_hour": slope,
        "descriptors": [rows[1][2], rows[-1][2]],
        "collections": [generation["collections"] for generation in gc.get_stats()],
    }


def write(new: dict[str, Any], out: Path) -> str:
    """Return the page, with the stored results of other parts."""
    path = out / "soak_rate.json"
    results = (json.loads(path.read_text()) if path.exists() else {}) | new
    text = ["# Sustained rates of one core, and memory", ""]
    if long := results.get("long"):
        text += [
            "The real daemon in one process with its nodes, eight pads to an in-process bus with a",
            "bounded queue, a tenth of the pads touched by sliding contacts, one subscriber to all",
            "hands. The share of a core is the hot thread's: SYNC, receive, tick, send and all",
            f"other stages, without the nodes that answer in the same thread; the aim is {AIM:.0%}.",
            f"{long['machine']}; load average when it ended {long['load']:.1f}, with the daemon's own.",
            "",
            *table([long]),
        ]
    if long := results.get("long_socket"):
        text += [
            f"Over pairs of sockets that carry `struct can_frame`, {PADS_PER_SOCKET} pads each, with",
            f"the nodes in a process of their own; load average when it ended {long['load']:.1f}:",
            "",
            *table([long]),
        ]
    for key, bus in (("limits", "in-process buses"), ("limits_socket", "pairs of sockets")):
        rows = results.get(key, [])
        if not rows:
            continue
        text += [
            f"Rate limits over {bus}, {LIMIT_S:.0f} s each; overrun is more than {MISSED:.1%} of the samples",
            "late, or of the periods skipped, without a SYNC:",
            "",
            *table(rows),
        ]
        if sustained := [row for row in rows if row["sustained"]]:
            best = max(sustained, key=lambda row: row["pads"] * row["rate_hz"])
            product = best["pads"] * best["rate_hz"]
            text += [
                f"The largest product sustained is {best['pads']} pads at {best['rate_hz']} Hz,",
                f"{product} samples/s: {product / 15:.0f} hands of 15 pads x Hz.",
                "",
            ]
    if memory := results.get("memory"):
        text += [
            "## Memory",
            "",
            f"{memory['hours']:g} h of 15 pads at 1 kHz, compressed: {memory['ticks']} ticks through",
            f"pipeline and publisher, {memory['contacts']} contacts begun, {memory['messages']} messages",
            "received by a subscriber to everything,",
            f"{sum(memory['congestion_episodes'].values())} congestion episodes. Resident",
            f"{memory['mb_first']:.1f} MB at first, {memory['mb_third']:.1f} after a third,",
            f"{memory['mb_last']:.1f} at the end: {memory['mb_per_hour']:+.2f} MB an hour from there on",
            "(least squares). Descriptors",
            f"{memory['descriptors'][0]} and {memory['descriptors'][1]}.",
            "",
        ]
    text.append(f"{made_by()}.")
    (out / "soak_rate.md").write_text("\n".join(text) + "\n")
    path.write_text(json.dumps(results, indent=1) + "\n")
    return "\n".join(text)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return table rows of daemon runs."""
    return [
        "| pads | SYNCs/s | s | ticks | samples | lost | late | skipped | queue | core | generator | |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
        *(
            "| {pads} | {rate_hz} | {seconds} | {ticks} | {samples} | {lost} | {missed} | {overruns} "
            "| {longest_queue} | {hot_core:.0%} | {generator_core:.0%} |".format(**row)
            + (" |" if row["sustained"] else " overrun |")
            for row in rows
        ),
        "",
    ]


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="of 60 pads at 1 kHz; 0: not that")
    parser.add_argument("--hours", type=float, default=1.0, help="of the memory run, compressed; 0: not that")
    parser.add_argument(
        "--limits", action=argparse.BooleanOptionalAction, default=True, help="how far it goes"
    )
    parser.add_argument("--socket", action="store_true", help="over pairs of sockets; without the memory run")
    asked = parser.parse_args()
    sys.setswitchinterval(GIL_SWITCH_S)
    limits, limit_s, out, failed = LIMITS, LIMIT_S, output_folder(asked.quick), False
    kind = ""
    if asked.socket:
        limits, asked.hours, kind = SOCKET_LIMITS, 0.0, "_socket"
    if asked.quick:
        asked.minutes, asked.hours, limits, limit_s = 0.05, min(asked.hours, 0.01), ((30, 500),), 3.0
    if asked.minutes:
        long = served(60, 1000, 60 * asked.minutes, asked.socket) | {
            "machine": machine(),
            "load": os.getloadavg()[0],
        }
        print(long, flush=True)
        failed |= long["lost"] > 0
        write({f"long{kind}": long}, out)
    if asked.limits:
        rows = []
        for pads, rate_hz in limits:
            rows.append(served(pads, rate_hz, limit_s, asked.socket))
            print(rows[-1], flush=True)
        write({f"limits{kind}": rows}, out)
    if asked.hours:
        memory = remember(asked.hours)
        print(memory)
        failed |= (
            memory["mb_per_hour"] > GROWTH_MB_PER_H or memory["descriptors"][0] < memory["descriptors"][1]
        )
        write({"memory": memory}, out)
    print(write({}, out))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
