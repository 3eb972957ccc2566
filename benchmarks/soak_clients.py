"""Soak test of the daemon's sockets: clients that stall, flood and send garbage beside well-behaved ones.

50 clients without keys over TCP, 15 of them hostile; then the same well-behaved ones beside processes that
use as much CPU and don't connect. Status 1 if tick rate or p99 differ by more than 10 %, or memory grows.
ARGS="--minutes 2" sets how long each of the two takes; default 10.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_latency import PORT, descriptors, in_own_network, machine, on_loopback, resident_mb
from benchmarks.client_checks import CHECKED, Truth, longest_age_s, watch_hand, watch_ros
from benchmarks.cycled_processes import scenario_text
from benchmarks.hostile_clients import HOSTILE, burner, cpu_seconds, hostile_client
from benchmarks.page import ROOT, made_by, options, output_folder, progress, table
from handtouch.client import connect, request
from handtouch.config import load

WELL_BEHAVED = 35
READERS_PER_PROCESS = 7
JOINING_S, LEAVING_S = 5.0, 10.0
PATIENCE_S = 300.0  # of a request for `status`, on a machine with other load
SAMPLES_OF_MEMORY = 50
ORDINARY_NICE = 10
"""Nice levels of hostile clients and burners below the others, as `handtouch@.service` puts the daemon before
ordinary processes. Without them, a flood on the same processors takes what the scheduler gives to any busy
process, whatever the daemon does"""
MAX_RATIO = 1.1
MAX_GROWTH_MB = 5.0
"""Growth after a third of the time; until then the queues of stalled subscribers fill"""
HEAD = """| beside | ticks/s | overruns | p50, ms | p99, ms | messages | lost | status | MB | third | last |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def read(endpoint: str, count: int, stop: Event, measure: Event, results: Any) -> None:
    """Run well-behaved subscribers in a process; put their latencies [s] and losses into a queue."""
    late_s: list[float] = []
    with ExitStack() as stack:
        readers = [stack.enter_context(connect("hand/*", endpoint=endpoint)) for _ in range(count)]
        lost_before: list[int] = []
        while not stop.is_set():
            if measure.is_set() and not lost_before:
                lost_before = [reader.lost_messages for reader in readers]
            waited = readers[0].recv(0.1)
            for reader in readers:
                message = waited if reader is readers[0] else reader.recv(0)
                now_ns = time.monotonic_ns()
                if message is not None and lost_before and not message.retained:
                    late_s.append((now_ns - message.t_ns) * 1e-9)
                while reader.recv(0) is not None:
                    pass  # what waited while this process did; its age isn't the daemon's
        lost = [reader.lost_messages for reader in readers]
    results.put((late_s, sum(lost) - sum(lost_before)))


@contextmanager
def running(targets: list[tuple[Callable[..., None], tuple[Any, ...]]]) -> Iterator[tuple[list[int], Event]]:
    """Run functions in processes, their last argument an event that stops them; yield ids and event."""
    stop = multiprocessing.Event()
    started = [multiprocessing.Process(target=call, args=(*given, stop)) for call, given in targets]
    for process in started:
        process.start()
    try:
        yield [process.pid or 0 for process in started], stop
    finally:
        stop.set()
        for process in started:
            process.join(5)
            process.kill()


def run_hostile(kind: str, endpoints: dict[str, str], seed: int, stop: Event) -> None:
    os.nice(ORDINARY_NICE)
    hostile_client(kind, endpoints, stop, seed)


def run_burner(share: float, stop: Event) -> None:
    os.nice(ORDINARY_NICE)
    burner(share, stop)


def run_reader(endpoint: str, measure: Event, results: Any, stop: Event) -> None:
    read(endpoint, READERS_PER_PROCESS, stop, measure, results)


def phase(
    endpoints: dict[str, str],
    own: list[int],
    seconds: float,
    others: list[tuple[Callable[..., None], tuple[Any, ...]]],
) -> dict[str, Any]:
    """Measure the daemon and well-behaved clients beside other processes; `own`: daemon and nodes."""
    pid = own[0]
    results: multiprocessing.Queue[tuple[list[float], int]] = multiprocessing.Queue()
    measure = multiprocessing.Event()
    count = WELL_BEHAVED // READERS_PER_PROCESS
    late_s: list[float] = []
    lost = 0
    readers = [(run_reader, (endpoints["live"], measure, results))] * count
    with running(readers) as (reader_pids, stop_readers), running(others) as (pids, _):
        time.sleep(JOINING_S)
        measure.set()
        before = request("status", endpoint=endpoints["control"], timeout_s=PATIENCE_S)["service"]
        used_s = [cpu_seconds(other) for other in pids]
        memory_mb, begin_s = [], time.monotonic()
        busy_s = outside_seconds([*own, *reader_pids, *pids])
        while (passed_s := time.monotonic() - begin_s) < seconds:
            memory_mb.append((passed_s, resident_mb(pid)))
            if len(memory_mb) % (SAMPLES_OF_MEMORY // 5) == 1:
                progress(f"{passed_s:.0f} of {seconds:.0f} s, {memory_mb[-1][1]:.0f} MB")
            time.sleep(seconds / SAMPLES_OF_MEMORY)
        busy_s = outside_seconds([*own, *reader_pids, *pids]) - busy_s
        asked_s = time.monotonic()
        after = request("status", endpoint=endpoints["control"], timeout_s=PATIENCE_S)["service"]
        answered_s = time.monotonic() - asked_s
        took_s = (after["t_ns"] - before["t_ns"]) * 1e-9
        shares = [(cpu_seconds(p) - used) / took_s for p, used in zip(pids, used_s, strict=True)]
        stop_readers.set()
        for _ in range(count):
            times, missed = results.get(timeout=60)
            late_s += times
            lost += missed
    rejected = {cause: n - before["rejected"].get(cause, 0) for cause, n in after["rejected"].items()}
    episodes = [sum(service["congestion_episodes"].values()) for service in (before, after)]
    return {
        "ticks_hz": (after["ticks"] - before["ticks"]) / took_s,
        "overruns": after["overruns"] - before["overruns"],
        "p50_ms": 1e3 * float(np.percentile(late_s, 50)),
        "p99_ms": 1e3 * float(np.percentile(late_s, 99)),
        "messages": len(late_s),
        "lost": lost,
        "status_s": answered_s,
        "congestion_episodes": episodes[1] - episodes[0],
        "rejected": {cause: n for cause, n in rejected.items() if n},
        "memory_mb": memory_mb,
        "shares": shares,
        "outside": busy_s / seconds,
        "late": {part: n - before["loop"]["late"].get(part, 0) for part, n in after["loop"]["late"].items()},
    }


def outside_seconds(pids: list[int]) -> float:
    """Return the CPU time that all processes of the machine but these have used."""
    user, nice, system = map(int, Path("/proc/stat").read_text().split()[1:4])
    total_s = (user + nice + system) / os.sysconf("SC_CLK_TCK")
    return total_s - sum(cpu_seconds(pid) for pid in [*pids, os.getpid()])


def over_tcp(config: Path) -> Path:
    """Give a deployment TCP endpoints on free ports."""
    text = config.read_text()
    with ExitStack() as stack:
        for name in ("live", "complete", "control", "inputs"):
            probe = stack.enter_context(socket.socket())
            probe.bind(("127.0.0.1", 0))
            old = getattr(load(config).daemon, name)
            text = text.replace(f'"{old}"', f'"tcp://127.0.0.1:{probe.getsockname()[1]}"')
    config.write_text(text)
    return config


def measure(config: Path, seconds: float) -> dict[str, Any]:
    """Run the daemon with simulated nodes, and both phases."""
    settings = load(config).daemon
    endpoints = {name: getattr(settings, name) for name in ("live", "complete", "control", "inputs")}
    deployment = load(config)
    scenario, started = config.with_name("scenario.toml"), config.with_name("started")
    scenario.write_text(scenario_text([pad.link for _, pad in deployment.pads], [], 0)[0])
    truth = Truth.of_process(scenario, started)
    command = [sys.executable, "-m"]
    played = [*command, "benchmarks.client_checks", str(config), str(scenario), str(started)]
    nodes = subprocess.Popen(played, cwd=ROOT)
    daemon = subprocess.Popen([*command, "handtouch", "run", str(config)], stderr=subprocess.DEVNULL)
    checked = ExitStack()
    try:
        with connect("hand/*", endpoint=endpoints["live"]) as hands:
            hands.recv()
        limit_s = longest_age_s(deployment)
        hand = checked.enter_context(watch_hand(endpoints["live"], endpoints["control"], truth, limit_s))
        ros = checked.enter_context(watch_ros(endpoints["complete"], truth))
        time.sleep(JOINING_S)
        kinds = [kind for kind, (count, _) in HOSTILE.items() for _ in range(count)]
        hostile = phase(
            endpoints,
            [daemon.pid, nodes.pid],
            seconds,
            [(run_hostile, (kind, endpoints, seed)) for seed, kind in enumerate(kinds)],
        )
        time.sleep(LEAVING_S)
        left = {"memory_mb": resident_mb(daemon.pid), "descriptors": descriptors(daemon.pid)}
        burners = [(run_burner, (share,)) for share in hostile["shares"]]
        control = phase(endpoints, [daemon.pid, nodes.pid], seconds, burners)
        found = [hand.finish(), ros.found]
    finally:
        checked.close()
        for process in (daemon, nodes):
            process.terminate()
            process.wait()
    used = {
        kind: sum(share for k, share in zip(kinds, hostile["shares"], strict=True) if k == kind)
        for kind in HOSTILE
    }
    return {
        "seconds": seconds,
        "hostile": hostile,
        "control": control,
        "left": left,
        "used": used,
        "checked": [part.figures() for part in found],
        "contradictions": [text for part in found for text in part.texts],
    }


def verdicts(results: dict[str, Any]) -> dict[str, tuple[float, bool]]:
    """Return each quantity that is limited, and whether it is within its limit."""
    hostile, control = results["hostile"], results["control"]
    rate, tail = hostile["ticks_hz"] / control["ticks_hz"], hostile["p99_ms"] / control["p99_ms"]
    memory = hostile["memory_mb"]
    growth = memory[-1][1] - memory[len(memory) // 3][1]
    return {
        "tick rate, beside hostile clients / beside burners": (rate, rate >= 1 / MAX_RATIO),
        "p99, beside hostile clients / beside burners": (tail, tail <= MAX_RATIO),
        "memory, last two thirds, MB": (growth, growth <= MAX_GROWTH_MB),
        "contradictions of the truth": (wrong := len(results["contradictions"]), wrong == 0),
    }


def page_of(results: dict[str, Any]) -> str:
    """Return the page."""
    rows = []
    for name, title in (("hostile", "15 hostile clients"), ("control", "burners")):
        row = results[name]
        memory = [mb for _, mb in row["memory_mb"]]
        rows.append(
            f"| {title} | {row['ticks_hz']:.1f} | {row['overruns']} "
            f"| {row['p50_ms']:.1f} | {row['p99_ms']:.1f} "
            f"| {row['messages']} | {row['lost']} | {1e3 * row['status_s']:.0f} | {memory[0]:.0f} "
            f"| {memory[len(memory) // 3]:.0f} | {memory[-1]:.0f} |"
        )
    judged = [
        f"| {name} | {value:.3g} | {'yes' if within else '**no**'} |"
        for name, (value, within) in verdicts(results).items()
    ]
    used = ", ".join(f"{kind} {share:.2f}" for kind, share in results["used"].items())
    rejected = ", ".join(f"`{cause}` {n}" for cause, n in results["hostile"]["rejected"].items())
    return f"""# Hostile clients

A daemon without keys, its four endpoints over TCP on loopback, and a simulated hand of 15 pads at 200 Hz;
{WELL_BEHAVED} well-behaved subscribers to `hand/*` beside 15 hostile clients for
{results["seconds"] / 60:.2g} min: 5 read nothing; 5 subscribe without pause, 3 of them
to prefixes without topic, and connect again when they
are disconnected; 3 request `status`, `snapshot` and `tare` with 100 requests under way each; 2 connect and
send random bytes to all endpoints, with 200 connections open each. Then the same subscribers beside processes
that use as much CPU as each hostile client did and don't connect (processors: {used}).
Hostile clients and burners run {ORDINARY_NICE} nice levels below the others, as `handtouch@.service`
puts the daemon before ordinary processes.
Latency is from SYNC to the message in the subscriber.
{machine()}; load average when it ended {os.getloadavg()[0]:.1f}. Processes that don't belong to the test used
{results["hostile"]["outside"]:.2f} processors beside the hostile clients,
{results["control"]["outside"]:.2f} beside the burners: the two can be compared only where these agree.

{HEAD}
{chr(10).join(rows)}

| | | within its limit |
| --- | --- | --- |
{chr(10).join(judged)}

Rejected meanwhile: {rejected}; {results["hostile"]["congestion_episodes"]} congestion episodes.
{chr(10).join(table("What clients showed", CHECKED, results["checked"]))}
{LEAVING_S:.0f} s after the hostile clients left: {results["left"]["memory_mb"]:.0f} MB,
{results["left"]["descriptors"]} descriptors.

{made_by()}.
"""


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    asked = parser.parse_args()
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = over_tcp(on_loopback(Path(folder), PORT + 2))
        results = measure(config, 15.0 if asked.quick else 60 * asked.minutes)
    out = output_folder(asked.quick)
    page = page_of(results)
    print(page)
    print({name: results[name]["late"] for name in ("hostile", "control")})
    (out / "soak_clients.json").write_text(json.dumps(results, indent=1) + "\n")
    (out / "soak_clients.md").write_text(page)
    return int(not all(within for _, within in verdicts(results).values()))


if __name__ == "__main__":
    sys.exit(main())
