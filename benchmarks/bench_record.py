"""Recording and replay: processor time of daemon and recorder, disk space, losses; speed of replay.

The daemon's pipeline and its two streams at 500 Hz with 15 pads, some touched by sliding contacts, fed with
the counts of a simulated hand as from a bus. The recorder is the real `handtouch record`, a process of its
own, and every recording is replayed by `handtouch replay`, which must give equal contacts bit for bit. *Loop*
is the processor time of the daemon's thread; *relative*: to that without subscriber, which computes no
positions and forces and encodes nothing. *Recorder*: its processor time for each tick of the daemon. MB (10^6
bytes) are of the file on disk, compressed with zstd. *Lost*: messages missing in the recorder. *Replay*:
recorded time over the processor time of `handtouch replay`, start and model included.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.page import Report, Rows, middle, options
from benchmarks.served_hand import PATHS, film, processor_s
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.config.files import deployment_files
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import Publisher
from handtouch.host.build import build_info
from handtouch.wire import PadState
from tests.client.hand_messages import make_service

RATE_HZ = 500
PERIOD_NS = 1_000_000_000 // RATE_HZ
MODES: dict[str, list[str] | None] = {"none": None, "record": [], "record --hand": ["--hand"]}
"""Subscriber -> options of the recorder, None: no recorder."""
SERVICE_TICKS = RATE_HZ // 2


class Loop:
    """The daemon's loop without a bus; `run` returns the processor time of its thread."""

    def __init__(self, deployment: Deployment, samples: NDArray[np.int64], folder: Path) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        topics = wire.topics_of(deployment.links_by_hand)
        self._authenticator = Authenticator(self._context)
        self.publisher = Publisher.open(
            self._context, f"ipc://{folder}/live", f"ipc://{folder}/complete", topics, self._authenticator
        )
        self.pipeline = Pipeline(PadModel(deployment), PERIOD_NS, 0.6, self.publisher, self.publisher.session)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.publisher.retained_messages.update(self.pipeline.messages.retained_messages())
        self.publisher.retained_messages.update(self.pipeline.journal.retained_messages())
        files = deployment_files(deployment)
        self.pipeline.journal.publish_config(deployment, files, build_info(), time.monotonic_ns())
        self._hands = deployment.links_by_hand
        self._service_seq = 0
        self._film = [[row.astype("<i2").tobytes() for row in sample] for sample in samples]

    def run(self, seconds: float) -> float:
        """Tick at RATE_HZ for some seconds; return the processor time of the thread per tick [s]."""
        pipeline, publisher = self.pipeline, self.publisher
        next_ns = time.monotonic_ns()
        busy_s, ticks = time.thread_time(), round(seconds * RATE_HZ)
        for _ in range(ticks):
            next_ns = max(next_ns + PERIOD_NS, time.monotonic_ns() - PERIOD_NS)
            time.sleep(max(0.0, (next_ns - time.monotonic_ns()) * 1e-9))
            now_ns = time.monotonic_ns()
            pipeline.begin_cycle(now_ns, now_ns)
            for pad, data in enumerate(self._film[pipeline.ticks % len(self._film)]):
                pipeline.slab.write_pdo(pad, data, now_ns + 1)
            pipeline.tick_if_due(now_ns + 2)
            pipeline.prepare_next_tick()
            publisher.poll_subscriptions(now_ns)
            if pipeline.ticks % SERVICE_TICKS == 1:
                publisher.send(self._service(now_ns))
        return (time.thread_time() - busy_s) / ticks

    def close(self) -> None:
        """Close the endpoints."""
        self.publisher.close()
        self._authenticator.close()
        self._context.term()

    def _service(self, now_ns: int) -> wire.Service:
        self._service_seq += 1
        return make_service(
            self._service_seq,
            self.publisher.session,
            t_ns=now_ns,
            wall_offset_ns=time.time_ns() - time.monotonic_ns(),
            period_s=1 / RATE_HZ,
            hands=self._hands,
            ticks=self.pipeline.ticks,
            rate_hz=RATE_HZ,
            congestion_episodes=dict(self.publisher.congestion_episodes),
        )


def recorded(loop: Loop, options: list[str], seconds: float, folder: Path) -> dict[str, Any]:
    """Record for some seconds and replay; return cost, losses and equality."""
    out = folder / f"{time.monotonic_ns()}.mcap"
    command = [sys.executable, "-m", "handtouch"]
    endpoint = ["--endpoint", f"ipc://{folder}/complete"]
    process = subprocess.Popen(
        [*command, "record", "-o", str(out), *endpoint, *options], stderr=subprocess.PIPE, text=True
    )
    while not out.exists():
        loop.run(0.2)
    loop.run(1.0)
    size, busy_s = out.stat().st_size, processor_s(process.pid)
    loop_s = loop.run(seconds)
    time.sleep(1.2)  # the recorder writes once a second
    size, busy_s = out.stat().st_size - size, processor_s(process.pid) - busy_s
    process.send_signal(signal.SIGINT)
    _, summary = process.communicate(timeout=60)
    report = folder / "report.json"
    before_s = os.times().children_user + os.times().children_system
    replayed = subprocess.run(
        [*command, "replay", str(out), "--report", str(report)], capture_output=True, text=True, check=False
    )
    if not report.exists():
        raise RuntimeError(f"replay: {replayed.stderr}\nrecord: {summary}")
    took_s = os.times().children_user + os.times().children_system - before_s
    result = json.loads(report.read_text())
    out.unlink()
    return {
        "loop, us a tick": 1e6 * loop_s,
        "recorder, us a tick": 1e6 * busy_s / (seconds * RATE_HZ),
        "of a core, %": 100 * busy_s / seconds,
        "MB/min": size / seconds * 60 / 1e6,
        "lost": sum(map(int, re.findall(r"\S+: (\d+) messages lost", summary))),
        "compared": result["compared"],
        "equal": result["equal"],
        "replay, times real": result["ticks"] / RATE_HZ / took_s,
    }


def measure(touched: list[int], turns: int, seconds: float) -> Rows:
    """Measure all cases, `turns` times."""
    deployment = load(shipped.path("utah_mit.toml"))
    rows: Rows = []
    alone_us = np.nan
    for count in touched:
        samples = film(deployment, PATHS["sliding"], range(count))
        with tempfile.TemporaryDirectory(prefix="ht.") as folder:
            loop = Loop(deployment, samples, Path(folder))
            loop.run(1.0)
            for turn in range(turns):
                for mode, options in MODES.items():
                    row: dict[str, Any] = {"touched": count, "subscriber": mode, "turn": turn}
                    if options is None:
                        row["loop, us a tick"] = 1e6 * loop.run(seconds)
                    else:
                        row |= recorded(loop, options, seconds, Path(folder))
                    if options is None:
                        alone_us = row["loop, us a tick"]
                    row["relative"] = row["loop, us a tick"] / alone_us
                    rows.append(row)
                    print(row, flush=True)
            loop.close()
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=6.0, help="duration of a case")
    parser.add_argument("--turns", type=int, default=1)
    parser.add_argument("--touched", type=int, nargs="+", default=[1, 5, 15], help="pads that are touched")
    args = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if args.quick:
        args.touched, args.turns, args.seconds = [5], 1, 2.0
    rows = measure(args.touched, args.turns, args.seconds)
    report = Report(args.quick, rate_hz=RATE_HZ, seconds_of_a_case=args.seconds, turns=args.turns)
    report.table("Cases", middle(rows, ("touched", "subscriber")))
    report.limit("messages lost", sum(row.get("lost", 0) for row in rows), 0)
    differing = sum(row["compared"] - row["equal"] for row in rows if "equal" in row)
    report.limit("contacts that replay differently", differing, 0)
    report.keep()


if __name__ == "__main__":
    main()
