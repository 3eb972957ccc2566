"""Processor time of the supervisor process: 15 pads at 200 Hz, at rest, in ordinary and in constant use.

The daemon's pipeline and its supervision run in this process, faster than real time; the supervisor's worker
gets the messages that its process would get, and its processor time is measured, that of unpacking, of its
store and of its results included. Hands of the world `default`, reporting family. Writes
docs/benchmarks/supervisor.{md,json}; `--quick` plays a minute of each and writes nothing.
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.compressed_days import InlineSupervisor
from benchmarks.page import made_by, options, output_folder, progress, table
from benchmarks.soak_alarms import Hour
from handtouch.canbus.nodes.spec import SerialChanged
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.simulate.worlds import WORLDS
from handtouch.supervisor.ipc import WorkerConfig
from handtouch.wire import PadState

RATE_HZ = 200
PERIOD_NS = 10**9 // RATE_HZ
FIRST_S = 60.0
"""Time whose share is stated apart: tables are made in it."""
FIRST_SERIAL = 1001
USES = ("at rest", "ordinary use", "all pads in use")


class SteadyHour(Hour):
    """Use that is sampled at the full rate all the time, also at rest."""

    def __init__(self, use: str, seed: int, length_s: float) -> None:
        super().__init__(WORLDS["default"], seed, length_s)
        if use == "ordinary use":
            return
        self.touches.clear()
        self.faults.clear()
        self.busy = []
        if use == "all pads in use":
            self.busy = [(0.0, length_s)]
            for link in self.links:
                self._single(link, 1.0, length_s)

    def _stretches(self) -> Iterator[tuple[float, float, int]]:
        yield 0.0, self.length_s, RATE_HZ


class TimedSupervisor(InlineSupervisor):
    """The supervisor's worker, with the processor time that it has taken."""

    def __init__(self, start: bytes) -> None:
        super().__init__(start)
        self.spent_s = 0.0

    def poll(self, now_ns: int) -> bool:
        """Start the worker, unless it runs; return True if it was started."""
        begin_s = time.process_time()
        started = super().poll(now_ns)
        self.spent_s += time.process_time() - begin_s
        return started

    def send(self, message: bytes) -> bool:
        """Process a message at once."""
        begin_s = time.process_time()
        sent = super().send(message)
        self.spent_s += time.process_time() - begin_s
        return sent


def measure(use: str, seed: int, length_s: float, store: Path) -> dict[str, Any]:
    """Return a row: shares of a core of the first minute and of the rest."""
    hour = SteadyHour(use, seed, length_s)
    model = PadModel(hour.deployment)
    sink: Any = SimpleNamespace(has_subscriber=lambda _: False, send=lambda _: None)
    pipeline = Pipeline(model, PERIOD_NS, 0.8, sink, 1)
    pipeline.node_state[:] = PadState.CLEAR
    config_of = WorkerConfig(
        hour.deployment,
        str(store),
        tuple(model.default_calibration_ids),
        np.array(model.ampere_per_count / model.gains),
        model.noise_counts,
    )
    serials = [FIRST_SERIAL + pad for pad in range(model.size)]
    nodes: Any = SimpleNamespace(status=lambda: [SimpleNamespace(state=None, serial=s) for s in serials])
    process = TimedSupervisor(config_of.dump())
    supervisor = SupervisorClient(hour.deployment, pipeline, nodes, "", process)
    supervisor.start(0)
    process.poll(0)
    events = [SerialChanged(pad, 0, None, serial) for pad, serial in enumerate(serials)]
    supervisor.handle_node_events(events, 0)
    first_s = spent_s = 0.0
    for block in hour.blocks():
        for sync_ns, sample in zip((block.sample_ns[:, 0] + 10**9).tolist(), block.counts, strict=True):
            pipeline.begin_cycle(sync_ns, sync_ns)
            for pad, counts in enumerate(sample.astype("<i2")):
                pipeline.slab.write_pdo(pad, counts.tobytes(), sync_ns + 1000 + 100 * pad)
            pipeline.tick_if_due(sync_ns + PERIOD_NS - 1)
            pipeline.prepare_next_tick()
            supervisor.process_tick(sync_ns + PERIOD_NS - 1)
        if block.sample_ns[-1, 0] < FIRST_S * 1e9:
            first_s = process.spent_s
        spent_s = process.spent_s
    contacts = int(pipeline.tick.contacts.begun_count)
    supervisor.close()
    return {
        "use": use,
        "minutes": length_s / 60,
        "contacts": contacts,
        "in use, %": 100 * sum(until_s - from_s for from_s, until_s in hour.busy) / length_s,
        "first minute, % of a core": 100 * first_s / FIRST_S,
        "then, % of a core": 100 * (spent_s - first_s) / max(length_s - FIRST_S, 1e-9),
    }


NOTE = f"""\
The shipped hand of 15 pads at {RATE_HZ} Hz, also at rest, as if the daemon's idling were disabled. Processor
time (user and system) of what the supervisor process does with the daemon's messages: calibration, storage,
diagnosis. *Ordinary use*: bouts as in [alarms](alarms.md), with rests between. *All pads in use*: each
touched every few seconds. Tables of diagnosis are made in the first minute of contacts."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=20.0, help="of ordinary use (default: 20)")
    asked = parser.parse_args()
    minutes = {"at rest": 3.0, "ordinary use": asked.minutes, "all pads in use": 5.0}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, use in enumerate(USES):
            length_s = 120.0 if asked.quick else 60 * minutes[use]
            rows.append(measure(use, 100 + number, length_s, Path(folder) / f"{number}.db"))
            progress(rows[-1])
    lines = table("Processor time", NOTE, rows)
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}"
    )
    out = output_folder(asked.quick)
    head = ["# Cost of the supervisor process", "", f"{made_by()}; {machine}.", ""]
    (out / "supervisor.md").write_text("\n".join([*head, *lines]))
    (out / "supervisor.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
