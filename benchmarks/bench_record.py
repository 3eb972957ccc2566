"""Cost of recording: processor time of daemon and recorder, disk space, losses; speed of replay.

The daemon's pipeline and its two streams at 500 Hz with 15 pads, fed with the counts of a simulated hand as
from a bus; the recorder is the real `handtouch record`, a process of its own, and every recording is replayed
by `handtouch replay`, which must give equal contacts bit for bit. Results are processor time and bytes per
tick, which depend little on other load of the machine. Writes docs/benchmarks/record.{md,json}.
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

from benchmarks.bench_latency import PATHS, machine
from benchmarks.page import made_by, options, output_folder
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.config.files import deployment_files
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import Publisher
from handtouch.host.build import build_info
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family
from handtouch.wire import PadState

RATE_HZ = 500
PERIOD_NS = 1_000_000_000 // RATE_HZ
FILM_S = 2.0
MODES: dict[str, list[str] | None] = {"none": None, "record": [], "record --hand": ["--hand"]}
"""Subscriber -> options of the recorder, None: no recorder."""
SERVICE_TICKS = RATE_HZ // 2
_START_S = 2.0


def film(deployment: Deployment, touched: int) -> NDArray[np.int64]:
    """Return counts (k, pads, 4), a sample each 5 ms, of contacts sliding on some pads."""
    links = [pad.link for hand in deployment.hands for pad in hand.pads]
    touches = "\n".join(
        f'[[touch]]\nlink = "{link}"\nfrom_s = 0\nduration_s = {FILM_S + 1}\nramp_s = 0.4\nforce_n = [1.5]\n'
        f"radius_mm = 2.5\npath = {PATHS['sliding']}"
        for link in links[:touched]
    )
    hand = VirtualHand(deployment, Scenario.parse(touches), WORLDS["ideal"].draw(Family.REPORTING.seed(1)))
    there = np.stack([hand.sample(t_s) for t_s in np.arange(0.5, 0.5 + FILM_S, 5e-3)])
    return np.concatenate([there, there[::-1]])


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
        return wire.Service(
            v=wire.SCHEMA_VERSION,
            session=self.publisher.session,
            seq=self._service_seq,
            t_ns=now_ns,
            wall_offset_ns=time.time_ns() - time.monotonic_ns(),
            version="",
            pid=0,
            uptime_s=0.0,
            period_s=1 / RATE_HZ,
            hands=self._hands,
            ticks=self.pipeline.ticks,
            overruns=0,
            rate_hz=RATE_HZ,
            core_compiled=True,
            tick_us={},
            loop={},
            contacts=self.pipeline.tick.contacts.begun_count,
            rejected={},
            process={},
            buses={},
            congestion_episodes=dict(self.publisher.congestion_episodes),
            subscriptions=(),
            retained=False,
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
        "loop_us": 1e6 * loop_s,
        "recorder_us": 1e6 * busy_s / (seconds * RATE_HZ),
        "ticks_hz": result["ticks"] / result["seconds"],
        "mb_per_minute": size / seconds * 60 / 1e6,
        "lost": sum(map(int, re.findall(r"\S+: (\d+) messages lost", summary))),
        "congestion_episodes": loop.publisher.congestion_episodes["complete"],
        "status": process.returncode,
        "compared": result["compared"],
        "equal": result["equal"],
        "replay_times_real": result["ticks"] / RATE_HZ / took_s,
    }


def processor_s(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(touched: list[int], turns: int, seconds: float) -> list[dict[str, Any]]:
    """Measure all cases, `turns` times."""
    deployment = load(shipped.path("utah_mit.toml"))
    rows = []
    for count in touched:
        samples = film(deployment, count)
        with tempfile.TemporaryDirectory(prefix="ht.") as folder:
            loop = Loop(deployment, samples, Path(folder))
            loop.run(1.0)
            for turn in range(turns):
                for mode, options in MODES.items():
                    row: dict[str, Any] = {"touched": count, "subscriber": mode, "turn": turn}
                    if options is None:
                        row["loop_us"] = 1e6 * loop.run(seconds)
                    else:
                        row |= recorded(loop, options, seconds, Path(folder))
                    rows.append(row)
                    print(row, flush=True)
            loop.close()
    return rows


def _median(rows: list[dict[str, Any]], key: str) -> float:
    return float(np.median([row[key] for row in rows]))


def write(results: dict[str, Any], out: Path) -> str:
    """Write the page and return it."""
    rows = results["rows"]
    baseline = {(row["touched"], row["turn"]): row["loop_us"] for row in rows if row["subscriber"] == "none"}
    for row in rows:
        row["relative"] = row["loop_us"] / baseline[row["touched"], row["turn"]]
    lines = []
    for count in sorted({row["touched"] for row in results["rows"]}):
        for mode in MODES:
            of_case = [r for r in rows if (r["touched"], r["subscriber"]) == (count, mode)]
            ratio = _median(of_case, "relative")
            line = f"| {count} | {mode} | {_median(of_case, 'loop_us'):.0f} | {ratio:.2f} "
            if MODES[mode] is None:
                lines.append(f"{line}| | | | | | |")
                continue
            recorder_us = _median(of_case, "recorder_us")
            lines.append(
                f"{line}| {recorder_us:.0f} | {recorder_us * RATE_HZ / 1e6:.0%} "
                f"| {_median(of_case, 'mb_per_minute'):.1f} | {sum(r['lost'] for r in of_case)} "
                f"| {sum(r['equal'] for r in of_case)} of {sum(r['compared'] for r in of_case)} "
                f"| {_median(of_case, 'replay_times_real'):.1f} |"
            )
    turns = 1 + max(row["turn"] for row in rows)
    text = f"""# Recording and replay

A hand of 15 pads at {RATE_HZ} Hz, of which some are touched by sliding contacts. Each case runs
{results["seconds"]:.0f} s, {"once" if turns == 1 else f"{turns} times, and the median is stated"}.
{results["machine"]}; load average when it ended {results["load"]:.1f}.

| touched | subscriber | loop, us a tick | relative | recorder, us a tick | of a core | MB/min | lost \
| equal | replay, times real |
| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
{chr(10).join(lines)}

* *loop* is the daemon's pipeline and streams fed with counts, without a bus: processor time of its thread.
  *relative*: to that without subscriber, which computes no positions and forces and encodes nothing.
* *recorder* is `handtouch record`, a process of its own: its processor time for each tick of the daemon, and
  as a fraction of a core at {RATE_HZ} Hz. MB (10^6 bytes) are of the file on disk, compressed with zstd.
* *lost*: messages missing in the recorder, and messages dropped by the daemon's queue.
* Every recording is replayed: contact messages that are *equal* bit for bit, of all; and recorded
  time over the processor time of `handtouch replay`, start and model included (some {_START_S:.0f} s).

{made_by()}.
"""
    (out / "record.md").write_text(text)
    (out / "record.json").write_text(json.dumps(results, indent=1) + "\n")
    return text


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
    results = {"rows": rows, "seconds": args.seconds, "machine": machine(), "load": os.getloadavg()[0]}
    print(write(results, output_folder(args.quick)))


if __name__ == "__main__":
    main()
