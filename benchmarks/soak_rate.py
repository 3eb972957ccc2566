"""Sustained rates of one core: many pads at 1 kHz through the real daemon.

The daemon's hot loop runs in a thread with its nodes, eight pads to an in-process bus with a bounded queue, a
tenth of the pads touched by sliding contacts, one subscriber to all hands. Its nodes are simulated ones until
they are booted; then each SYNC is answered with messages made before, while it is sent: their share of a core
is *generator*. *Core* is the hot thread's: SYNC, receive, tick, send and all other stages. *Sustained*: at
most 0.1 % of the samples late, and of the periods skipped, without a SYNC. Exit status 1 if a sample was
lost.
"""

from __future__ import annotations

import multiprocessing
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

from benchmarks.page import Report, options
from benchmarks.served_hand import PATHS, PreparedAnswers, film
from handtouch.canbus.cia301 import SYNC
from handtouch.config import (
    Bus,
    Deployment,
    load,
    shipped,
)
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.device import DeviceBus

PADS_PER_BUS = 8
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
LIMIT_S = 8.0
MISSED = 1e-3
"""Fraction of late samples or skipped periods above which a run counts as overrun"""
BOOT_PERIOD_NS = 50_000_000
SAMPLES = 1000
GIL_SWITCH_S = 0.0005
"""Switch interval that `handtouch run` sets"""


def hands_of(pads: int, rate_hz: float, folder: Path) -> Deployment:
    """Return a deployment of shipped hands with `PADS_PER_BUS` pads per bus."""
    shipped_hand = load(shipped.path("utah_mit.toml"))
    (hand,) = shipped_hand.hands
    hands = []
    for first in range(0, pads, len(hand.pads)):
        some = tuple(
            pad.model_copy(
                update={"bus": f"b{n // PADS_PER_BUS}", "node_id": 1 + n % PADS_PER_BUS, "serial": 1000 + n}
            )
            for n, pad in enumerate(hand.pads[: pads - first], first)
        )
        hands.append(hand.model_copy(update={"name": f"h{first}", "pads": some}))
    buses = tuple(
        Bus(name=f"b{n}", interface="virtual", channel=f"{folder.name}.{n}")
        for n in range(-(-pads // PADS_PER_BUS))
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
        self._answers = [self._answers_of(name, samples) for name in self._names]

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
        return min(answers.prepared.count for answers in self._answers)

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

    def _answers_of(self, name: str, samples: NDArray[np.int64]) -> Answers:
        """Return the nodes of one bus, with samples (k, pads, 4)."""
        rows = [row for row, pad in enumerate(self._pads) if pad.bus == name]
        ids = [self._pads[row].node_id for row in rows]
        return Answers(PreparedAnswers(ids, samples[:, rows], self._period_ms))


class Answers(queue.Queue[can.Message]):
    """Stand-in for the nodes of a bus, once the daemon's `inbox` is known."""

    inbox: Any

    def __init__(self, prepared: PreparedAnswers) -> None:
        super().__init__()
        self.prepared, self.busy_ns = prepared, 0

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:  # noqa: ARG002
        """Handle a frame from the daemon."""
        if item.arbitration_id != SYNC:
            return
        start_ns = time.perf_counter_ns()
        put = self.inbox.put
        for answer in self.prepared.next():
            put(answer)
        self.busy_ns += time.perf_counter_ns() - start_ns


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


def served(pads: int, rate_hz: int, seconds: float) -> dict[str, Any]:
    """Run the daemon at this rate for a time, with its nodes in process."""
    with tempfile.TemporaryDirectory(prefix="ht.") as folder, ExitStack() as opened:
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
    nodes: Nodes,
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
    longest = 0
    while time.monotonic() - start_s < seconds:
        longest = max(longest, nodes.waiting())
        time.sleep(0.05)
    took_s, busy_s = time.monotonic() - start_s, time.clock_gettime(clock) - busy_s
    feeding_s = nodes.busy_s() - feeding_s
    answered, ticks, overruns, missed, taken, samples, overflow = (totals() - before).tolist()
    return {
        "pads": pads,
        "SYNCs/s": rate_hz,
        "s": took_s,
        "ticks": ticks,
        "samples": samples,
        "lost": max(0, (answered - 2) * pads - samples) + overflow,
        "late": missed,
        "skipped": overruns,
        "queue": longest,
        "core, %": 100 * (busy_s - feeding_s) / took_s,
        "generator, %": 100 * feeding_s / took_s,
        "sustained": missed <= MISSED * samples
        and overruns <= MISSED * rate_hz * took_s
        and taken >= (1 - 10 * MISSED) * samples,  # no node timed out
    }


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=5.0, help="of 60 pads at 1 kHz")
    asked = parser.parse_args()
    sys.setswitchinterval(GIL_SWITCH_S)
    limits, limit_s = LIMITS, LIMIT_S
    if asked.quick:
        asked.minutes, limits, limit_s = 0.05, ((30, 500),), 3.0
    report = Report(asked.quick)
    long = served(60, 1000, 60 * asked.minutes)
    report.table("For a long time", [long])
    report.table("How far it goes", [served(pads, rate_hz, limit_s) for pads, rate_hz in limits])
    report.limit("samples lost", long["lost"], 0)
    report.limit("of a core", long["core, %"], 100 * AIM, "%")
    report.keep()
    return int(long["lost"] > 0)


if __name__ == "__main__":
    sys.exit(main())
